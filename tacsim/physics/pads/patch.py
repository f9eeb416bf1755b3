"""The contact patches of objects on gels: their moments, how much of their friction is used, and how their wrenches
follow a motion. Of many pads together: one after the other would take most of the time of a step.

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
from tacsim.physics.pads.tuning import (
    MIN_LEVER,
    NORMAL_MEMORY,
    PATCH_DEPTH_SHARE,
    PATCH_NORMAL_SHARE,
    PATCH_SHEAR_SHARE,
    SHEAR_MEMORY,
    SLIDING_SHARE,
)
from tacsim.physics.units import MM

Floats = NDArray[np.float64]
Float32 = NDArray[np.float32]

_TO_METRES = np.array([1.0, 1.0, 1.0, 1 / MM, 1 / MM, 1 / MM])  # of wrenches [N, N mm]
_STIFFNESS_TO_METRES = MM * np.outer(_TO_METRES, _TO_METRES)
# (9,) of the moments [x^i y^j]: those in the stiffness along z of a shift, and of turns about x and y, and their signs
_NORMAL_MOMENTS = np.array([0, 1, 3, 1, 2, 4, 3, 4, 6])
_NORMAL_SIGNS = np.array([1.0, 1.0, -1.0, 1.0, 1.0, -1.0, -1.0, -1.0, 1.0])


def step_moduli(gel: GelParams, time: float) -> tuple[float, float, float, float]:
    """Of a gel in a step of kernel `time` [mm]: stiffness of the layer along its normal and along its surface [MPa/mm],
    and what the edge of a patch adds to both, times its radius [MPa].

    In a step the gel answers down to the depth that its waves reach; beyond, it is not yet deformed. To this layer
    comes the edge of the patch, as of a disc on a half-space.
    """
    poisson, shear_wave = gel.lam / (2 * (gel.lam + gel.mu)), math.sqrt(gel.mu / gel.density)
    return (
        PATCH_NORMAL_SHARE * gel.density / min(gel.thickness, PATCH_DEPTH_SHARE * time),
        PATCH_SHEAR_SHARE * gel.mu / min(gel.thickness, shear_wave * time),
        4 * gel.mu / (1 - poisson) / math.pi,
        8 * gel.mu / (2 - poisson) / math.pi,
    )


@dataclass(frozen=True, slots=True, eq=False)
class Patches:
    """Area and pressure of the contact points that touch, of k pads."""

    moments: Floats  # (k, 9) integrals over the area of 1, y, y^2, x, x y, x y^2, x^2, x^2 y, x^2 y^2 [mm^2 ...]
    heights: Floats  # (k,) z of the surface, mean by pressure [mm]
    centres: Floats  # (k, 2) x, y, mean by pressure [mm]
    lever: Floats  # (k,) mean distance from `centres`, by pressure, MIN_LEVER at least [mm]

    @classmethod
    def measure(cls, spacing: float, points: Float32, nodes: Float32, tops: Float32) -> Self:
        """spacing: of the surface's nodes [mm]; points: stored pressure of the contact points (k, 3 nx, 3 ny) [MPa];
        nodes: of the surface's nodes (k, nx + 1, ny + 1); tops: their height [mm]."""
        count, side = len(points), spacing / POINTS
        x, y = _powers(points.shape[1], side), _powers(points.shape[2], side)
        weights = np.empty((2, *points.shape))
        weights[0], weights[1] = points > 0.0, points
        # (2, k, 3, 3) sums of 1, x, x^2 times 1, y, y^2 over points that touch, and by pressure
        touching, pressed = x.T @ (weights @ y)
        totals = np.where(touching[:, 0, 0] > 0.0, pressed[:, 0, 0], 1.0)
        centres = np.stack([pressed[:, 1, 0], pressed[:, 0, 1]], axis=1) / totals[:, None]
        from_x, from_y = x[:, 1] - centres[:, :1], y[:, 1] - centres[:, 1:]
        distances = np.sqrt((from_x * from_x)[:, :, None] + (from_y * from_y)[:, None, :])
        lever = np.einsum("kij,kij->k", weights[1], distances) / totals
        flat = count, nodes.shape[1] * nodes.shape[2]
        loads = nodes.astype(np.float64).reshape(flat)
        carried, raised = loads.sum(axis=1), (loads * tops.reshape(flat)).sum(axis=1)
        heights = raised / np.where(carried > 0.0, carried, 1.0)
        moments = side**2 * touching.reshape(count, 9)
        return cls(moments, heights, centres, np.maximum(lever, MIN_LEVER))

    @property
    def areas(self) -> Floats:
        """(k,) [mm^2]"""
        return self.moments[:, 0]

    def shear_loads(self, wrenches: Floats) -> Floats:
        """(k, 3) drag along x and y, and twist about the pressure's centre over `lever`: the loads of friction [N].
        Their limit is an ellipsoid (Howe & Cutkosky 1996), in these coordinates a ball."""
        loads = wrenches[:, [0, 1, 5]]
        twists = self.centres[:, 0] * wrenches[:, 1] - self.centres[:, 1] * wrenches[:, 0]
        loads[:, 2] = (loads[:, 2] - twists) / self.lever
        return loads

    def shear_directions(self) -> Floats:
        """(k, 6, 3) wrenches of a unit drag along x and along y at the pressure's centre, and of a unit twist about it,
        over `lever`."""
        found = np.zeros((len(self.heights), 6, 3))
        found[:, 0, 0] = found[:, 1, 1] = 1.0
        found[:, 4, 0], found[:, 3, 1] = self.heights, -self.heights
        found[:, 5, 0], found[:, 5, 1], found[:, 5, 2] = -self.centres[:, 1], self.centres[:, 0], self.lever
        return found

    def used_friction(self, wrenches: Floats, frictions: Floats) -> Floats:
        """(k,) share of the limit of friction that wrenches (k, 6) [N, N mm] use: 1 is full sliding."""
        return _share_of(_lengths(self.shear_loads(wrenches)), frictions * np.maximum(-wrenches[:, 2], 0.0))

    def responses(self, moduli: Floats, wrenches: Floats, frictions: Floats, motions: Floats) -> PatchResponses:
        """How the mean wrench of the next step follows the motion in it. moduli: see `step_moduli`; wrenches: means of
        the last step (k, 6) [N, N mm]; motions: of the objects in it (k, 6) [mm, rad].

        Part of the answer is viscous (waves that leave, dashpots of the contact): when the motion ends, NORMAL_MEMORY
        and SHEAR_MEMORY of it stay.
        """
        areas, lx, ly = self.areas, self.centres[:, 0], self.centres[:, 1]
        along_normal, along_surface = (moduli[:, :2] + moduli[:, 2:] * np.sqrt(math.pi / areas)[:, None]).T
        normals = np.zeros((len(areas), 6, 6))
        springs = self.moments[:, _NORMAL_MOMENTS] * (along_normal[:, None] * _NORMAL_SIGNS)
        normals[:, 2:5, 2:5] = springs.reshape(-1, 3, 3)
        directions = self.shear_directions()
        centred = self.moments[:, 2] + self.moments[:, 6] + areas * (lx * lx + ly * ly)
        centred -= 2.0 * (lx * self.moments[:, 3] + ly * self.moments[:, 1])
        stiffness = np.empty((len(areas), 3))
        stiffness[:, 0] = stiffness[:, 1] = along_surface * areas
        stiffness[:, 2] = along_surface * centred / self.lever**2
        loads, limits = self.shear_loads(wrenches), frictions * np.maximum(-wrenches[:, 2], 0.0)
        sizes = _lengths(loads)
        grown = stiffness * (motions[:, None] @ directions)[:, 0]
        faded = (1.0 - SHEAR_MEMORY) * _viscous_part(loads, grown)
        lost = (1.0 - NORMAL_MEMORY) * (normals @ motions[..., None]) + directions @ faded[..., None]
        used = _share_of(sizes, limits)
        kept = np.where(used > SLIDING_SHARE, sizes, limits)
        return PatchResponses(wrenches - lost[..., 0], normals, directions, stiffness, loads - faded, kept, used)


