"""Peg: how a bar over and in a hole is judged, and a policy that finds the hole by touch."""

from __future__ import annotations

import math

import numpy as np
import pytest

from robot import open_rig
from robot.deploy.control_loop import run_episode
from robot.open import load_with_task
from tacsim import pose as se3
from tacsim.config import load_task
from tacsim.interface import ArmState, FloatArray, Observation, Pose, Truth
from tacsim.models.task import PegConfig
from tacsim.tasks import make_task
from tacsim.tasks.peg import Peg
from tacsim.tasks.peg_policy import ScriptedPeg

DEPTH, LENGTH = 10e-3, 40e-3  # of the shipped task [m]
TURNED = ("scene.fixtures.hole.position=[1 mm, -2 mm, 20 mm]", "scene.fixtures.hole.roll=3 deg")


def task(*overrides: str) -> Peg:
    made = make_task(load_task("peg", overrides))
    assert isinstance(made, Peg)
    return made


def hole(made: Peg) -> Pose:
    fixture = made.config.scene.fixtures["hole"]
    return Pose(np.array(fixture.position), fixture.turn)


def truth(bar: Pose, grip: FloatArray | None = None) -> Truth:
    """A bar, and pads around the point `grip` of it, by default 2 mm above its centre."""
    middle = se3.transform(bar, np.array([0.0, 0.0, 2e-3])) if grip is None else grip
    turn = se3.compose(bar, Pose(quaternion=np.array([0.0, math.sqrt(0.5), 0.0, math.sqrt(0.5)]))).quaternion
    pads = {name: Pose(middle + [sign * 5e-3, 0.0, 0.0], turn) for name, sign in (("left", -1.0), ("right", 1.0))}
    return Truth(LENGTH, bar.position, np.zeros((1, 3), np.float32), pads, {"object": bar}, dict.fromkeys(pads, 12.0))


def in_hole(made: Peg, depth: float, sideways: float = 0.0) -> Truth:
    """The bar upright in the hole, its end at a depth."""
    return truth(se3.compose(hole(made), Pose(np.array([sideways, 0.0, LENGTH / 2 - depth]))))


@pytest.mark.parametrize("overrides", [(), TURNED])
def test_distance_is_that_of_the_end_from_its_goal_in_the_hole(overrides: tuple[str, ...]) -> None:
    made = task(*overrides)
    start = in_hole(made, -4e-3)
    assert made.distance(in_hole(made, DEPTH), start) == pytest.approx(0.0, abs=1e-12)
    assert made.distance(in_hole(made, 7e-3), start) == pytest.approx(3e-3)
    assert made.distance(in_hole(made, 7e-3, 4e-3), start) == pytest.approx(5e-3)
    assert made.measures(in_hole(made, 7e-3), start)["depth"] == pytest.approx(7e-3)


def test_a_bar_that_slipped_in_the_grip_does_not_count() -> None:
    made = task()
    start, there = in_hole(made, -4e-3), in_hole(made, DEPTH)
    grip = next(iter(there.objects.values())).position + [0.0, 0.0, 2e-3 + 2 * made.config.max_slip]
    assert made.distance(there, start) < made.config.success
    slipped = truth(next(iter(there.objects.values())), grip)
    assert made.distance(slipped, start) == pytest.approx(made.config.success + made.config.reward_scale)


def test_the_expert_goes_over_the_hole_then_along_its_axis() -> None:
    made = task(*TURNED)
    start = in_hole(made, -4e-3)
    aside = made.expert(in_hole(made, -4e-3, 2e-3), start)
    assert se3.rotate(se3.inverse(hole(made)), aside[:3]) == pytest.approx([-1.0, 0.0, 0.0], abs=0.01)
    down = made.expert(start, start)
    assert se3.rotate(se3.inverse(hole(made)), down[:3]) == pytest.approx([0.0, 0.0, -1.0], abs=0.01)
    on_block = made.expert(in_hole(made, 0.0, 0.5e-3), start)
    assert on_block[2] == pytest.approx(0.0, abs=1e-9) or on_block[2] > 0
    assert made.expert(in_hole(made, DEPTH), start)[:3] == pytest.approx([0.0, 0.0, 0.0], abs=1e-9)


