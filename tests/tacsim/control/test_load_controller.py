"""Arms that hold a load: on springs, with noise, tilted, shortened by limits, out of reach, and on simulated gels."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from robot.open import open_rig
from tacsim import pose as se3
from tacsim.config import ConfigError, load_rig
from tacsim.control.load_controller import LoadController, load_controller
from tacsim.control.tuning import LOAD_TOLERANCE, MAX_TRAVEL
from tacsim.interface import Action, ArmState, Pose
from tacsim.limits import LimitExceeded
from tacsim.models.rig import RepositionConfig, SqueezeConfig

STIFFNESS, LOAD, LONGEST = 3e3, 2.0, 0.2e-3  # [N/m], [N], [m]


class Wall:
    """One sensor against an elastic wall across its z; it goes where it is sent."""

    def __init__(self, stiffness: float = STIFFNESS, start: Pose | None = None, noise: float = 0.0) -> None:
        self.stiffness, self.noise = stiffness, noise
        self.start = self.pose = Pose() if start is None else start
        self.rng = np.random.default_rng(3)

    @property
    def depth(self) -> float:
        return float(se3.relative_pose(self.start, self.pose).position[2])

    @property
    def force(self) -> float:
        return max(0.0, 1.0 + self.stiffness * self.depth)

    def state(self) -> ArmState:
        felt = np.array([0.0, 0.0, -self.force + self.noise * self.rng.standard_normal(), 0.0, 0.0, 0.0])
        return ArmState(self.pose, np.zeros(6), felt, None, 0.0)

    def period(self, held: LoadController, asked: Pose | None, share: float = 1.0) -> None:
        """share: of the way that its limits leave."""
        target = held(Action({"hand": asked}), {"hand": self.state()}).tool["hand"]
        assert target is not None
        self.pose = se3.interpolate_pose(self.pose, target, share)
        held.record_sent_poses({"hand": self.pose})


def holding(load: float = LOAD) -> LoadController:
    return LoadController({"hand": load}, LONGEST)


@pytest.mark.parametrize("stiffness", [300.0, 3e3, 3e4])
@pytest.mark.parametrize("load", [0.3, 2.0])
def test_a_load_is_reached_and_then_rests(stiffness: float, load: float) -> None:
    wall, held = Wall(stiffness), holding(load)
    way = abs(load - 1.0) / stiffness
    for _ in range(6 + int(way / LONGEST)):
        wall.period(held, None)
    assert wall.force == pytest.approx(load, rel=LOAD_TOLERANCE)
    rests = wall.pose
    wall.period(held, None)
    assert np.array_equal(wall.pose.position, rests.position)


def test_only_the_way_along_z_of_the_sensor_is_replaced() -> None:
    turned = Rotation.from_rotvec([0.3, -0.2, 0.7])
    wall, held = Wall(start=Pose(np.array([0.1, 0.2, 0.3]), turned.as_quat())), holding()
    x, _, z = turned.as_matrix().T
    for count in range(1, 9):
        wall.period(held, Pose(wall.start.position + count * 0.1e-3 * x - 0.4e-3 * z, turned.as_quat()))
        moved = se3.relative_pose(wall.start, wall.pose).position
        assert moved[:2] == pytest.approx([count * 0.1e-3, 0.0], abs=1e-12)
    assert wall.force == pytest.approx(LOAD, rel=LOAD_TOLERANCE)


def test_no_correction_is_longer_than_allowed() -> None:
    wall, held = Wall(100.0), holding()
    for _ in range(20):
        before = wall.depth
        wall.period(held, None)
        assert abs(wall.depth - before) <= LONGEST * (1 + 1e-9)


def test_noise_of_the_force_does_not_build_up() -> None:
    wall, held = Wall(noise=0.1), holding()
    forces = []
    for _ in range(200):
        wall.period(held, None)
        forces.append(wall.force)
    assert np.mean(forces[20:]) == pytest.approx(LOAD, abs=0.1)
    assert np.std(forces[20:]) < 0.25


def test_what_limits_shorten_is_not_wound_up() -> None:
    wall, held = Wall(), holding()
    for _ in range(50):
        wall.period(held, None, share=0.0)  # nothing is let through
    depths = []
    for _ in range(10):
        wall.period(held, None)
        depths.append(wall.depth)
    assert max(depths) <= (LOAD - 1.0) / STIFFNESS * 1.5
    assert wall.force == pytest.approx(LOAD, rel=LOAD_TOLERANCE)


def test_an_arm_with_nothing_to_press_stops_and_says_so() -> None:
    wall, held = Wall(stiffness=0.0), holding()
    for _ in range(249):  # corrections of a tenth of the longest, as no stiffness shows
        wall.period(held, None)
    with pytest.raises(LimitExceeded, match=r"'hand' does not reach its load of 2 N: it feels 1 N after \+5.* mm"):
        _twice(wall, held)
    assert 0.9 * MAX_TRAVEL < wall.depth <= MAX_TRAVEL
    held.reset()
    wall.period(held, None)  # a new episode begins anew


def _twice(wall: Wall, held: LoadController) -> None:
    wall.period(held, None)
    wall.period(held, None)


@pytest.mark.parametrize("felt", [np.nan, np.inf])
def test_a_force_that_is_no_number_moves_nothing(felt: float) -> None:
    state = ArmState(Pose(), np.zeros(6), np.array([0.0, 0.0, felt, 0.0, 0.0, 0.0]), None, 0.0)
    with pytest.raises(LimitExceeded, match=r"but feels (nan|-?inf) N"):
        holding()(Action({}), {"hand": state})


def test_only_tasks_that_name_loads_hold_them() -> None:
    assert load_controller(None) is None
    assert load_controller(SqueezeConfig(kind="squeeze")) is None
    assert load_controller(RepositionConfig(kind="reposition")) is None
    held = load_controller(RepositionConfig(kind="reposition", loads={"upper": 2.0}))
    assert held is not None and held.loads == {"upper": 2.0}


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("task.loads={uper: 2 N}", "no arm 'uper'; allowed: lower, upper"),
        ("task.loads={upper: 0 N}", "out of range"),
        ("task.loads={upper: 2 mm}", "force"),
    ],
)
def test_rig_files_name_loads_of_their_arms(override: str, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        load_rig("sim", task="reposition", overrides=[override])


def test_a_load_at_which_the_arm_stops_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"task\.loads\.upper: arm 'upper' stops at limits\.force, 60 N"):
        load_rig("mock", task="reposition", overrides=["task.loads={upper: 60 N}"])


def test_a_rig_holds_the_load_whatever_the_policy_asks_along_z(open_springs: Callable[..., Any]) -> None:
    rig = open_springs("reposition", "task.loads={upper: 2 N}")
    before = rig.reset().arms["upper"]
    assert -before.wrench[2] == pytest.approx(1.0, rel=0.2)  # touch_force
    for count in range(1, 8):
        asked = Pose(before.pose.position + [count * 0.1e-3, 0.0, 1e-3], before.pose.quaternion)
        observation, sent = rig.step(Action({"upper": asked}))
    arm = observation.arms["upper"]
    assert -arm.wrench[2] == pytest.approx(2.0, rel=LOAD_TOLERANCE)
    assert arm.pose.position[:2] == pytest.approx(before.pose.position[:2] + [0.7e-3, 0.0], abs=1e-9)
    assert sent["upper"] is not None and sent["upper"].position[2] == arm.pose.position[2]
    rig.step(Action())  # an arm that the policy holds goes on holding its load
    assert np.array_equal(rig.reset().arms["upper"].pose.position, before.pose.position)


@pytest.mark.slow
def test_the_gels_hold_it_too_while_the_body_is_dragged() -> None:
    config = load_rig("sim", task="reposition", overrides=["task.loads={upper: 2 N}", "task.scene.preset=draft"])
    forces = []
    with open_rig(config) as rig:
        arm = rig.reset().arms["upper"]
        for count in range(1, 9):
            asked = Pose(arm.pose.position + [count * 0.1e-3, 0.0, 0.0], arm.pose.quaternion)
            observation, _ = rig.step(Action({"upper": asked}))
            forces.append(-observation.arms["upper"].wrench[2])
    assert forces[3:] == pytest.approx([2.0] * 5, rel=0.03)
