"""Means of maps and pictures over the cells of a coarser grid."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tacsim.interface import FloatArray, IncompatibleRig
from tacsim.models.policy import MapGrid
from tacsim.models.sensor import CanonicalGrid


class CellMeans:
    """Means over the cells of a finer grid with the same centre.

    Raises IncompatibleRig when a cell is no whole number of the finer cells, or lies beyond them.
    """

    def __init__(self, grid: MapGrid, canonical: CanonicalGrid) -> None:
        self._shape, self._every = (grid.rows, grid.columns), round(grid.pitch / canonical.pitch)
        finer = (canonical.rows, canonical.columns)
        margins = [have - want * self._every for have, want in zip(finer, self._shape, strict=True)]
        whole = self._every >= 1 and abs(self._every * canonical.pitch - grid.pitch) <= 1e-6 * grid.pitch
        if not whole or min(margins) < 0 or any(margin % 2 for margin in margins):
            raise IncompatibleRig(
                f"maps of {grid.rows} x {grid.columns} cells of {1e3 * grid.pitch:g} mm cannot be put together from "
                f"the rig's canonical grid of {canonical.rows} x {canonical.columns} cells of "
                f"{1e3 * canonical.pitch:g} mm: give the rig a grid whose cells are a whole part of these, and that "
                "spans them (canonical)"
            )
        self._inside = tuple(
            slice(margin // 2, have - margin // 2) for margin, have in zip(margins, finer, strict=True)
        )

    def __call__(self, values: FloatArray, valid: NDArray[np.bool_]) -> FloatArray:
        """(channels, h, w) means of (rows, columns, channels) over valid cells; 0 where none is."""
        if valid.all():
            return self._block_sums(values[self._inside]).transpose(2, 0, 1) / self._every**2
        weights = valid[self._inside].astype(np.float64)[..., None]
        total, count = self._block_sums(values[self._inside] * weights), self._block_sums(weights)
        means: FloatArray = np.divide(total, count, out=np.zeros_like(total), where=count > 0)
        return means.transpose(2, 0, 1)

    def _block_sums(self, values: FloatArray) -> FloatArray:
        (rows, columns), every, channels = self._shape, self._every, values.shape[-1]
        down = values.reshape(rows, every, columns * every, channels).sum(axis=1)  # one axis after the other is quicker
        total: FloatArray = down.reshape(rows, columns, every, channels).sum(axis=2)
        return total


def image_means(picture: NDArray[np.uint8] | None, grid: MapGrid) -> FloatArray:
    """(3, h, w) means over the parts of a picture [grey levels], which differ in size by a pixel at most."""
    if picture is None:
        raise IncompatibleRig("the policy sees pictures as the camera gave them, and this sensor delivers none")
    rows, columns = picture.shape[:2]
    if rows < grid.rows or columns < grid.columns:
        raise IncompatibleRig(
            f"the policy's picture of {rows} x {columns} px has fewer than {grid.rows} x {grid.columns} parts: "
            "give the sensor a larger picture"
        )
    down, right = np.arange(grid.rows) * rows // grid.rows, np.arange(grid.columns) * columns // grid.columns
    sums = np.add.reduceat(np.add.reduceat(picture, down, axis=0, dtype=np.float64), right, axis=1)
    pixels = np.outer(np.diff(down, append=rows), np.diff(right, append=columns))
    means: FloatArray = sums.transpose(2, 0, 1) / pixels
    return means