@pytest.mark.parametrize("place", [(4e-3, 0.0), (0.0, -5e-3), (-2e-3, 3e-3)])
def test_support_is_where_the_block_presses_the_bar(place: tuple[float, float]) -> None:
    made = task()
    policy = made.scripted()
    assert isinstance(policy, ScriptedPeg)
    force = np.array([0.7, -1.1, 5.0])
    moment = np.cross([*place, -(LENGTH / 2 + 2e-3)], force)
    assert policy.support(force, moment) == pytest.approx(place)


@pytest.mark.parametrize("direction", [-1.0, 1.0])
def test_the_teacher_goes_on_from_where_a_learned_policy_moved_the_hand(direction: float) -> None:
    """It searches in the direction of the last motion; the scripted policy goes on from where it sent the hand."""
    made = task()
    policies, targets = (made.teacher(), made.scripted()), np.zeros((2, 3))  # [mm]
    down = se3.from_rotation_vector(np.zeros(3), [math.pi, 0.0, 0.0]).quaternion
    for x, height, press in ((0.0, 50.0, 0.0), (0.0, 46.0, 5.0), (0.0, 47.0, 0.0), (0.4 * direction, 46.0, 5.0)):
        wrench = np.array([0.0, 0.0, -press, 0.0, 0.0, 0.0])  # in the hand's axes: z points down
        pose = Pose(1e-3 * np.array([x, 0.0, height]), down)
        arms = {"hand": ArmState(pose, np.zeros(6), wrench, None, 0.0)}
        for number, policy in enumerate(policies):
            target = policy(Observation({}, arms, 0.0)).tool["hand"]
            assert target is not None
            targets[number] = 1e3 * target.position
    assert targets[0] == pytest.approx([0.8 * direction, 0.0, 47.0])
    assert targets[1, 0] == pytest.approx(0.8)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["scene.fixtures={}"], "one fixture of shape socket, this one has 0"),
        (["scene=hold"], "one fixture of shape socket, this one has 0"),
        (["scene=squeeze"], "whose object is a box or a cylinder"),
        (["scene.object.geometry={shape: sphere, radius: 4 mm}"], "whose object is a box or a cylinder"),
        (
            ["scene.object.geometry={shape: box, size: [10.5 mm, 8 mm, 40 mm]}"],
            r"10.5 x 8 mm wide and its hole 10.5 x 10.5 mm",
        ),
        (["goal=41 mm"], "more than the object's length"),
    ],
)
def test_what_no_peg_fits_into_is_refused(overrides: list[str], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        task(*overrides)


def test_two_holes_are_refused() -> None:
    shipped = load_task("peg")
    assert isinstance(shipped, PegConfig)
    fixtures = {"hole": shipped.scene.fixtures["hole"], "other": shipped.scene.fixtures["hole"]}
    scene = shipped.scene.model_copy(update={"fixtures": fixtures})
    with pytest.raises(ValueError, match="this one has 2"):
        make_task(shipped.model_copy(update={"scene": scene}))


@pytest.mark.slow
def test_the_scripted_policy_stops_in_a_hole_that_is_right_below() -> None:
    """The bar goes in without a touch: what is met next is not the mouth of the hole."""
    loaded = load_with_task("hand", "peg", [])
    assert loaded.config.task is not None
    made = make_task(loaded.config.task)
    with open_rig(loaded) as rig:
        episode = run_episode(rig, made.scripted(), made, 25)
    assert max(step.distance for step in episode.steps[16:]) <= made.config.success


@pytest.mark.slow
def test_the_scripted_policy_finds_a_hole_that_is_aside_and_turned() -> None:
    """By force and moment alone: the hole is 1.6 mm aside, where a bar that goes straight down rests on the block."""
    hole = "scene.fixtures.hole"
    place = [f"{hole}.position=[-1.04 mm, 1.22 mm, 20 mm]", f"{hole}.roll=-0.75 deg", f"{hole}.pitch=-0.84 deg"]
    loaded = load_with_task("hand", "peg", place)
    assert loaded.config.task is not None
    made = make_task(loaded.config.task)
    with open_rig(loaded) as rig:
        episode = run_episode(rig, made.scripted(), made, 60)
    assert episode.steps[0].distance > 13e-3
    assert episode.steps[-1].distance <= made.config.success
    assert max(abs(step.arms["hand"].wrench[2]) for step in episode.steps) < 12.0
