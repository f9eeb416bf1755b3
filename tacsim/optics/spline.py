"""The C1 quadratic B-spline surface over a lattice of control values: at single points, and along lines.

With s the position in lattice spacings, i the nearest node and f = s - i in [-1/2, 1/2], the weights of the nodes
i-1, i, i+1 are (1/2 - f)^2 / 2, 3/4 - f^2, (1/2 + f)^2 / 2 (de Boor 1978). At the rim the outermost control value
repeats; beyond it the surface continues unchanged.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from tacsim.interface import FloatArray
from tacsim.models.scene import GelSurface


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


def displacement_and_jacobian(surface: GelSurface, points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Displacement (n, 3) [m] and its derivative (n, 3, 2) by X, Y at material points (n, 2) [m]."""
    nx, ny, _ = surface.displacement.shape
    i, wx, dx = spline_weights((points[:, 0] - surface.origin[0]) / surface.spacing, nx)
    j, wy, dy = spline_weights((points[:, 1] - surface.origin[1]) / surface.spacing, ny)
    control = surface.displacement[i[:, :, None], j[:, None, :]].astype(np.float64)  # (n, 3, 3, 3)
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


def refine_spline(control: NDArray[np.float32], points: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """The spline through control values (nodes, m), and its slope by the position in lattice spacings, at every
    1/`points` of a spacing, an even number: (n, m) both, n = (nodes - 1) points + 1.

    Products of matrices three wide, node by node: so small that BLAS does each at once on this thread, where it would
    wait for others on a busy machine.
    """
    nodes, m = control.shape
    ends_repeat = np.concatenate([control[:1], control, control[-1:]])
    row, item = ends_repeat.strides
    # sliding_window_view of NumPy takes longer than the products
    neighbours = np.ndarray((nodes, 3, m), ends_repeat.dtype, ends_repeat, strides=(row, row, item))
    between = slice(points // 2, points // 2 + (nodes - 1) * points + 1)  # a node's points lie on both sides of it
    value, slope = ((weights @ neighbours).reshape(-1, m)[between] for weights in _node_weights(points))
    return value, slope


@lru_cache(maxsize=8)
def _node_weights(points: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(points, 3) both: weights of a node and its neighbours at the points nearest to it, and their derivatives."""
    _, weight, slope = spline_weights(np.arange(points) / points + 0.5, 3)
    return weight.astype(np.float32), slope.astype(np.float32)
