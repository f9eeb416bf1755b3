"""Even motions of objects in the frames of gel pads."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tacsim.physics.units import MM

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class EvenMotion:
    """Motions of k objects, each evenly from one pose to another. Computed in each timestep of an engine, so without
    SciPy's rotations, which take ten times as long for few."""

    places: Floats  # (k, 3) at the start [mm]
    axes: Floats  # (k, 3, 3) then
    shifts: Floats  # (k, 3) [mm]
    turns: Floats  # (k, 3) rotation vectors [rad]

    @classmethod
    def between(cls, starts: Floats, ends: Floats) -> Self:
        """From and to poses (k, 7) [m], quaternions x, y, z, w of length 1."""
        (ax, ay, az, aw), (bx, by, bz, bw) = starts[:, 3:].T, ends[:, 3:].T
        x, y, z = (
            aw * bx - bw * ax + bz * ay - by * az,
            aw * by - bw * ay + bx * az - bz * ax,
            aw * bz - bw * az + by * ax - bx * ay,
        )
        w = aw * bw + ax * bx + ay * by + az * bz
        size = np.sqrt(x * x + y * y + z * z)
        share = 2.0 * np.arctan2(size, np.abs(w)) / np.where(size > 0.0, size, 1.0)
        turns = np.where(w < 0.0, -share, share)[:, None] * np.stack([x, y, z], axis=1)
        return cls(MM * starts[:, :3], matrices_of(starts), MM * (ends[:, :3] - starts[:, :3]), turns)

    def of(self, rows: list[int]) -> EvenMotion:
        """Those of some objects."""
        return EvenMotion(self.places[rows], self.axes[rows], self.shifts[rows], self.turns[rows])

    def drive(self, substeps: int, time: float) -> NDArray[np.float32]:
        """(k, substeps, 1, 6, 3) pose and velocity in each substep, in a kernel `time` [mm]: by Rodrigues' formula."""
        share = np.arange(1, substeps + 1) / substeps
        angle = np.sqrt((self.turns * self.turns).sum(axis=1))[:, None]
        is_turning = angle > 1e-12
        size = np.where(is_turning, angle, 1.0)
        first = np.where(is_turning, np.sin(share * size) / size, share)[..., None, None]
        second = np.where(is_turning, 2.0 * (np.sin(0.5 * share * size) / size) ** 2, 0.5 * share**2)[..., None, None]
        x, y, z = self.turns.T
        cross = np.zeros((len(self.turns), 3, 3))
        cross[:, 0, 1], cross[:, 0, 2], cross[:, 1, 2] = -z, y, -x
        cross -= cross.transpose(0, 2, 1)
        once = cross @ self.axes
        drive = np.empty((len(self.turns), substeps, 1, 6, 3), np.float32)
        drive[:, :, 0, :3] = self.axes[:, None] + first * once[:, None] + second * (cross @ once)[:, None]
        drive[:, :, 0, 3] = self.places[:, None] + share[:, None] * self.shifts[:, None]
        drive[:, :, 0, 4], drive[:, :, 0, 5] = (self.shifts / time)[:, None], (self.turns / time)[:, None]
        return drive

    def at_origin(self, substeps: int) -> Floats:
        """(k, 6) shift of what is at the origin [mm], and turn [rad], about the middle of a drive of `substeps`."""
        x, y, z = (self.places + (0.5 + 0.5 / substeps) * self.shifts).T
        rx, ry, rz = self.turns.T
        about = np.stack([rz * y - ry * z, rx * z - rz * x, ry * x - rx * y], axis=1)
        return np.concatenate([self.shifts + about, self.turns], axis=1)


def check_poses(poses: ArrayLike, count: int) -> Floats:
    """(n, 7) with quaternions of length 1. Raises ValueError."""
    given = np.array(poses, dtype=np.float64)
    if given.shape != (count, 7):
        raise ValueError(f"poses must have shape ({count}, 7), position and quaternion of each pad; got {given.shape}")
    length = np.linalg.norm(given[:, 3:], axis=1)
    bad = np.flatnonzero(~(np.isfinite(given).all(axis=1) & (np.abs(length - 1.0) <= 1e-3)))
    if len(bad):
        raise ValueError(
            f"the pose of the object of pad {bad[0]} is {given[bad[0]].tolist()}: it needs finite numbers and a "
            f"quaternion (x, y, z, w) of length 1; has the engine diverged?"
        )
    given[:, 3:] /= length[:, None]
    return given


def matrices_of(poses: Floats) -> Floats:
    """Rotation matrices (..., 3, 3) of poses (..., 7) with unit quaternions: faster than SciPy's for few."""
    x, y, z, w = (poses[..., number] for number in range(3, 7))
    xx, yy, zz, xy, zw, xz, yw, yz, xw = x * x, y * y, z * z, x * y, z * w, x * z, y * w, y * z, x * w
    rows = (
        (1 - 2 * (yy + zz), 2 * (xy - zw), 2 * (xz + yw)),
        (2 * (xy + zw), 1 - 2 * (xx + zz), 2 * (yz - xw)),
        (2 * (xz - yw), 2 * (yz + xw), 1 - 2 * (xx + yy)),
    )
    found = np.empty((*poses.shape[:-1], 3, 3))
    for r, c in itertools.product(range(3), range(3)):
        found[..., r, c] = rows[r][c]
    return found
