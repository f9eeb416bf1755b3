"""Change of colour over a sensor's view -> height and gradient on the canonical grid.

The view is wider than the canonical image: all of the gel that the camera sees. Slopes are integrated over all of it,
because its border, farther from the contact, is the best zero there is.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.depth import Integrator
from calibration.gradient import GradientModel
from tacsim.optics.geometry import CanonicalGrid
from tacsim.optics.grid import PixelGrid, canonical_image

Float32 = NDArray[np.float32]
Mask = NDArray[np.bool_]

INK = 0.6  # a pixel darker than this in all channels, relative to the mean of the gel, shows a printed dot
DOT_RIM = 1  # pixels round a dot that its blurred edge reaches
BRIDGE = 1.5  # slopes under a dot are those around it, weighted by a Gaussian so wide [px]
CALM = 0.08  # a pixel that changes less than this, drift apart, is not touched [-]
LEAST_CALM = 0.15  # share of the view that must be calm for a drift to be told
DRIFT_THIN = 3  # every so many pixels say enough of it


@dataclass(frozen=True, slots=True, eq=False)
class FoundSurface:
    """What a picture tells of the gel surface, on the canonical grid."""

    height: Float32  # (h, w) into the gel, 0 at the contact-free border of the view [m]
    gradient: Float32  # (h, w, 2) [-]
    beyond: float  # share of the view's pixels whose colour lies beyond the calibrated slopes


class SurfaceFinder:
    """Finds the surface of one sensor.

    Args:
        slopes: the inverse of its light, on the pixels of :func:`seen_box`.
        valid: (H, W) of :func:`view`, as the rectification gives it.
        dots: dots are printed on the gel.
        drifts: the light changes in time, as that of any real sensor; what changes where nothing touches is removed.
    """

    def __init__(
        self, slopes: GradientModel, valid: Mask, grid: CanonicalGrid, *, dots: bool, drifts: bool = False
    ) -> None:
        self._slopes, self._grid, self._dots = slopes, grid, dots
        self._box = seen_box(valid)
        self._unseen = ~valid[self._box]
        pitch = grid.pitch / grid.image_scale
        self._drift = _Drift(self._unseen.shape) if drifts else None
        self._integrate = Integrator(self._unseen.shape, pitch)
        self._shape = valid.shape

    def __call__(self, change: Float32, reference: Float32) -> FoundSurface:
        """The surface of a view (H, W, 3) of relative changes; `reference`: I0 / mean(I0), (H, W, 3)."""
        change, reference = change[self._box], reference[self._box]
        hidden = self._unseen | _ink(reference) if self._dots else self._unseen
        clear = reference[~hidden].mean(axis=0)  # the light that is known is that of all the gel, without its dots
        change, reference = change / clear, reference / clear
        if self._dots:
            hidden = hidden | _ink(reference + change)
        if self._drift is not None:
            change -= self._drift(change, hidden)
        gradient, beyond = self._slopes(change)
        if self._dots:
            gradient = _bridged(gradient, hidden)
        gradient[self._unseen] = 0.0  # what is not seen is taken as flat
        beyond &= ~hidden
        height = self._integrate(gradient)
        return FoundSurface(
            height=self._cells(height[..., None])[..., 0],
            gradient=self._cells(gradient),
            beyond=float(beyond.mean()),
        )

    def _cells(self, pixels: Float32) -> Float32:
        """(h, w, n) means over the cells of the canonical grid, of pixels (., ., n) of the seen box; 0 beyond it."""
        view = np.zeros((*self._shape, pixels.shape[2]), dtype=np.float32)
        view[self._box] = pixels
        scale = self._grid.image_scale
        cut = window(view, self._grid)
        parts = cut.reshape(self._grid.rows, scale, self._grid.columns, scale, -1)
        total = parts[:, 0, :, 0].copy()
        for row in range(scale):
            for column in range(1 if row == 0 else 0, scale):
                total += parts[:, row, :, column]
        total /= scale * scale
        return total


def view(grid: CanonicalGrid, gel_size: tuple[float, float]) -> PixelGrid:
    """The canonical image, extended by whole cells on each side until it covers a gel of `gel_size` (x, y) [m]."""
    extra_y, extra_x = (
        max(0, math.ceil((length / grid.pitch - cells) / 2 - 1e-6))
        for length, cells in ((gel_size[1], grid.rows), (gel_size[0], grid.columns))
    )
    return canonical_image(grid).extended(extra_y * grid.image_scale, extra_x * grid.image_scale)


def seen_box(valid: Mask) -> tuple[slice, slice]:
    """Rows and columns of a view in which gel is seen. Raises ValueError when there are none."""
    rows, columns = np.flatnonzero(valid.any(axis=1)), np.flatnonzero(valid.any(axis=0))
    if len(rows) < 2 or len(columns) < 2:
        raise ValueError("the camera sees no gel: check corners, size or geometry of the sensor")
    return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)


def window(view: NDArray[Any], grid: CanonicalGrid) -> NDArray[Any]:
    """The canonical image in the middle of a view (H, W, ...); it shares the view's memory."""
    rows, columns = grid.rows * grid.image_scale, grid.columns * grid.image_scale
    top, left = (view.shape[0] - rows) // 2, (view.shape[1] - columns) // 2
    return view[top : top + rows, left : left + columns]


