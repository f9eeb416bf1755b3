"""The C1 quadratic B-spline surface over a lattice of control values: at single points, and along lines.

With s the position in lattice spacings, i the nearest node and f = s - i in [-1/2, 1/2], the weights of the nodes
i-1, i, i+1 are (1/2 - f)^2 / 2, 3/4 - f^2, (1/2 + f)^2 / 2 (de Boor 1978). At the rim the outermost control value
repeats; beyond it the surface continues unchanged.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from tacsim.interface import FloatArray
from tacsim.models.scene import GelSurface

MIN_JACOBIAN = 0.1  # det J of a sheet that is seen edge-on; its slope is as that of one this narrow in the picture


def spline_weights(position: FloatArray, nodes: int) -> tuple[NDArray[np.intp], FloatArray, FloatArray]:
    """Nodes (..., 3), their weights and the derivatives of those, at `position` (...,) in lattice spacings."""
    inside = np.clip(position, 0.0, nodes - 1.0)
    centre = np.floor(inside + 0.5)
    f = inside - centre
    index = np.clip(centre[..., None] + np.array([-1, 0, 1]), 0, nodes - 1).astype(np.intp)
    weight = np.stack([0.5 * (0.5 - f) ** 2, 0.75 - f**2, 0.5 * (0.5 + f) ** 2], axis=-1)
    slope = np.stack([f - 0.5, -2.0 * f, f + 0.5], axis=-1)
    slope[inside != position] = 0.0
    return index, weight, slope


@dataclass(frozen=True, slots=True, eq=False)
class SplinePoints:
    """Material points of a lattice: along x and along y their nodes (n, 3), weights and the derivatives of those."""

    x: tuple[NDArray[np.intp], FloatArray, FloatArray]
    y: tuple[NDArray[np.intp], FloatArray, FloatArray]

    @classmethod
    def of(cls, surface: GelSurface, points: FloatArray) -> SplinePoints:
        """Points (n, 2) [m]."""
        nx, ny, _ = surface.displacement.shape
        return cls(
            spline_weights((points[:, 0] - surface.origin[0]) / surface.spacing, nx),
            spline_weights((points[:, 1] - surface.origin[1]) / surface.spacing, ny),
        )

    def control(self, surface: GelSurface) -> FloatArray:
        """(n, 3, 3, 3) displacements of their nodes [m]."""
        return surface.displacement[self.x[0][:, :, None], self.y[0][:, None, :]].astype(np.float64)

    def displacement(self, surface: GelSurface) -> FloatArray:
        """(n, 3) [m]"""
        return np.asarray(np.einsum("nijc,ni,nj->nc", self.control(surface), self.x[1], self.y[1]))


def displacement_and_jacobian(surface: GelSurface, points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Displacement (n, 3) [m] and its derivative (n, 3, 2) by X, Y at material points (n, 2) [m]."""
    at = SplinePoints.of(surface, points)
    (_, wx, dx), (_, wy, dy) = at.x, at.y
    control = at.control(surface)
    value = np.einsum("nijc,ni,nj->nc", control, wx, wy)
    by_x = np.einsum("nijc,ni,nj->nc", control, dx, wy) / surface.spacing
    by_y = np.einsum("nijc,ni,nj->nc", control, wx, dy) / surface.spacing
    return value, np.stack([by_x, by_y], axis=-1)


@dataclass(frozen=True, slots=True, eq=False)
class LineMatrix:
    """A matrix (n, nodes) of three numbers a row: three products of whole rows are quicker than SciPy's import."""

    index: NDArray[np.intp]  # (3, n) columns
    weight: NDArray[np.float32]  # (3, n, 1)

    def __matmul__(self, control: NDArray[np.float32]) -> NDArray[np.float32]:
        """(nodes, m) -> (n, m)"""
        first, *others = (np.take(control, index, axis=0) for index in self.index)
        product: NDArray[np.float32] = np.multiply(first, self.weight[0], out=first)
        for other, weight in zip(others, self.weight[1:], strict=True):
            product += np.multiply(other, weight, out=other)
        return product


def line_matrices(position: FloatArray, nodes: int) -> tuple[LineMatrix, LineMatrix]:
    """Two (n, nodes) matrices: control values along a line -> spline and its derivative by the position, at `position`
    (n,) in lattice spacings."""
    index, *weights = spline_weights(position, nodes)
    value, derivative = (each.T[..., None].astype(np.float32) for each in weights)
    return LineMatrix(index.T, value), LineMatrix(index.T, derivative)


