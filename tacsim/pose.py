"""Rigid transforms: operations on tacsim.interface.Pose.

``a_from_b`` maps coordinates in b to coordinates in a; it also is the pose of b in a.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from tacsim.interface import FloatArray, Pose

if TYPE_CHECKING:  # imported where something really turns: it brings all of scipy.spatial, 0.2 s
    from scipy.spatial.transform import Rotation

# Pose of the upper sensor's axes as seen from the lower one's: z turned down, nothing mirrored.
HALF_TURN_X = Pose(quaternion=np.array([1.0, 0.0, 0.0, 0.0]))


def rotation(pose: Pose) -> Rotation:
    """The rotation of a pose."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_quat(np.array(pose.quaternion))  # a copy: SciPy refuses read-only arrays


def rotation_matrix(pose: Pose) -> FloatArray:
    """The rotation matrix (3, 3) of a pose."""
    x, y, z, w = _unit_pose(*pose.quaternion.tolist())
    xx, yy, zz, ww, xy, zw, xz, yw, yz, xw = x * x, y * y, z * z, w * w, x * y, z * w, x * z, y * w, y * z, x * w
    rows = (
        (xx - yy - zz + ww, 2 * (xy - zw), 2 * (xz + yw)),
        (2 * (xy + zw), -xx + yy - zz + ww, 2 * (yz - xw)),
        (2 * (xz - yw), 2 * (yz + xw), -xx - yy + zz + ww),
    )
    return np.array(rows)


def _unit_pose(x: float, y: float, z: float, w: float) -> tuple[float, float, float, float]:
    length = math.sqrt(x * x + y * y + z * z + w * w)
    return x / length, y / length, z / length, w / length


def _rotate_vectors(turn: FloatArray, vectors: FloatArray) -> FloatArray:
    """(n, 3) vectors turned by a matrix (3, 3)."""
    turned: FloatArray = np.einsum("jk,ik->ij", turn, vectors)
    return turned


def from_rotation_vector(position: ArrayLike, vector: ArrayLike) -> Pose:
    """The pose at `position` (3,) [m], turned by |vector| [rad] about `vector` (3,)."""
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_rotvec(np.array(vector, dtype=np.float64))
    return Pose(np.array(position, dtype=np.float64), turn.as_quat())


def from_matrix(matrix: ArrayLike) -> Pose:
    """The pose of a homogeneous matrix (4, 4) [m].

    Raises ValueError when its last row is not 0 0 0 1, or its rotation is not orthonormal or mirrors (within 1e-6).
    """
    from scipy.spatial.transform import Rotation

    given = np.array(matrix, dtype=np.float64)
    if given.shape != (4, 4) or not np.isfinite(given).all() or not np.allclose(given[3], [0, 0, 0, 1], atol=1e-9):
        raise ValueError(f"from_matrix: need 4 x 4 finite numbers with last row 0 0 0 1, got {given.tolist()}")
    turn = given[:3, :3]
    skew, determinant = float(np.abs(turn @ turn.T - np.eye(3)).max()), float(np.linalg.det(turn))
    if skew > 1e-6 or determinant < 0:
        raise ValueError(
            f"from_matrix: no rotation (determinant {determinant:.6g}, orthonormal within {skew:.2g}, limit 1e-06); "
            "frames are right-handed and unscaled: look for a flipped axis or a length in the rotation"
        )
    return Pose(given[:3, 3], Rotation.from_matrix(turn).as_quat())


