"""Distance between body and gel inside their contact patch, from geometry alone, without stored data of the contact.

The body's surface is that of its outer particles (`tacsim.physics.body.surface`): for each the foot of its tangent
plane. The gel's surface is the B-spline that the renderer draws. The distance is along the gel's normal. The patch
consists of cells of two particle spacings that contain a loaded particle. The measure includes all outer particles that
face the gel in a cell whose eight neighbours belong to the patch, loaded or not, so it includes holes in the patch. In
the outermost ring the planes are oblique at an edge, and their feet do not represent the surface; it is reported
separately.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tacsim.optics.spline import displacement_and_jacobian
from tacsim.optics.surface import material_points
from tacsim.physics.body.surface import surface_points
from tacsim.pose import inverse, rotate, transform

if TYPE_CHECKING:
    from tacsim.interface import FloatArray
    from tacsim.models.scene import GelSurface
    from tacsim.physics.world import World

MM = 1e3  # m -> mm, of a snapshot's lengths
CELL = 2.0  # of the patch, in particle spacings
MIN_COSINE = 0.7  # between the normals of a particle's plane and of the gel's surface


@dataclass(frozen=True, slots=True)
class Gaps:
    """Largest distances of body and gel [m]."""

    gap: float  # inside the patch
    overlap: float  # inside the patch, positive
    rim: float  # largest |distance| of loaded particles in the patch's outermost ring


def gaps(world: World, spacing: float) -> Gaps:
    """The largest values of both sensors. spacing: of the body's particles [m]. Raises ValueError for a small patch."""
    found = [_of_sensor(world, name, index, spacing) for index, name in enumerate(world.sensors)]
    return Gaps(max(f.gap for f in found), max(f.overlap for f in found), max(f.rim for f in found))


def _of_sensor(world: World, name: str, index: int, spacing: float) -> Gaps:
    from scipy.ndimage import binary_erosion, binary_fill_holes

    state = world.snapshot()
    x, planes = (state[key].astype(np.float64) for key in ("position", "planes"))
    outer = (planes != 0).any(axis=1)
    loaded = state["contact"][index, outer, 3] > 0  # the multiplier, which is the whole contact force at rest
    to_sensor = inverse(world.pose(name))
    feet = transform(to_sensor, surface_points(x[outer], planes[outer]) / MM)
    normal = rotate(to_sensor, planes[outer])
    at, distance, upwards = _from_gel(world.surface(name), feet)
    towards_gel = -(normal * upwards).sum(axis=1) > MIN_COSINE * np.linalg.norm(normal, axis=1)
    cell = np.floor(at / (CELL * spacing)).astype(int)
    cell -= cell.min(axis=0) - 1
    patch = np.zeros(cell.max(axis=0) + 2, dtype=bool)
    patch[tuple(cell[loaded].T)] = True
    within = binary_erosion(binary_fill_holes(patch), np.ones((3, 3), dtype=bool))[tuple(cell.T)]
    inside, ring = distance[towards_gel & within], distance[loaded & ~within]
    if not len(inside):
        raise ValueError(f"'{name}' has no contact patch of at least three cells of {CELL * spacing * MM:g} mm across")
    return Gaps(
        max(float(inside.max()), 0.0), max(-float(inside.min()), 0.0), float(np.abs(ring).max(initial=0.0))
    )  # fmt: skip


def _from_gel(surface: GelSurface, points: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Material points (n, 2) [m] under `points` (n, 3) [m, sensor frame], distances (n,) [m] above, normals (n, 3)."""
    at = material_points(surface, points[:, :2])
    displacement, jacobian = displacement_and_jacobian(surface, at)
    along = jacobian + np.eye(3)[:, :2]
    normal = np.cross(along[:, :, 0], along[:, :, 1])
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    return at, (points[:, 2] - displacement[:, 2]) * normal[:, 2], normal
