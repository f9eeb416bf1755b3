"""Kinematics of UR arms: forward, Jacobian, inverse. NumPy and floats only, fast enough for a 500 Hz loop.

Standard Denavit-Hartenberg frames with the nominal lengths that Universal Robots publishes ("DH Parameters for
calculations of kinematics and dynamics", support article 16316). A real arm is calibrated in the factory and differs
from these by about a millimetre: read poses from the controller, use this module for reach, speed and singularities.

Frames are homogeneous matrices (4, 4), lengths [m], angles [rad]. `tool` is flange_from_tcp, the tool
centre point (TCP) in flange axes. A UR pose is (6,): position and rotation vector, both in base axes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tacsim.interface import FloatArray

if TYPE_CHECKING:
    from tacsim.models.hardware import Model  # pydantic and SciPy: half a second of start-up

JOINT_RANGE = 2 * math.pi  # joints turn from -JOINT_RANGE to +JOINT_RANGE (all e-Series user manuals)
# Bound on the change of the minimum singular value per radian of joint motion: each of the six columns has a length of
# at most sqrt(2) in these units, and rotates with the joints before it.
MAX_SINGULAR_VALUE_RATE = math.sqrt(12.0)


@dataclass(frozen=True)
class Lengths:
    """DH lengths [m] (alpha = pi/2, 0, 0, pi/2, -pi/2, 0) and maximum joint speeds [rad/s] (user manuals)."""

    a2: float
    a3: float
    d1: float
    d4: float
    d5: float
    d6: float
    joint_speeds: tuple[float, ...]


_TURN = math.pi  # half a turn a second
MODELS: dict[Model, Lengths] = {
    "ur3e": Lengths(-0.24355, -0.2132, 0.15185, 0.13105, 0.08535, 0.0921, (_TURN,) * 3 + (2 * _TURN,) * 3),
    "ur5e": Lengths(-0.425, -0.3922, 0.1625, 0.1333, 0.0997, 0.0996, (_TURN,) * 6),
    "ur10e": Lengths(-0.6127, -0.57155, 0.1807, 0.17415, 0.11985, 0.11655, (2 * _TURN / 3,) * 2 + (_TURN,) * 4),
}


def rotation(vector: Sequence[float] | FloatArray) -> FloatArray:
    """(3, 3) rotation about `vector` (3,) by its length [rad] (Rodrigues)."""
    x, y, z = float(vector[0]), float(vector[1]), float(vector[2])
    angle = math.sqrt(x * x + y * y + z * z)
    if angle < 1e-12:
        return np.array([[1.0, -z, y], [z, 1.0, -x], [-y, x, 1.0]])
    x, y, z = x / angle, y / angle, z / angle
    c, s = math.cos(angle), math.sin(angle)
    v = 1.0 - c
    return np.array(
        [
            [x * x * v + c, x * y * v - z * s, x * z * v + y * s],
            [x * y * v + z * s, y * y * v + c, y * z * v - x * s],
            [x * z * v - y * s, y * z * v + x * s, z * z * v + c],
        ]
    )


def rotation_vector(turn: FloatArray) -> FloatArray:
    """(3,) axis times angle, 0 to pi [rad], of a rotation (3, 3)."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = turn.tolist()
    x, y, z = zy - yz, xz - zx, yx - xy  # 2 sin(angle) axis
    sine, cosine = 0.5 * math.sqrt(x * x + y * y + z * z), 0.5 * (xx + yy + zz - 1.0)
    angle = math.atan2(sine, cosine)
    if cosine > -0.9:  # far from half a turn, where the antisymmetric part vanishes
        factor = angle / (2.0 * sine) if sine > 1e-9 else 0.5
        return np.array([x * factor, y * factor, z * factor])
    # (R + R^T) / 2 - cos I = (1 - cos) axis axis^T: its longest column is along the axis; the sign is in what is left.
    xy, xz, yz = 0.5 * (xy + yx), 0.5 * (xz + zx), 0.5 * (yz + zy)
    columns = ((xx - cosine, xy, xz), (xy, yy - cosine, yz), (xz, yz, zz - cosine))
    u, v, w = columns[max(range(3), key=lambda i: columns[i][i])]
    factor = angle / math.copysign(math.sqrt(u * u + v * v + w * w), u * x + v * y + w * z)
    return np.array([u * factor, v * factor, w * factor])


