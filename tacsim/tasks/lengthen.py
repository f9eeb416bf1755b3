"""Lengthen: press the body until it is a given length along world x, by moving both sensors along world z."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from tacsim.geometry import shapes
from tacsim.interface import Action, FloatArray, Needs, Observation, Policy, Pose, Truth
from tacsim.models.sensor import CanonicalGrid
from tacsim.models.task import LengthenConfig
from tacsim.tasks.squeeze import BOTH, estimated_height
from tacsim.tasks.task import Axis, Estimator, GoalOutOfReach, Task
from tacsim.tasks.tuning import LENGTH_RULE, MIN_LENGTH_SHARE, MIN_PRESSED_DEPTH


@dataclass(frozen=True)
class Lengthen(Task):
    """distance = |length - goal|, length = extent of the body along world x."""

    config: LengthenConfig

    def require_reachable(self, start: Truth) -> None:
        now, scene = self.length(start), self.config.scene
        longest = min(scene.gel_of(name).size[0] for name in scene.sensors)
        if not now - self.config.success <= self.config.goal <= longest:
            raise GoalOutOfReach(
                f"task.goal: {1e3 * self.config.goal:g} mm; the body is {1e3 * now:.3g} mm long and pressing makes it "
                f"longer, up to the {1e3 * longest:g} mm of the gels; give a goal between them"
            )

    @property
    def touch_needs(self) -> Needs:
        return Needs(BOTH, BOTH, height=True)

    @property
    def axes(self) -> tuple[Axis, ...]:
        return (Axis("lower", (0.0, 0.0, 1.0)), Axis("upper", (0.0, 0.0, 1.0)))

    @property
    def goal(self) -> float:
        return self.config.goal

    @cached_property
    def volume(self) -> float:
        """Of the body [m^3]. Raises ValueError for a scene without a body."""
        body = self.config.scene.body
        if body is None:
            raise ValueError("task 'lengthen' needs a scene with a body")
        return shapes.enclosed_volume(body.geometry)

    def length(self, truth: Truth) -> float:
        """Extent of the body along world x [m]: of its particles, plus one spacing."""
        spacing = float((self.volume / len(truth.points)) ** (1 / 3))
        return float(np.ptp(truth.points[:, 0].astype(np.float64))) + spacing

    def distance(self, truth: Truth, start: Truth) -> float:
        return abs(self.length(truth) - self.config.goal)

    def estimator(self, canonical: CanonicalGrid) -> Estimator:
        length = LengthEstimate(canonical)

        def tactile_estimate(observation: Observation) -> float | None:
            found = length(observation)
            touched = all(observation.tactile[name].contact.any() for name in BOTH)
            return abs(found - self.config.goal) if touched and found is not None else None

        return tactile_estimate

    def expert(self, truth: Truth, start: Truth) -> FloatArray:
        """Both sensors close by what is left of the length, over the growth of the body per displacement of the
        sensors since `start`."""
        closed = _sensor_gap(start) - _sensor_gap(truth)
        grown, left = self.length(truth) - self.length(start), self.config.goal - self.length(truth)
        share = max(grown / closed, MIN_LENGTH_SHARE) if closed > 0 else 1.0
        half = np.clip(left / share / 2 / self.config.max_step, -1.0, 1.0)
        return np.array([half, -half])

    def scripted(self, *, through: bool = False) -> Policy:
        return LengthRule(self.config, through)

    def analytic(self) -> Policy:
        return LengthRule(self.config, False)


class LengthEstimate:
    """Length of the body along x by touch [m] = a + b * L0 * sqrt(H0 / height) + c * extent of the contact, with extent
    L0 and height H0 when both gels are first pressed deeply enough: the volume is kept, and the contact shows two
    faces. None before. The factors are those of least squares on training draws of the benchmark."""

    def __init__(self, canonical: CanonicalGrid) -> None:
        self._canonical = canonical
        self._first: tuple[float, float] | None = None  # extent and height at the first press [m]

    def __call__(self, observation: Observation) -> float | None:
        """Raises ValueError for a sensor without height."""
        min_height = 1e-3  # [m]; arms that measure less are wrong
        constant, of_volume, of_contact = LENGTH_RULE
        extent, height = pressed_extent(observation, self._canonical), estimated_height(observation)
        if self._first is None:
            if extent == 0.0:
                return None
            self._first = extent, height
        by_volume = self._first[0] * float(np.sqrt(max(self._first[1], 0.0) / max(height, min_height)))
        return constant + of_volume * by_volume + of_contact * extent


class LengthRule:
    """Each sensor closes by half of what is left of the length that touch estimates; at the full rate before there is
    an estimate, and with `through` after the goal, too."""

    def __init__(self, config: LengthenConfig, through: bool) -> None:
        self._goal, self._max_step, self._through = config.goal, config.max_step, through
        self.reset()

    @property
    def needs(self) -> Needs:
        return Needs(BOTH, BOTH, height=True)

    def reset(self) -> None:
        self._length = LengthEstimate(CanonicalGrid())

    def __call__(self, observation: Observation) -> Action:
        length = self._length(observation)
        if length is None or (self._through and length >= self._goal):
            return closing_action(observation, self._max_step)
        return closing_action(observation, float(np.clip((self._goal - length) / 2, 0.0, self._max_step)))


def closing_action(observation: Observation, step: float) -> Action:
    """Both sensors move towards each other by `step` [m]."""
    up = np.array([0.0, 0.0, step])
    lower, upper = observation.arms["lower"].pose, observation.arms["upper"].pose
    return Action(
        {"lower": Pose(lower.position + up, lower.quaternion), "upper": Pose(upper.position - up, upper.quaternion)}
    )


def pressed_extent(observation: Observation, canonical: CanonicalGrid) -> float:
    """Extent along the x of the sensors [m], the mean of both gels, of the part that is pressed at least half as deep
    as the deepest point: the length of a rectangle with the same second moment, which a few noisy points change little.
    0 if a gel is pressed by less than MIN_PRESSED_DEPTH. Raises ValueError for a sensor without height."""
    extents = []
    for name in sorted(BOTH):
        touch = observation.tactile[name]
        if touch.height is None:
            raise ValueError("the length of a body is found from the gel's height, and this sensor delivers none")
        deepest = float(touch.height.max(where=touch.valid, initial=0.0))
        if deepest < MIN_PRESSED_DEPTH:
            return 0.0
        columns = np.nonzero(touch.valid & (touch.height > 0.5 * deepest))[1]
        extents.append(float(np.sqrt(12.0 * columns.var() + 1.0)) * canonical.pitch)
    return float(np.mean(extents))


def _sensor_gap(truth: Truth) -> float:
    """Between the sensors, along world z [m]."""
    return float(truth.poses["upper"].position[2] - truth.poses["lower"].position[2])
