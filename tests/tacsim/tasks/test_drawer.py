"""Drawer: how travel and grip are judged, and a policy that finds the grip by touch."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from robot import open_rig
from robot.deploy.control_loop import run_episode
from robot.open import load_with_task
from tacsim.config import load_task
from tacsim.interface import Pose, TactileObservation, Truth
from tacsim.record.episode import Episode
from tacsim.tasks import GoalOutOfReach, make_task
from tacsim.tasks.drawer import Drawer, middle_of_contact, min_pulling_grip

LEAST = (1.5 + 1.0 * 10e-3) / (2 * 0.6)  # friction of the guide, damping at 10 mm/s, friction of the handle [N]


def task(*overrides: str) -> Drawer:
    made = make_task(load_task("drawer", overrides))
    assert isinstance(made, Drawer)
    return made


def truth(travel: float = 0.0, grip: float = 1.3 * LEAST, slip: float = 0.0) -> Truth:
    handle = Pose(np.array([0.0, travel, 66e-3]))
    pads = {
        name: Pose(np.array([x, travel + slip, 66e-3]), np.array([0.0, np.sqrt(0.5), 0.0, np.sqrt(0.5)]))
        for name, x in (("left", -6e-3), ("right", 6e-3))
    }
    return Truth(
        12e-3, handle.position, np.zeros((1, 3), np.float32), pads, {"object": handle}, dict.fromkeys(pads, grip)
    )


def test_the_least_grip_follows_from_resistance_and_friction() -> None:
    assert min_pulling_grip(task().config) == pytest.approx(LEAST)
    assert min_pulling_grip(task("scene.object.friction=0.3").config) == pytest.approx(2 * LEAST)


def test_distance_is_the_travel_that_is_left_and_what_the_grip_is_off() -> None:
    made, start = task(), truth()
    assert made.distance(truth(30e-3), start) == pytest.approx(0.0, abs=1e-12)
    assert made.distance(truth(22e-3), start) == pytest.approx(8e-3)
    assert made.distance(truth(31e-3, LEAST), start) == pytest.approx(1e-3)
    assert made.distance(truth(30e-3, 2.2 * LEAST), start) == pytest.approx(5e-3)  # beyond 1.7 by 0.5, of 10 mm
    assert made.distance(truth(30e-3, 0.8 * LEAST), start) == pytest.approx(2e-3)
    assert made.measures(truth(22e-3), start)["travel"] == pytest.approx(22e-3)


def test_a_handle_that_slipped_does_not_count() -> None:
    made = task()
    slipped = made.distance(truth(30e-3, slip=4.5e-3), truth())
    assert slipped == pytest.approx(made.config.success + 0.5 * made.config.reward_scale)
    assert made.measures(truth(30e-3, slip=2e-3), truth())["slip"] == pytest.approx(2e-3)


def test_the_expert_pulls_as_far_as_is_left() -> None:
    made, start = task(), truth()
    assert made.expert(truth(10e-3), start)[0] == 1.0
    assert made.expert(truth(29.75e-3), start)[0] == pytest.approx(0.5)


@pytest.mark.parametrize(("grip", "asked"), [(6.0, 5.4), (1.6 * LEAST, 1.5 * LEAST), (0.5 * LEAST, 1.5 * LEAST)])
def test_the_expert_lowers_the_grip_to_what_is_wanted(grip: float, asked: float) -> None:
    made = task()
    action = made.expert(truth(grip=grip), truth())
    assert made.grip_axis.target(float(action[1])).force == pytest.approx(asked)


def test_axes_follow_the_guide() -> None:
    made = task("scene.object.guide.axis=x")
    assert made.axes[0].direction == (1.0, 0.0, 0.0)  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["scene.object.guide=null"], "needs a scene whose object has a guide"),
        (["scene=squeeze"], "needs a scene whose object has a guide"),
        (["scene.object.guide.friction=0 N"], "needs resistance and grip"),
        (["goal=61 mm"], "opens by 0.06 m"),
        (["margin=2"], "must be below max_excess"),
    ],
)
def test_what_is_no_drawer_is_refused(overrides: list[str], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        task(*overrides)


def test_a_drawer_too_heavy_for_the_grip_is_out_of_reach() -> None:
    task().require_reachable(truth())
    with pytest.raises(GoalOutOfReach, match="needs a grip of 21"):
        task("scene.object.guide.friction=20 N").require_reachable(truth())


def test_the_middle_of_a_contact_is_that_of_what_is_indented() -> None:
    height = np.zeros((8, 10), np.float32)
    height[2:5, 4:8] = 0.5e-3
    touch = TactileObservation(
        np.zeros((16, 20, 3), np.uint8), height=height, gradient=None, contact=height > 0, valid=height >= 0,
        flow=None, time=0.0, age=0.0,
    )  # fmt: skip
    assert middle_of_contact(touch) == pytest.approx([5.5, 3.0])
    assert middle_of_contact(replace_height(touch, None)) == pytest.approx([0.0, 0.0])


def replace_height(touch: TactileObservation, height: Any) -> TactileObservation:
    return replace(touch, height=height)


def play(motion: str) -> Episode:
    changed = ["task.goal=20 mm", "task.touch_force=3 N", "scene.object.mass=0.1", f"motion={motion}"]
    loaded = load_with_task("hand", "drawer", changed)
    assert loaded.config.task is not None
    made = make_task(loaded.config.task)
    assert isinstance(made, Drawer)
    with open_rig(loaded) as rig:
        episode = run_episode(rig, made.scripted(), made, 50)
    assert episode.steps[0].distance > 20e-3 - 1e-6
    assert episode.steps[-1].distance <= made.config.success
    pulled = [float(np.linalg.norm(step.arms["hand"].wrench[:3])) for step in episode.steps[25:35]]
    assert pulled == pytest.approx([1.51] * len(pulled), rel=0.02)  # a light drawer resists as much as a heavy one
    return episode


@pytest.mark.slow
def test_the_scripted_policy_opens_the_drawer_with_little_grip_at_rest_as_in_time() -> None:
    rested, lived = play("flowing"), play("dynamic")
    for number in (20, 30, 40, 50):
        ours, theirs = rested.steps[number], lived.steps[number]
        assert ours.distance == pytest.approx(theirs.distance, abs=0.2e-3)
        assert ours.grippers["hand"].force == pytest.approx(theirs.grippers["hand"].force, rel=0.01)
