"""What an episode takes of the arms."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from tacsim import pose as se3
from tacsim.interface import ArmState


class Effort:
    """The greatest normal force of a sensor, and the work that the arms do, from the states after each control step.

    Work is the sum over arms and steps of the force on the body times the way of its sensor, the force taken as the
    mean of before and after (trapezoidal rule); turns are left out.
    """

    def __init__(self, arms: Mapping[str, ArmState]) -> None:
        self._before = arms
        self.peak = _max_normal_force(arms)  # [N]
        self.work = 0.0  # [J]

    def add(self, arms: Mapping[str, ArmState]) -> None:
        """The next states of the same arms."""
        for name, now in arms.items():
            before = self._before[name]
            force = -0.5 * (_world_force(before) + _world_force(now))  # on the body
            self.work += float(force @ (now.pose.position - before.pose.position))
        self._before, self.peak = arms, max(self.peak, _max_normal_force(arms))


def _world_force(arm: ArmState) -> np.ndarray:
    """(3,) on the sensor, world axes [N]."""
    return se3.rotate(arm.pose, arm.wrench[:3])


def _max_normal_force(arms: Mapping[str, ArmState]) -> float:
    return max((abs(float(arm.wrench[2])) for arm in arms.values()), default=0.0)
