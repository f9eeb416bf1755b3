"""Shapes of contacts: ellipses for pixels that are not square, and slopes that indicate another ball.

The presses are fitted together again from their refined circles, with more parameters: one ratio of axes and its
direction for all, and for each press the blur of its rim and the radius of its ball. The light is eliminated as in
:mod:`calibration.light.refinement`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibration.light import tuning
from calibration.light.dent import ContactCircle, dent_gradient, dent_height
from calibration.light.photometry import photometric_features
from calibration.light.press import Window
from tacsim.interface import FloatArray

DEGREE, RIDGE = 3, 1e-4  # of the light that is eliminated
MAX_STEPS, MIN_GAIN = 12, 1e-4
PRESS_STEPS = np.array([0.05, 0.05, -0.05, 0.005, 0.05])  # of differences: x, y, radius [px], log ball, blur [px]
COMMON_STEPS = np.array([0.05, 0.003, 0.003])  # of the thinness and of both parts of the stretch


@dataclass(frozen=True, slots=True)
class Stretch:
    """Ratio of the axes of contacts, and direction of the longer axis."""

    ratio: float  # of the axes of a round contact, 1 or more
    angle: float  # of the longer axis from x towards y [degrees], -90 to 90
    uncertainty: float  # of the ratio: half the difference between two halves of the presses; NaN for few

    def __str__(self) -> str:
        spread = "" if np.isnan(self.uncertainty) else f" ± {self.uncertainty:.3f}"
        return f"{self.ratio:.3f}{spread}, the longer axis {self.angle:.0f} degrees from x"


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """Parameters of n presses (n, 5): x, y, radius [px], log of the ball's radius, blur [px]; and three common ones:
    thinness of the gel, stretch along x over y, stretch along the diagonal."""

    presses: FloatArray
    common: FloatArray


def fit_stretch(
    windows: Sequence[Window], circles: Sequence[ContactCircle], thickness: float, ball: float, shape: tuple[int, int]
) -> Stretch:
    """The common ratio of axes of contacts. ball: its radius. thickness: of the gel [px]."""
    position = 1 if len(windows) > tuning.MAX_FEW_PRESSES else 0
    free = ((0, 1, 2, 4), (0, 1, 2))

    def parts(chosen: slice) -> FloatArray:
        common = _minimise(windows[chosen], circles[chosen], ball / thickness, ball, shape, position, free).common
        return np.asarray(common[1:], dtype=np.float64)

    found, spread = parts(slice(None)), float("nan")
    if len(windows) > tuning.MAX_FEW_PRESSES:
        one, other = (parts(slice(start, None, 2)) for start in (0, 1))
        spread = float(np.hypot(*(one - other)))  # half the difference; a ratio is twice the logarithm
    # the fit squeezes a picture until contacts are round, so the picture is stretched by its inverse
    angle = float(np.degrees(np.arctan2(-found[1], -found[0]))) / 2
    return Stretch(float(np.exp(2 * np.hypot(*found))), angle, spread)


def find_other_balls(
    windows: Sequence[Window], circles: Sequence[ContactCircle], thickness: float, ball: float, shape: tuple[int, int]
) -> tuple[tuple[int, ...], float]:
    """The presses, a minority, with a ball of another radius than the rest, and the ratio of the radii. Under one light
    the slopes of a press identify its ball. No press if one ball explains all."""
    if len(windows) <= tuning.MAX_FEW_PRESSES:
        return (), 1.0
    free = ((0, 1, 2, 3, 4), (0, 1, 2))
    balls = _minimise(windows, circles, ball / thickness, ball, shape, 0, free).presses[:, 3]
    order = np.argsort(balls)
    gaps = np.diff(balls[order])
    cut = int(np.argmax(gaps)) + 1
    low, high = balls[order[:cut]], balls[order[cut:]]
    within = np.sqrt((((low - low.mean()) ** 2).sum() + ((high - high.mean()) ** 2).sum()) / (len(balls) - 2))
    if gaps[cut - 1] < max(tuning.MIN_BALL_GAP, tuning.MIN_GAP_DEVIATIONS * within):
        return (), 1.0
    ratio = float(np.exp(low.mean() - high.mean()))
    few, ratio = (order[:cut], ratio) if cut <= len(balls) / 2 else (order[cut:], 1 / ratio)
    return tuple(int(k) for k in few), ratio


def _minimise(
    windows: Sequence[Window],
    circles: Sequence[ContactCircle],
    thinness: float,
    ball: float,
    shape: tuple[int, int],
    position: int,
    free: tuple[tuple[int, ...], tuple[int, ...]],
) -> _Fit:
    """From circles to the least cost near them, by Levenberg and Marquardt's steps. `free`: columns of the presses'
    parameters, and of the common ones, that are fitted; `position`: degree of the light in the place."""
    model = _Model(windows, ball, shape, position)
    fit = _Fit(
        np.array([[c.x, c.y, c.radius, 0.0, tuning.RIM_BLUR] for c in circles]),
        np.array([np.clip(thinness, *tuning.THINNESS_BOUNDS), 0.0, 0.0]),
    )
    cost, damping, own = model.cost(fit), 1e-2, len(free[0]) * len(windows)
    for _ in range(MAX_STEPS):
        gradient, curvature = model.normal_equations(fit, free)
        for _ in range(8):
            damped = curvature + damping * np.diag(np.diag(curvature) + 1e-12)
            step: FloatArray = np.asarray(np.linalg.solve(damped, -gradient), dtype=np.float64)
            trial = _step_fit(fit, free, step[:own].reshape(len(windows), -1), step[own:], ball)
            trial_cost = model.cost(trial)
            if trial_cost < cost:
                break
            damping *= 4
        else:
            break
        gain, fit, cost, damping = 1 - trial_cost / cost, trial, trial_cost, damping / 3
        if gain < MIN_GAIN:
            break
    return fit


def _step_fit(
    fit: _Fit, free: tuple[tuple[int, ...], tuple[int, ...]], by: FloatArray, common_by: FloatArray, ball: float
) -> _Fit:
    blur_bounds = (0.3, 12.0)  # [px]
    presses, common = fit.presses.copy(), fit.common.copy()
    presses[:, free[0]] += by
    common[list(free[1])] += common_by
    presses[:, 3] = np.clip(presses[:, 3], -1.2, 1.2)
    presses[:, 4] = np.clip(presses[:, 4], *blur_bounds)
    presses[:, 2] = np.clip(presses[:, 2], 1.0, tuning.MAX_RIM_RATIO * ball * np.exp(presses[:, 3]))
    common[0] = np.clip(common[0], *tuning.THINNESS_BOUNDS)
    common[1:] = np.clip(common[1:], -0.5, 0.5)
    return _Fit(presses, common)


class _Model:
    """Costs of fits to the same windows."""

    def __init__(self, windows: Sequence[Window], ball: float, shape: tuple[int, int], position: int) -> None:
        self._windows, self._ball, self._shape, self._position = windows, ball, shape, position
        self._power = sum(float((window.change**2).sum()) for window in windows)

    def cost(self, fit: _Fit) -> float:
        _, _, residuals, _ = self._solve_light(fit)
        prior = tuning.SCALE_PRIOR * self._power * len(self._windows) * float(fit.presses[:, 3].mean()) ** 2
        return sum(float((residual**2).sum()) for residual in residuals) + prior

    def normal_equations(
        self, fit: _Fit, free: tuple[tuple[int, ...], tuple[int, ...]]
    ) -> tuple[FloatArray, FloatArray]:
        """Gradient and Gauss-Newton curvature of half the cost; the part that the light explains is projected out."""
        terms, weights, residuals, square = self._solve_light(fit)
        count, own, common = len(self._windows), free[0], free[1]
        size = len(own) * count + len(common)
        gradient, curvature, onto = np.zeros(size), np.zeros((size, size)), np.zeros((3, size, len(square)))
        for i in range(count):
            slopes = []
            for which, steps in ((own, PRESS_STEPS), (common, COMMON_STEPS)):
                for k in which:
                    press, shared = fit.presses[i].copy(), fit.common.copy()
                    (press if which is own else shared)[k] += steps[k]
                    slopes.append(-(self._terms(i, press, shared) - terms[i]) @ weights / steps[k])
            moved = np.stack(slopes)
            at = np.r_[len(own) * i : len(own) * (i + 1), len(own) * count : size]
            gradient[at] += np.einsum("pnc,nc->p", moved, residuals[i])
            curvature[np.ix_(at, at)] += np.einsum("pnc,qnc->pq", moved, moved, optimize=True)
            onto[:, at] += np.einsum("pnc,nk->cpk", moved, terms[i], optimize=True)
        curvature -= np.einsum("cpk,kl,cql->pq", onto, np.linalg.inv(square), onto, optimize=True)
        if 3 in own:
            at = np.array([len(own) * i + own.index(3) for i in range(count)])
            gradient[at] += tuning.SCALE_PRIOR * self._power * fit.presses[:, 3].mean()
            curvature[np.ix_(at, at)] += tuning.SCALE_PRIOR * self._power / count
        return gradient, curvature

    def _solve_light(self, fit: _Fit) -> tuple[list[FloatArray], FloatArray, list[FloatArray], FloatArray]:
        """Terms of each press, weights of the light, residuals, and the square matrix of the light's equations."""
        terms = [self._terms(i, press, fit.common) for i, press in enumerate(fit.presses)]
        square = np.sum([t.T @ t for t in terms], axis=0)
        right = np.sum([t.T @ w.change for t, w in zip(terms, self._windows, strict=True)], axis=0)
        square = square + RIDGE * np.trace(square) / len(square) * np.eye(len(square))
        weights = np.asarray(np.linalg.solve(square, right), dtype=np.float64)
        return terms, weights, [w.change - t @ weights for t, w in zip(terms, self._windows, strict=True)], square

    def _terms(self, i: int, press: FloatArray, common: FloatArray) -> FloatArray:
        """(n, terms) of the light, of a press whose contact is round once its picture is squeezed."""
        window, (x, y, radius, scale, blur), (thinness, along, across) = self._windows[i], press, common
        far = np.hypot(along, across)
        even, odd = np.cosh(far), np.sinh(far) / max(far, 1e-12)
        dx, dy = window.u - x, window.v - y
        u, v = (even + odd * along) * dx + odd * across * dy, odd * across * dx + (even - odd * along) * dy
        ball, thickness = self._ball * float(np.exp(scale)), self._ball / float(thinness)
        circle = ContactCircle(0.0, 0.0, min(float(radius), tuning.MAX_RIM_RATIO * ball))
        gradient = dent_gradient(u, v, circle, thickness, ball, float(blur))
        depth = dent_height(u, v, circle, thickness, ball)[:, None] / self._ball
        rows, columns = self._shape
        place = (window.u + 0.5) / columns - 0.5, (window.v + 0.5) / rows - 0.5
        return np.concatenate([photometric_features(gradient, *place, DEGREE, self._position), depth], axis=1)
