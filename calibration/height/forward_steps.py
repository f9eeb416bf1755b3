"""Improves slopes by the forward model of the light, with data from the surroundings of each pixel.

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

from calibration.height.integration import slopes_of
from calibration.height.tuning import MAX_CERTAIN_ERROR, MAX_EXTRAPOLATION, MIN_CONTACT_CHANGE, PRIOR_WEIGHT
from tacsim.interface import Float32, Mask
from tacsim.models.photometric import PhotometricLight, PhotometricModel, horizon_slope


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
