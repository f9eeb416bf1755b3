"""Poses of objects and pads as arrays; checks of what a caller gives."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tacsim.physics.motion.even import matrices_of
from tacsim.physics.units import MM

Floats = NDArray[np.float64]


def z_axes(poses: Floats) -> Floats:
    """(..., 3) of poses (..., 7)."""
    x, y, z, w = (poses[..., number] for number in range(3, 7))
    return np.stack([2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)], axis=-1)


def half_widths(pads: Floats) -> Floats:
    """(n,) distance of the pads (n, k, 7) from their common centre, along their z axes, on average [m]."""
    away = pads[..., :3].mean(axis=1, keepdims=True) - pads[..., :3]
    return np.asarray((away * z_axes(pads)).sum(axis=-1).mean(axis=1))


def max_closings(pads: Floats) -> Floats:
    """(n,) how far the pads of each grip may close until two that face each other meet [m]."""
    z, found = z_axes(pads), np.full(len(pads), 1.0)
    for g in range(pads.shape[1]):
        for h in range(g):
            facing = 1.0 - (z[:, g] * z[:, h]).sum(axis=1)
            gap = ((pads[:, h] - pads[:, g])[:, :3] * (z[:, g] - z[:, h])).sum(axis=1) / 2
            found = np.where(facing > 1.0, np.minimum(found, gap / np.maximum(facing, 1.0)), found)
    return found


def in_mm(poses: Floats) -> Floats:
    return poses * [MM, MM, MM, 1, 1, 1, 1]


def relative_rows(item: Floats, pad: Floats) -> NDArray[np.float32]:
    """Motion (6, 3) of an object at rest in the frame of a pad, as in a drive."""
    axes = matrices_of(pad)
    rows = np.zeros((6, 3))
    rows[:3], rows[3] = axes.T @ matrices_of(item), axes.T @ (MM * (item[:3] - pad[:3]))
    return rows.astype(np.float32)


def checked_numbers(values: ArrayLike, shape: tuple[int, ...], name: str) -> Floats:
    given = np.array(values, np.float64)
    if given.shape != shape or not np.isfinite(given).all():
        raise ValueError(f"{name} must be finite numbers of shape {shape}; got {given.tolist()}")
    return given


def checked_forces(values: ArrayLike, count: int) -> Floats:
    given = np.array(values, np.float64)
    if given.shape != (count,) or np.isinf(given).any() or (given < 0.0).any():
        raise ValueError(
            f"forces must have shape ({count},), not negative, NaN of grips without one; got {given.tolist()}"
        )
    return given


def checked_poses(values: ArrayLike, shape: tuple[int, ...], name: str) -> Floats:
    """Poses with quaternions of length 1. Raises ValueError."""
    given = np.array(values, np.float64)
    if given.shape != shape:
        raise ValueError(f"{name} must have shape {shape}, positions and quaternions; got {given.shape}")
    length = np.linalg.norm(given[..., 3:], axis=-1)
    bad = ~(np.isfinite(given).all(axis=-1) & (np.abs(length - 1.0) <= 1e-3))
    if bad.any():
        worst = given[bad][0]
        raise ValueError(f"{name} has {worst.tolist()}: finite numbers, and a quaternion (x, y, z, w) of length 1")
    given[..., 3:] /= length[..., None]
    return given
