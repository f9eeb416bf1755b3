"""Tasks with a rigid object in a gripper: distances on made-up truths, and the scripted policies in MuJoCo."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from robot.open import load_with_task, open_rig
from tacsim import Task, Truth, evaluate_outcome, load_task, make_task
from tacsim.gym.features import FeatureEncoder
from tacsim.interface import ArmState, GripperState, Observation, Pose, TactileObservation
from tacsim.models.policy import Features
from tacsim.models.sensor import CanonicalGrid
from tacsim.models.task import HoldConfig, TurnConfig
from tacsim.tasks import GoalOutOfReach
from tacsim.tasks.rigid import slip_of, turn_in_grip
from tacsim.tasks.tuning import FORCE_DECREASE, GRIP_RULE
from tacsim.tasks.turn import TurnEstimate

# The pads look at each other along world x; their y axes point down, as on a hand above a table.
LEFT = Pose(np.array([-8e-3, 0.0, 0.1]), Rotation.from_matrix(np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0.0]])).as_quat())
RIGHT = Pose(
    np.array([8e-3, 0.0, 0.1]), Rotation.from_matrix(np.array([[0, 0, -1], [-1, 0, 0], [0, 1, 0.0]])).as_quat()
)


def truth(position: tuple[float, float, float] = (0, 0, 0.1), turn: float = 0.0, force: float = 5.0) -> Truth:
    """An object between the pads, turned about the line between them [rad], gripped with `force` [N]."""
    pose = Pose(np.array(position), Rotation.from_rotvec([turn, 0.0, 0.0]).as_quat())
    return Truth(
        height=0.01, position=pose.position, points=np.zeros((0, 3), np.float32), poses={"left": LEFT, "right": RIGHT},
        objects={"object": pose}, forces={"left": force, "right": force},
    )  # fmt: skip


def task(name: str) -> Task:
    return make_task(load_task(name))


def test_slip_is_that_of_what_was_gripped_and_not_of_the_centre() -> None:
    start = truth((0, -0.012, 0.1))  # gripped 12 mm off its centre
    assert slip_of(truth((0, -0.012, 0.097)), start) == pytest.approx(3e-3)
    turned = truth((0, -0.012 * math.cos(0.5), 0.1 - 0.012 * math.sin(0.5)), turn=0.5)
    assert slip_of(turned, start) == pytest.approx(0.0, abs=1e-9)
    assert abs(turn_in_grip(turned, start)) == pytest.approx(0.5)
    carried = replace(
        turned, poses={name: Pose(pad.position + 0.1, pad.quaternion) for name, pad in start.poses.items()}
    )
    moved = Pose(turned.objects["object"].position + 0.1, turned.objects["object"].quaternion)
    assert slip_of(replace(carried, objects={"object": moved}), start) == pytest.approx(0.0, abs=1e-9)


def test_hold_wants_little_more_than_the_force_that_holds() -> None:
    hold, start = task("hold"), truth()
    assert isinstance(hold.config, HoldConfig)
    needed = 0.1 * 9.81 / (2 * 0.6)  # m g / (2 mu) of the shipped scene
    assert hold.distance(truth(force=1.25 * needed), start) == pytest.approx(0.0, abs=1e-9)
    assert hold.distance(truth(force=2.25 * needed), start) == pytest.approx(1.0)
    assert hold.distance(truth(force=needed), start) == pytest.approx(0.25)
    assert not evaluate_outcome(hold, truth(force=needed), start).success
    slipped = truth((0, 0, 0.1 - 6e-3), force=1.25 * needed)  # twice max_slip
    assert hold.distance(slipped, start) == pytest.approx(hold.config.success + hold.config.reward_scale)
    for force, wanted in ((5.0, 0.92 * 5.0), (1.26 * needed, 1.25 * needed), (0.5, 1.25 * needed)):
        best = hold.expert(truth(force=force), start)
        assert best is not None and hold.grip_axis.target(float(best[0])).force == pytest.approx(wanted)  # type: ignore[attr-defined]
    assert hold.measures(slipped, start) == pytest.approx({"slip": 6e-3, "grip_force": 1.25 * needed})


def held(force: float | None, weight: float, rim: float) -> Observation:
    """A box of this weight [N], gripped by this force [N]: its markers have a flow of 0.2 mm, those at the rim differ
    from their neighbours by `rim` of that."""
    flow = np.zeros((9, 11, 2), np.float32)
    flow[..., 1] = 0.2e-3
    flow[0, :, 1] -= rim * 0.2e-3
    grid = np.zeros((64, 64))
    touch = TactileObservation(
        np.zeros((128, 128, 3), np.uint8), gradient=None, height=None, contact=grid > 0, valid=grid == 0, flow=flow,
        time=0.0, age=0.0,
    )  # fmt: skip
    arm = ArmState(Pose(), np.zeros(6), np.array([0.0, 0.6 * weight, 0.8 * weight, 0, 0, 0]), None, 0.0)
    gripper = GripperState(width=0.02, force=force, time=0.0)
    return Observation({"left": touch, "right": touch}, {"hand": arm}, 0.0, grippers={"hand": gripper})


def test_the_rule_for_hold_asks_for_less_the_less_the_rim_slips() -> None:
    rule = make_task(load_task("hold")).analytic()
    scale, of_force, of_flow = GRIP_RULE

    def asked(force: float | None, rim: float) -> float:
        grip = rule(held(force, 1.0, rim)).grippers["hand"]
        assert grip is not None
        return grip.force

    excess = scale * 2.0**of_force * 0.1**of_flow
    assert asked(2.0, 0.1) == pytest.approx(2.0 * 1.25 / excess)
    assert asked(2.0, 0.1) > 2.0 > asked(2.0, 0.9) == pytest.approx(FORCE_DECREASE * 2.0)
    with pytest.raises(ValueError, match="measures its force"):
        asked(None, 0.1)


def test_hold_refuses_an_object_that_no_force_of_the_task_holds() -> None:
    heavy = load_task("hold").model_copy(update={"force_range": (0.2, 0.9)})
    with pytest.raises(GoalOutOfReach, match=r"needs a grip of 1.02 N, and the task's force_range is 0.2 to 0.9 N"):
        make_task(heavy).require_reachable(truth())
    with pytest.raises(ValueError, match="the first must be below the second"):
        HoldConfig(kind="hold", force_range=(2.0, 2.0))


def test_turn_judges_the_angle_whichever_way_it_turns() -> None:
    turn, start = task("turn"), truth()
    assert isinstance(turn.config, TurnConfig)
    for angle in (-20.0, 20.0):
        assert turn.distance(truth(turn=math.radians(angle)), start) == pytest.approx(math.radians(10.0))
    assert evaluate_outcome(turn, truth(turn=math.radians(28)), start).success


def edge_seen(angle: float) -> Observation:
    """A gel with the edges of a bar, turned by an angle [rad]."""
    y, x = np.mgrid[-8e-3:8e-3:64j, -8e-3:8e-3:64j]
    across = -x * np.sin(angle) + y * np.cos(angle)
    slope = np.exp(-(((np.abs(across) - 3e-3) / 1e-3) ** 2)) * np.sign(across)
    gradient = np.stack([-np.sin(angle) * slope, np.cos(angle) * slope], axis=-1).astype(np.float32)
    whole = np.ones((64, 64), np.bool_)
    touch = TactileObservation(
        np.zeros((128, 128, 3), np.uint8), gradient=gradient, height=np.zeros((64, 64), np.float32), contact=whole,
        valid=whole, flow=None, time=0.0, age=0.0,
    )  # fmt: skip
    return Observation({"left": touch}, {}, 0.0)


def test_the_turn_is_seen_by_the_edges_in_the_gel_past_a_quarter_turn() -> None:
    estimate = TurnEstimate()
    for angle in np.radians(np.arange(0.0, 121.0, 10.0)):
        assert estimate(edge_seen(angle)) == pytest.approx(angle, abs=math.radians(1.0))
    blank = edge_seen(0.0).tactile["left"]
    assert estimate(Observation({"left": replace(blank, contact=~blank.contact)}, {}, 0.0)) == pytest.approx(
        math.radians(120.0), abs=math.radians(1.0)
    )
    assert TurnEstimate()(Observation({"left": replace(blank, contact=~blank.contact)}, {}, 0.0)) is None


def test_a_learned_policy_sees_the_turn_of_the_edges_with_its_sign() -> None:
    asked = FeatureEncoder(
        Features(sensors=("left",), arms=(), maps=(), touch=("turned",), goal=False, frames=2), CanonicalGrid()
    )
    assert asked.needs.height and asked.inputs["touch"].names == ("turned_left -1", "turned_left")
    assert asked.begin(edge_seen(0.3))["touch"].tolist() == [0.0, 0.0]
    for angle in (0.9, 1.5, 2.1):  # past a quarter turn
        seen = asked(edge_seen(angle))["touch"]
    assert seen == pytest.approx([2.4, 3.6], abs=0.04)  # over 0.5 rad
    assert asked.begin(edge_seen(0.3))["touch"].tolist() == [0.0, 0.0]  # another episode
    assert asked(edge_seen(-0.2))["touch"][1] == pytest.approx(-1.0, abs=0.04)


def test_the_teacher_of_a_turn_goes_on_from_the_force_that_there_is() -> None:
    turn, grips = task("turn"), {"hand": GripperState(0.02, 2.0, 0.0)}
    for policy, force in ((turn.teacher(), 2.0), (turn.scripted(), turn.config.touch_force)):
        policy.reset()
        target = policy(replace(edge_seen(0.0), grippers=grips)).grippers["hand"]
        assert target is not None and target.force == pytest.approx(0.95 * force)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "overrides"),
    [
        ("hold", ["scene.object.mass=0.05", "scene.object.friction=0.8"]),
        ("turn", ["scene.object.mass=0.12", "scene.object.friction=0.5", "task.goal=20 deg"]),
    ],
)
def test_the_scripted_policy_reaches_the_goal_by_touch(name: str, overrides: list[str]) -> None:
    pytest.importorskip("mujoco")
    loaded = load_with_task("hand", name, ["scene.preset=learn", *overrides])
    made = make_task(loaded.config.task)  # type: ignore[arg-type]
    with open_rig(loaded) as rig:
        observation, policy = rig.reset(), made.scripted()
        start = rig.truth()
        assert start is not None
        rig.require(policy.needs, "the policy")
        policy.reset()
        for _ in range(made.config.steps):
            observation, _ = rig.step(policy(observation))
        end = rig.truth()
    assert end is not None
    assert evaluate_outcome(made, end, start).success, (made.distance(end, start), made.measures(end, start))
    assert made.measures(end, start)["slip"] < made.config.max_slip  # type: ignore[attr-defined]
