"""A user-defined task: stretch the body along x, by squeezing it.

    tacsim run sim --task stretch:StretchConfig --set "task.goal=2 mm"

docs/tasks.md says what each part is for.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from tacsim import (
    Action,
    Axis,
    CanonicalGrid,
    Estimator,
    Length,
    Needs,
    Observation,
    Policy,
    Pose,
    Task,
    TaskConfig,
    Truth,
    register_task,
)

BOTH = frozenset({"lower", "upper"})


class StretchConfig(TaskConfig):
    """What a file, `--set` or a randomisation may say of the task, beyond what every task has."""

    kind: Literal["stretch"] = "stretch"
    goal: Annotated[Length, Field(gt=0)] = 1.5e-3  # elongation of the body along x [m]
    success: Annotated[Length, Field(gt=0)] = 0.3e-3


@dataclass(frozen=True)
class Stretch(Task):
    """distance = |length - length at first - goal|; actions move both sensors along world z."""

    config: StretchConfig

    @property
    def axes(self) -> tuple[Axis, ...]:
        return (Axis("lower", (0.0, 0.0, 1.0)), Axis("upper", (0.0, 0.0, 1.0)))

    @property
    def goal(self) -> float:
        return self.config.goal

    def distance(self, truth: Truth, start: Truth) -> float:
        now, then = (float(np.ptp(each.points[:, 0])) for each in (truth, start))
        return abs(now - then - self.config.goal)

    # From here on all is optional: the distance by touch alone, and a policy that finds its way by it.

    @property
    def touch_needs(self) -> Needs:
        return Needs(BOTH, BOTH, height=True)

    def estimator(self, canonical: CanonicalGrid) -> Estimator:
        length = FeltLength(canonical)
        return lambda observation: abs(length(observation) - self.config.goal)

    def scripted(self, *, through: bool = False) -> Policy:
        return ScriptedStretch(self.config, through)


class FeltLength:
    """How much longer the contacts are along x than at first [m]; contact is where a gel is pressed half as deep as it
    is anywhere."""

    def __init__(self, canonical: CanonicalGrid) -> None:
        self._pitch, self._first = canonical.pitch, float("nan")

    def __call__(self, observation: Observation) -> float:
        lengths = []
        for touch in observation.tactile.values():
            assert touch.height is not None
            pressed = np.flatnonzero((touch.height > 0.5 * touch.height.max()).any(axis=0))
            lengths.append(self._pitch * float(np.ptp(pressed)))
        length = sum(lengths) / len(lengths)
        self._first = length if np.isnan(self._first) else self._first
        return length - self._first


class ScriptedStretch:
    """Closes both sensors until the body feels long enough, then holds."""

    needs = Needs(BOTH, BOTH, height=True)

    def __init__(self, config: StretchConfig, through: bool) -> None:
        self._config, self._through = config, through

    def reset(self) -> None:
        self._length, self._there = FeltLength(CanonicalGrid()), False

    def __call__(self, observation: Observation) -> Action:
        enough = self._config.goal - 0.1e-3  # it stops one step late
        self._there = self._length(observation) >= enough or self._there
        if self._there and not self._through:
            return Action({"lower": None, "upper": None})
        half = np.array([0.0, 0.0, self._config.max_step / 2])
        lower, upper = observation.arms["lower"].pose, observation.arms["upper"].pose
        up, down = Pose(lower.position + half, lower.quaternion), Pose(upper.position - half, upper.quaternion)
        return Action({"lower": up, "upper": down})


register_task(StretchConfig, Stretch)
