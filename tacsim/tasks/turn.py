"""Turn: an object that is gripped off its centre turns in the grip by an angle, while the grip loosens."""

from __future__ import annotations

import math
from collections import defaultdict
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

    def teacher(self) -> Policy:
        """The scripted policy, which goes on from the force that there is, even if a learned policy asked for it."""
        return ScriptedTurn(self.config, through=False, follows=True)


class EdgeTurn:
    """The angle by which the edges in a gel have turned since its first observation with an edge: their direction from
    the structure tensor of the slopes (Bigun & Granlund 1987)."""

    def __init__(self) -> None:
        self._before: float | None = None  # direction of the edges at the last observation [rad]
        self._turned = 0.0

    @property
    def is_known(self) -> bool:
        """An edge was seen."""
        return self._before is not None

    def __call__(self, touch: TactileObservation) -> float:
        """[rad], from sensor x to y; as before where the gel shows no edge."""
        direction = edge_direction(touch)
        if direction is not None:
            if self._before is not None:  # a direction is known but for half a turn
                self._turned += (direction - self._before + math.pi / 2) % math.pi - math.pi / 2
            self._before = direction
        return self._turned


class TurnEstimate:
    """The angle by which an object with straight edges has turned in the grip since the first observation, by touch:
    the mean of its gels."""

    def __init__(self) -> None:
        self._turns: defaultdict[str, EdgeTurn] = defaultdict(EdgeTurn)  # by sensor

    def __call__(self, observation: Observation) -> float | None:
        """[rad], not negative; None where no sensor has shown an edge."""
        turned = {name: self._turns[name](touch) for name, touch in observation.tactile.items()}
        known = [abs(angle) for name, angle in turned.items() if self._turns[name].is_known]
        return float(np.mean(known)) if known else None


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
    the height of the gels. With `through` it does not tighten at the goal, with `follows` it changes the measured force
    instead of the one that it asked for."""

    def __init__(self, config: TurnConfig, through: bool, follows: bool = False) -> None:
        self._config, self._through, self._follows = config, through, follows
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
        measured = observation.grippers[self._config.gripper].force
        if self._follows and measured is not None:
            self._force = measured
        self._reached = self._reached or left <= STOPPING_STEPS * turned
        if self._reached and not self._through:
            self._force = self._config.touch_force
        else:
            wanted = MAX_TURN_STEP if self._through else min(MAX_TURN_STEP, max(left, 0.0) / 4)
            self._force *= LOOSENING if turned < wanted else TIGHTENING
        low, high = self._config.force_range
        self._force = min(max(self._force, low), high)
        return Action({}, {self._config.gripper: GripperTarget(0.0, self._force)})