def _ink(relative: Float32) -> Mask:
    """(H, W) where an image relative to the mean of the gel shows a printed dot."""
    import cv2

    red, green, blue = relative[..., 0], relative[..., 1], relative[..., 2]
    dark = (np.maximum(np.maximum(red, green), blue) < INK).astype(np.uint8)
    side = 2 * DOT_RIM + 1
    return np.asarray(cv2.dilate(dark, np.ones((side, side), dtype=np.uint8)), dtype=np.bool_)


class _Drift:
    """How colour has changed where nothing touches: a quadratic in the place through the calm pixels, twice, the second
    time through those near the first; their median where too few are calm to tell more."""

    def __init__(self, shape: tuple[int, int]) -> None:
        u, v = np.meshgrid(*(np.linspace(-1, 1, count, dtype=np.float32) for count in reversed(shape)))
        self._terms = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=-1)
        self._few = np.ascontiguousarray(self._terms[::DRIFT_THIN, ::DRIFT_THIN].reshape(-1, 6))

    def __call__(self, change: Float32, hidden: Mask) -> Float32:
        """(H, W, 3) drift of relative changes (H, W, 3), of which those `hidden` (H, W) say nothing."""
        seen = change[::DRIFT_THIN, ::DRIFT_THIN].reshape(-1, 3)
        told = ~hidden[::DRIFT_THIN, ::DRIFT_THIN].ravel()
        weights = np.zeros((6, 3), dtype=np.float32)
        if told.any():
            weights[0] = np.median(seen[told], axis=0)
        for _ in range(2):
            calm = told & (np.abs(seen - self._few @ weights).max(axis=1) < CALM)
            if calm.mean() < LEAST_CALM:
                break
            terms = self._few[calm].astype(np.float64)
            square = terms.T @ terms + 1e-6 * len(terms) * np.eye(6)
            weights = np.linalg.solve(square, terms.T @ seen[calm]).astype(np.float32)
        drift: Float32 = self._terms @ weights
        return drift


def _bridged(gradient: Float32, hidden: Mask) -> Float32:
    """`gradient` (H, W, 2), with a weighted mean of what surrounds them in the hidden pixels."""
    import cv2

    weighted = np.empty((*hidden.shape, 3), dtype=np.float32)
    weighted[..., 2] = ~hidden
    np.multiply(gradient, weighted[..., 2:], out=weighted[..., :2])
    around = np.asarray(cv2.GaussianBlur(weighted, (0, 0), BRIDGE), dtype=np.float32)[hidden]
    bridged = gradient.copy()
    bridged[hidden] = around[:, :2] / np.maximum(around[:, 2:], np.float32(1e-6))
    return bridged
