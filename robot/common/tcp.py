"""Conversion of poses, speeds and forces between a UR controller and the rig; no other module converts them.

A controller uses the tool centre point (TCP) in base axes, with poses as position and rotation vector; the rig uses the
sensor in the world frame. The controller's force is the load of the environment on the tool, so it has the sign of
`ArmState.wrench`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from robot.common.kinematics import inverse_frame, matrix, rotation_vector
from tacsim.interface import FloatArray, Pose

if TYPE_CHECKING:
    from tacsim.models.hardware import UrArmConfig


@dataclass(frozen=True, slots=True, eq=False)
class Measured:
    """One package of the controller, as pose, twist and wrench of the sensor."""

    stamp: float  # on the controller's own clock [s]
    joints: FloatArray  # (6,) [rad]
    flange: FloatArray  # base_from_flange (4, 4) of the controller
    sensor: FloatArray  # world_from_sensor (4, 4)
    twist: FloatArray  # (6,) of the sensor's origin, world axes [m/s, rad/s]
    wrench: FloatArray  # (6,) of the object on the sensor, about its origin, sensor axes [N, N m]


class ArmFrames:
    """The fixed frames of one arm, each (4, 4): `world_from_base`, `flange_from_tool`, `tool_from_sensor`."""

    def __init__(self, world_from_base: FloatArray, flange_from_tool: FloatArray, tool_from_sensor: FloatArray) -> None:
        self.world_from_base, self.flange_from_tool, self.tool_from_sensor = (
            np.array(frame, dtype=np.float64) for frame in (world_from_base, flange_from_tool, tool_from_sensor)
        )
        self._tool_from_flange = inverse_frame(self.flange_from_tool)
        self._base_from_world = inverse_frame(self.world_from_base)
        self._sensor_from_flange = inverse_frame(self.flange_from_tool @ self.tool_from_sensor)

    @classmethod
    def of(cls, config: UrArmConfig) -> ArmFrames:
        """The frames of an arm in a rig file."""
        from tacsim.pose import to_matrix  # SciPy takes half a second to load; a worker does not need it

        fixed = (config.world_from_base, config.flange_from_tool, config.tool_from_sensor)
        return cls(*(to_matrix(frame.pose) for frame in fixed))

    def flange(self, target: FloatArray) -> FloatArray:
        """base_from_flange (4, 4) at which the sensor is at `target`, world_from_sensor (4, 4)."""
        flange: FloatArray = self._base_from_world @ target @ self._sensor_from_flange
        return flange

    def measure(self, package: NDArray[np.void]) -> Measured:
        """Converts one package of the controller: a record () with stamp, and joints, tcp_pose, tcp_speed, tcp_force,
        each (6,)."""
        speed, force = package["tcp_speed"], package["tcp_force"]
        base_from_tool = matrix(package["tcp_pose"])
        base_from_sensor = base_from_tool @ self.tool_from_sensor
        lever = base_from_sensor[:3, 3] - base_from_tool[:3, 3]
        to_world, to_sensor = self.world_from_base[:3, :3], base_from_sensor[:3, :3].T
        return Measured(
            stamp=float(package["stamp"]),
            joints=package["joints"].copy(),
            flange=base_from_tool @ self._tool_from_flange,
            sensor=self.world_from_base @ base_from_sensor,
            twist=np.concatenate([to_world @ (speed[:3] + _cross(speed[3:], lever)), to_world @ speed[3:]]),
            wrench=np.concatenate([to_sensor @ force[:3], to_sensor @ (force[3:] - _cross(lever, force[:3]))]),
        )


def pose_of(frame: FloatArray) -> Pose:
    """Converts a frame (4, 4) to a Pose, without SciPy, which is slow for a single pose."""
    vector = rotation_vector(frame[:3, :3])
    half = 0.5 * math.sqrt(float(vector @ vector))
    factor = 0.5 * (math.sin(half) / half if half > 1e-9 else 1.0)
    return Pose(frame[:3, 3], np.array([*(factor * vector), math.cos(half)]))


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """np.cross of two vectors (3,), ten times as fast."""
    (ax, ay, az), (bx, by, bz) = a.tolist(), b.tolist()
    return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])
