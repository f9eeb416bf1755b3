"""Native image -> the canonical grid: one precomputed map from metric points on the gel to pixels of the camera.

A map is made once for a sensor, from the four corners of the gel in a real image, from the view of a board on it
(distortion of the lens and perspective in one), or from the geometry of a simulated one; applying it is one look-up. If
the resolution of the camera is finer than the canonical grid, each canonical pixel is the mean over its area.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from calibration.lens.view import BadCorners, Corners, GelView, check_corners
from tacsim.models.sensor import PictureRegion, SensorGeometry
from tacsim.optics.grid import PixelGrid, image_grid


@dataclass(frozen=True, eq=False)
class Rectification:
    """The map of one sensor. Make it by :func:`rectification_of_corners`,
    :func:`rectification_of_view` or :func:`rectification_of_geometry`."""

    image_shape: tuple[int, int]  # rows, columns of the native image
    pixels: NDArray[np.float32]  # (factor * H, factor * W, 2) native u, v of each look-up [px]
    factor: int  # look-ups along each side of one canonical pixel
    valid: NDArray[np.bool_]  # (H, W) the canonical pixel lies on the gel and in the native image
    size: tuple[float, float]  # x, y of the gel that the native image shows, also beyond the canonical one [m]

    def __call__(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """(H, W, 3) rectified image, 0..255, of a native (rows, columns, 3) uint8 RGB image; 0 where not valid.

        Raises ValueError for an image of any other shape or type.
        """
        import cv2

        if image.dtype != np.uint8 or image.shape != (*self.image_shape, 3):
            raise ValueError(
                f"image is {image.shape} {image.dtype}, this sensor delivers {(*self.image_shape, 3)} uint8; "
                "is it another camera, or another setting of it?"
            )
        found = np.zeros((*self.valid.shape, 3), dtype=np.float32)
        if not self.valid.any():
            return found
        box, look_ups, fraction, hidden = self._box
        between = cv2.INTER_LINEAR if fraction.size else cv2.INTER_NEAREST
        fine = cv2.remap(image, look_ups, fraction, between, borderMode=cv2.BORDER_REPLICATE)
        seen = np.asarray(fine, dtype=np.float32)  # before the mean, so that it is not rounded twice
        if self.factor > 1:
            size = (seen.shape[1] // self.factor, seen.shape[0] // self.factor)
            seen = np.asarray(cv2.resize(seen, size, interpolation=cv2.INTER_AREA), dtype=np.float32)
        if hidden is not None:
            seen[hidden] = 0.0
        found[box] = seen
        return found

    def within(self, region: PictureRegion | None) -> Rectification:
        """The map with only a polygon of the native image as gel; None: all of it. Raises BadCorners."""
        if region is None:
            return self
        shown = region_mask(region, self.image_shape)
        column, row = np.rint(np.moveaxis(self.pixels, -1, 0)).astype(np.intp)
        seen = shown[row.clip(0, len(shown) - 1), column.clip(0, shown.shape[1] - 1)]
        rows, columns = self.valid.shape
        whole = seen.reshape(rows, self.factor, columns, self.factor).all(axis=(1, 3))
        return replace(self, valid=self.valid & whole)

    @cached_property
    def _box(
        self,
    ) -> tuple[tuple[slice, slice], NDArray[np.int16], NDArray[np.uint16], NDArray[np.bool_] | None]:
        """Rows and columns with valid pixels, their look-ups in OpenCV's fixed point (to 1/32 px, as it rounds them
        anyway; an empty fraction where all are whole pixels), and which of them are not valid (None: all are)."""
        import cv2

        box = visible_box(self.valid)
        finer = tuple(slice(side.start * self.factor, side.stop * self.factor) for side in box)
        look_ups, fraction = cv2.convertMaps(self.pixels[finer], np.empty(0, dtype=np.float32), cv2.CV_16SC2)
        hidden = ~self.valid[box]
        parted = np.asarray(fraction if fraction.any() else fraction[:0], dtype=np.uint16)
        return box, np.asarray(look_ups, dtype=np.int16), parted, hidden if hidden.any() else None


def region_mask(region: PictureRegion, image_shape: tuple[int, int]) -> NDArray[np.bool_]:
    """(rows, columns) True for pixels inside a polygon. Raises BadCorners for one with very few pixels, or one that is
    partly outside the picture."""
    min_region = 0.02  # of a picture, that a region must enclose
    import cv2

    rows, columns = image_shape
    for u, v in region:
        if not (-1 <= u <= columns and -1 <= v <= rows):
            raise BadCorners(f"region: its corner {u:g},{v:g} lies beyond the picture of {columns} x {rows} px")
    shown = np.zeros(image_shape, dtype=np.uint8)
    cv2.fillPoly(shown, [np.rint(np.array(region, dtype=np.float64)).astype(np.int32)], 1)
    if np.count_nonzero(shown) < min_region * shown.size:
        raise BadCorners(
            f"region {region!r} encloses {np.count_nonzero(shown)} of the picture's {columns} x {rows} px; give its "
            "corners one after the other [px, u to the right, v down]"
        )
    return np.asarray(shown, dtype=np.bool_)


def rectification_of_corners(
    corners: Corners | None, size: tuple[float, float], image_shape: tuple[int, int], grid: PixelGrid
) -> Rectification:
    """The map of a real camera, as a perspective through the four corners of the gel.

    Args:
        corners: u, v [px] of the gel's top left, top right, bottom right, bottom left; None: the image's own corners.
        size: width (x) and height (y) of the gel between them [m].
        image_shape: rows, columns of the native image.
        grid: pixels of the canonical image.

    Raises BadCorners if the corners are out of order, on a line, or far outside the image.
    """
    import cv2

    rows, columns = image_shape
    if corners is None:
        corners = ((-0.5, -0.5), (columns - 0.5, -0.5), (columns - 0.5, rows - 0.5), (-0.5, rows - 0.5))
    check_corners(corners, image_shape)
    x, y = size[0] / 2, size[1] / 2
    on_gel = np.array([(-x, -y), (x, -y), (x, y), (-x, y)]) * 1e3  # [mm]: numbers near 1 keep the solver accurate
    image_from_gel = cv2.getPerspectiveTransform(on_gel.astype(np.float32), np.array(corners, dtype=np.float32))

    def project(points: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(cv2.perspectiveTransform(points * 1e3, image_from_gel), dtype=np.float64)

    factor = _lookups_per_side(project(grid.points()))
    # The perspective of points far beyond the gel may pass through infinity: look there at the gel's rim instead.
    points = _is_inside(grid.refined(factor).points(), size)
    return _make_rectification(project(points), factor, grid.points_on_gel(size), image_shape, size)


def rectification_of_view(view: GelView, grid: PixelGrid) -> Rectification:
    """The map of a real camera whose view of the gel's plane was calibrated."""
    factor = _lookups_per_side(view.project(_is_inside(grid.points(), view.size)))
    points = _is_inside(grid.refined(factor).points(), view.size)  # beyond the gel nothing is known of the lens
    return _make_rectification(view.project(points), factor, grid.points_on_gel(view.size), view.image_shape, view.size)


