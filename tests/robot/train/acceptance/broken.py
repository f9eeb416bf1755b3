"""Policies that break the contract."""

from __future__ import annotations

import math

from tacsim.interface import Action, Needs, Observation, Pose


class GivesNan:
    """From its second step on it asks for a place that is none."""

    needs = Needs()

    def reset(self) -> None:
        self._step = 0

    def __call__(self, observation: Observation) -> Action:
        self._step += 1
        if self._step < 2:
            return Action({"lower": None, "upper": None})
        pose = observation.arms["lower"].pose
        return Action({"lower": Pose(pose.position + [0.0, 0.0, math.nan], pose.quaternion), "upper": None})


class GivesNumbers:
    """An array is no Action."""

    needs = Needs()

    def reset(self) -> None: ...

    def __call__(self, observation: Observation) -> list[float]:
        return [0.0, 0.0, 0.0]


class NeedsFlow:
    """Markers that the rig does not have."""

    needs = Needs(sensors=frozenset({"lower"}), flow=True)

    def reset(self) -> None: ...

    def __call__(self, observation: Observation) -> Action:
        return Action({"lower": None, "upper": None})


class Ends:
    """Ends Python in its reset."""

    needs = Needs()

    def reset(self) -> None:
        raise SystemExit(3)

    def __call__(self, observation: Observation) -> Action:
        return Action()
