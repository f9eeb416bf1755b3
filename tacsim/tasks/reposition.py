"""Reposition: move the body in the plane by moving the upper sensor in world x and y."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from tacsim import pose as se3
from tacsim.interface import Action, ArmState, FloatArray, Needs, Observation, Policy, Pose, Truth
from tacsim.models.sensor import CanonicalGrid
from tacsim.models.task import RepositionConfig
from tacsim.tasks.task import Axis, Estimator, GoalOutOfReach, Task
from tacsim.tasks.tuning import ARRIVAL_DISTANCE, MIN_FORCE


@dataclass(frozen=True, slots=True)
class Reposition(Task):
    """distance = ||position - goal||_2, position = centre of mass minus its value at reset, world x and y."""

    config: RepositionConfig

    def require_reachable(self, start: Truth) -> None:
        there = start.position + [*self.config.goal, 0.0] - start.poses["lower"].position if start.poses else None
        half = np.array(self.config.scene.gel_of("lower").size[:2]) / 2
        if there is not None and (np.abs(there[:2]) > half).any():
            goal = ", ".join(f"{1e3 * each:g}" for each in self.config.goal)
            raise GoalOutOfReach(
                f"task.goal: the body would leave the gel of sensor 'lower' if it moved by ({goal}) mm, which reaches "
                f"{1e3 * half[0]:g} and {1e3 * half[1]:g} mm from its middle; give a nearer goal"
            )

    @property
    def touch_needs(self) -> Needs:
        return Needs(arms=frozenset({"lower", "upper"}))

    @property
    def axes(self) -> tuple[Axis, ...]:
        return (Axis("upper", (1.0, 0.0, 0.0)), Axis("upper", (0.0, 1.0, 0.0)))

    @property
    def goal(self) -> tuple[float, float]:
        return self.config.goal

    def distance(self, truth: Truth, start: Truth) -> float:
        moved = truth.position[:2] - start.position[:2]
        return math.hypot(moved[0] - self.config.goal[0], moved[1] - self.config.goal[1])

    def estimator(self, canonical: CanonicalGrid) -> Estimator:
        start: FloatArray | None = None

        def tactile_estimate(observation: Observation) -> float | None:
            nonlocal start
            position = estimated_position(observation)
            if position is None:
                return None
            start = position if start is None else start
            return math.hypot(*(position - start - np.array(self.config.goal)))

        return tactile_estimate

    def expert(self, truth: Truth, start: Truth) -> FloatArray:
        """Straight for the goal, as fast as the longer axis may go."""
        left = np.array(self.config.goal) - (truth.position - start.position)[:2]
        return left / max(self.config.max_step, float(np.abs(left).max()))

    def scripted(self, *, through: bool = False) -> Policy:
        return ScriptedReposition(self.config, through)

    def analytic(self) -> Policy:
        return AnalyticReposition(self.config)


class ScriptedReposition:
    """Moves the upper sensor at half of max_step until the estimated position of the body is the goal, then holds.

    Closed loop: it does not matter whether the body sticks to the sensor, slides under it, or tips. Without contact it
    holds. With `through` it moves on past the goal, straight and at the full rate.
    """

    def __init__(self, config: RepositionConfig, through: bool) -> None:
        self._goal, self._rate, self._through = np.array(config.goal), config.max_step / 2, through
        self._start: FloatArray | None = None
        self._reached = False

    @property
    def needs(self) -> Needs:
        return Needs(arms=frozenset({"lower", "upper"}))

    def reset(self) -> None:
        self._start, self._reached = None, False

    def __call__(self, observation: Observation) -> Action:
        position = estimated_position(observation)
        if position is None:
            return Action({"upper": None})
        if self._start is None:
            self._start = position
        left = self._goal - (position - self._start)
        self._reached = self._reached or float(np.linalg.norm(left)) <= ARRIVAL_DISTANCE
        if self._reached and not self._through:
            return Action({"upper": None})
        direction = self._goal if self._reached else left
        longest = float(np.abs(direction).max())
        step = direction * (self._rate / longest if self._reached or longest > self._rate else 1.0)
        now = observation.arms["upper"].pose
        return Action({"upper": Pose(now.position + np.append(step, 0.0), now.quaternion)})


class AnalyticReposition:
    """Position = midway between the centres of pressure on the two faces; the upper sensor moves by what is left to the
    goal, again in each step."""

    def __init__(self, config: RepositionConfig) -> None:
        self._goal, self._max_step = np.array(config.goal), config.max_step
        self._start: FloatArray | None = None

    @property
    def needs(self) -> Needs:
        return Needs(arms=frozenset({"lower", "upper"}))

    def reset(self) -> None:
        self._start = None

    def __call__(self, observation: Observation) -> Action:
        position = estimated_position(observation)
        if position is None:
            return Action({"upper": None})
        if self._start is None:
            self._start = position
        left = (self._goal - (position - self._start)).clip(-self._max_step, self._max_step)
        now = observation.arms["upper"].pose
        return Action({"upper": Pose(now.position + np.append(left, 0.0), now.quaternion)})


def estimated_position(observation: Observation) -> FloatArray | None:
    """(2,) position of the body, world x and y [m], estimated by touch: midway between the centres of pressure on its
    two faces. Friction tips the body, which moves the two centres apart but not their middle. None without contact."""
    centres = [centre_of_pressure(observation.arms[name]) for name in ("lower", "upper")]
    return None if centres[0] is None or centres[1] is None else 0.5 * (centres[0] + centres[1])[:2]


def centre_of_pressure(arm: ArmState) -> FloatArray | None:
    """(3,) the point of the gel's rest plane where the normal force acts, world [m]; None without contact."""
    here = centre_of_pressure_in_sensor(arm)
    return None if here is None else se3.transform(arm.pose, np.append(here, 0.0))


def centre_of_pressure_in_sensor(arm: ArmState) -> FloatArray | None:
    """(2,) the same in the axes of the sensor.

    A force at (x, y, 0) in the sensor frame has the moment (y Fz, -x Fz, ...), hence x = -My / Fz, y = Mx / Fz.
    """
    _, _, force, moment_x, moment_y, _ = arm.wrench
    return None if -force < MIN_FORCE else np.array([-moment_y / force, moment_x / force])