def from_axes(position: ArrayLike, axes: FloatArray) -> Pose:
    """The pose at `position` (3,) [m] with `axes` (3, 3) in its columns, orthonormal within rounding, which is not
    checked. Markley's method (2008), with the bits of SciPy's Rotation.from_matrix, in a thirtieth of its time."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = axes.tolist()
    trace = xx + yy + zz
    largest = max(xx, yy, zz, trace)
    if largest == xx:
        x, y, z, w = 1 - trace + 2 * xx, yx + xy, zx + xz, zy - yz
    elif largest == yy:
        x, y, z, w = xy + yx, 1 - trace + 2 * yy, zy + yz, xz - zx
    elif largest == zz:
        x, y, z, w = xz + zx, yz + zy, 1 - trace + 2 * zz, yx - xy
    else:
        x, y, z, w = zy - yz, xz - zx, yx - xy, 1 + trace
    return Pose(np.array(position, dtype=np.float64), np.array(_unit_pose(x, y, z, w)))


def to_matrix(pose: Pose) -> FloatArray:
    """Homogeneous matrix (4, 4) [m]."""
    whole = np.eye(4)
    whole[:3, :3] = rotation_matrix(pose)
    whole[:3, 3] = pose.position
    return whole


def compose(a_from_b: Pose, b_from_c: Pose) -> Pose:
    """a_from_c."""
    position = a_from_b.position + _rotate_vectors(rotation_matrix(a_from_b), b_from_c.position[None])[0]
    (ax, ay, az, aw), (bx, by, bz, bw) = (_unit_pose(*each.quaternion.tolist()) for each in (a_from_b, b_from_c))
    turn = _unit_pose(
        aw * bx + bw * ax + (ay * bz - az * by),
        aw * by + bw * ay + (az * bx - ax * bz),
        aw * bz + bw * az + (ax * by - ay * bx),
        aw * bw - ax * bx - ay * by - az * bz,
    )
    return Pose(position, np.array(turn))


def translated_along_z(pose: Pose, distance: float) -> Pose:
    """`pose`, moved by `distance` [m] along its own z axis."""
    return compose(pose, Pose(np.array([0.0, 0.0, distance])))


def inverse(a_from_b: Pose) -> Pose:
    """b_from_a."""
    x, y, z, w = _unit_pose(*a_from_b.quaternion.tolist())
    back = Pose(quaternion=np.array([-x, -y, -z, w]))
    return Pose(-_rotate_vectors(rotation_matrix(back), a_from_b.position[None])[0], back.quaternion)


def relative_pose(a: Pose, b: Pose) -> Pose:
    """Pose of b as seen from a: ``a_from_b``, both given in one frame."""
    return compose(inverse(a), b)


def relative_position(a: Pose, b: Pose) -> FloatArray:
    """(3,) `relative_pose(a, b).position` [m], without the rotation."""
    offset: FloatArray = (b.position - a.position) @ rotation_matrix(a)  # by the transposed matrix, its inverse
    return offset


def transform(a_from_b: Pose, points: ArrayLike) -> FloatArray:
    """(..., 3) points in b -> the same points in a [m]."""
    return rotate(a_from_b, points) + a_from_b.position


def rotate(a_from_b: Pose, vectors: ArrayLike) -> FloatArray:
    """(..., 3) directions, velocities or forces in the axes of b -> the same in the axes of a."""
    given = np.array(vectors, dtype=np.float64)
    return _rotate_vectors(rotation_matrix(a_from_b), given.reshape(-1, 3)).reshape(given.shape)


def transform_wrench(a_from_b: Pose, wrench: ArrayLike) -> FloatArray:
    """(6,) force and torque about b's origin, in b's axes -> the same load about a's origin, in a's axes [N, N m]."""
    load = np.array(wrench, dtype=np.float64)
    if load.shape != (6,):
        raise ValueError(f"transform_wrench: need 3 forces [N] and 3 torques [N m], got shape {load.shape}")
    force, torque = rotate(a_from_b, load.reshape(2, 3))
    (x, y, z), (fx, fy, fz) = a_from_b.position.tolist(), force.tolist()
    about_a = np.array([y * fz - z * fy, z * fx - x * fz, x * fy - y * fx])  # np.cross takes ten times as long
    return np.concatenate([force, torque + about_a])


def pose_difference(before: Pose, after: Pose) -> FloatArray:
    """(6,) motion from one pose to another, in the axes of the frame both are given in: shift of the origin [m], and
    rotation vector [rad], the shorter rotation."""
    shift = after.position - before.position
    if np.array_equal(before.quaternion, after.quaternion):  # most motions turn nothing, and that is seen at once
        return np.concatenate([shift, np.zeros(3)])
    turn = rotation(after) * rotation(before).inv()
    return np.concatenate([shift, turn.as_rotvec()])


def pose_distance(a: Pose, b: Pose) -> tuple[float, float]:
    """Distance between two poses: of their origins [m], and of their axes as one angle [rad]."""
    motion = pose_difference(a, b)
    return float(np.linalg.norm(motion[:3])), float(np.linalg.norm(motion[3:]))


def interpolate_pose(a: Pose, b: Pose, s: float) -> Pose:
    """The pose at the fraction `s` of the path from a to b: straight line, shorter rotation (slerp).

    Raises ValueError outside 0 <= s <= 1.
    """
    if not 0.0 <= s <= 1.0:
        raise ValueError(f"interpolate: s must lie within 0 and 1, got {s}")
    from scipy.spatial.transform import Rotation

    motion = s * pose_difference(a, b)
    return Pose(a.position + motion[:3], (Rotation.from_rotvec(motion[3:]) * rotation(a)).as_quat())


def rotation_columns(pose: Pose) -> FloatArray:
    """(6,) first, then second column of the rotation matrix: continuous everywhere (Zhou et al. 2019), as no rotation
    vector and no set of angles is."""
    return np.ascontiguousarray(rotation_matrix(pose)[:, :2].T).ravel()


def from_rotation_columns(position: ArrayLike, columns: ArrayLike) -> Pose:
    """The pose whose rotation has these two columns (6,), made orthonormal by Gram-Schmidt.

    Raises ValueError when they are parallel or zero.
    """
    from scipy.spatial.transform import Rotation

    first, second = np.array(columns, dtype=np.float64).reshape(2, 3)
    area = float(np.linalg.norm(np.cross(first, second)))
    if not area > 1e-9:
        raise ValueError(f"from_rotation_columns: columns {columns!r} span no plane")
    x = first / np.linalg.norm(first)
    y = second - (second @ x) * x
    y /= np.linalg.norm(y)
    turn = np.stack([x, y, np.cross(x, y)], axis=1)
    return Pose(np.array(position, dtype=np.float64), Rotation.from_matrix(turn).as_quat())
