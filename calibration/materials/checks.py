"""Do the presses follow the model at all? What a fit must not hide: a wrong contact, a zero of the force that drifts.

A zero that is off by a constant is a nuisance and fitted. One that drifts, and forces that no material of this kind
gives, are told; the fit is then not to be used.
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
    """Something that speaks against the fit."""

    kind: Literal["misfit", "drift", "size"]
    text: str
    probability: float  # of the like without a cause


@dataclass(frozen=True, slots=True, eq=False)
class _CandidateCause:
    """A cause that a fit of materials leaves out: one more linear unknown."""

    column: FloatArray  # (m,)
    kind: Literal["drift", "size"]
    text: Callable[[float, float], str]  # of its size and twice its standard deviation
    allowed: float = 0.0  # as large as this it does no harm


def find_contradictions(
    fit: Fit, signals: Signals, names: tuple[str, ...], by_size: FloatArray | None = None
) -> list[Finding]:
    """What speaks against the fit; causes first, they explain a misfit too.

    names: of the presses. by_size: (m, b) derivative of the signals by the logarithm of the size of each indenter.
    """
    candidates = _drift_candidates(signals, names)
    for column in () if by_size is None else by_size.T:
        pressed = ", ".join(names[press] for press in sorted(set(signals.press[column != 0].tolist())))
        candidates.append(_CandidateCause(column, "size", partial(_describe_size, pressed), MAX_SIZE_ERROR))
    return _test_candidates(fit, signals, candidates) or _find_misfits(fit, signals, names)


def indenter_size_error(fit: Fit, by_size: FloatArray) -> float:
    """Standard deviation of the logarithm of an indenter's size, if the signals alone were to tell it; of several the
    greatest. by_size: (m, b)."""
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
        f"{press}: the zero of {channel} drifts by {size:+.3g} N from beginning to end (give or take {spread:.2g}); "
        "let the sensor warm up, zero it before each press, and record again"
    )


def _describe_size(presses: str, size: float, spread: float) -> str:
    return (
        f"{presses}: felt and seen is an indenter about {math.exp(size):.2f} times as large as stated (give or take "
        f"{100 * spread:.0f} %), or of another shape; measure it, and check the pixel pitch of the sensor"
    )


def _test_candidates(fit: Fit, signals: Signals, candidates: list[_CandidateCause]) -> list[Finding]:
    """The suspects that the signals show, each as one more unknown beside all others of the fit."""
    found: list[Finding] = []
    residual = (signals.values - fit.predicted) / fit.sigma
    seen: list[FloatArray] = []  # the columns of those found before: one that is wrong pulls at all others
    while len(seen) < len(candidates):
        sizes = [_fit_one_more(fit, [*seen, each.column], residual) for each in candidates]
        clear = [
            max(abs(size) - each.allowed, 0.0) / spread for each, (size, spread) in zip(candidates, sizes, strict=True)
        ]
        worst = int(np.argmax(clear))
        chance = float(2 * norm.sf(clear[worst])) * len(candidates)
        if chance > MAX_PROBABILITY:
            break
        seen.append(candidates[worst].column)
        size, spread = sizes[worst]
        found.append(Finding(candidates[worst].kind, candidates[worst].text(size, 2 * spread), chance))
    return found


def _fit_one_more(fit: Fit, columns: list[FloatArray], residual: FloatArray) -> tuple[float, float]:
    """What the fit gives for the last of these further linear unknowns, and its standard deviation."""
    p = len(fit.free)
    rows = np.column_stack([fit.system, *columns]) / fit.sigma[:, None]
    known = np.zeros((len(fit.priors), rows.shape[1]))
    known[:, p : p + len(fit.priors)] = np.diag(1.0 / fit.priors)
    whole = np.vstack([rows, known])
    right = np.concatenate([residual, -fit.nuisances / fit.priors])
    triangle = np.asarray(np.linalg.qr(whole, mode="r"))
    last = abs(float(triangle[-1, -1]))  # what of the column no other column explains
    if last < 1e-3 * np.linalg.norm(whole[:, -1]):
        return 0.0, math.inf  # cannot be told from the others
    solved = np.linalg.lstsq(whole, right, rcond=1e-12)[0]
    return float(solved[-1]), 1.0 / last


def _find_misfits(fit: Fit, signals: Signals, names: tuple[str, ...]) -> list[Finding]:
    found = []
    residual = (signals.values - fit.predicted) / fit.sigma
    whole = float((residual**2).sum())
    chance = float(chi2.sf(whole, fit.degrees_of_freedom))
    worst = _worst_channel(residual, signals, names)
    if chance < MAX_PROBABILITY:
        found.append(
            Finding(
                "misfit",
                f"no such material gives these signals: off by {math.sqrt(whole / fit.degrees_of_freedom):.1f} times "
                f"what noise and mesh explain, most of all {worst}; is the indenter or body of that shape and size and "
                "in that place, are axes and units right, is the noise larger than stated?",
                chance,
            )
        )
        return found
    chance = _runs_test(residual, signals)
    if chance < MAX_PROBABILITY and whole > 0.5 * fit.degrees_of_freedom:
        found.append(
            Finding(
                "misfit",
                f"measured and fitted forces differ in a bow, not at random, most of all {worst}: the contact is not "
                "what the scene says; look at its shape and size, and at where it begins",
                chance,
            )
        )
    return found


def _worst_channel(residual: FloatArray, signals: Signals, names: tuple[str, ...]) -> str:
    """The press and channel that fit worst, in words."""
    sizes = {}
    for p in range(signals.presses):
        for c, channel in enumerate(signals.channels):
            rows = (signals.press == p) & (signals.channel == c)
            if rows.any():
                sizes[f"{channel} of {names[p]}"] = float((residual[rows] ** 2).mean())
    return max(sizes, key=lambda name: sizes[name])


def _runs_test(residual: FloatArray, signals: Signals) -> float:
    """Chance of so few runs of equal signs (Wald & Wolfowitz 1940), over all presses and channels in order of time."""
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
