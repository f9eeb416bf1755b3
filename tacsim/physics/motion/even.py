"""Even motions of objects in the frames of gel pads."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tacsim.physics.units import MM

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class EvenMotion:
    """Motions of k objects, each evenly from one pose to another.

    Computed in each timestep of an engine, so in few operations on arrays: what is computed of quaternions is a sum
    over the products of all their numbers (`_RELATIVE_QUATERNION`, `_ROTATION_MATRIX`). SciPy's rotations take ten
    times as long for few.
    """

    places: Floats  # (k, 3) at the start [mm]
    axes: Floats  # (k, 3, 3) then
    shifts: Floats  # (k, 3) [mm]
    turns: Floats  # (k, 3) rotation vectors [rad]
    angles: Floats  # (k,) their lengths
    cross_matrices: Floats  # (k, 3, 3) matrices of the cross product with the turns

    @classmethod
    def between(cls, starts: Floats, ends: Floats) -> Self:
        """From and to poses (k, 7) [m], quaternions x, y, z, w of length 1."""
        both = (ends[:, 3:, None] * starts[:, None, 3:]).reshape(-1, 1, 16)
        relative = (both @ _RELATIVE_QUATERNION)[:, 0]
        vector, w = relative[:, :3], relative[:, 3]
        size = np.sqrt((vector * vector).sum(axis=1))
        angles = 2.0 * np.arctan2(size, np.abs(w))
        share = angles / np.maximum(size, np.finfo(np.float64).tiny)
        turns = np.where(w < 0.0, -share, share)[:, None] * vector
        cross_matrices = (turns[:, None] @ _CROSS_PRODUCT).reshape(-1, 3, 3)
        places = MM * starts[:, :3]
        return cls(places, matrices_of(starts), MM * ends[:, :3] - places, turns, angles, cross_matrices)

    def of(self, rows: list[int]) -> EvenMotion:
        """Those of some objects."""
        return EvenMotion(
            self.places[rows], self.axes[rows], self.shifts[rows], self.turns[rows], self.angles[rows],
            self.cross_matrices[rows],
        )  # fmt: skip

    def drive(self, substeps: int, time: float) -> NDArray[np.float32]:
        """(k, substeps, 1, 6, 3) pose and velocity in each substep, in a kernel `time` [mm]: by Rodrigues' formula."""
        share = _shares(substeps)
        size = np.maximum(self.angles, 1e-12)[:, None]  # the quotients below have their limits there
        weights = np.ones((len(size), substeps, 4))
        weights[..., 1] = share
        weights[..., 2] = np.sin(share * size) / size
        weights[..., 3] = 2.0 * (np.sin((0.5 * share) * size) / size) ** 2
        once = self.cross_matrices @ self.axes
        parts = np.zeros((len(size), 4, 18))
        parts[:, 0, :9], parts[:, 0, 9:12] = self.axes.reshape(-1, 9), self.places
        parts[:, 0, 12:15], parts[:, 0, 15:] = self.shifts / time, self.turns / time
        parts[:, 1, 9:12] = self.shifts
        parts[:, 2, :9], parts[:, 3, :9] = once.reshape(-1, 9), (self.cross_matrices @ once).reshape(-1, 9)
        return (weights @ parts).astype(np.float32).reshape(-1, substeps, 1, 6, 3)

    def at_origin(self, substeps: int) -> Floats:
        """(k, 6) shift of what is at the origin [mm], and turn [rad], about the middle of a drive of `substeps`."""
        middle = self.places + (0.5 + 0.5 / substeps) * self.shifts
        return np.concatenate([self.shifts - (self.cross_matrices @ middle[..., None])[..., 0], self.turns], axis=1)


@lru_cache(maxsize=32)
def _shares(substeps: int) -> Floats:
    """(substeps,) of a motion that is over at the end of each substep."""
    return np.arange(1, substeps + 1) / substeps


def check_poses(poses: ArrayLike, count: int) -> Floats:
    """(n, 7) with quaternions of length 1. Raises ValueError."""
    given = np.array(poses, dtype=np.float64)
    if given.shape != (count, 7):
        raise ValueError(f"poses must have shape ({count}, 7), position and quaternion of each pad; got {given.shape}")
    turns = given[:, 3:]
    length = np.sqrt((turns * turns).sum(axis=1))
    if not (np.isfinite(given).all() and (np.abs(length - 1.0) <= 1e-3).all()):
        bad = np.flatnonzero(~(np.isfinite(given).all(axis=1) & (np.abs(length - 1.0) <= 1e-3)))
        raise ValueError(
            f"the pose of the object of pad {bad[0]} is {given[bad[0]].tolist()}: it needs finite numbers and a "
            f"quaternion (x, y, z, w) of length 1; has the engine diverged?"
        )
    turns /= length[:, None]
    return given


def matrices_of(poses: Floats) -> Floats:
    """Rotation matrices (..., 3, 3) of poses (..., 7) with unit quaternions: faster than SciPy's for few."""
    turns = poses[..., 3:]
    products = (turns[..., :, None] * turns[..., None, :]).reshape(*turns.shape[:-1], 1, 16)
    return (_IDENTITY + products @ _ROTATION_MATRIX).reshape(*turns.shape[:-1], 3, 3)


def _weights(rows: list[str]) -> Floats:
    """(16, n) weights of the products of all pairs of x, y, z, w in each of n sums, written as "+wx-yz"."""
    found = np.zeros((4, 4, len(rows)))
    for number, row in enumerate(rows):
        for sign, first, second in zip(row[::3], row[1::3], row[2::3], strict=True):
            found["xyzw".index(first), "xyzw".index(second), number] += 1.0 if sign == "+" else -1.0
    return found.reshape(16, len(rows))


# Of the quaternion b a^-1, by products of the numbers of b and a
_RELATIVE_QUATERNION = _weights(["-wx+xw-yz+zy", "-wy+yw-zx+xz", "-wz+zw-xy+yx", "+ww+xx+yy+zz"])
# Of the rotation matrix of a quaternion, row by row
_ROTATION_MATRIX = 2.0 * _weights(
    ["-yy-zz", "+xy-zw", "+xz+yw", "+xy+zw", "-xx-zz", "+yz-xw", "+xz-yw", "+yz+xw", "-xx-yy"]
)  # fmt: skip
_IDENTITY = np.eye(3).reshape(1, 9)
# (3, 9) of the matrix of the cross product with a vector
_CROSS_PRODUCT = np.array([[0.0, 0, 0, 0, 0, -1, 0, 1, 0], [0, 0, 1, 0, 0, 0, -1, 0, 0], [0, -1, 0, 1, 0, 0, 0, 0, 0]])
