"""A policy that an operator pauses and steps, and motions by hand."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from robot.serve import operated_policy
from robot.serve.operated_policy import MAX_LEAD, OperatedPolicy, make_operated_policy
from tacsim import pose as se3
from tacsim.interface import Action, ArmState, Needs, Observation, Pose

TURNED = se3.from_rotation_vector((0.1, 0.0, 0.2), (np.pi, 0.0, 0.0))  # its z points down
TARGET = Pose([0.0, 0.0, 0.5], [0.0, 0.0, 0.0, 1.0])


class Policy:
    needs = Needs()

    def __init__(self) -> None:
        self.calls = 0

    def reset(self) -> None:
        self.calls = 0

    def __call__(self, observation: Observation) -> Action:
        self.calls += 1
        return Action({"upper": TARGET})


def observe(pose: Pose = TURNED) -> Observation:
    state = ArmState(pose, np.zeros(6), np.zeros(6), None, 0.0)
    return Observation({}, {"upper": state}, 0.0)


def make(policy: Policy | None = None, mode: operated_policy.Mode = "teleoperation") -> OperatedPolicy:
    return OperatedPolicy(policy, mode, 1e-3, 0.01, 3, is_live=True)


def target_of(action: Action) -> Pose:
    target = action.tool["upper"]
    assert target is not None
    return target


def test_pause_and_single_step() -> None:
    policy = Policy()
    operated = make(policy, "paused")
    assert operated(observe()).tool == {} and policy.calls == 0
    operated.set_mode("step")
    assert target_of(operated(observe())) is TARGET and operated.mode == "paused"
    assert operated(observe()).tool == {} and policy.calls == 1


def test_only_steps_of_the_policy_count() -> None:
    operated = make(Policy(), "paused")
    for _ in range(9):
        operated(observe())
    operated.set_mode("policy")
    for _ in range(3):
        assert not operated.has_ended
        operated(observe())
    assert operated.has_ended


def test_jog_moves_along_the_axes_of_the_sensor() -> None:
    operated = make()
    operated.set_jog("upper", np.array([0.5, 0.0, -1.0, 0.0, 0.0, 0.0]))
    target = target_of(operated(observe()))
    np.testing.assert_allclose(target.position - TURNED.position, [0.5e-3, 0.0, 1e-3], atol=1e-12)
    target = target_of(operated(observe()))  # from the last target, not from the measured pose
    np.testing.assert_allclose(target.position - TURNED.position, [1e-3, 0.0, 2e-3], atol=1e-12)


def test_a_target_does_not_run_away_from_an_arm_that_is_held_back() -> None:
    operated = make()
    operated.set_jog("upper", np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0]))
    leads = [se3.pose_distance(target_of(operated(observe())), TURNED)[0] for _ in range(50)]
    assert max(leads) < MAX_LEAD + 1.1e-3
    operated.set_jog("upper", np.array([0.0, 0.0, 0.0, 0.0, 0.0, 1.0]))
    turns = [se3.pose_distance(target_of(operated(observe())), TURNED)[1] for _ in range(50)]
    assert max(turns) < operated_policy.MAX_TURN_LEAD + 0.011


def test_an_old_or_zero_jog_holds(monkeypatch: pytest.MonkeyPatch) -> None:
    operated = make()
    operated.set_jog("upper", np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0]))
    now = operated_policy.time.monotonic()
    monkeypatch.setattr(operated_policy.time, "monotonic", lambda: now + operated_policy.JOG_LIFETIME + 0.01)
    assert operated(observe()).tool == {}
    operated.set_jog("upper", np.zeros(6))
    assert operated(observe()).tool == {}


@pytest.mark.parametrize("jog", [[1.5, 0, 0, 0, 0, 0], [np.nan, 0, 0, 0, 0, 0], [1.0, 0.0]])
def test_wrong_jogs_are_refused(jog: list[float]) -> None:
    with pytest.raises(ValueError, match="6 numbers from -1 to 1"):
        make().set_jog("upper", np.array(jog, np.float64))


def test_there_is_no_policy_in_a_motion_by_hand() -> None:
    operated = make()
    with pytest.raises(ValueError, match="no episode runs"):
        operated.set_mode("policy")
    operated.set_mode("paused")
    assert operated.mode == "paused"


def test_a_paused_simulation_waits_until_it_is_ended() -> None:
    operated = OperatedPolicy(Policy(), "paused", 1e-3, 0.01, None, is_live=False)
    done = threading.Event()
    thread = threading.Thread(target=lambda: (operated(observe()), done.set()), daemon=True)
    thread.start()
    assert not done.wait(0.1)
    operated.end()
    assert done.wait(10.0) and operated.has_ended


def test_motion_by_hand_keeps_its_speed_at_any_period_and_the_step_of_the_task() -> None:
    for period, max_step, expected in ((0.1, None, 0.5e-3), (0.02, None, 0.1e-3), (0.1, 0.2e-3, 0.2e-3)):
        operated = make_operated_policy(None, "teleoperation", period, max_step, None, is_live=True)
        operated.set_jog("upper", np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0]))
        assert se3.pose_distance(target_of(operated(observe())), TURNED)[0] == pytest.approx(expected)
