"""The contact patch of an indenter on a gel: its moments, how much of its friction is used, and its stiffness.

Units: mm, N, MPa; wrenches and motions about the sensor's origin, in sensor axes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Self

import numpy as np
from numpy.typing import NDArray

from tacsim.physics.contact.indenter import POINTS
from tacsim.physics.gel.gel import GelParams
from tacsim.physics.units import MM
from tacsim.physics.worlds.tuning import (
    MIN_LEVER,
    NORMAL_MEMORY,
    PATCH_DEPTH_SHARE,
    PATCH_NORMAL_SHARE,
    PATCH_SHEAR_SHARE,
    SHEAR_MEMORY,
    SLIDING_SHARE,
)

Floats = NDArray[np.float64]

_TO_METRES = np.array([1.0, 1.0, 1.0, 1 / MM, 1 / MM, 1 / MM])  # of wrenches [N, N mm]


@dataclass(frozen=True, slots=True, eq=False)
class Patch:
    """Area and pressure of the contact points that touch."""

    area: float  # [mm^2]
    first: Floats  # (2,) integrals of x and y over the area [mm^3]
    second: Floats  # (2, 2) integrals of x x, x y, y y over the area [mm^4]
    height: float  # z of the surface, mean by pressure [mm]
    centre: Floats  # (2,) x, y, mean by pressure [mm]
    lever: float  # mean distance from `centre`, by pressure [mm]

    @classmethod
    def measure(
        cls, gel: GelParams, points: NDArray[np.float32], nodes: NDArray[np.float32], tops: NDArray[np.float32]
    ) -> list[Self]:
        """Of k pads together. points: stored pressure of the contact points (k, 3 nx, 3 ny) [MPa]; nodes: of the
        surface's nodes (k, nx + 1, ny + 1); tops: their height [mm]."""
        side = gel.spacing / POINTS
        x, y = _powers(points.shape[1], side), _powers(points.shape[2], side)
        weight = points.astype(np.float64)
        # (k, 3, 3) sums of 1, x, x^2 times 1, y, y^2 over points that touch, and by pressure
        sums, weighted = x.T @ (points > 0.0).astype(np.float64) @ y, x.T @ weight @ y
        totals = np.where(sums[:, 0, 0] > 0.0, weighted[:, 0, 0], 1.0)
        centres = np.stack([weighted[:, 1, 0], weighted[:, 0, 1]], axis=1) / totals[:, None]
        distances = np.hypot((x[:, 1] - centres[:, :1])[:, :, None], (y[:, 1] - centres[:, 1:])[:, None, :])
        levers = np.einsum("kij,kij->k", weight, distances) / totals
        carried, raised = (
            nodes.sum(axis=(1, 2), dtype=np.float64),
            np.einsum("kij,kij->k", nodes, tops, dtype=np.float64),
        )
        heights = np.where(carried > 0.0, raised / np.where(carried > 0.0, carried, 1.0), 0.0)
        found, square = list[Self](), side**2
        for s, centre, height, lever in zip(square * sums, centres, heights.tolist(), levers.tolist(), strict=True):
            second = np.array([[s[2, 0], s[1, 1]], [s[1, 1], s[0, 2]]])
            found.append(cls(float(s[0, 0]), np.array([s[1, 0], s[0, 1]]), second, height, centre, lever))
        return found

    @property
    def shear_directions(self) -> Floats:
        """(6, 3) wrenches of a unit drag along x and along y at the pressure's centre, and of a unit twist about it."""
        (x, y), z = self.centre, self.height
        return np.array([[1, 0, 0, 0, z, -y], [0, 1, 0, -z, 0, x], [0, 0, 0, 0, 0, 1.0]]).T

    def shear_load(self, wrench: Floats) -> Floats:
        """(3,) drag along x and y, and twist about the pressure's centre over `lever`: the load of friction [N]. Its
        limit is an ellipsoid (Howe & Cutkosky 1996), in these coordinates a ball."""
        twist = wrench[5] - (self.centre[0] * wrench[1] - self.centre[1] * wrench[0])
        return np.array([wrench[0], wrench[1], twist / max(self.lever, MIN_LEVER)])

    def used_friction(self, wrench: Floats, friction: float) -> float:
        """Share of the limit of friction that a wrench (6,) [N, N mm] uses: 1 is full sliding."""
        limit = friction * max(-float(wrench[2]), 0.0)
        return float(np.linalg.norm(self.shear_load(wrench))) / limit if limit > 0.0 else 1.0

    def response(self, gel: GelParams, time: float, wrench: Floats, friction: float, motion: Floats) -> PatchResponse:
        """How the mean wrench of the next step of kernel `time` [mm] follows the motion in it. wrench: mean of the last
        step (6,) [N, N mm]; motion: of the object in it (6,) [mm, rad].

        In a step the gel answers down to the depth that its waves reach; beyond, it is not yet deformed. To this layer
        comes the edge of the patch, as of a disc on a half-space. Part of the answer is viscous (waves that leave,
        dashpots of the contact): when the motion ends, NORMAL_MEMORY and SHEAR_MEMORY of it stay.
        """
        shear_wave = math.sqrt(gel.mu / gel.density)
        radius = math.sqrt(self.area / math.pi)
        poisson = gel.lam / (2 * (gel.lam + gel.mu))
        normal = PATCH_NORMAL_SHARE * gel.density / min(gel.thickness, PATCH_DEPTH_SHARE * time)
        tangential = PATCH_SHEAR_SHARE * gel.mu / min(gel.thickness, shear_wave * time)
        normal += 4 * gel.mu / (1 - poisson) / (math.pi * radius)
        tangential += 8 * gel.mu / (2 - poisson) / (math.pi * radius)
        stiffness = self._normal_stiffness(normal)
        lever = max(self.lever, MIN_LEVER)
        directions = self.shear_directions * [1.0, 1.0, lever]
        centred = self.second.trace() - 2 * self.centre @ self.first + self.area * self.centre @ self.centre
        along = tangential * np.array([self.area, self.area, centred / lever**2])
        load, limit = self.shear_load(wrench), friction * max(-float(wrench[2]), 0.0)
        size = float(np.linalg.norm(load))
        faded = (1.0 - SHEAR_MEMORY) * _viscous_part(load, along * (directions.T @ motion))
        rest = wrench - (1.0 - NORMAL_MEMORY) * stiffness @ motion - directions @ faded
        used = size / limit if limit > 0.0 else 1.0
        kept = size if used > SLIDING_SHARE else limit
        return PatchResponse(rest, stiffness, directions, along, load - faded, kept, stick_share(used))

    def _normal_stiffness(self, modulus: float) -> Floats:
        """(6, 6) of springs along z over the area [MPa/mm]: a turn r moves the point (x, y) by r_x y - r_y x."""
        (x, y), ((xx, xy), (_, yy)) = self.first, self.second
        matrix = np.zeros((6, 6))
        matrix[2:5, 2:5] = [[self.area, y, -x], [y, yy, -xy], [-x, -xy, xx]]
        return modulus * matrix