def matrix(pose: Sequence[float] | FloatArray) -> FloatArray:
    """(4, 4) of a UR pose (6,)."""
    frame = np.eye(4)
    frame[:3, :3] = rotation(pose[3:6])
    frame[:3, 3] = pose[:3]
    return frame


def pose(frame: FloatArray) -> FloatArray:
    """UR pose (6,) of a frame (4, 4)."""
    return np.concatenate([frame[:3, 3], rotation_vector(frame[:3, :3])])


def inverse_frame(frame: FloatArray) -> FloatArray:
    """Inverse of a frame (4, 4)."""
    back = np.eye(4)
    back[:3, :3] = frame[:3, :3].T
    back[:3, 3] = -frame[:3, :3].T @ frame[:3, 3]
    return back


def displacement(before: FloatArray, after: FloatArray) -> FloatArray:
    """Displacement (6,) between two frames (4, 4): shift of the origin [m], rotation vector [rad], base axes."""
    return np.concatenate([after[:3, 3] - before[:3, 3], rotation_vector(after[:3, :3] @ before[:3, :3].T)])


class Kinematics:
    """Kinematics of one arm model. Joints `q` are (6,) [rad], numbered from the base."""

    def __init__(self, model: Model = "ur5e") -> None:
        self.model = model
        self.lengths = MODELS[model]
        self.joint_speeds = np.array(self.lengths.joint_speeds)  # maximum (6,) [rad/s]

    @property
    def reach(self) -> float:
        """Maximum distance of the wrist from the shoulder [m]."""
        return abs(self.lengths.a2) + abs(self.lengths.a3)

    def forward(self, q: Sequence[float] | FloatArray, tool: FloatArray | None = None) -> FloatArray:
        """base_from_tcp (4, 4) at joints q; base_from_flange without a tool."""
        return self._chain(q, tool)[0]

    def jacobian(self, q: Sequence[float] | FloatArray, tool: FloatArray | None = None) -> FloatArray:
        """Jacobian (6, 6): joint speeds [rad/s] to velocity [m/s] and turn rate [rad/s] of the TCP, in base axes."""
        return self.forward_and_jacobian(q, tool)[1]

    def forward_and_jacobian(
        self, q: Sequence[float] | FloatArray, tool: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Forward kinematics and Jacobian, computed together."""
        frame, (c1, s1, x2, y2, z2, x3, y3, z3, x4, y4, z4, ax, ay, az, x5, y5, z5, bx, by, bz) = self._chain(q, tool)
        px, py, pz = frame[:3, 3].tolist()
        # Column of a joint: axis x (TCP - a point of the axis), axis. The axes of joints 2, 3, 4 are (s1, -c1, 0).
        h1, h2, h3 = pz - self.lengths.d1, pz - z2, pz - z3
        r4x, r4y, r4z = px - x4, py - y4, pz - z4
        r5x, r5y, r5z = px - x5, py - y5, pz - z5
        return frame, np.array(
            [
                [-py, -c1 * h1, -c1 * h2, -c1 * h3, ay * r4z - az * r4y, by * r5z - bz * r5y],
                [px, -s1 * h1, -s1 * h2, -s1 * h3, az * r4x - ax * r4z, bz * r5x - bx * r5z],
                [
                    0.0,
                    s1 * py + c1 * px,
                    s1 * (py - y2) + c1 * (px - x2),
                    s1 * (py - y3) + c1 * (px - x3),
                    ax * r4y - ay * r4x,
                    bx * r5y - by * r5x,
                ],
                [0.0, s1, s1, s1, ax, bx],
                [0.0, -c1, -c1, -c1, ay, by],
                [1.0, 0.0, 0.0, 0.0, az, bz],
            ]
        )

    def inverse(
        self, target: FloatArray, seed: Sequence[float] | FloatArray, tool: FloatArray | None = None
    ) -> FloatArray | None:
        """Joints (6,) that place the TCP at `target` (4, 4): the solution nearest to `seed`; None if there is none.

        Newton's method finds a target near the pose of the seed. Otherwise the nearest of up to eight closed-form
        solutions is taken. None also for a target that is not finite or needs a joint beyond its range.
        """
        if not np.isfinite(target).all() or not np.isfinite(seed).all():
            return None
        near = self._newton(target, np.array(seed, dtype=np.float64), tool)
        if near is not None:
            return near
        flange = target if tool is None else target @ inverse_frame(tool)
        return min(self.solutions(flange, seed), key=lambda q: float(np.abs(q - seed).max()), default=None)

    def singularity(self, q: Sequence[float] | FloatArray) -> float:
        """Distance from a singular pose: minimum singular value of the Jacobian at the flange, lengths divided by the
        reach. 0 is singular; a UR arm in the middle of its workspace has 0.1 to 0.3."""
        jacobian = self.jacobian(q)
        jacobian[:3] /= self.reach
        return float(np.linalg.svd(jacobian, compute_uv=False)[-1])

    def solutions(self, flange: FloatArray, seed: Sequence[float] | FloatArray) -> list[FloatArray]:
        """All joint vectors (6,) that place the flange at the frame (4, 4), each with the full turns nearest to `seed`
        within the joint range. At a singular wrist (joint 5 at 0 or pi) joint 6 has the seed's value.

        The three parallel axes decouple the arm: joint 1 from the wrist centre, 5 and 6 from the direction of the
        flange, 2 to 4 as a planar arm (Hawkins, "Analytic inverse kinematics for the Universal Robots UR-5/UR-10
        arms", 2013).
        """
        k, found = self.lengths, []
        (x6, y6, z6), origin = flange[:3, :3].T, flange[:3, 3]
        wrist = origin - k.d6 * z6
        radius = math.hypot(wrist[0], wrist[1])
        if radius < k.d4:
            return []
        bearing, lean = math.atan2(wrist[1], wrist[0]), math.asin(k.d4 / radius)
        for q1 in (bearing + lean, bearing + math.pi - lean):
            c1, s1 = math.cos(q1), math.sin(q1)
            side, out = np.array([s1, -c1, 0.0]), np.array([c1, s1, 0.0])
            c5 = float(side @ z6)
            s5_size = math.hypot(float(out @ z6), float(z6[2]))
            for s5 in (s5_size, -s5_size):
                q5 = math.atan2(s5, c5)
                if s5_size < 1e-9:
                    q6 = float(seed[5])
                else:
                    q6 = math.atan2(-float(side @ y6) / s5, float(side @ x6) / s5)
                z4 = -(math.sin(q6) * x6 + math.cos(q6) * y6)
                q234 = math.atan2(float(out @ z4), -float(z4[2]))
                elbow = wrist - k.d5 * z4
                u, z = float(out @ elbow), float(elbow[2]) - k.d1
                c3 = (u * u + z * z - k.a2**2 - k.a3**2) / (2 * k.a2 * k.a3)
                if abs(c3) > 1.0 + 1e-12:
                    continue
                for q3 in (math.acos(max(-1.0, min(1.0, c3))), -math.acos(max(-1.0, min(1.0, c3)))):
                    q2 = math.atan2(z, u) - math.atan2(k.a3 * math.sin(q3), k.a2 + k.a3 * math.cos(q3))
                    found.append(_nearest_turns(np.array([q1, q2, q3, q234 - q2 - q3, q5, q6]), seed))
        return found

    def _chain(self, q: Sequence[float] | FloatArray, tool: FloatArray | None) -> tuple[FloatArray, tuple[float, ...]]:
        """The frame of the TCP; c1, s1, then points and axes of the joints: o2, o3, o4, axis 5, o5, axis 6."""
        q1, q2, q3, q4, q5, q6 = q.tolist() if isinstance(q, np.ndarray) else q
        k = self.lengths
        c1, s1, c5, s5, c6, s6 = math.cos(q1), math.sin(q1), math.cos(q5), math.sin(q5), math.cos(q6), math.sin(q6)
        c, s = math.cos(q2 + q3 + q4), math.sin(q2 + q3 + q4)
        # In the plane of the arm: u outwards, z up; w along the axes of joints 2 to 4.
        u2, z2 = k.a2 * math.cos(q2), k.d1 + k.a2 * math.sin(q2)
        u3, z3 = u2 + k.a3 * math.cos(q2 + q3), z2 + k.a3 * math.sin(q2 + q3)
        u5, z5 = u3 + k.d5 * s, z3 - k.d5 * c
        bu, bw, bz = -s5 * c, c5, -s5 * s  # axis of joint 6
        xu, xw, xz = c6 * c5 * c - s6 * s, c6 * s5, c6 * c5 * s + s6 * c
        yu, yw, yz = -s6 * c5 * c - c6 * s, -s6 * s5, -s6 * c5 * s + c6 * c
        w4x, w4y = k.d4 * s1, -k.d4 * c1
        x5, y5 = c1 * u5 + w4x, s1 * u5 + w4y
        bx, by = c1 * bu + s1 * bw, s1 * bu - c1 * bw
        frame = np.array(
            [
                [c1 * xu + s1 * xw, c1 * yu + s1 * yw, bx, x5 + k.d6 * bx],
                [s1 * xu - c1 * xw, s1 * yu - c1 * yw, by, y5 + k.d6 * by],
                [xz, yz, bz, z5 + k.d6 * bz],
                [0.0, 0.0, 0.0, 1.0],
            ]
        )
        if tool is not None:
            frame = frame @ tool
        x3, y3 = c1 * u3, s1 * u3
        return frame, (
            *(c1, s1, c1 * u2, s1 * u2, z2, x3, y3, z3, x3 + w4x, y3 + w4y, z3),
            *(c1 * s, s1 * s, -c, x5, y5, z5, bx, by, bz),
        )

    def _newton(self, target: FloatArray, seed: FloatArray, tool: FloatArray | None) -> FloatArray | None:
        """Newton's method from the seed; None if it does not converge in a few steps or leaves the seed."""
        tolerance = 1e-10  # of the inverse [m, rad]
        q, begin = seed, seed.tolist()
        (tx, ty, tz, px), (ux, uy, uz, py), (vx, vy, vz, pz), _ = target.tolist()
        for _ in range(7):
            frame, jacobian = self.forward_and_jacobian(q, tool)
            (ax, ay, az, ox), (bx, by, bz, oy), (cx, cy, cz, oz), _ = frame.tolist()
            # sin(angle) axis of the remaining rotation: half the sum of (present axis) x (target axis)
            error = (
                px - ox,
                py - oy,
                pz - oz,
                0.5 * (bx * vx - cx * ux + by * vy - cy * uy + bz * vz - cz * uz),
                0.5 * (cx * tx - ax * vx + cy * ty - ay * vy + cz * tz - az * vz),
                0.5 * (ax * ux - bx * tx + ay * uy - by * ty + az * uz - bz * tz),
            )
            size = max(map(abs, error))
            if size < tolerance:
                # The sine is also small at half a turn, where the axes are opposite.
                aligned = ax * tx + bx * ux + cx * vx > 0 and ay * ty + by * uy + cy * vy > 0
                return q if aligned and max(map(abs, q.tolist())) <= JOINT_RANGE else None
            if size > 0.3:
                return None
            try:
                q = q + np.linalg.solve(jacobian, error)
            except np.linalg.LinAlgError:
                return None
            if not max(abs(now - before) for now, before in zip(q.tolist(), begin, strict=True)) < 0.5:
                return None
        return None


class SingularityGuard:
    """Checks the distance of joints from a singularity; skips its computation while the last result suffices."""

    def __init__(self, kinematics: Kinematics) -> None:
        self._kinematics = kinematics
        self._last_check: tuple[FloatArray, float] | None = None  # joints, and their margin to a singularity

    def is_nearer(self, joints: FloatArray, sent_joints: FloatArray) -> bool:
        """True if `joints` (6,) are too near to a singularity, and nearer than the last `sent_joints` (6,)."""
        min_value = 0.02  # of the Jacobian, lengths in reaches; below it the arm may only move away
        if self._last_check is not None:
            last_joints, last_margin = self._last_check
            if MAX_SINGULAR_VALUE_RATE * float(np.abs(joints - last_joints).sum()) < last_margin:
                return False
        distance = self._kinematics.singularity(joints)
        self._last_check = joints, distance - min_value
        return distance < min_value and distance < self._kinematics.singularity(sent_joints)


def _nearest_turns(q: FloatArray, seed: Sequence[float] | FloatArray) -> FloatArray:
    """q plus full turns of each joint: as near to the seed as the joint range allows."""
    turned = q - 2 * math.pi * np.round((q - np.asarray(seed)) / (2 * math.pi))
    turned = np.where(turned > JOINT_RANGE, turned - 2 * math.pi, turned)
    nearest: FloatArray = np.where(turned < -JOINT_RANGE, turned + 2 * math.pi, turned)
    return nearest