def refine_spline(control: NDArray[np.float32], points: int, *, derivative: bool = False) -> NDArray[np.float32]:
    """The spline through control values (nodes, m), or its derivative by the position in lattice spacings, at every
    1/`points` of a spacing, an even number: (n, m), n = (nodes - 1) points + 1.

    A product of matrices three wide, node by node: so small that BLAS does each at once on this thread, where it would
    wait for others on a busy machine.
    """
    nodes, m = control.shape
    ends_repeat = np.concatenate([control[:1], control, control[-1:]])
    row, item = ends_repeat.strides
    # sliding_window_view of NumPy takes longer than the product
    neighbours = np.ndarray((nodes, 3, m), ends_repeat.dtype, ends_repeat, strides=(row, row, item))
    between = slice(points // 2, points // 2 + (nodes - 1) * points + 1)  # a node's points lie on both sides of it
    refined: NDArray[np.float32] = (_node_weights(points)[derivative] @ neighbours).reshape(-1, m)[between]
    return refined


@lru_cache(maxsize=8)
def _node_weights(points: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(points, 3) both: weights of a node and its neighbours at the points nearest to it, and their derivatives."""
    _, weight, slope = spline_weights(np.arange(points) / points + 0.5, 3)
    return weight.astype(np.float32), slope.astype(np.float32)


class SplineTable:
    """A surface and its derivatives at the points of a table, rows along y. Its arrays are shared: not to be written
    to."""

    height: NDArray[np.float32]  # (rows, columns) [m]
    lateral: NDArray[np.float32]  # (rows, columns, 2) u_x, u_y [table points]

    def __init__(self, control: NDArray[np.float32], spacing: float, points: int) -> None:
        """control: displacements (nx, ny, 3) [m]; points: of the table, in each `spacing` [m]."""
        self._control, self._spacing, self._points = control, spacing, points
        value = self._refine()
        self.height, self.lateral = -value[2], np.stack([value[0], value[1]], axis=-1) * np.float32(points / spacing)
        for array in (self.height, self.lateral):
            array.setflags(write=False)

    def _refine(self, *, by_x: bool = False, by_y: bool = False) -> NDArray[np.float32]:
        """(3, rows, columns) displacements, or their derivatives times `spacing` [m]."""
        nx, ny, _ = self._control.shape
        along_x = refine_spline(self._control.reshape(nx, -1), self._points, derivative=by_x)
        # rows are nodes along y then, and columns x of one component after the other
        rows = np.ascontiguousarray(along_x.reshape(-1, ny, 3).transpose(1, 2, 0)).reshape(ny, -1)
        both = refine_spline(rows, self._points, derivative=by_y)
        return both.reshape(len(both), 3, -1).transpose(1, 0, 2)

    @cached_property
    def _derivatives(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        return self._refine(by_x=True), self._refine(by_y=True)

    @cached_property
    def _determinant(self) -> NDArray[np.float32]:
        """(rows, columns) det J, times `spacing` squared [m^2]."""
        (x_by_x, y_by_x, _), (x_by_y, y_by_y, _) = self._derivatives
        determinant: NDArray[np.float32] = (self._spacing + x_by_x) * (self._spacing + y_by_y) - x_by_y * y_by_x
        return determinant

    @cached_property
    def folded(self) -> bool:
        """True if det J <= 0 at some of the points.

        The derivatives of a quadratic B-spline are means of the differences of neighbouring control values, so these
        bound det J, nearly always far above 0; the derivatives themselves are needed only where they do not.
        """
        lateral = self._control[..., :2]
        steps = [np.abs(np.diff(lateral, axis=axis)).max(axis=(0, 1)) / self._spacing for axis in (0, 1)]
        (x_by_x, y_by_x), (x_by_y, y_by_y) = steps
        if max(x_by_x, y_by_y) < 1.0 and (1.0 - x_by_x) * (1.0 - y_by_y) > x_by_y * y_by_x:
            return False
        return float(self._determinant.min()) <= 0.0

    @cached_property
    def fields(self) -> NDArray[np.float32]:
        """(rows, columns, 3) height [m], its derivatives by x and y in the image [-]. The slope of what faces away is
        that of a sheet seen edge-on: it is read only between such points and visible ones."""
        (x_by_x, y_by_x, z_by_x), (x_by_y, y_by_y, z_by_y) = self._derivatives
        determinant = self._determinant
        if self.folded:
            determinant = np.maximum(determinant, np.float32(MIN_JACOBIAN * self._spacing**2))
        inverse = -1.0 / determinant  # the minus turns u_z into height
        slope_x = ((self._spacing + y_by_y) * z_by_x - y_by_x * z_by_y) * inverse
        slope_y = ((self._spacing + x_by_x) * z_by_y - x_by_y * z_by_x) * inverse
        fields = np.stack([self.height, slope_x, slope_y], axis=-1)
        fields.setflags(write=False)
        return fields


@lru_cache(maxsize=4)  # a picture and a map of one surface are asked one after the other
def spline_table(displacement: bytes, shape: tuple[int, ...], spacing: float, points: int) -> SplineTable:
    return SplineTable(np.frombuffer(displacement, np.float32).reshape(shape), spacing, points)
