"""The task `lengthen`: the length of a body, its teacher and its estimate by touch."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from robot.open import make_env
from tacsim.geometry.shapes import lattice_particles
from tacsim.interface import Truth
from tacsim.models.scene import Body, Box, Scene
from tacsim.models.sensor import CanonicalGrid
from tacsim.models.task import LengthenConfig
from tacsim.pose import Pose
from tacsim.tasks import GoalOutOfReach, Lengthen, evaluate_outcome
from tacsim.tasks.lengthen import LengthEstimate, pressed_extent
from tacsim.tasks.tuning import LENGTH_RULE
from tests.tacsim.gym.small import SMALL

BOX = Box(size=(8e-3, 6e-3, 10e-3))


def task(goal: float = 9e-3) -> Lengthen:
    return Lengthen(LengthenConfig(kind="lengthen", goal=goal, scene=Scene(body=Body(geometry=BOX))))


def truth(scale: float = 1.0, gap: float = 10e-3) -> Truth:
    points = (lattice_particles(BOX, 0.5e-3) * [scale, 1.0, 1.0]).astype(np.float32)
    poses = {"lower": Pose(), "upper": Pose(np.array([0.0, 0.0, gap]))}
    return Truth(10e-3, np.zeros(3), points, poses)


def test_length_is_that_of_the_box() -> None:
    assert task().length(truth()) == pytest.approx(8e-3, rel=1e-5)
    assert task(8.6e-3).distance(truth(), truth()) == pytest.approx(0.6e-3, rel=1e-4)
    assert evaluate_outcome(task(8.25e-3), truth(), truth()).success
    assert not evaluate_outcome(task(8.35e-3), truth(), truth()).success


@pytest.mark.parametrize("goal", [7.6e-3, 20.5e-3])
def test_goal_out_of_reach_is_refused(goal: float) -> None:
    with pytest.raises(GoalOutOfReach, match="give a goal between them"):
        task(goal).require_reachable(truth())


def test_teacher_closes_by_what_is_left_over_the_growth() -> None:
    """It has grown by 0.25 of 2 mm closed; 0.1 mm are left, so the gap closes by another 0.4 mm: each sensor by its
    greatest step, 0.2 mm. Too long: it opens."""
    grown = truth(scale=(8.5 - 0.5) / 7.5, gap=8e-3)  # particle centres span 7.5 mm at first
    assert task(8.6e-3).expert(grown, truth()) == pytest.approx([1.0, -1.0], rel=1e-3)
    assert task(8.525e-3).expert(grown, truth()) == pytest.approx([0.25, -0.25], rel=1e-3)
    assert task(8.4e-3).expert(grown, truth())[0] < 0


def test_estimate_follows_volume_and_contact() -> None:
    """A plateau of 20 columns, of 0.25 mm, in a wider shallow rim; later of 22, and the gap is 4 mm instead of 9 mm."""
    constant, of_volume, of_contact = LENGTH_RULE

    def observation(columns: int, gap: float) -> Any:
        height = np.zeros((64, 64), np.float32)
        height[20:40, 5:55] = 0.1e-3
        height[20:40, 20 : 20 + columns] = 0.4e-3
        touch = SimpleNamespace(height=height, valid=np.ones_like(height, bool), contact=height > 0)
        arms = {"lower": SimpleNamespace(pose=Pose()), "upper": SimpleNamespace(pose=Pose(np.array([0.0, 0.0, gap])))}
        return SimpleNamespace(tactile={"lower": touch, "upper": touch}, arms=arms)

    first, later = observation(20, 9e-3), observation(22, 4e-3)
    assert pressed_extent(first, CanonicalGrid()) == pytest.approx(20 * 0.25e-3)
    estimate = LengthEstimate(CanonicalGrid())
    assert estimate(first) == pytest.approx(constant + (of_volume + of_contact) * 5e-3)
    by_volume = 5e-3 * np.sqrt(9.8 / 4.8)  # heights: gap and twice 0.4 mm
    assert estimate(later) == pytest.approx(constant + of_volume * by_volume + of_contact * 5.5e-3)


def face(depth: float, noise: float, seed: int = 0) -> Any:
    """A face of 9 mm, in heights with noise."""
    height = np.zeros((64, 64), np.float32)
    height[14:50, 14:50] = depth
    height += np.random.default_rng(seed).normal(0.0, noise, height.shape).astype(np.float32)
    touch = SimpleNamespace(height=height, valid=np.ones_like(height, bool))
    arms = {"lower": SimpleNamespace(pose=Pose()), "upper": SimpleNamespace(pose=Pose(np.array([0.0, 0.0, 9e-3])))}
    return SimpleNamespace(tactile={"lower": touch, "upper": touch}, arms=arms)


@pytest.mark.parametrize("seed", range(5))
def test_extent_of_a_press_withstands_noise(seed: int) -> None:
    """With seeds 1 and 4 the outermost pressed points are 12.5 and 13 mm apart."""
    assert pressed_extent(face(50e-6, 18e-6, seed), CanonicalGrid()) == pytest.approx(9e-3, abs=0.5e-3)


def test_light_touch_is_no_measurement_and_the_rule_closes_on() -> None:
    """The first reading that counts is that of the press: the same as without the light touch before."""
    assert pressed_extent(face(10e-6, 5e-6), CanonicalGrid()) == 0.0
    estimate, alone = LengthEstimate(CanonicalGrid()), LengthEstimate(CanonicalGrid())
    assert estimate(face(10e-6, 5e-6)) is None
    assert estimate(face(100e-6, 5e-6)) == alone(face(100e-6, 5e-6))
    rule = task().analytic()
    rule.reset()
    lower = rule(face(10e-6, 5e-6)).tool["lower"]
    assert lower is not None and lower.position[2] == pytest.approx(task().config.max_step)


@pytest.mark.slow
def test_teacher_reaches_the_goal_in_simulation() -> None:
    words = [word for word in SMALL if not word.startswith("task.")]
    words += ["task.goal=3.5 mm", "task.steps=20", "scene.body.material=soft-clay", "motion=flowing"]
    env = make_env("lengthen", overrides=words)
    _, start = env.reset(seed=0)
    for _ in range(20):
        info = env.step(env.expert())[4]
    env.close()
    assert start["distance"] == pytest.approx(0.5e-3, abs=0.1e-3)
    assert info["distance"] < 0.05e-3 and info["is_success"]
