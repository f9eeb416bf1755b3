"""What a fit of materials is made of: its unknowns, where a simulation is run, what was measured, and what came out."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from tacsim.interface import FloatArray

MESH_ERROR_SHARE = 0.5  # standard deviation of what is left of the mesh's error, over what the finer mesh changed


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
    begin: float | None = None  # where a fit fit_start_values, if not at the start, where it stays if nothing tells it

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
    """The free numbers at which a fit fit_start_values."""
    return np.array([each.free(each.start if each.begin is None else each.begin) for each in parameters])


@dataclass(frozen=True, slots=True)
class Point:
    """Where a simulation is run."""

    free: FloatArray  # (p,) free numbers of the parameters
    places: FloatArray  # (t,) how much nearer than recorded the parts of each press are [m]
    size: float = 0.0  # logarithm of how much larger than stated the indenter is, its lowest point where it was


Predict = Callable[[Sequence[Point]], list[FloatArray]]  # (m,) signals at each point


@dataclass(frozen=True, slots=True, eq=False)
class Signals:
    """What was measured in all presses, one number a row."""

    values: FloatArray  # (m,) [N, or m]
    noise: FloatArray  # (m,) standard deviation
    press: NDArray[np.int64]  # (m,) index of its press
    channel: NDArray[np.int64]  # (m,) index into `channels`
    time: FloatArray  # (m,) [s]
    channels: tuple[str, ...]
    force: NDArray[np.bool_]  # (c,) channels that are forces, whose zero may be off

    @property
    def presses(self) -> int:
        return int(self.press.max()) + 1

    @property
    def series(self) -> NDArray[np.int64]:
        """(m,) which channel of which press, as one index."""
        found = np.unique(np.stack([self.press, self.channel]), axis=1, return_inverse=True)[1]
        return np.asarray(found.ravel(), dtype=np.int64)

    def zeros(self) -> FloatArray:
        """(m, z) columns of the zeros: one for each press and each force that it has."""
        pairs = sorted({(p, c) for p, c in zip(self.press.tolist(), self.channel.tolist(), strict=True)})
        columns = [(self.press == p) & (self.channel == c) for p, c in pairs if self.force[c]]
        return np.stack(columns, axis=1).astype(np.float64) if columns else np.zeros((len(self.values), 0))


@dataclass(frozen=True, slots=True)
class Priors:
    """How well the nuisances are known beforehand: standard deviations."""

    place: float  # [m]
    zero: float  # [N]


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """An estimate and what it rests on. n = p + t + z unknowns: parameters, places, zeros."""

    parameters: tuple[Parameter, ...]
    held: NDArray[np.bool_]  # (p,) those that the data do not tell: they stayed at their start
    free: FloatArray  # (p,)
    covariance: FloatArray  # (p, p) of the free numbers, with what the mesh, and those held, may be off
    mesh_shift: FloatArray  # (p,) how far the finer mesh moved them, or what it changed press by press
    settled_shift: FloatArray  # (k, p) by how much each press and channel moves them that is off as a whole
    predicted: FloatArray  # (m,) with the zeros of the force
    sigma: FloatArray  # (m,) standard deviations that weighed: noise, and what the simulation is off
    system: FloatArray  # (m, n)
    nuisances: FloatArray  # (t + z,)
    priors: FloatArray  # (t + z,) standard deviations of the nuisances
    runs: int = 0  # simulated presses

    @property
    def identified(self) -> tuple[Parameter, ...]:
        return tuple(each for each, held in zip(self.parameters, self.held, strict=True) if not held)

    @property
    def unidentified(self) -> tuple[Parameter, ...]:
        return tuple(each for each, held in zip(self.parameters, self.held, strict=True) if held)

    @property
    def degrees_of_freedom(self) -> int:
        return max(1, len(self.predicted) - len(self.identified))

    def value(self, name: str) -> float:
        index = self._index(name)
        return self.parameters[index].value(float(self.free[index]))

    def half_interval(self, name: str) -> float:
        """Half the 95 % interval of a free number."""
        index = self._index(name)
        return float(student.ppf(0.975, self.degrees_of_freedom) * np.sqrt(self.covariance[index, index]))

    def interval(self, name: str) -> tuple[float, float]:
        """95 %."""
        index = self._index(name)
        return self.parameters[index].interval_values(float(self.free[index]), self.half_interval(name))

    def with_sigma(self, sigma: FloatArray) -> Fit:
        """What its intervals were if the signals had these standard deviations."""
        p = len(self.free)
        spread = covariance_of(self.system, sigma, self.priors, self.held)[:p, :p]
        spread = spread + np.diag((MESH_ERROR_SHARE * self.mesh_shift) ** 2) + self.settled_shift.T @ self.settled_shift
        return replace(self, sigma=sigma, covariance=spread)

    def parameter_change(self, change: FloatArray) -> FloatArray:
        """(p,) how far the free numbers move if the simulation changes by `change` (m,)."""
        covariance = covariance_of(self.system, self.sigma, self.priors, self.held, 0.0)
        found: FloatArray = -(covariance @ self.system.T @ (change / self.sigma**2))[: len(self.free)]
        return found

    def parameter_changes(self, change: FloatArray, series: NDArray[np.int64]) -> FloatArray:
        """(k, p) the same for each series' part of the change; `series` (m,): `Signals.series`."""
        return np.array(
            [self.parameter_change(np.where(series == each, change, 0.0)) for each in range(series.max() + 1)]
        )

    def widen_intervals(self, residual: FloatArray, series: NDArray[np.int64]) -> Fit:
        """With intervals as wide as the series (m,) pull its numbers apart, where that is more than they knew. What a
        simulation is off lasts through a series, whose readings are no opinions of their own: the variance is that of
        clusters (Liang and Zeger, Biometrika 73, 1986). residual: (m,) measured less `predicted`."""
        pulls = self.parameter_changes(residual, series)
        pulled = (pulls**2).sum(axis=0) * len(pulls) / max(1, len(pulls) - 1)
        more = np.maximum(0.0, pulled - np.diag(self.covariance))
        return replace(self, covariance=self.covariance + np.diag(more))

    def _index(self, name: str) -> int:
        return [each.name for each in self.parameters].index(name)


def covariance_of(
    system: FloatArray, sigma: FloatArray, priors: FloatArray, held: NDArray[np.bool_], spread: float = 0.5
) -> FloatArray:
    """(n, n) of all unknowns, from the system (m, n), whose last columns have `priors`. Parameters that are held have
    no variance themselves; `spread` is what they may be off, as far as the others go."""
    unknown_deviation = 100.0  # standard deviation of a free number of which nothing is known
    p, n = len(held), system.shape[1]
    free = np.concatenate([~held, np.ones(n - p, np.bool_)])
    known = np.concatenate([np.full(p, unknown_deviation), priors])[free]
    rows = system / sigma[:, None]
    scaled = rows[:, free] * known  # by what is known beforehand: then the information is never singular
    found = np.zeros((n, n))
    found[np.ix_(free, free)] = np.linalg.inv(scaled.T @ scaled + np.eye(len(known))) * np.outer(known, known)
    for index in np.flatnonzero(held):
        moved = found @ (rows.T @ rows[:, index])
        found = found + spread**2 * np.outer(moved, moved)
    return found
