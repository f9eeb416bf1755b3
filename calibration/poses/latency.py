"""Latency of a camera's picture relative to an arm's state, from a few taps on a firm object.

The arm moves down and up; its depth and the contact signal of the picture are two signals over arrival times. The
contact signal is an unknown increasing function of the depth: by the rearrangement inequality (Hardy, Littlewood, Polya
1934, section 10.13) the correlation of the two is then greatest at the true shift. That function is fitted (isotonic
regression) and the shift refined, in turn. Correlations are evaluated at the camera's own, irregular times: only the
arm's fast signal is interpolated.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import isotonic_regression, minimize_scalar

from calibration.poses.tuning import MAX_SECOND_PEAK, MIN_CORRELATION, MIN_SAMPLES, PEAK_HALF_WIDTH
from tacsim.interface import FloatArray

COARSE_STEP = 1e-3  # of the coarse search [s]


class NoLatency(ValueError):
    """The two signals do not determine a latency."""


@dataclass(frozen=True, slots=True)
class Latency:
    """Delay of the second signal relative to the first."""

    seconds: float  # latency of the camera minus that of the arm [s]
    uncertainty: float  # one standard deviation: jackknife over stretches of the record [s]
    correlation: float  # at the best shift [-]
    samples: int  # number of pictures used


def estimate_latency(
    depth_times: ArrayLike,
    depth: ArrayLike,
    touch_times: ArrayLike,
    touch: ArrayLike,
    search: tuple[float, float] = (-0.1, 0.5),
) -> Latency:
    """Latency of `touch` (m,) at `touch_times` (m,) [s] behind `depth` (n,) at `depth_times` (n,) [s].

    `depth` grows towards contact, in any unit (of a sensor that presses down: minus z); rates may be irregular. The
    record begins and ends without contact and has three taps or more, at uneven intervals. `search`: bounds of the
    latency [s]. Raises NoLatency if the signals do not correlate, or fit several latencies, ValueError for arrays
    that are no signals.
    """
    blocks = 8
    arm_times, arm = _check_signal(depth_times, depth, "depth")
    times, observed = _check_signal(touch_times, touch, "touch")
    low, high = search
    if not low < high:
        raise ValueError(f"search must be two increasing bounds [s], got {search}")
    covered = (times - high >= arm_times[0]) & (times - low <= arm_times[-1])
    times, observed = times[covered], observed[covered]
    if len(times) < MIN_SAMPLES:
        raise NoLatency(
            f"only {len(times)} pictures lie where the arm's record covers latencies of {low:g} to {high:g} s, "
            f"{MIN_SAMPLES} are needed; record longer, with a pause before and after the taps"
        )

    shifts = np.arange(low, high + 0.5 * COARSE_STEP, COARSE_STEP)
    curve = np.array([_correlation(np.interp(times - shift, arm_times, arm), observed) for shift in shifts])
    best = int(np.argmax(curve))
    _check_peak(shifts, curve, best)

    fit = partial(_fit_shift, float(shifts[best]), arm_times, arm)
    shift, likeness = fit(times, observed)
    parts = np.array_split(np.arange(len(times)), blocks)
    without = np.array([fit(np.delete(times, gone), np.delete(observed, gone))[0] for gone in parts])
    spread = (blocks - 1) / blocks * float(((without - without.mean()) ** 2).sum())
    return Latency(seconds=shift, uncertainty=float(np.sqrt(spread)), correlation=likeness, samples=len(times))


def _fit_shift(
    shift: float, arm_times: FloatArray, arm: FloatArray, times: FloatArray, observed: FloatArray
) -> tuple[float, float]:
    """Response and shift in turn, from the coarse `shift` on: the shift [s], and the correlation there."""
    iterations = 5  # fits of the response and the shift in turn
    likeness = 0.0
    for _ in range(iterations):
        response = _fit_response(np.interp(times - shift, arm_times, arm), observed)
        expected = np.interp(arm, *response)  # the contact signal of a camera without latency
        found = minimize_scalar(
            lambda tried, touch=expected: -_correlation(np.interp(times - tried, arm_times, touch), observed),
            bounds=(shift - PEAK_HALF_WIDTH, shift + PEAK_HALF_WIDTH),
            method="bounded",
            options={"xatol": 1e-6},
        )
        shift, likeness = float(found.x), -float(found.fun)
    return shift, likeness


def _fit_response(depth: FloatArray, touch: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The increasing function of depth that fits the contact signal best: increasing abscissae, and values."""
    order = np.argsort(depth, kind="stable")
    fitted = np.asarray(isotonic_regression(touch[order]).x, dtype=np.float64)
    abscissae, first = np.unique(depth[order], return_index=True)
    counts = np.diff([*first, len(depth)])
    return abscissae, np.add.reduceat(fitted, first) / counts


def _check_signal(times: ArrayLike, values: ArrayLike, what: str) -> tuple[FloatArray, FloatArray]:
    t, x = np.array(times, dtype=np.float64), np.array(values, dtype=np.float64)
    if t.ndim != 1 or t.shape != x.shape or len(t) < 2:
        raise ValueError(f"{what}: needs as many times as values, two at least, got shapes {t.shape} and {x.shape}")
    if not (np.isfinite(t).all() and np.isfinite(x).all()):
        raise ValueError(f"{what}: times and values must be finite")
    if not (np.diff(t) > 0.0).all():
        raise ValueError(f"{what}: times must increase from sample to sample")
    if float(np.ptp(x)) <= 1e-12 * max(1.0, float(np.abs(x).max())):
        raise NoLatency(f"{what}: the signal never changes; tap so that contact begins and ends")
    return t, x


def _correlation(a: FloatArray, b: FloatArray) -> float:
    """Pearson correlation; 0 if one signal is constant."""
    a, b = a - a.mean(), b - b.mean()
    size = float(np.sqrt((a @ a) * (b @ b)))
    return float(a @ b) / size if size > 0.0 else 0.0


def _check_peak(shifts: FloatArray, curve: FloatArray, best: int) -> None:
    """Raises NoLatency unless the peak is high, inside the range and the only one."""
    if curve[best] < MIN_CORRELATION:
        raise NoLatency(
            f"the signals do not correlate: {curve[best]:.2f} at best, {MIN_CORRELATION} is needed. Does the sensor "
            "see this arm's taps, and does `depth` grow towards contact?"
        )
    if best in (0, len(curve) - 1):
        raise NoLatency(f"the best latency is at the edge of the search, {shifts[best]:.3f} s; widen the search")
    inner = curve[1:-1]
    peaks = np.flatnonzero((inner >= curve[:-2]) & (inner >= curve[2:])) + 1
    rivals = [
        k for k in peaks if abs(k - best) * COARSE_STEP > PEAK_HALF_WIDTH and curve[k] > MAX_SECOND_PEAK * curve[best]
    ]
    if rivals:
        raise NoLatency(
            f"latencies of {shifts[best]:.3f} s and {shifts[rivals[0]]:.3f} s fit alike; tap at uneven intervals"
        )
