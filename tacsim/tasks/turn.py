"""Turn: an object that is gripped off its centre turns in the grip by an angle, while the grip loosens."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from tacsim.interface import Action, GripperTarget, Needs, Observation, Policy, TactileObservation, Truth
from tacsim.models.sensor import CanonicalGrid
from tacsim.models.task import TurnConfig
from tacsim.tasks.rigid import RigidTask, turn_in_grip
from tacsim.tasks.task import Estimator, GripAxis
from tacsim.tasks.tuning import LOOSENING, MAX_TURN_STEP, STOPPING_STEPS, TIGHTENING


@dataclass(frozen=True, slots=True)
class Turn(RigidTask):
    """distance = |angle - goal|, angle about the line between the fingers since reset, without its sign: gravity says
    which way it turns."""

    config: TurnConfig

    @property
    def axes(self) -> tuple[GripAxis, ...]:
        return (self.grip_axis,)

    @property
    def goal(self) -> float:
        return self.config.goal

    @property
    def touch_needs(self) -> Needs:
        return Needs(height=True, grippers=frozenset({self.config.gripper}))

    def remaining(self, truth: Truth, start: Truth) -> float:
        return abs(abs(turn_in_grip(truth, start)) - self.config.goal)

    def estimator(self, canonical: CanonicalGrid) -> Estimator:
        angle = TurnEstimate()

        def tactile_estimate(observation: Observation) -> float | None:
            turned = angle(observation)
            return None if turned is None else abs(turned - self.config.goal)

        return tactile_estimate

    def scripted(self, *, through: bool = False) -> Policy:
        return ScriptedTurn(self.config, through)


class TurnEstimate:
    """The angle by which an object with straight edges has turned in the grip since the first observation, by touch:
    the direction of its edges in the gels, from the structure tensor of the slopes (Bigun & Granlund 1987)."""

    def __init__(self) -> None:
        self._before: dict[str, float] = {}  # direction of the edges at the last observation, by sensor [rad]
        self._turned: dict[str, float] = {}  # since the first [rad]

    def __call__(self, observation: Observation) -> float | None:
        """[rad], not negative; None where no sensor shows an edge."""
        for name, touch in observation.tactile.items():
            direction = edge_direction(touch)
            if direction is None:
                continue
            if name in self._before:  # a direction is known but for half a turn
                change = (direction - self._before[name] + math.pi / 2) % math.pi - math.pi / 2
                self._turned[name] = self._turned.get(name, 0.0) + change
            self._before[name] = direction
            self._turned.setdefault(name, 0.0)
        return float(np.mean(np.abs(list(self._turned.values())))) if self._turned else None


def edge_direction(touch: TactileObservation) -> float | None:
    """Direction of the steepest slopes in the gel, across the edges of an object, from sensor x, within half a turn
    [rad]; None without height or contact."""
    if touch.gradient is None or not touch.contact.any():
        return None
    slopes = touch.gradient[touch.valid].astype(np.float64)
    xx, xy, yy = (slopes[:, 0] ** 2).sum(), (slopes[:, 0] * slopes[:, 1]).sum(), (slopes[:, 1] ** 2).sum()
    return 0.5 * math.atan2(2.0 * xy, xx - yy)


class ScriptedTurn:
    """Loosens the grip until the object turns as fast as it should, slower near the goal, and tightens it there. Needs
    the height of the gels. With `through` it does not tighten at the goal."""

    def __init__(self, config: TurnConfig, through: bool) -> None:
        self._config, self._through = config, through
        self.reset()

    @property
    def needs(self) -> Needs:
        return Needs(height=True, grippers=frozenset({self._config.gripper}))

    def reset(self) -> None:
        self._estimate, self._angle = TurnEstimate(), 0.0
        self._force = self._config.touch_force
        self._reached = False

    def __call__(self, observation: Observation) -> Action:
        angle = self._estimate(observation) or 0.0
        turned, self._angle = angle - self._angle, angle
        left = self._config.goal - angle
        self._reached = self._reached or left <= STOPPING_STEPS * turned
        if self._reached and not self._through:
            self._force = self._config.touch_force
        else:
            wanted = MAX_TURN_STEP if self._through else min(MAX_TURN_STEP, max(left, 0.0) / 4)
            self._force *= LOOSENING if turned < wanted else TIGHTENING
        low, high = self._config.force_range
        self._force = min(max(self._force, low), high)
        return Action({}, {self._config.gripper: GripperTarget(0.0, self._force)})
