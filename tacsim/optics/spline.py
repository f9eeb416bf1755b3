"""The C1 quadratic B-spline surface over a lattice of control values: at single points, and as matrices for lines.

With s the position in lattice spacings, i the nearest node and f = s - i in [-1/2, 1/2], the weights of the nodes
i-1, i, i+1 are (1/2 - f)^2 / 2, 3/4 - f^2, (1/2 + f)^2 / 2 (de Boor 1978). At the rim the outermost control value
repeats; beyond it the surface continues unchanged.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from tacsim.models.scene import GelSurface

Float64 = NDArray[np.float64]


def spline_weights(position: Float64, nodes: int) -> tuple[NDArray[np.intp], Float64, Float64]:
    """Nodes (..., 3), their weights and the derivatives of those, at `position` (...,) in lattice spacings."""
    inside = np.clip(position, 0.0, nodes - 1.0)
    centre = np.floor(inside + 0.5)
    f = inside - centre
    index = np.clip(centre[..., None] + np.array([-1, 0, 1]), 0, nodes - 1).astype(np.intp)
    weight = np.stack([0.5 * (0.5 - f) ** 2, 0.75 - f**2, 0.5 * (0.5 + f) ** 2], axis=-1)
    slope = np.stack([f - 0.5, -2.0 * f, f + 0.5], axis=-1)
    slope[inside != position] = 0.0
    return index, weight, slope


def displacement_and_jacobian(surface: GelSurface, points: Float64) -> tuple[Float64, Float64]:
    """Displacement (n, 3) [m] and its derivative (n, 3, 2) by X, Y at material points (n, 2) [m]."""
    nx, ny, _ = surface.displacement.shape
    i, wx, dx = spline_weights((points[:, 0] - surface.origin[0]) / surface.spacing, nx)
    j, wy, dy = spline_weights((points[:, 1] - surface.origin[1]) / surface.spacing, ny)
    control = surface.displacement[i[:, :, None], j[:, None, :]].astype(np.float64)  # (n, 3, 3, 3)
    value = np.einsum("nijc,ni,nj->nc", control, wx, wy)
    by_x = np.einsum("nijc,ni,nj->nc", control, dx, wy) / surface.spacing
    by_y = np.einsum("nijc,ni,nj->nc", control, wx, dy) / surface.spacing
    return value, np.stack([by_x, by_y], axis=-1)


def line_matrices(position: Float64, nodes: int) -> tuple[csr_array, csr_array]:
    """Two sparse (n, nodes) matrices: control values along a line -> spline and its derivative by the position, at
    `position` (n,) in lattice spacings."""
    index, weight, slope = spline_weights(position, nodes)
    row = np.arange(len(position))[:, None].repeat(3, axis=1)
    shape = (len(position), nodes)
    value = csr_array((weight.astype(np.float32).ravel(), (row.ravel(), index.ravel())), shape=shape)
    derivative = csr_array((slope.astype(np.float32).ravel(), (row.ravel(), index.ravel())), shape=shape)
    return value, derivative
