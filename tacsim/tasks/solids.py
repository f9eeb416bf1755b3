"""How far a kneaded body is from a solid of equal volume: Chamfer and earth mover's distance, intersection over union.

A body is a cloud of particles (n, 3) [m], each of the volume V / n. It is compared with its centre of mass at the
solid's. Of the three measures Huang et al. 2021 (PlasticineLab) report the IoU, Lin et al. 2022 (DiffSkill) the
earth mover's distance on 500 points, Shi et al. 2023 (RoboCook) Chamfer's and the earth mover's.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from tacsim.geometry import shapes
from tacsim.interface import FloatArray
from tacsim.models.scene import Cylinder, Sphere

SAMPLE_POINTS = 500  # of the earth mover's distance


@dataclass(frozen=True)
class Solid:
    """A ball, or a rod (a cylinder) along world x, that a body shall become."""

    geometry: Sphere | Cylinder

    @staticmethod
    def make_ball(volume: float) -> Solid:
        return Solid(Sphere(radius=(3.0 * volume / (4.0 * np.pi)) ** (1 / 3)))

    @staticmethod
    def make_rod(volume: float, slenderness: float) -> Solid:
        """slenderness: length over diameter."""
        radius = (volume / (2.0 * np.pi * slenderness)) ** (1 / 3)
        return Solid(Cylinder(radius=radius, height=2.0 * radius * slenderness))

    @property
    def size(self) -> FloatArray:
        """(3,) along world x, y, z [m]."""
        size: FloatArray = shapes.bounding_size(self.geometry)[[2, 1, 0]]
        return size

    def distance(self, points: FloatArray) -> FloatArray:
        """Signed distance (n,) of points (n, 3), world axes, from its middle [m]; negative inside."""
        distance: FloatArray = shapes.shape_distance(self.geometry, points[:, [2, 1, 0]])
        return distance

    @cached_property
    def points(self) -> FloatArray:
        """Points (n, 3) that fill it evenly, world axes, from its middle [m]."""
        cells_across = 12  # particles of a target across its diameter
        spacing = 2.0 * self.geometry.radius / cells_across
        points: FloatArray = shapes.lattice_particles(self.geometry, spacing)[:, [2, 1, 0]]
        return points

    @cached_property
    def sample_points(self) -> FloatArray:
        """(POINTS, 3) of `points`."""
        points: FloatArray = select_evenly(self.points)
        return points


def centre_points(points: ArrayLike) -> FloatArray:
    """Points from their mean."""
    given = np.asarray(points, dtype=np.float64)
    moved: FloatArray = given - given.mean(axis=0)
    return moved


def chamfer_distance(body: FloatArray, solid: Solid, volume: float) -> float:
    """Mean of how far the body's particles lie outside the solid, and how far the solid's points lie from the body [m].

    Each particle covers the points that are no farther than half the diagonal of its cube, so that a body that fills
    the solid is at 0.
    """
    from scipy.spatial import KDTree  # here: other tasks start without SciPy, 0.3 s sooner

    outside = np.maximum(solid.distance(body), 0.0).mean()
    reach = 0.5 * np.sqrt(3.0) * (volume / len(body)) ** (1 / 3)
    bare = np.maximum(KDTree(body).query(solid.points)[0] - reach, 0.0).mean()
    return float(0.5 * (outside + bare))


def earth_movers_distance(one: FloatArray, other: FloatArray) -> float:
    """Mean way that the points of one cloud have to go to become the other, of as many points, at best [m]."""
    from scipy.optimize import linear_sum_assignment
    from scipy.spatial.distance import cdist

    ways = cdist(one, other)
    return float(ways[linear_sum_assignment(ways)].mean())


def select_evenly(points: FloatArray, number: int = SAMPLE_POINTS) -> FloatArray:
    """(number, 3) of the points, the same ones each time; some twice where there are too few."""
    order = np.random.default_rng(0).permutation(len(points))
    return points[np.resize(order, number)]


def intersection_over_union(body: FloatArray, solid: Solid) -> float:
    """Intersection over union of the two, which have the same volume [-]: of a share f of the body that lies inside the
    solid, f / (2 - f)."""
    inside = float((solid.distance(body) <= 0.0).mean())
    return inside / (2.0 - inside)
