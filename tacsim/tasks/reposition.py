"""Reposition: move the body in the plane by moving the upper sensor in world x and y."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from tacsim import pose as se3
from tacsim.interface import Action, FloatArray, Needs, Observation, Policy, Pose, Truth
from tacsim.rigfile import RepositionFacts
from tacsim.scene import Gel, lame
from tacsim.tasks.task import Axis

REACHED = 0.02e-3  # the scripted policy holds when its estimate is this near the goal [m]


@dataclass(frozen=True, slots=True)
class Reposition:
    """distance = ||position - goal||_2, position = centre of mass minus its value at reset, world x and y."""

    facts: RepositionFacts

    @property
    def needs(self) -> Needs:
        return Needs(arms=frozenset({"upper"}), truth=True)

    @property
    def axes(self) -> tuple[Axis, ...]:
        return (Axis("upper", (1.0, 0.0, 0.0)), Axis("upper", (0.0, 1.0, 0.0)))

    def distance(self, truth: Truth, start: Truth) -> float:
        moved = truth.position[:2] - start.position[:2]
        return math.hypot(moved[0] - self.facts.goal[0], moved[1] - self.facts.goal[1])

    def scripted(self, *, through: bool = False) -> Policy:
        return ScriptedReposition(self.facts, through)


class ScriptedReposition:
    """Moves the upper sensor towards the goal until the body, as felt, is there, then holds.

    The body lags behind the sensor by the shear of the gel, which the policy takes from the shear force it feels.
    With `through` it goes on beyond the goal, straight and at the full rate.
    """

    def __init__(self, facts: RepositionFacts, through: bool) -> None:
        self._facts, self._through = facts, through
        self._rate = facts.max_step / 2  # of each axis
        self._start: Observation | None = None
        self._reached = False

    @property
    def needs(self) -> Needs:
        return Needs(sensors=frozenset({"upper"}), arms=frozenset({"upper"}), height=True)

    def reset(self) -> None:
        self._start, self._reached = None, False

    def __call__(self, observation: Observation) -> Action:
        if self._start is None:
            self._start = observation
        goal = np.array(self._facts.goal)
        left = goal - felt_displacement(observation, self._start, self._facts.scene.gel)
        self._reached = self._reached or float(np.linalg.norm(left)) <= REACHED
        if self._reached and not self._through:
            return Action({"upper": None})
        step = goal if self._reached else left
        longest = float(np.abs(step).max())
        step = step * (self._rate / longest if self._reached or longest > self._rate else 1.0)
        now = observation.arms["upper"].pose
        return Action({"upper": Pose(now.position + np.append(step, 0.0), now.quaternion)})
