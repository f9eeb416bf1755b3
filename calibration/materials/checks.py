"""Checks that the presses follow the model: a fit must not hide a wrong contact, or a zero of the force that drifts.

A constant error of a zero is a nuisance parameter of the fit. A zero that drifts, and forces that no material of this
kind produces, are findings; the fit must then not be used.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np
from scipy.stats import chi2, norm

from calibration.materials.fit import Fit, Signals
from calibration.materials.tuning import MAX_PROBABILITY, MAX_SIZE_ERROR
from tacsim.interface import FloatArray


@dataclass(frozen=True, slots=True)
class Finding:
    """An observation that contradicts the fit."""

    kind: Literal["misfit", "drift", "size"]
    text: str
    probability: float  # without a known cause


@dataclass(frozen=True, slots=True, eq=False)
class _CandidateCause:
    """A cause outside the fit of materials: one additional linear unknown."""

    column: FloatArray  # (m,)
    kind: Literal["drift", "size"]
    text: Callable[[float, float], str]  # of its size and twice its standard deviation
    allowed: float = 0.0  # a smaller size is harmless


def find_contradictions(
    fit: Fit, signals: Signals, names: tuple[str, ...], by_size: FloatArray | None = None
) -> list[Finding]:
    """The findings that contradict the fit. Causes are first, because they can also explain a misfit.

    names: of the presses. by_size: (m, b) derivative of the signals by the logarithm of the size of each indenter.
    """
    candidates = _drift_candidates(signals, names)
    for column in () if by_size is None else by_size.T:
        pressed = ", ".join(names[press] for press in sorted(set(signals.press[column != 0].tolist())))
        candidates.append(_CandidateCause(column, "size", partial(_describe_size, pressed), MAX_SIZE_ERROR))
    return _test_candidates(fit, signals, candidates) or _find_misfits(fit, signals, names)


def indenter_size_error(fit: Fit, by_size: FloatArray) -> float:
    """Standard deviation of the logarithm of an indenter's size from the signals alone; of several indenters the
    largest. by_size: (m, b)."""
    return max(_fit_one_more(fit, [column], np.zeros(len(column)))[1] for column in by_size.T)


def _drift_candidates(signals: Signals, names: tuple[str, ...]) -> list[_CandidateCause]:
    """Zeros that drift: a slope over the time of each press, for each of its forces."""
    found = []
    for press, force in sorted({(p, c) for p, c in zip(signals.press.tolist(), signals.channel.tolist(), strict=True)}):
        if not signals.force[force]:
            continue
        rows = (signals.press == press) & (signals.channel == force)
        time = np.where(rows, signals.time, 0.0)
        middle, length = time[rows].mean(), max(float(np.ptp(time[rows])), 1e-9)
        words = partial(_describe_drift, names[press], signals.channels[force])
        found.append(_CandidateCause(np.where(rows, (time - middle) / length, 0.0), "drift", words))
    return found


def _describe_drift(press: str, channel: str, size: float, spread: float) -> str:
    return (
        f"{press}: the zero of {channel} drifts by {size:+.3g} N from beginning to end (± {spread:.2g}); "
        "let the sensor warm up, zero it before each press, and record again"
    )


def _describe_size(presses: str, size: float, spread: float) -> str:
    return (
        f"{presses}: forces and heights fit an indenter about {math.exp(size):.2f} times as large as stated (± "
        f"{100 * spread:.0f} %), or of another shape; measure it, and check the pixel pitch of the sensor"
    )


def _test_candidates(fit: Fit, signals: Signals, candidates: list[_CandidateCause]) -> list[Finding]:
    """The suspects that the signals show, each as one unknown in addition to all others of the fit."""
    found: list[Finding] = []
    residual = (signals.values - fit.predicted) / fit.sigma
    # columns of the causes found before, because one large error also affects all other estimates
    found_columns: list[FloatArray] = []
    while len(found_columns) < len(candidates):
        sizes = [_fit_one_more(fit, [*found_columns, each.column], residual) for each in candidates]
        clear = [
            max(abs(size) - each.allowed, 0.0) / spread for each, (size, spread) in zip(candidates, sizes, strict=True)
        ]
        worst = int(np.argmax(clear))
        probability = float(2 * norm.sf(clear[worst])) * len(candidates)
        if probability > MAX_PROBABILITY:
            break
        found_columns.append(candidates[worst].column)
        size, spread = sizes[worst]
        found.append(Finding(candidates[worst].kind, candidates[worst].text(size, 2 * spread), probability))
    return found


def _fit_one_more(fit: Fit, columns: list[FloatArray], residual: FloatArray) -> tuple[float, float]:
    """Estimate and standard deviation of the last of these additional linear unknowns."""
    p = len(fit.free)
    rows = np.column_stack([fit.system, *columns]) / fit.sigma[:, None]
    known = np.zeros((len(fit.priors), rows.shape[1]))
    known[:, p : p + len(fit.priors)] = np.diag(1.0 / fit.priors)
    whole = np.vstack([rows, known])
    right = np.concatenate([residual, -fit.nuisances / fit.priors])
    triangle = np.asarray(np.linalg.qr(whole, mode="r"))
    last = abs(float(triangle[-1, -1]))  # norm of the part of the column that is independent of the others
    if last < 1e-3 * np.linalg.norm(whole[:, -1]):
        return 0.0, math.inf  # not distinguishable from the others
    solved = np.linalg.lstsq(whole, right, rcond=1e-12)[0]
    return float(solved[-1]), 1.0 / last


def _find_misfits(fit: Fit, signals: Signals, names: tuple[str, ...]) -> list[Finding]:
    found = []
    residual = (signals.values - fit.predicted) / fit.sigma
    whole = float((residual**2).sum())
    probability = float(chi2.sf(whole, fit.degrees_of_freedom))
    worst = _worst_channel(residual, signals, names)
    if probability < MAX_PROBABILITY:
        found.append(
            Finding(
                "misfit",
                f"no such material produces these signals: their error is "
                f"{math.sqrt(whole / fit.degrees_of_freedom):.1f} times that of noise and mesh, most of all {worst}; "
                "check shape, size and place of the indenter or body, axes and units, and the stated noise",
                probability,
            )
        )
        return found
    probability = _runs_test(residual, signals)
    if probability < MAX_PROBABILITY and whole > 0.5 * fit.degrees_of_freedom:
        found.append(
            Finding(
                "misfit",
                f"measured and fitted forces differ systematically, not at random, most of all {worst}: the contact "
                "differs from the scene; check its shape and size, and where it begins",
                probability,
            )
        )
    return found


def _worst_channel(residual: FloatArray, signals: Signals, names: tuple[str, ...]) -> str:
    """Name of the press and channel with the worst fit."""
    sizes = {}
    for p in range(signals.presses):
        for c, channel in enumerate(signals.channels):
            rows = (signals.press == p) & (signals.channel == c)
            if rows.any():
                sizes[f"{channel} of {names[p]}"] = float((residual[rows] ** 2).mean())
    return max(sizes, key=lambda name: sizes[name])


def _runs_test(residual: FloatArray, signals: Signals) -> float:
    """Probability of so few runs of equal signs (Wald & Wolfowitz 1940), over all presses and channels in time."""
    runs = expected = variance = 0.0
    for p in range(signals.presses):
        for c in range(len(signals.channels)):
            rows = np.flatnonzero((signals.press == p) & (signals.channel == c))
            signs = residual[rows[np.argsort(signals.time[rows])]] > 0
            up, down, n = int(signs.sum()), int((~signs).sum()), len(signs)
            if up == 0 or down == 0 or n < 3:
                continue
            runs += 1 + int((signs[1:] != signs[:-1]).sum())
            expected += 2 * up * down / n + 1
            variance += 2 * up * down * (2 * up * down - n) / (n**2 * (n - 1))
    return float(norm.cdf((runs - expected) / math.sqrt(variance))) if variance > 0 else 1.0
