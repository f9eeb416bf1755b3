"""The one place where poses, speeds and forces of a UR controller turn into those of the rig, and back.

A controller speaks of its tool centre point (TCP), in the axes of the base, poses as position and rotation vector; the
rig speaks of the sensor, in the world. The controller's force is what the surroundings do to the tool, so its sign is
that of `ArmState.wrench`.
"""

from __future__ import annotations

import numpy as np

from robot.kinematics import inverse_frame, matrix
from tacsim.interface import FloatArray


class ArmFrames:
    """The fixed frames of one arm, each (4, 4): `world_from_base`, `flange_from_tool`, `tool_from_sensor`."""

    def __init__(self, world_from_base: FloatArray, flange_from_tool: FloatArray, tool_from_sensor: FloatArray) -> None:
        self.world_from_base, self.flange_from_tool, self.tool_from_sensor = (
            np.array(frame, dtype=np.float64) for frame in (world_from_base, flange_from_tool, tool_from_sensor)
        )
        self._tool_from_flange = inverse_frame(self.flange_from_tool)
        self._base_from_world = inverse_frame(self.world_from_base)
        self._sensor_from_flange = inverse_frame(self.flange_from_tool @ self.tool_from_sensor)

    def sensor(self, tcp_pose: FloatArray) -> FloatArray:
        """world_from_sensor (4, 4) from the controller's TCP pose (6,)."""
        frame: FloatArray = self.world_from_base @ matrix(tcp_pose) @ self.tool_from_sensor
        return frame

    def measured_flange(self, tcp_pose: FloatArray) -> FloatArray:
        """base_from_flange (4, 4) from the controller's TCP pose (6,)."""
        frame: FloatArray = matrix(tcp_pose) @ self._tool_from_flange
        return frame

    def flange(self, world_from_sensor: FloatArray) -> FloatArray:
        """base_from_flange (4, 4) that brings the sensor to a pose (4, 4)."""
        frame: FloatArray = self._base_from_world @ world_from_sensor @ self._sensor_from_flange
        return frame

    def twist(self, tcp_pose: FloatArray, tcp_speed: FloatArray) -> FloatArray:
        """(6,) velocity of the sensor's origin and its turn rate, world axes, from TCP pose and speed (6,)."""
        base_from_tool = matrix(tcp_pose)[:3, :3]
        lever = base_from_tool @ self.tool_from_sensor[:3, 3]
        velocity = tcp_speed[:3] + np.cross(tcp_speed[3:], lever)
        turn = self.world_from_base[:3, :3]
        return np.concatenate([turn @ velocity, turn @ tcp_speed[3:]])

    def wrench(self, tcp_pose: FloatArray, tcp_force: FloatArray) -> FloatArray:
        """(6,) what the object does to the sensor, about its origin, sensor axes, from TCP pose and force (6,)."""
        base_from_tool = matrix(tcp_pose)[:3, :3]
        base_from_sensor = base_from_tool @ self.tool_from_sensor[:3, :3]
        lever = base_from_tool @ self.tool_from_sensor[:3, 3]
        torque = tcp_force[3:] - np.cross(lever, tcp_force[:3])
        return np.concatenate([base_from_sensor.T @ tcp_force[:3], base_from_sensor.T @ torque])