def metric_rectification(view: GelView) -> Rectification:
    """The map of a real camera to its metric picture (see `GelView.geometry`), for fits over all of the gel."""
    return rectification_of_view(view, image_grid(view.geometry))


def _is_inside(points: NDArray[np.float64], size: tuple[float, float]) -> NDArray[np.float64]:
    x, y = size[0] / 2, size[1] / 2
    return np.clip(points, (-x, -y), (x, y))


def rectification_of_geometry(
    geometry: SensorGeometry, gel_size: tuple[float, float], grid: PixelGrid
) -> Rectification:
    """The map of a simulated (or already rectified) image: `x = (u - u0) * pixel_pitch`. Exact means of areas where the
    canonical pitch is a whole multiple of the pixel pitch."""
    factor = _limit_lookups(math.ceil(grid.pitch / geometry.pixel_pitch - 1e-9))
    pixels = grid.refined(factor).points() / geometry.pixel_pitch + geometry.principal
    shown = geometry.width * geometry.pixel_pitch, geometry.height * geometry.pixel_pitch
    size = min(gel_size[0], shown[0]), min(gel_size[1], shown[1])
    return _make_rectification(pixels, factor, grid.points_on_gel(gel_size), (geometry.height, geometry.width), size)


def _make_rectification(
    pixels: NDArray[np.float64],
    factor: int,
    on_gel: NDArray[np.bool_],
    image_shape: tuple[int, int],
    size: tuple[float, float],
) -> Rectification:
    rows, columns = image_shape
    margin = 0.5 + 1e-6  # an image reaches half a pixel beyond its outermost pixel centres
    u, v = pixels[..., 0], pixels[..., 1]
    in_image = (u >= -margin) & (u <= columns - 1 + margin) & (v >= -margin) & (v <= rows - 1 + margin)
    height, width = on_gel.shape
    whole = in_image.reshape(height, factor, width, factor).all(axis=(1, 3))
    return Rectification(image_shape, pixels.astype(np.float32), factor, whole & on_gel, size)


def _lookups_per_side(pixels: NDArray[np.float64]) -> int:
    """Native pixels along one canonical pixel, in the middle of the grid, rounded up."""
    middle = pixels[pixels.shape[0] // 2, pixels.shape[1] // 2]
    right = pixels[pixels.shape[0] // 2, pixels.shape[1] // 2 - 1] - middle
    below = pixels[pixels.shape[0] // 2 - 1, pixels.shape[1] // 2] - middle
    return _limit_lookups(math.ceil(max(float(np.hypot(*right)), float(np.hypot(*below))) - 0.01))


def _limit_lookups(factor: int) -> int:
    max_lookups_per_side = 16  # look-ups along each side of one canonical pixel
    if factor > max_lookups_per_side:
        raise ValueError(
            f"the native image has {factor} pixels along one canonical pixel, at most {max_lookups_per_side} are "
            "averaged; "
            "check the gel's size and the canonical pitch [m]"
        )
    return max(factor, 1)


def visible_box(valid: NDArray[np.bool_]) -> tuple[slice, slice]:
    """Rows and columns of a view that show the gel. Raises ValueError if there are none."""
    rows, columns = np.flatnonzero(valid.any(axis=1)), np.flatnonzero(valid.any(axis=0))
    if len(rows) < 2 or len(columns) < 2:
        raise ValueError("the camera sees no gel: check corners, size or geometry of the sensor")
    return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)