@lru_cache(maxsize=8)
def _powers(count: int, side: float) -> Floats:
    """(count, 3) 1, x and x^2 of the contact points along an axis [mm]."""
    at = (np.arange(count) - (count - 1) / 2) * side
    return np.stack([np.ones(count), at, at**2], axis=1)


def _viscous_part(load: Floats, grown: Floats) -> Floats:
    """The part of a load that a motion has added, `grown` (3,), at most the load's component along it: the load of a
    contact that slides has not grown so much."""
    size = float(np.linalg.norm(grown))
    if size == 0.0:
        return grown
    return grown * min(1.0, max(float(load @ grown), 0.0) / size**2)


@dataclass(frozen=True, slots=True, eq=False)
class PatchResponse:
    """Mean wrench of a contact in a step, by the motion of the object in it (6,) [mm, rad]: springs along the normal;
    along the surface springs up to the limit of friction, where it slides.

    wrench: (6,) without motion. normal: (6, 6) stiffness. directions: (6, 3) wrench by the shear load; stiffness: (3,)
    of that; load: (3,) without motion [N]; limit: of its length [N], of a contact that slides what it was. stick: share
    of the stiffness that partial slip leaves for a small motion.
    """

    wrench: Floats
    normal: Floats
    directions: Floats
    stiffness: Floats
    load: Floats
    limit: float
    stick: float

    def after(self, motion: Floats) -> tuple[Floats, Floats]:
        """The wrench (6,) after a motion, and its change by a further one (6, 6)."""
        trial = self.load + self.stiffness * (self.directions.T @ motion)
        size = float(np.linalg.norm(trial))
        kept, tangent = trial, np.diag(self.stiffness)
        if size > self.limit:
            along = trial / size
            kept = self.limit * along
            tangent = (self.limit / size) * (np.eye(3) - np.outer(along, along)) * self.stiffness
        change = self.normal @ motion + self.directions @ (kept - self.load)
        return self.wrench + change, self.normal + self.directions @ tangent @ self.directions.T

    def linear(self) -> Floats:
        """(6, 6) change of the wrench by a small motion."""
        return np.asarray(self.normal + self.stick * (self.directions * self.stiffness) @ self.directions.T)

    def in_metres(self) -> PatchResponse:
        """The same for motions in m and rad, wrenches in N and N m."""
        return PatchResponse(
            self.wrench * _TO_METRES, MM * self.normal * _TO_METRES * _TO_METRES[:, None],
            self.directions * _TO_METRES[:, None], MM * self.stiffness, self.load, self.limit, self.stick,
        )  # fmt: skip


def stick_share(used: float) -> float:
    """Tangential stiffness under a load that uses a share of the limit of friction, over that without one:
    (1 - T / (mu N))^(1/3) (Mindlin 1949); 0 of a contact that slides."""
    return float(max(0.0, 1.0 - used / SLIDING_SHARE) ** (1.0 / 3.0))
