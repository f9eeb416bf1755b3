"""The body's surface as tangent planes: each particle near the surface stores the plane of the true surface.

Particles sample the volume, not the surface. If all particles touched at the same distance, the dent would show how
deep below the surface each one lies: steps of the lattice in a curved body, noise with random particles. Therefore each
particle stores m = n / r, with the outward normal n of the nearest surface and its distance r. A plane that moves with
the material is transformed by F^-T, m' = -C^T m, so 1 / |m| stays the distance of the deformed surface, even if the
layer between is compressed. Lengths in any one unit, m in its inverse.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tacsim.geometry.shapes import outward_normals, shape_distance
from tacsim.models.scene import Shape
from tacsim.physics.body.tuning import MIN_SURFACE_DISTANCE, SURFACE_DEPTH

FloatArray = NDArray[np.floating]


def tangent_planes(geometry: Shape, points: NDArray[np.float64], spacing: float) -> NDArray[np.float64]:
    """Planes m (n, 3) [1/m] of body particles at `points` (n, 3) [m], frame of the shape; zero deep inside.

    Where several faces have the same distance (at an edge of a box), n is their mean direction.
    Raises the errors of :func:`tacsim.geometry.shapes.shape_distance`.
    """
    depth = -shape_distance(geometry, points)
    outer = np.flatnonzero(depth <= SURFACE_DEPTH * spacing)
    planes = np.zeros((len(points), 3))
    normals = outward_normals(geometry, points[outer])
    planes[outer] = normals / np.maximum(depth[outer], MIN_SURFACE_DISTANCE * spacing)[:, None]
    return planes


def surface_points(x: FloatArray, planes: FloatArray) -> FloatArray:
    """Nearest point of the surface for each particle (n, 3), x + m / |m|^2; deep inside the particle itself."""
    square = np.einsum("ni,ni->n", planes, planes)[:, None]
    return x + np.where(square > 0, planes / np.where(square > 0, square, 1.0), 0.0)
