"""Data of a fit of materials: its unknowns, the recorded presses and squeezes with their signals, the points of
simulations, and the result."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from tacsim.interface import FloatArray, Pose
from tacsim.pose import pose_difference

MESH_ERROR_SHARE = 0.5  # standard deviation of the remaining mesh error, over the change by the finer mesh


@dataclass(frozen=True, slots=True)
class Parameter:
    """One unknown of a material or a contact.

    A fit uses its free number: the logarithm of a positive value (`log`); log(1/2 - nu) of Poisson's ratio, because the
    bulk modulus of a nearly incompressible gel is proportional to 1 / (1/2 - nu) (`volume`); the value over `unit` if
    it may be zero (`linear`).
    """

    name: str
    start: float  # SI units
    low: float
    high: float
    kind: Literal["log", "volume", "linear"] = "log"
    unit: float = 1.0
    begin: float | None = None  # first value of a fit, if not `start`, which it keeps if it is not identified

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
        """Minimum and maximum of the free number."""
        ends = sorted((self.free(self.low), self.free(self.high)))
        return ends[0], ends[1]

    def interval_values(self, free: float, half: float) -> tuple[float, float]:
        """The interval free - half .. free + half as values, within the bounds."""
        low, high = self.bounds
        ends = sorted(self.value(min(max(end, low), high)) for end in (free - half, free + half))
        return ends[0], ends[1]


def start_values(parameters: Sequence[Parameter]) -> FloatArray:
    """The free numbers of parameters that are not identified."""
    return np.array([each.free(each.start) for each in parameters])


def fit_start_values(parameters: Sequence[Parameter]) -> FloatArray:
    """The free numbers at which a fit starts."""
    return np.array([each.free(each.start if each.begin is None else each.begin) for each in parameters])


@dataclass(frozen=True, slots=True)
class Point:
    """The unknowns of one simulation."""

    free: FloatArray  # (p,) free numbers of the parameters
    places: FloatArray  # (t,) displacement of the parts of each press towards each other, relative to the recording [m]
    size: float = 0.0  # logarithm of the indenter's size over the stated one, with the same lowest point


Predict = Callable[[Sequence[Point]], list[FloatArray]]  # (m,) signals at each point


@dataclass(frozen=True, slots=True, eq=False)
class Signals:
    """The measured signals of all presses, one number for each row."""

    values: FloatArray  # (m,) [N, or m]
    noise: FloatArray  # (m,) standard deviation
    press: NDArray[np.int64]  # (m,) index of its press
    channel: NDArray[np.int64]  # (m,) index into `channels`
    time: FloatArray  # (m,) [s]
    channels: tuple[str, ...]
    force: NDArray[np.bool_]  # (c,) channels that are forces, whose zero may have an error

    @property
    def presses(self) -> int:
        return int(self.press.max()) + 1

    @property
    def series(self) -> NDArray[np.int64]:
        """(m,) index of press and channel."""
        found = np.unique(np.stack([self.press, self.channel]), axis=1, return_inverse=True)[1]
        return np.asarray(found.ravel(), dtype=np.int64)

    def zeros(self) -> FloatArray:
        """(m, z) columns of the zeros: one for each press and each force that it has."""
        pairs = sorted({(p, c) for p, c in zip(self.press.tolist(), self.channel.tolist(), strict=True)})
        columns = [(self.press == p) & (self.channel == c) for p, c in pairs if self.force[c]]
        return np.stack(columns, axis=1).astype(np.float64) if columns else np.zeros((len(self.values), 0))


@dataclass(frozen=True, slots=True)
class Priors:
    """Prior standard deviations of the nuisance parameters."""

    place: float  # [m]
    zero: float  # [N]


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """An estimate and its linear system. n = p + t + z unknowns: parameters, places, zeros."""

    parameters: tuple[Parameter, ...]
    held: NDArray[np.bool_]  # (p,) fixed parameters, not identified by the data: they have their start value
    free: FloatArray  # (p,)
    covariance: FloatArray  # (p, p) of the free numbers, with the errors of the mesh and of fixed parameters
    mesh_shift: FloatArray  # (p,) their change by the finer mesh, in total or by press
    settled_shift: FloatArray  # (k, p) their change by a common error of each press and channel
    predicted: FloatArray  # (m,) with the zeros of the force
    sigma: FloatArray  # (m,) standard deviations of the weights: noise, and error of the simulation
    system: FloatArray  # (m, n)
    nuisances: FloatArray  # (t + z,)
    priors: FloatArray  # (t + z,) standard deviations of the nuisance parameters
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
        """The fit with the intervals of other standard deviations of the signals."""
        p = len(self.free)
        spread = covariance_of(self.system, sigma, self.priors, self.held)[:p, :p]
        spread = spread + np.diag((MESH_ERROR_SHARE * self.mesh_shift) ** 2) + self.settled_shift.T @ self.settled_shift
        return replace(self, sigma=sigma, covariance=spread)

    def parameter_change(self, change: FloatArray) -> FloatArray:
        """(p,) change of the free numbers if the simulation changes by `change` (m,)."""
        covariance = covariance_of(self.system, self.sigma, self.priors, self.held, 0.0)
        found: FloatArray = -(covariance @ self.system.T @ (change / self.sigma**2))[: len(self.free)]
        return found

    def parameter_changes(self, change: FloatArray, series: NDArray[np.int64]) -> FloatArray:
        """(k, p) the same for the part of each series in the change. series (m,): `Signals.series`."""
        return np.array(
            [self.parameter_change(np.where(series == each, change, 0.0)) for each in range(series.max() + 1)]
        )

    def widen_intervals(self, residual: FloatArray, series: NDArray[np.int64]) -> Fit:
        """The fit with intervals that include the spread between the series (m,), if that is larger. The error of a
        simulation is correlated within a series, so the variance is that of clusters (Liang and Zeger, Biometrika 73,
        1986). residual: (m,) measured minus `predicted`."""
        pulls = self.parameter_changes(residual, series)
        pulled = (pulls**2).sum(axis=0) * len(pulls) / max(1, len(pulls) - 1)
        more = np.maximum(0.0, pulled - np.diag(self.covariance))
        return replace(self, covariance=self.covariance + np.diag(more))

    def _index(self, name: str) -> int:
        return [each.name for each in self.parameters].index(name)


def covariance_of(
    system: FloatArray, sigma: FloatArray, priors: FloatArray, held: NDArray[np.bool_], spread: float = 0.5
) -> FloatArray:
    """(n, n) covariance of all unknowns, from the system (m, n), whose last columns have `priors`. Fixed parameters
    have no variance; `spread` is their error for the covariance of the others."""
    unknown_deviation = 100.0  # standard deviation of a free number without prior knowledge
    p, n = len(held), system.shape[1]
    free = np.concatenate([~held, np.ones(n - p, np.bool_)])
    known = np.concatenate([np.full(p, unknown_deviation), priors])[free]
    rows = system / sigma[:, None]
    scaled = rows[:, free] * known  # scaled by the priors, so that the information matrix is not singular
    found = np.zeros((n, n))
    found[np.ix_(free, free)] = np.linalg.inv(scaled.T @ scaled + np.eye(len(known))) * np.outer(known, known)
    for index in np.flatnonzero(held):
        moved = found @ (rows.T @ rows[:, index])
        found = found + spread**2 * np.outer(moved, moved)
    return found


Quantity = Literal["force", "dent", "width", "slip"]
QUANTITY: dict[str, Quantity] = {
    "fx": "force", "fy": "force", "fz": "force", "dent": "dent", "width": "width", "slip_x": "slip", "slip_y": "slip",
}  # fmt: skip
MIN_CORNER_COSINE = np.cos(np.radians(20.0))  # of the directions of two steps; the path turns if it is smaller


@dataclass(frozen=True, slots=True, eq=False)
class Press:
    """One recorded press or squeeze, moment by moment."""

    name: str
    poses: Mapping[str, tuple[Pose, ...]]  # by the part that moves: n poses each
    readings: Mapping[str, FloatArray]  # by channel, such as "lower.fz": (n,) [N, or m], NaN where not measured
    time: FloatArray  # (n,) [s]
    repeats: NDArray[np.int64]  # (n,) number of readings in each mean
    ball: float | None = None  # radius of the pressed ball, if it is not the scene's indenter [m]

    @property
    def places(self) -> FloatArray:
        """(n, 6 k) positions of the k parts, and their rotation vectors times ARM [m]."""
        lever = 5e-3  # about half a gel: from its centre to its edge [m]
        turned = [[lever * pose_difference(poses[0], pose)[3:] for pose in poses] for poses in self.poses.values()]
        return np.hstack([*([pose.position for pose in poses] for poses in self.poses.values()), *turned])

    def at(self, moments: Sequence[int]) -> Press:
        """Only these moments."""
        chosen = np.array(moments)
        return replace(
            self,
            poses={part: tuple(poses[k] for k in moments) for part, poses in self.poses.items()},
            readings={channel: values[chosen] for channel, values in self.readings.items()},
            time=self.time[chosen],
            repeats=self.repeats[chosen],
        )


@dataclass(frozen=True, slots=True)
class Noise:
    """Standard deviations of single readings."""

    force: float = 0.02  # [N]
    dent: float = 5e-6  # of the root mean square of a height map [m]
    width: float = 50e-6  # of the width of a dent: an error of the pixel pitch by 2 % [m]
    slip: float = 10e-6  # of the mean of a flow [m]


def merge_repeated_readings(press: Press) -> Press:
    """The press with the mean of readings that were taken in one place."""
    same_place = 1e-6  # parts that move less are in the same place [m]
    places = press.places
    moved = np.abs(np.diff(places, axis=0)).max(axis=1) > same_place
    group = np.concatenate([[0], np.cumsum(moved)])
    first = [int(np.flatnonzero(group == k)[0]) for k in range(group[-1] + 1)]
    result = press.at(first)
    mean = [group == k for k in range(group[-1] + 1)]
    return replace(
        result,
        readings={name: np.array([values[rows].mean() for rows in mean]) for name, values in press.readings.items()},
        time=np.array([press.time[rows].mean() for rows in mean]),
        repeats=np.array([int(press.repeats[rows].sum()) for rows in mean]),
    )


def downsample_press(press: Press, max_moments: int) -> Press:
    """At most about `max_moments` moments, evenly along the path, with its ends and the points where it turns."""
    places = press.places
    count = len(places)
    if count <= max_moments:
        return press
    steps = np.diff(places, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    along = np.concatenate([[0.0], np.cumsum(lengths)])
    kept = {0, count - 1}
    for k in range(1, count - 1):
        both = lengths[k - 1] * lengths[k]
        if both > 0 and steps[k - 1] @ steps[k] < MIN_CORNER_COSINE * both:
            kept.add(k)
    kept |= {int(np.argmin(np.abs(along - at))) for at in np.linspace(0.0, along[-1], max_moments)}
    return press.at(sorted(kept))


def signals_of(presses: Sequence[Press], noise: Noise) -> Signals:
    """All measured signals as rows of a fit, in the order of press, channel and moment."""
    channels = tuple(sorted({name for press in presses for name in press.readings}))
    rows: list[tuple[FloatArray, FloatArray, FloatArray, int, int]] = []
    for index, press in enumerate(presses):
        for name, values in press.readings.items():
            there = np.isfinite(values)
            spread = getattr(noise, QUANTITY[name.partition(".")[2]]) / np.sqrt(press.repeats[there])
            rows.append((values[there], spread, press.time[there], index, channels.index(name)))
    return Signals(
        values=np.concatenate([row[0] for row in rows]),
        noise=np.concatenate([row[1] for row in rows]),
        press=np.concatenate([np.full(len(row[0]), row[3]) for row in rows]),
        channel=np.concatenate([np.full(len(row[0]), row[4]) for row in rows]),
        time=np.concatenate([row[2] for row in rows]),
        channels=channels,
        force=np.array([QUANTITY[name.partition(".")[2]] == "force" for name in channels]),
    )
