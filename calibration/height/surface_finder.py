"""Change of colour over a sensor's view -> height and gradient on the canonical grid: slopes are integrated by
Poisson's equation (`Integrator`), then improved by the forward model of the light (`ForwardSteps`).

The view is wider than the canonical image: it contains all of the visible gel. Slopes are integrated over all of it,
because its border, farther from the contact, is the best zero. The returned slopes are those of the height, because
colours alone may give slopes that no surface has.

The inverse of a light treats each pixel separately. It contains no cast shadows, and cannot decide which of two slopes
with nearly the same colour fits a surface. A surface determines both, so forward steps compute

    min over height h, slopes g of  sum over pixels, channels rho(c - light(g, h) - rest(h)) + STIFFNESS |g - grad h|^2

for the observed change of colour c, of which rest(h) is the part of cast shadows. They alternate a Gauss-Newton step in
g for each pixel, and the h with the nearest slopes (Poisson's equation; half-quadratic splitting, Geman and Yang 1995).
They start from the inverse's height. rho is Cauchy's function, so that a channel that no slope explains, because it is
saturated or dirty, has little weight.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.height import tuning
from calibration.height.slopes import GradientModel
from calibration.lens.rectification import visible_box
from calibration.reference import PIXEL_STRIDE, DriftFinder, max_mean_change
from tacsim.interface import Float32, Mask
from tacsim.models.photometric import PhotometricLight, PhotometricModel, horizon_slope
from tacsim.models.sensor import CanonicalGrid
from tacsim.optics.grid import PixelGrid, canonical_image


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
        width = max(1, round(tuning.RIM_WIDTH / pitch))
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
        seen = np.flatnonzero((np.abs(change).max(axis=0) > tuning.MIN_CONTACT_CHANGE) & ~hidden)
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
        xx = yy = np.full_like(colour[0], tuning.PRIOR_WEIGHT)
        xy = right_x = right_y = np.zeros_like(colour[0])
        for channel, seen in enumerate(colour):
            error, x, y = seen - here[..., channel], by_x[..., channel], by_y[..., channel]
            weight = 1 / (1 + (error / np.float32(tuning.MAX_CERTAIN_ERROR)) ** 2)
            xx, xy, yy = xx + weight * x * x, xy + weight * x * y, yy + weight * y * y
            right_x, right_y = right_x + weight * x * error, right_y + weight * y * error
        step = np.stack([yy * right_x - xy * right_y, xx * right_y - xy * right_x], axis=-1)
        better = slope + step / (xx * yy - xy * xy)[..., None]
        steepness = np.hypot(better[..., 0], better[..., 1])
        least = np.minimum(1, tuning.MAX_EXTRAPOLATION * self._model.steepest / np.maximum(steepness, 1e-9))
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


@dataclass(frozen=True, slots=True, eq=False)
class FoundSurface:
    """The gel surface found in a picture, on the canonical grid."""

    height: Float32  # (h, w) into the gel, 0 at the contact-free border of the view [m]
    gradient: Float32  # (h, w, 2) of the height [-]
    out_of_range_share: float  # share of the view's pixels whose colour lies beyond the calibrated slopes
    drift: float | None  # mean relative change of the untouched gel's colour [-]; None: too little of it
    drift_slope: float | None  # mean angle of the slopes that correspond to this change [degrees]
    removed_drift: Float32 | None  # (H, W, 3) drift taken off the canonical image's change; None: nothing is taken off


class SurfaceFinder:
    """Finds the surface of one sensor.

    Args:
        slopes: the inverse of its light, on the pixels of :func:`visible_box`.
        valid: (H, W) of :func:`extended_view`, as the rectification gives it.
        dots: dots are printed on the gel.
        drifts: the light is real and drifts: the drift, which is measured in any case, is removed.
        better: improves the height by the light's forward model, on the same pixels; None: no improvement.
    """

    def __init__(
        self,
        slopes: GradientModel,
        valid: Mask,
        grid: CanonicalGrid,
        *,
        dots: bool,
        drifts: bool = False,
        better: ForwardSteps | None = None,
    ) -> None:
        self._slopes, self._grid, self._dots, self._better = slopes, grid, dots, better
        self._box = visible_box(valid)
        self._unseen = ~valid[self._box]
        self._pitch = grid.pitch / grid.image_scale
        self._drift_finder, self._remove_drift = DriftFinder(self._unseen.shape), drifts
        # the canonical image in the seen box: its first row and column, and its size
        self._image = (grid.rows * grid.image_scale, grid.columns * grid.image_scale)
        corner = [(there - own) // 2 for there, own in zip(valid.shape, self._image, strict=True)]
        self._corner = (corner[0] - self._box[0].start, corner[1] - self._box[1].start)
        self._response = _slope_response(slopes, self._unseen.shape)
        self._integrate = Integrator(self._unseen.shape, self._pitch)
        self._shape = valid.shape
        self._any_unseen = bool(self._unseen.any())
        self._known: _PreparedReference | None = None

    def __call__(self, change: Float32, reference: Float32) -> FoundSurface:
        """The surface of a view (H, W, 3) of relative changes; `reference`: I0 / mean(I0), (H, W, 3); what
        follows from it is cached per array object."""
        if self._known is None or self._known.picture is not reference:
            self._known = self._prepare_reference(reference)
        known, hidden = self._known, self._known.hidden
        planes = np.empty((3, *self._unseen.shape), dtype=np.float32)  # planes are several times as fast as pixels
        for channel in range(3):
            np.multiply(change[(*self._box, channel)], known.gain[channel], out=planes[channel])
        if self._dots:
            hidden = hidden | _ink_mask(known.planes + planes)
        drift = self._drift_finder(planes, hidden)
        changed = self._drift_finder.drift_at_stride(drift) if drift.measured else None
        if self._remove_drift:
            self._drift_finder.remove(planes, drift)
        gradient, beyond_range = self._slopes(np.moveaxis(planes, 0, -1))
        by_x, by_y = np.ascontiguousarray(gradient[..., 0]), np.ascontiguousarray(gradient[..., 1])
        if self._dots:
            _fill_hidden((by_x, by_y), hidden)
        if self._any_unseen:
            by_x[self._unseen] = by_y[self._unseen] = 0.0  # pixels that are not visible count as flat
        height = self._integrate(np.stack([by_x, by_y], axis=-1))
        if self._better is not None:
            height = self._better(planes, height, hidden, self._integrate)
        by_x, by_y = slopes_of(height, self._pitch)
        return FoundSurface(
            height=self._cell_means(height),
            gradient=np.stack([self._cell_means(by_x), self._cell_means(by_y)], axis=-1),
            out_of_range_share=float(np.count_nonzero(beyond_range & ~hidden) / beyond_range.size),
            drift=None if changed is None else max_mean_change(changed),
            drift_slope=None if changed is None else self._mean_angle(changed),
            removed_drift=self._drift_finder.drift_on_part(drift.scaled(1.0 / known.gain), self._corner, self._image)
            if self._remove_drift and drift.measured
            else None,
        )

    def _mean_angle(self, change: Float32) -> float:
        """Mean angle [degrees] of the slopes that belong to changes of colour (n, 3) at every PIXEL_STRIDE-th pixel."""
        slope = np.einsum("nsc,nc->ns", self._response, change)
        steepness = np.hypot(slope[:, 0], slope[:, 1])[~self._unseen[::PIXEL_STRIDE, ::PIXEL_STRIDE].ravel()]
        return float(np.degrees(np.arctan(steepness)).mean())

    def _prepare_reference(self, picture: Float32) -> _PreparedReference:
        reference = picture[self._box]
        hidden = self._unseen | _ink_mask(np.moveaxis(reference, -1, 0)) if self._dots else self._unseen
        # the light that is known is that of all the gel, without its dots
        gain = (1.0 / reference[~hidden].mean(axis=0)).astype(np.float32)
        return _PreparedReference(picture, np.ascontiguousarray(np.moveaxis(reference * gain, -1, 0)), gain, hidden)

    def _cell_means(self, plane: Float32) -> Float32:
        """(h, w) means over the cells of the canonical grid, of a plane of the seen box; 0 beyond it."""
        import cv2

        whole = np.zeros(self._shape, dtype=np.float32)
        whole[self._box] = plane
        size = (self._grid.columns, self._grid.rows)
        part = canonical_part(whole, self._grid)
        return np.asarray(cv2.resize(part, size, interpolation=cv2.INTER_AREA), dtype=np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class _PreparedReference:
    """Data computed from the reference alone."""

    picture: Float32  # itself
    planes: Float32  # (3, H, W) of the seen box, relative to the mean of the gel without its dots
    gain: Float32  # (3,) from relative to the mean with dots, to that without
    hidden: Mask  # (H, W) not seen, or under a dot at rest


def extended_view(grid: CanonicalGrid, gel_size: tuple[float, float]) -> PixelGrid:
    """The canonical image, extended by whole cells on each side until it covers a gel of `gel_size` (x, y) [m]."""
    extra_y, extra_x = (
        max(0, math.ceil((length / grid.pitch - cells) / 2 - 1e-6))
        for length, cells in ((gel_size[1], grid.rows), (gel_size[0], grid.columns))
    )
    return canonical_image(grid).extended(extra_y * grid.image_scale, extra_x * grid.image_scale)


def canonical_part(picture: NDArray[Any], grid: CanonicalGrid) -> NDArray[Any]:
    """The canonical image in the middle of a view (H, W, ...); it shares the view's memory."""
    rows, columns = grid.rows * grid.image_scale, grid.columns * grid.image_scale
    top, left = (picture.shape[0] - rows) // 2, (picture.shape[1] - columns) // 2
    return picture[top : top + rows, left : left + columns]


