"""Motions of pads in one step, in the frame of their grip, which moves with their mean."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tacsim.physics.grip.layout import FRAME_ROWS
from tacsim.physics.motion.even import matrices_of

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class PadMotions:
    """Even motions of the pads of many grips relative to the frame of their grip, which itself moves evenly.

    centres: (n, 3) of the objects at the start, world [mm]; common_shift, common_turn: (n, 3) of the frame [mm, rad],
    world; places: (n, k, 3) of the pads at the start [mm]; axes: (n, k, 3, 3) then; shifts, turns: (n, k, 3) [mm, rad],
    in the frame.
    """

    centres: Floats
    common_shift: Floats
    common_turn: Floats
    places: Floats
    axes: Floats
    shifts: Floats
    turns: Floats

    @classmethod
    def between(cls, centres: Floats, starts: Floats, ends: Floats, carrying: NDArray[np.bool_]) -> Self:
        """starts, ends: (n, k, 7) poses of the pads in world [mm]. carrying: (n, k) pads with whose mean motion, about
        the object's centre, the frame moves; without one it does not move."""
        count = starts.shape[:2]
        before, after = (Rotation.from_quat(each[..., 3:].reshape(-1, 4)) for each in (starts, ends))
        turns = (after * before.inv()).as_rotvec().reshape(*count, 3)
        arms = centres[:, None] - starts[..., :3]
        carried = ends[..., :3] - starts[..., :3] + _turn(turns, arms) - arms
        weights = (carrying / np.maximum(carrying.sum(axis=1, keepdims=True), 1))[..., None]
        shift, turn = (weights * carried).sum(axis=1), (weights * turns).sum(axis=1)
        back = np.swapaxes(_matrices(turn), -1, -2)[:, None]
        last = (back @ (ends[..., :3] - (centres + shift)[:, None])[..., None])[..., 0]
        axes = matrices_of(starts)
        turned = back @ matrices_of(ends) @ np.swapaxes(axes, -1, -2)
        own = Rotation.from_matrix(turned.reshape(-1, 3, 3)).as_rotvec().reshape(*count, 3)
        return cls(centres, shift, turn, -arms, axes, last + arms, own)

    def lengths(self, lever: float) -> Floats:
        """(n,) longest path of a pad relative to the frame [mm]; lever: of its rim from its origin [mm]."""
        paths = np.linalg.norm(self.shifts, axis=-1) + lever * np.linalg.norm(self.turns, axis=-1)
        return np.asarray(paths.max(axis=1))

    def frames(self, substeps: NDArray[np.int64], step: float) -> list[NDArray[np.float32]]:
        """Of each grip (substeps + 1, k + 1, FRAME_ROWS, 3), see tacsim.physics.grip.layout; step: of time [mm]."""
        grips, pads = self.places.shape[:2]
        longest = int(substeps.max())
        share = np.minimum(np.arange(1, longest + 2) / substeps[:, None], 1.0)[..., None]  # (n, longest + 1, 1)
        moving = (np.arange(longest + 1) < substeps[:, None])[..., None]
        rate = np.where(moving, 1.0 / (step * substeps[:, None, None]), 0.0)
        found = np.zeros((grips, longest + 1, pads + 1, FRAME_ROWS, 3))
        for g in range(pads):
            shift, turn = self.shifts[:, None, g], self.turns[:, None, g]
            found[:, :, g, :3] = _matrices(share * turn) @ self.axes[:, None, g]
            found[:, :, g, 3] = self.places[:, None, g] + share * shift
            found[:, :, g, 4], found[:, :, g, 5] = rate * shift, rate * turn
        shift, turn = self.common_shift[:, None], self.common_turn[:, None]
        found[:, :, pads, :3] = _matrices(share * turn)
        found[:, :, pads, 3], found[:, :, pads, 4], found[:, :, pads, 5] = share * shift, rate * shift, rate * turn
        return [each[: count + 1].astype(np.float32) for each, count in zip(found, substeps, strict=True)]

    def to_world(self, places: Floats, vectors: Floats) -> tuple[Floats, Floats, Floats]:
        """Positions (n, 3) [mm] and vectors (n, m, 3) at the end of the motion, from the frame of the grip to world,
        and the rotation matrices (n, 3, 3) between both."""
        turned = _matrices(self.common_turn)
        at = self.centres + self.common_shift + (turned @ places[..., None])[..., 0]
        return at, vectors @ np.swapaxes(turned, -1, -2), turned


def _matrices(turns: Floats) -> Floats:
    return np.asarray(Rotation.from_rotvec(turns.reshape(-1, 3)).as_matrix().reshape(*turns.shape[:-1], 3, 3))


def _turn(turns: Floats, vectors: Floats) -> Floats:
    """Vectors turned by rotation vectors, both (..., 3)."""
    return np.asarray(Rotation.from_rotvec(turns.reshape(-1, 3)).apply(vectors.reshape(-1, 3)).reshape(vectors.shape))
