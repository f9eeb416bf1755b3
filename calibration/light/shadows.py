"""Cast shadows of ball presses: positions of their lamps, estimated from the presses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calibration.light.dent import ContactCircle, cached_profile, dent_gradient
from calibration.light.photometry import photometric_features
from calibration.light.press import Window
from tacsim.interface import FloatArray
from tacsim.models.photometric import Floats, horizon_slope, shadow_terms


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
    nobody = DentShade((), shape)
    light = [
        nobody.light(dent_gradient(s.u, s.v, circle, thickness, ball), s.u, s.v)
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
