"""Quaternions (x, y, z, w) of unit length and vectors as plain numbers: for what is computed in each timestep, where
arrays take ten times as long."""

from __future__ import annotations

import math
from collections.abc import Sequence

Numbers = tuple[float, ...]


def product(first: Sequence[float], second: Sequence[float]) -> Numbers:
    """a_from_c of a_from_b and b_from_c."""
    (ax, ay, az, aw), (bx, by, bz, bw) = first, second
    return (
        aw * bx + bw * ax + ay * bz - az * by,
        aw * by + bw * ay + az * bx - ax * bz,
        aw * bz + bw * az + ax * by - ay * bx,
        aw * bw - ax * bx - ay * by - az * bz,
    )


def rotated(vector: Sequence[float], quaternion: Sequence[float]) -> Numbers:
    """A vector in the axes of b, in those of a."""
    (x, y, z), (a, b, c, w) = vector, quaternion
    tx, ty, tz = 2 * (b * z - c * y), 2 * (c * x - a * z), 2 * (a * y - b * x)
    return x + w * tx + b * tz - c * ty, y + w * ty + c * tx - a * tz, z + w * tz + a * ty - b * tx


def turned_by(quaternion: Sequence[float], vector: Sequence[float]) -> Numbers:
    """Turned by a rotation vector [rad] in the axes of a."""
    x, y, z = vector
    angle = math.sqrt(x * x + y * y + z * z)
    if angle == 0.0:
        return tuple(quaternion)
    share = math.sin(0.5 * angle) / angle
    return product((share * x, share * y, share * z, math.cos(0.5 * angle)), quaternion)


def rotation_vector(quaternion: Sequence[float]) -> Numbers:
    """[rad], of the shorter rotation."""
    x, y, z, w = quaternion
    size = math.sqrt(x * x + y * y + z * z)
    if size == 0.0:
        return 0.0, 0.0, 0.0
    share = 2.0 * math.atan2(size, abs(w)) / size
    share = share if w >= 0.0 else -share
    return share * x, share * y, share * z
