"""Slopes -> height by Poisson's equation, zero at the untouched rim of the view; the slopes of that height; and better
slopes by the forward model of the light, with data from the surroundings of each pixel (`ForwardSteps`).

The inverse of a light treats each pixel separately. It contains no cast shadows, and cannot decide which of two slopes
with nearly the same colour fits a surface. A surface determines both, so the method computes

    min over height h, slopes g of  sum over pixels, channels rho(c - light(g, h) - rest(h)) + STIFFNESS |g - grad h|^2

for the observed change of colour c, of which rest(h) is the part of cast shadows. It alternates a Gauss-Newton step in
g for each pixel, and the h with the nearest slopes (Poisson's equation; half-quadratic splitting, Geman and Yang 1995).
It starts from the inverse's height. rho is Cauchy's function, so that a channel that no slope explains, because it is
saturated or dirty, has little weight.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from calibration.height.tuning import MAX_CERTAIN_ERROR, MAX_EXTRAPOLATION, MIN_CONTACT_CHANGE, PRIOR_WEIGHT, RIM_WIDTH
from tacsim.interface import Float32, Mask
from tacsim.models.photometric import PhotometricLight, PhotometricModel, horizon_slope


class Integrator:
    """Integrates slopes on a rectangle of pixels: the surface whose slopes are nearest to those given, in the sense of
    least squares, with a free border (cosine transform; Frankot and Chellappa 1988, Poisson with natural boundary)."""

    def __init__(self, shape: tuple[int, int], pitch: float) -> None:
        """`shape`: rows, columns; `pitch`: distance of two pixels [m]."""
        rows, columns = shape
        if min(shape) < 2 or not pitch > 0:
            raise ValueError(f"cannot integrate over {rows} x {columns} pixels of {pitch} m; at least 2 x 2")
        along_y = 2.0 * np.cos(np.pi * np.arange(rows) / rows) - 2.0
        along_x = 2.0 * np.cos(np.pi * np.arange(columns) / columns) - 2.0
        eigenvalue = along_y[:, None] + along_x[None, :]
        eigenvalue[0, 0] = 1.0
        inverse = pitch / eigenvalue
        inverse[0, 0] = 0.0  # slopes determine no constant
        self._inverse = inverse.astype(np.float32)
        width = max(1, round(RIM_WIDTH / pitch))
        rim = np.ones(shape, dtype=np.bool_)
        rim[width:-width, width:-width] = False
        self._rim = np.flatnonzero(rim)

    def __call__(self, gradient: Float32) -> Float32:
        """(rows, columns) height [m] of slopes (rows, columns, 2) along x, y [-].

        The constant is chosen so that the median along the border of the view is zero: one bulge, or a contact that
        reaches the border on one side, does not move it.
        """
        from scipy.fft import dctn, idctn

        by_x, by_y = np.ascontiguousarray(gradient[..., 0]), np.ascontiguousarray(gradient[..., 1])
        across = 0.5 * (by_x[:, 1:] + by_x[:, :-1])  # slopes half-way between two pixels
        down = 0.5 * (by_y[1:] + by_y[:-1])
        divergence = np.zeros(self._inverse.shape, dtype=np.float32)
        divergence[:, :-1] += across
        divergence[:, 1:] -= across
        divergence[:-1] += down
        divergence[1:] -= down
        spectrum = dctn(divergence, norm="ortho", overwrite_x=True)
        spectrum *= self._inverse
        height: Float32 = idctn(spectrum, norm="ortho", overwrite_x=True)
        height -= np.median(height.ravel()[self._rim])
        return height


def slopes_of(height: Float32, pitch: float) -> tuple[Float32, Float32]:
    """Slopes by x and by y (rows, columns) of a height (rows, columns) [m] on pixels `pitch` [m] apart.

    For a height from :class:`Integrator` they are the part of its slopes that a surface can have, without rotational
    errors (half the power of random errors).
    """
    by_y, by_x = np.gradient(height, np.float32(pitch))
    return np.asarray(by_x, dtype=np.float32), np.asarray(by_y, dtype=np.float32)


class ForwardSteps:
    """The steps for one sensor, on the pixels of one view."""

    def __init__(self, model: PhotometricModel, u: Float32, v: Float32, pitch: float, width: float) -> None:
        """u, v (H, W): places of the pixels, -1/2..1/2 across the sensor's own picture; `pitch`: distance of two pixels
        of the view, `width` of that picture, in one unit."""
        self._light, self._model = PhotometricLight(model), model
        self._u, self._v = u.ravel(), v.ravel()
        self._pitch = pitch
        self._scale = np.float32(1.0 / width)
        self._pixel = np.float32(width / pitch)  # pixels of the view in a picture's width
        # rows over columns of the sensor's picture: what makes of v a place in its widths
        steps = float(u[0, -1] - u[0, 0]) / (u.shape[1] - 1), float(v[-1, 0] - v[0, 0]) / (v.shape[0] - 1)
        self._flat = np.float32(steps[0] / steps[1])
        self._corner = u[0, 0], v[0, 0] * self._flat

    def __call__(
        self, change: Float32, height: Float32, hidden: Mask, integrate: Callable[[Float32], Float32]
    ) -> Float32:
        """The improved height (H, W) for relative changes (3, H, W), without the pixels `hidden` (H, W).
        `integrate`: slopes (H, W, 2) -> height, in the unit of `pitch`."""
        step_count = 3
        chunk = 256  # pixels that are evaluated at a time
        seen = np.flatnonzero((np.abs(change).max(axis=0) > MIN_CONTACT_CHANGE) & ~hidden)
        if not len(seen):
            return height
        rows = np.resize(seen, (-(-len(seen) // chunk), chunk))  # the last row is filled up with pixels of the first
        colour = [plane.ravel()[rows] for plane in change]
        place = self._u[rows], self._v[rows]
        for _ in range(step_count):
            slopes = np.stack(slopes_of(height, self._pitch), axis=-1)
            flat = slopes.reshape(-1, 2)
            relative = height * self._scale
            deep = relative.ravel()[rows]
            flat[rows] = self._step(flat[rows], colour, (*place, deep), self._shadow_change(relative, place))
            height = integrate(slopes)
        return height

    def _step(
        self,
        slope: Float32,
        colour: list[Float32],
        place: tuple[Float32, Float32, Float32],
        shadow_change: Float32 | None,
    ) -> Float32:
        """(..., 2) slopes after a Gauss-Newton step from those of the surface, at places u, v, height."""
        slope_step = 0.02  # step of finite differences of colour by slope [-]
        steps = np.float32(slope_step) * np.array([[0, 0], [1, 0], [0, 1]], dtype=np.float32)
        slopes = slope + steps.reshape(3, *(1,) * (slope.ndim - 1), 2)
        here, at_x, at_y = self._light.change(slopes, *(np.broadcast_to(each, slopes.shape[:-1]) for each in place))[0]
        by_x, by_y = (at_x - here) / np.float32(slope_step), (at_y - here) / np.float32(slope_step)
        if shadow_change is not None:
            here = here + shadow_change
        xx = yy = np.full_like(colour[0], PRIOR_WEIGHT)
        xy = right_x = right_y = np.zeros_like(colour[0])
        for channel, seen in enumerate(colour):
            error, x, y = seen - here[..., channel], by_x[..., channel], by_y[..., channel]
            weight = 1 / (1 + (error / np.float32(MAX_CERTAIN_ERROR)) ** 2)
            xx, xy, yy = xx + weight * x * x, xy + weight * x * y, yy + weight * y * y
            right_x, right_y = right_x + weight * x * error, right_y + weight * y * error
        step = np.stack([yy * right_x - xy * right_y, xx * right_y - xy * right_x], axis=-1)
        better = slope + step / (xx * yy - xy * xy)[..., None]
        steepness = np.hypot(better[..., 0], better[..., 1])
        least = np.minimum(1, MAX_EXTRAPOLATION * self._model.steepest / np.maximum(steepness, 1e-9))
        return np.asarray(better * least[..., None], dtype=np.float32)

    def _shadow_change(self, relative: Float32, place: tuple[Float32, Float32]) -> Float32 | None:
        """(..., 3) change of colour of pixels at places u, v (...,) by the cast shadows of a surface with this height
        (H, W) [widths of the picture]; None without shadows."""
        import cv2

        if self._model.shadows is None:
            return None
        u, v = place

        def height_at(x: Float32, y: Float32) -> Float32:
            at = (x - self._corner[0]) * self._pixel, (y - self._corner[1]) * self._pixel
            seen = cv2.remap(relative, *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            return np.asarray(seen, dtype=np.float32)

        horizons = [horizon_slope(height_at, u, v * self._flat, lamp) for lamp in self._model.shadows.lamps]
        return self._light.shadow_change(horizons, u, v)
