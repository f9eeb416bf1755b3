"""Regular grids of points on the gel, in sensor x, y: the pixels of an image, the cells of the canonical grid."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tacsim.models.sensor import CanonicalGrid, SensorGeometry


@dataclass(frozen=True, slots=True)
class PixelGrid:
    """`rows` x `columns` points, sensor frame: column j at ``x = x0 + j * pitch``, row i at ``y = y0 + i * pitch``."""

    rows: int
    columns: int
    pitch: float  # [m]
    x0: float  # x of column 0 [m]
    y0: float  # y of row 0 [m]

    @property
    def shape(self) -> tuple[int, int]:
        return (self.rows, self.columns)

    @property
    def x(self) -> NDArray[np.float64]:
        """(columns,) [m]"""
        return self.x0 + self.pitch * np.arange(self.columns, dtype=np.float64)

    @property
    def y(self) -> NDArray[np.float64]:
        """(rows,) [m]"""
        return self.y0 + self.pitch * np.arange(self.rows, dtype=np.float64)

    def points(self) -> NDArray[np.float64]:
        """(rows, columns, 2) x, y of every point [m]"""
        return np.stack(np.meshgrid(self.x, self.y), axis=-1)

    def points_on_gel(self, size: tuple[float, float]) -> NDArray[np.bool_]:
        """(rows, columns) True where a point lies on a gel of `size` (x, y) [m], centred on the sensor axis."""
        margin = 1e-9
        inside_x = np.abs(self.x) <= size[0] / 2 + margin
        inside_y = np.abs(self.y) <= size[1] / 2 + margin
        return inside_y[:, None] & inside_x[None, :]

    def image_coordinates(self, x: NDArray[np.float32], y: NDArray[np.float32]) -> tuple[NDArray[Any], NDArray[Any]]:
        """u, v: where points x, y [m] lie across an image of these pixels, each from -1/2 to 1/2."""
        middle_x = self.x0 + (self.columns - 1) / 2 * self.pitch
        middle_y = self.y0 + (self.rows - 1) / 2 * self.pitch
        wide, high = self.columns * self.pitch, self.rows * self.pitch
        return (x - np.float32(middle_x)) / np.float32(wide), (y - np.float32(middle_y)) / np.float32(high)

    def refined(self, factor: int) -> PixelGrid:
        """The same area with `factor` x `factor` points for each one."""
        pitch = self.pitch / factor
        shift = (pitch - self.pitch) / 2
        return PixelGrid(self.rows * factor, self.columns * factor, pitch, self.x0 + shift, self.y0 + shift)

    def extended(self, rows: int, columns: int) -> PixelGrid:
        """The same points, with so many more rows and columns on each side."""
        return PixelGrid(
            self.rows + 2 * rows,
            self.columns + 2 * columns,
            self.pitch,
            self.x0 - columns * self.pitch,
            self.y0 - rows * self.pitch,
        )


STRIP_PIXELS = 32_768  # pixels


def image_strips(rows: int, columns: int) -> list[slice]:
    """Rows of an image cut into strips of about STRIP pixels: work on one stays in the processor's cache, which is
    twice as fast; smaller ones cost more calls than they save."""
    height = max(1, STRIP_PIXELS // columns)
    return [slice(top, min(top + height, rows)) for top in range(0, rows, height)]


def image_grid(geometry: SensorGeometry) -> PixelGrid:
    """The pixels of a sensor's own image."""
    u0, v0 = geometry.principal
    pitch = geometry.pixel_pitch
    return PixelGrid(geometry.height, geometry.width, pitch, -u0 * pitch, -v0 * pitch)


def canonical_cells(grid: CanonicalGrid) -> PixelGrid:
    """The cells of the canonical grid: where height, gradient and masks lie."""
    x0 = -(grid.columns - 1) / 2 * grid.pitch
    y0 = -(grid.rows - 1) / 2 * grid.pitch
    return PixelGrid(grid.rows, grid.columns, grid.pitch, x0, y0)


def canonical_image(grid: CanonicalGrid) -> PixelGrid:
    """The pixels of the canonical image: `image_scale` x `image_scale` for each cell."""
    return canonical_cells(grid).refined(grid.image_scale)
