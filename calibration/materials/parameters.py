"""The unknowns of a fit, and the numbers in which they are fitted."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from tacsim.interface import FloatArray


@dataclass(frozen=True, slots=True)
class Parameter:
    """One unknown of a material or a contact.

    A fit works in its free number: the logarithm of what is positive (`log`); log(1/2 - nu) of Poisson's ratio, since
    the bulk modulus of a nearly incompressible gel goes with 1 / (1/2 - nu) (`volume`); the value over `unit` of what
    may be zero (`linear`).
    """

    name: str
    start: float  # SI units
    low: float
    high: float
    kind: Literal["log", "volume", "linear"] = "log"
    unit: float = 1.0
    begin: float | None = None  # where a fit begins, if not at the start, where it stays if nothing tells it

    def free(self, value: float) -> float:
        if self.kind == "log":
            return math.log(value)
        return math.log(0.5 - value) if self.kind == "volume" else value / self.unit

    def value(self, free: float) -> float:
        if self.kind == "log":
            return math.exp(free)
        return 0.5 - math.exp(free) if self.kind == "volume" else free * self.unit

    @property
    def bounds(self) -> tuple[float, float]:
        """Least and greatest free number."""
        ends = sorted((self.free(self.low), self.free(self.high)))
        return ends[0], ends[1]

    def interval_values(self, free: float, half: float) -> tuple[float, float]:
        """The interval free - half .. free + half as values, within the bounds."""
        low, high = self.bounds
        ends = sorted(self.value(min(max(end, low), high)) for end in (free - half, free + half))
        return ends[0], ends[1]


def start_values(parameters: Sequence[Parameter]) -> FloatArray:
    """The free numbers at which what is not told stays."""
    return np.array([each.free(each.start) for each in parameters])


def fit_start_values(parameters: Sequence[Parameter]) -> FloatArray:
    """The free numbers at which a fit begins."""
    return np.array([each.free(each.start if each.begin is None else each.begin) for each in parameters])
