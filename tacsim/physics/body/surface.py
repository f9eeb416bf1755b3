"""The body's surface as its particles know it: each one near it carries the tangent plane of the true surface.

Particles stand for volume; where the surface is they do not say. If each touched at the same distance, the print would
show how deep below the surface each happens to lie: the steps of a lattice in a curved body, an orange peel of random
particles. So each carries m = n / r, n the outward normal of the nearest surface and r the distance from it. A plane
that moves with the material goes as F^-T, m' = -C^T m (convection of a covector), so 1 / |m| stays the distance of the
deformed surface, however the layer in between was squeezed thin. Lengths in any one unit, m in its inverse.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tacsim.geometry.shapes import outward_normals, shape_distance
from tacsim.models.scene import Shape
from tacsim.physics.body.tuning import MIN_SURFACE_DISTANCE, SURFACE_DEPTH

FloatArray = NDArray[np.floating]


def tangent_planes(geometry: Shape, points: NDArray[np.float64], spacing: float) -> NDArray[np.float64]:
    """Planes m (n, 3) [1/m] of body particles at `points` (n, 3) [m], the shape's own frame; zero deep inside.

    Where several faces are equally near (the edge of a box), n is their mean direction.
    Raises what :func:`tacsim.geometry.shapes.shape_distance` raises.
    """
    depth = -shape_distance(geometry, points)
    outer = np.flatnonzero(depth <= SURFACE_DEPTH * spacing)
    planes = np.zeros((len(points), 3))
    normals = outward_normals(geometry, points[outer])
    planes[outer] = normals / np.maximum(depth[outer], MIN_SURFACE_DISTANCE * spacing)[:, None]
    return planes


def surface_points(x: FloatArray, planes: FloatArray) -> FloatArray:
    """The point of the surface nearest to each particle (n, 3), x + m / |m|^2; the particle itself deep inside."""
    square = np.einsum("ni,ni->n", planes, planes)[:, None]
    return x + np.where(square > 0, planes / np.where(square > 0, square, 1.0), 0.0)
