"""Geometry of ball presses: contact circles and the thickness of the gel, refined together with the light that they
imply; and the positions of the lamps of their cast shadows.

The weights of the light are linear given the geometry, so they are eliminated (variable projection, Golub and Pereyra
1973; Kaufman's approximation): Levenberg-Marquardt steps on three numbers for each press and one of the gel reduce
the difference of colour that no light explains. No light is assumed, and the first circles may be approximate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from calibration.light.dent import ContactCircle, cached_profile, dent_gradient, dent_height
from calibration.light.photometry import photometric_features
from calibration.light.press import Window
from calibration.light.tuning import FIRST_THINNESS, MAX_ALTERNATIVE_COST, MAX_RIM_RATIO, RIM_BLUR, THINNESS_BOUNDS
from tacsim.interface import FloatArray
from tacsim.models.photometric import Floats, horizon_slope, shadow_terms

MAX_GROUPS = 8  # that are left out in turn to estimate the uncertainty of radii


@dataclass(frozen=True, slots=True)
class DentShade:
    """The lamps of a sensor, and the size of its picture, which determine the shadow around a ball's dent."""

    lamps: tuple[tuple[float, float], ...]  # [widths of the picture], from its centre
    shape: tuple[int, int]  # rows, columns

    def terms(self, u: FloatArray, v: FloatArray, circle: ContactCircle, thickness: float, ball: float) -> FloatArray:
        """(n, terms) of the shadows at pixels u, v (n,), in the order of their weights."""
        rows, columns = self.shape
        radii, depth = cached_profile(circle.radius, ball, thickness)
        depth = depth / columns
        steps, last, scale = np.diff(depth, append=depth[-1]), len(depth) - 1, columns / (radii[1] - radii[0])
        x, y = self._places(u, v)
        middle_x, middle_y = self._places(np.array(circle.x), np.array(circle.y))

        def height(x: Floats, y: Floats) -> Floats:
            to_x, to_y = x - middle_x, y - middle_y
            at = np.minimum(
                np.sqrt(to_x * to_x + to_y * to_y) * scale, last
            )  # radii are even: a third of interp's time
            before = at.astype(np.intp)
            return np.asarray(depth[before] + (at - before) * steps[before], dtype=np.float64)

        horizons = [horizon_slope(height, x, y, lamp) for lamp in self.lamps]
        return np.ascontiguousarray(shadow_terms(horizons, x, y * (columns / rows)).T, dtype=np.float64)

    def light(self, gradient: FloatArray, u: FloatArray, v: FloatArray) -> FloatArray:
        """(n, terms) of the light without shadows, for slopes (n, 2)."""
        degree, place_degree = 3, 2  # of the light without shadows
        x, y = self._places(u, v)
        return photometric_features(gradient, x, y * (self.shape[1] / self.shape[0]), degree, place_degree)

    def _places(self, u: FloatArray, v: FloatArray) -> tuple[FloatArray, FloatArray]:
        rows, columns = self.shape
        return (u - (columns - 1) / 2) / columns, (v - (rows - 1) / 2) / columns


def find_lamps(
    windows: Sequence[Window],
    circles: Sequence[ContactCircle],
    thickness: float,
    ball: float,
    shape: tuple[int, int],
) -> DentShade:
    """A lamp for each colour, at the position where its shadows explain most of the residual of that colour after the
    slopes. Shadows must darken: a brighter region is the lit flank of a lamp on the opposite side. thickness: of the
    gel, ball: its radius [px].
    """
    ridge = 1e-4
    max_steps = 30
    direction_count = 10
    # of lamps from the middle of the picture at which the search starts [widths]
    first_distances = (0.35, 0.7, 1.3, 4.0)
    from scipy.optimize import minimize

    thin = [_downsample_window(window) for window in windows]
    no_contact = DentShade((), shape)
    light = [
        no_contact.light(dent_gradient(s.u, s.v, circle, thickness, ball), s.u, s.v)
        for s, circle in zip(thin, circles, strict=True)
    ]
    lit = np.concatenate(light)
    changes = np.concatenate([window.change for window in thin])
    own = lit.T @ lit

    def unexplained(place: FloatArray, channel: int) -> float:
        shade = DentShade(((float(place[0]), float(place[1])),), shape)
        dark = np.concatenate(
            [shade.terms(s.u, s.v, circle, thickness, ball)[:, ::3] for s, circle in zip(thin, circles, strict=True)]
        )
        across = lit.T @ dark
        square = np.block([[own, across], [across.T, dark.T @ dark]])
        right = np.concatenate([lit, dark], axis=1).T @ changes[:, channel]
        weights = np.linalg.solve(square + ridge * np.trace(square) / len(square) * np.eye(len(square)), right)
        return -float(weights @ right) if float(weights[len(own) :] @ dark.sum(axis=0)) < 0 else 0.0

    turns = np.arange(direction_count) * 2 * np.pi / direction_count
    places = [far * np.array([np.cos(turn), np.sin(turn)]) for far in first_distances for turn in turns]
    lamps = []
    for channel in range(3):
        first = min(places, key=lambda place: unexplained(place, channel))
        size = 0.25 * float(np.hypot(*first)) + 0.02
        found = minimize(
            unexplained, first, args=(channel,), method="Nelder-Mead",
            options={"maxiter": max_steps, "initial_simplex": first + np.array([[0, 0], [size, 0], [0, size]])},
        )  # fmt: skip
        lamps.append((float(found.x[0]), float(found.x[1])))
    return DentShade(tuple(lamps), shape)


def _downsample_window(window: Window) -> Window:
    pixels_of_press = 600  # of each press, approximately, for the positions of lamps
    keep = slice(None, None, max(1, len(window.u) // pixels_of_press))
    return Window(window.u[keep], window.v[keep], window.change[keep])


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
