"""Paths of one control period: to the target exactly, and past it at speed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tacsim.interface import FloatArray
from tacsim.sim.cell.tuning import RISE_SHARE


@dataclass(frozen=True, slots=True, eq=False)
class Ramp:
    """Displacement (n,) over time: the velocity changes evenly from `velocity` by `change` during `rise` [s], then
    stays."""

    velocity: FloatArray
    change: FloatArray
    rise: float

    @classmethod
    def plan(cls, displacement: FloatArray, velocity: FloatArray, seconds: float) -> Ramp:
        """The path that has gone `displacement` after `seconds`. It does not stop there: a motion that goes on at
        the same speed shakes nothing. A stop overshoots by some percent of the displacement, and is back at its end."""
        rise = RISE_SHARE * seconds
        return cls(velocity, (displacement - velocity * seconds) / (seconds - rise / 2), rise)

    @classmethod
    def rest(cls, size: int) -> Ramp:
        """Of what stays where it is."""
        return cls(np.zeros(size), np.zeros(size), 1.0)

    def displacement(self, time: float) -> FloatArray:
        """(n,) at `time` [s] from its begin."""
        rising = min(time, self.rise)
        return self.velocity * time + self.change * (rising**2 / (2 * self.rise) + (time - rising))

    def speed(self, time: float) -> FloatArray:
        """(n,) its velocity."""
        return self.velocity + self.change * min(time / self.rise, 1.0)
