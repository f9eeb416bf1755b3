"""Do the presses follow the model at all? What a fit must not hide: a wrong contact, a zero of the force that drifts.

A zero that is off by a constant is a nuisance and fitted. One that drifts, and forces that no material of this kind
gives, are told; the fit is then not to be used.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.stats import chi2, norm

from calibration.materials.estimate import Fit, Signals
from tacsim.interface import FloatArray

CHANCE = 1e-3  # a finding that chance alone would bring more seldom counts


@dataclass(frozen=True, slots=True)
class Finding:
    """Something that speaks against the fit."""

    kind: Literal["misfit", "drift"]
    words: str
    chance: float  # of the like without a cause


def findings(fit: Fit, signals: Signals, names: tuple[str, ...]) -> list[Finding]:
    """What speaks against the fit, the drift first: it explains a misfit too. names: of the presses."""
    drifts = _drifts(fit, signals, names)
    return drifts or _misfits(fit, signals, names)


def _drifts(fit: Fit, signals: Signals, names: tuple[str, ...]) -> list[Finding]:
    """Zeros that drift, each as one more unknown beside all others of the fit: a slope over the time of its press."""
    found = []
    residual = (signals.values - fit.predicted) / fit.sigma
    pairs = sorted({(p, c) for p, c in zip(signals.press.tolist(), signals.channel.tolist(), strict=True)})
    pairs = [(p, c) for p, c in pairs if signals.force[c]]
    columns = []
    for which, force in pairs:
        rows = (signals.press == which) & (signals.channel == force)
        time = np.where(rows, signals.time, 0.0)
        middle, length = time[rows].mean(), max(float(np.ptp(time[rows])), 1e-9)
        columns.append(np.where(rows, (time - middle) / length, 0.0))
    seen: list[FloatArray] = []  # those found before: one that drifts pulls at all others
    while len(seen) < len(pairs):
        sizes = np.array([_one_more(fit, [*seen, column], residual) for column in columns])
        worst = int(np.argmax(np.abs(sizes[:, 0]) / sizes[:, 1]))
        press, channel = pairs[worst]
        size, spread = (float(each) for each in sizes[worst])
        chance = float(2 * norm.sf(abs(size) / spread)) * len(pairs)
        if chance > CHANCE:
            break
        seen.append(columns[worst])
        found.append(
            Finding(
                "drift",
                f"{names[press]}: the zero of {signals.channels[channel]} drifts by {size:+.3g} N from beginning to "
                f"end (give or take {2 * spread:.2g}); let the sensor warm up, zero it before each press, and record "
                "again",
                chance,
            )
        )
    return found


def _one_more(fit: Fit, columns: list[FloatArray], residual: FloatArray) -> tuple[float, float]:
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


def _misfits(fit: Fit, signals: Signals, names: tuple[str, ...]) -> list[Finding]:
    found = []
    residual = (signals.values - fit.predicted) / fit.sigma
    whole = float((residual**2).sum())
    chance = float(chi2.sf(whole, fit.freedom))
    worst = _worst(residual, signals, names)
    if chance < CHANCE:
        found.append(
            Finding(
                "misfit",
                f"no such material gives these signals: off by {math.sqrt(whole / fit.freedom):.1f} times what noise "
                f"and mesh explain, most of all {worst}; is the indenter or body of that shape and size and in that "
                "place, are axes and units right, is the noise larger than stated?",
                chance,
            )
        )
        return found
    chance = _runs(residual, signals)
    if chance < CHANCE and whole > 0.5 * fit.freedom:
        found.append(
            Finding(
                "misfit",
                f"measured and fitted forces differ in a bow, not at random, most of all {worst}: the contact is not "
                "what the scene says; look at its shape and size, and at where it begins",
                chance,
            )
        )
    return found


def _worst(residual: FloatArray, signals: Signals, names: tuple[str, ...]) -> str:
    """The press and channel that fit worst, in words."""
    sizes = {}
    for p in range(signals.presses):
        for c, channel in enumerate(signals.channels):
            rows = (signals.press == p) & (signals.channel == c)
            if rows.any():
                sizes[f"{channel} of {names[p]}"] = float((residual[rows] ** 2).mean())
    return max(sizes, key=lambda name: sizes[name])


def _runs(residual: FloatArray, signals: Signals) -> float:
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