def _ink_mask(relative: Float32) -> Mask:
    """(H, W) where an image (3, H, W) relative to the mean of the gel shows a printed dot."""
    dot_rim = 1  # width of the blurred edge of a dot [px]
    import cv2

    dark = (np.maximum(np.maximum(relative[0], relative[1]), relative[2]) < tuning.MAX_INK_LEVEL).view(np.uint8)
    side = 2 * dot_rim + 1
    return np.asarray(cv2.dilate(dark, np.ones((side, side), dtype=np.uint8))).view(np.bool_)


def _slope_response(slopes: GradientModel, shape: tuple[int, int]) -> Float32:
    """(n, 2, 3) derivative of the slope by colour, at every PIXEL_STRIDE-th row and column."""
    colour_step = 0.02  # of the finite differences of slope by colour [-]
    answers = []
    for channel in range(3):
        change = np.zeros((*shape, 3), dtype=np.float32)
        change[..., channel] = colour_step
        up, down = slopes(change)[0], slopes(-change)[0]
        answers.append(((up - down) / (2 * colour_step))[::PIXEL_STRIDE, ::PIXEL_STRIDE].reshape(-1, 2))
    return np.stack(answers, axis=-1)


def _fill_hidden(slopes: tuple[Float32, Float32], hidden: Mask) -> None:
    """Sets planes of slopes (H, W) in the hidden pixels to a weighted mean of those around."""
    fill_width = 1.5  # slopes under a dot are the mean of those around, weighted by a Gaussian of this deviation [px]
    import cv2

    known = (~hidden).astype(np.float32)
    total = np.maximum(cv2.GaussianBlur(known, (0, 0), fill_width), np.float32(1e-6))
    for slope in slopes:
        around = cv2.GaussianBlur(slope * known, (0, 0), fill_width)
        np.copyto(slope, around / total, where=hidden)
