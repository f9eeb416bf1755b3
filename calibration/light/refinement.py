"""Contact circles and the thickness of the gel, refined together with the light that they imply.

The weights of the light are linear given the geometry, so they are eliminated (variable projection, Golub and Pereyra
1973; Kaufman's approximation): Levenberg-Marquardt steps on three numbers for each press and one of the gel reduce
the difference of colour that no light explains. No light is assumed, and the first circles may be approximate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from calibration.light.dent import ContactCircle, dent_gradient, dent_height
from calibration.light.photometry import photometric_features
from calibration.light.press import Window
from calibration.light.shadows import DentShade
from calibration.light.tuning import FIRST_THINNESS, MAX_ALTERNATIVE_COST, MAX_RIM_RATIO, RIM_BLUR, THINNESS_BOUNDS
from tacsim.interface import FloatArray

MAX_GROUPS = 8  # that are left out in turn to estimate the uncertainty of radii


@dataclass(frozen=True, slots=True)
class RefinedGeometry:
    """Geometry of all presses."""

    circles: tuple[ContactCircle, ...]
    thickness: float  # of the gel, from its skirts [px]; above two ball radii it has little effect
    residual_shares: tuple[float, ...]  # share of the power of each press's change of colour
    _ends: tuple[_Problem, ...]  # what each start led to, the best first

    def radius_uncertainty(self) -> float:
        """Standard deviation of the scale of all radii together [-]: by leaving out each group of presses (the
        jackknife), or the difference from another equally good solution, if that is larger. NaN for a single press."""
        best, *others = self._ends
        count = len(best.circles)
        if count < 2:
            return float("nan")
        groups = min(count, MAX_GROUPS)
        scales = []
        for group in range(groups):
            selected = [i for i in range(count) if i % groups != group]
            refined = _minimise(best.select_presses(selected).solved())
            scales.append(_log_scale(refined, best.select_presses(selected)))
        spread = np.sqrt((groups - 1) / groups * np.sum((np.array(scales) - np.mean(scales)) ** 2))
        rivals = [abs(_log_scale(other, best)) for other in others if other.cost < MAX_ALTERNATIVE_COST * best.cost]
        return float(max([spread, *rivals]))


def refine_geometry(
    windows: Sequence[Window],
    start: Sequence[ContactCircle],
    ball: float,
    shade: DentShade | None = None,
    thinness: Sequence[float] = FIRST_THINNESS,
) -> RefinedGeometry:
    """Refines the circles. ball: radius [px]. shade: adds cast shadows of dents to the light. thinness: start value for
    the gel.

    The windows are fixed around `start`, so that the costs of two states can be compared.
    """
    ends = sorted(
        (_minimise(_Problem(windows, tuple(start), first, ball, shade).solved()) for first in thinness),
        key=lambda problem: problem.cost,
    )
    best = ends[0]
    powers = [float((window.change**2).sum()) for window in windows]
    shares = tuple(part / max(power, 1e-300) for part, power in zip(best.part_costs(), powers, strict=True))
    return RefinedGeometry(best.circles, ball / best.thinness, shares, tuple(ends))


def _minimise(state: _Problem) -> _Problem:
    """The state of minimum cost near `state`, by Levenberg-Marquardt steps."""
    min_gain = 1e-4  # relative gain of a step, below which the refinement ends
    max_steps = 25
    damping = 1e-2
    for _ in range(max_steps):
        gradient, curvature = state.normal_equations()
        for _ in range(8):
            step = np.linalg.solve(curvature + damping * np.diag(np.diag(curvature) + 1e-12), -gradient)
            trial = state.moved(np.asarray(step, dtype=np.float64)).solved()
            if trial.cost < state.cost:
                break
            damping *= 4
        else:
            break
        gain = 1.0 - trial.cost / state.cost
        state, damping = trial, damping / 3
        if gain < min_gain:
            break
    return state


def _log_scale(one: _Problem, other: _Problem) -> float:
    """Mean logarithm of the ratio of radii."""
    pairs = zip(one.circles, other.circles, strict=True)
    return float(np.mean([np.log(circle.radius / was.radius) for circle, was in pairs]))


@dataclass(slots=True, eq=False)
class _Problem:
    """One state of the geometry, with the light that fits it."""

    windows: Sequence[Window]
    circles: tuple[ContactCircle, ...]
    thinness: float
    ball: float
    shade: DentShade | None = None
    cost: float = np.inf
    _terms: list[FloatArray] = field(default_factory=list)
    _square: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    _weights: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    _residuals: list[FloatArray] = field(default_factory=list)

    def select_presses(self, selected: Sequence[int]) -> _Problem:
        """The same of some of the presses."""
        windows, circles = [self.windows[i] for i in selected], tuple(self.circles[i] for i in selected)
        return _Problem(windows, circles, self.thinness, self.ball, self.shade)

    def solved(self) -> Self:
        ridge = 1e-4
        self._terms = [self._features(i, self.circles[i], self.thinness) for i in range(len(self.windows))]
        square = sum((t.T @ t for t in self._terms), np.zeros((self._terms[0].shape[1],) * 2))
        right = sum(
            (t.T @ w.change for t, w in zip(self._terms, self.windows, strict=True)), np.zeros((len(square), 3))
        )
        self._square = square + ridge * np.trace(square) / len(square) * np.eye(len(square))
        self._weights = np.asarray(np.linalg.solve(self._square, right), dtype=np.float64)
        self._residuals = [w.change - t @ self._weights for t, w in zip(self._terms, self.windows, strict=True)]
        self.cost = sum(self.part_costs())
        return self

    def part_costs(self) -> list[float]:
        return [float((residual**2).sum()) for residual in self._residuals]

    def normal_equations(self) -> tuple[FloatArray, FloatArray]:
        """Gradient and Gauss-Newton curvature of half the cost by (x, y, radius) of each circle, then the thinness of
        the gel. The part that the light explains is projected out."""
        delta = 0.05  # step of finite differences [px]; of the gel's thinness [-]
        count = 3 * len(self.circles) + 1
        gradient, curvature = np.zeros(count), np.zeros((count, count))
        onto = np.zeros((3, count, len(self._square)))  # by channel: what the weights of the light could explain
        for i, circle in enumerate(self.circles):
            moved = [
                self._features(i, replace(circle, x=circle.x + delta), self.thinness),
                self._features(i, replace(circle, y=circle.y + delta), self.thinness),
                self._features(i, replace(circle, radius=circle.radius - delta), self.thinness),
                self._features(i, circle, self.thinness + delta),
            ]
            signs = (1, 1, -1, 1)
            # of the residual: (4, n, 3)
            slopes = np.stack(
                [-(m - self._terms[i]) @ self._weights * (s / delta) for m, s in zip(moved, signs, strict=True)]
            )
            at = np.array([3 * i, 3 * i + 1, 3 * i + 2, count - 1])
            gradient[at] += np.einsum("pnc,nc->p", slopes, self._residuals[i])
            curvature[np.ix_(at, at)] += np.einsum("pnc,qnc->pq", slopes, slopes, optimize=True)
            onto[:, at] += np.einsum("pnc,nk->cpk", slopes, self._terms[i], optimize=True)
        inverse = np.linalg.inv(self._square)
        curvature -= np.einsum("cpk,kl,cql->pq", onto, inverse, onto, optimize=True)
        return gradient, curvature

    def moved(self, step: FloatArray) -> _Problem:
        circles = tuple(
            ContactCircle(
                circle.x + dx, circle.y + dy, float(np.clip(circle.radius + dr, 1.0, MAX_RIM_RATIO * self.ball))
            )
            for circle, (dx, dy, dr) in zip(self.circles, np.clip(step[:-1].reshape(-1, 3), -4, 4), strict=True)
        )
        thinness = float(np.clip(self.thinness + np.clip(step[-1], -0.5, 0.5), *THINNESS_BOUNDS))
        return _Problem(self.windows, circles, thinness, self.ball, self.shade)

    def _features(self, i: int, circle: ContactCircle, thinness: float) -> FloatArray:
        degree = 3  # of the light during refinement; without shadows the same everywhere on the gel
        window = self.windows[i]
        thickness = self.ball / thinness
        gradient = dent_gradient(window.u, window.v, circle, thickness, self.ball, RIM_BLUR)
        # else larger circles would explain colour that depends on depth, and outside the contact
        depth = dent_height(window.u, window.v, circle, thickness, self.ball)[:, None] / self.ball
        if self.shade is None:
            return np.concatenate([photometric_features(gradient, window.u, window.v, degree, 0), depth], axis=1)
        dark = self.shade.terms(window.u, window.v, circle, thickness, self.ball)
        return np.concatenate([self.shade.light(gradient, window.u, window.v), depth, dark], axis=1)