@lru_cache(maxsize=8)
def _powers(count: int, side: float) -> Floats:
    """(count, 3) 1, x and x^2 of the contact points along an axis [mm]."""
    at = (np.arange(count) - (count - 1) / 2) * side
    return np.stack([np.ones(count), at, at**2], axis=1)


def _lengths(vectors: Floats) -> Floats:
    return np.asarray(np.sqrt((vectors * vectors).sum(axis=1)))


def _share_of(sizes: Floats, limits: Floats) -> Floats:
    """sizes / limits; 1 where the limit is 0."""
    return np.where(limits > 0.0, sizes / np.where(limits > 0.0, limits, 1.0), 1.0)


def _viscous_part(loads: Floats, grown: Floats) -> Floats:
    """The part of loads (k, 3) that motions have added, `grown`, at most the load's component along it: the load of a
    contact that slides has not grown so much."""
    squares = (grown * grown).sum(axis=1)
    along = (loads * grown).sum(axis=1)
    share = np.clip(along, 0.0, squares) / np.where(squares > 0.0, squares, 1.0)
    return np.asarray(share[:, None] * grown)


@dataclass(frozen=True, slots=True, eq=False)
class PatchResponses:
    """Mean wrenches of k contacts in a step, by the motions of the objects in it (k, 6) [mm, rad]: springs along the
    normal; along the surface springs up to the limit of friction, where it slides.

    wrenches: (k, 6) without motion. normals: (k, 6, 6) stiffness. directions: (k, 6, 3) wrench by the shear load;
    stiffness: (k, 3) of that; loads: (k, 3) without motion [N]; limits: (k,) of their length [N], of a contact that
    slides what it was. used: (k,) share of the limit of friction that the load of the last step uses.
    """

    wrenches: Floats
    normals: Floats
    directions: Floats
    stiffness: Floats
    loads: Floats
    limits: Floats
    used: Floats

    def __len__(self) -> int:
        return len(self.limits)

    def of(self, rows: slice | NDArray[np.intp]) -> PatchResponses:
        """Those of some contacts."""
        return PatchResponses(
            self.wrenches[rows], self.normals[rows], self.directions[rows], self.stiffness[rows], self.loads[rows],
            self.limits[rows], self.used[rows],
        )  # fmt: skip

    def after(self, motions: Floats) -> tuple[Floats, Floats]:
        """The wrenches (k, 6) after motions (k, 6), and their changes by further ones (k, 6, 6)."""
        across = self.directions.transpose(0, 2, 1)
        trial = self.loads + self.stiffness * (motions[:, None] @ self.directions)[:, 0]
        sizes = _lengths(trial)
        sliding = sizes > self.limits
        kept, along_surface = trial, self.directions * self.stiffness[:, None]
        if sliding.any():
            share = np.where(sliding, self.limits / np.where(sliding, sizes, 1.0), 1.0)
            along = np.where(sliding, 1.0 / np.where(sliding, sizes, 1.0), 0.0)[:, None] * trial
            kept = share[:, None] * trial
            left = share[:, None, None] * (_IDENTITY - along[:, :, None] * along[:, None, :])
            along_surface = self.directions @ (left * self.stiffness[:, None])
        change = self.normals @ motions[..., None] + self.directions @ (kept - self.loads)[..., None]
        return self.wrenches + change[..., 0], self.normals + along_surface @ across

    def linear(self) -> Floats:
        """(k, 6, 6) changes of the wrenches by small motions."""
        sticking = self.stiffness * stick_share(self.used)[:, None]
        return np.asarray(self.normals + (self.directions * sticking[:, None]) @ self.directions.transpose(0, 2, 1))

    def in_metres(self) -> PatchResponses:
        """The same for motions in m and rad, wrenches in N and N m."""
        return PatchResponses(
            self.wrenches * _TO_METRES, self.normals * _STIFFNESS_TO_METRES, self.directions * _TO_METRES[:, None],
            MM * self.stiffness, self.loads, self.limits, self.used,
        )  # fmt: skip


_IDENTITY = np.eye(3)


def stick_share(used: Floats) -> Floats:
    """Tangential stiffness under loads that use a share of the limit of friction, over that without one:
    (1 - T / (mu N))^(1/3) (Mindlin 1949); 0 of a contact that slides."""
    return np.asarray(np.maximum(0.0, 1.0 - used / SLIDING_SHARE) ** (1.0 / 3.0))
