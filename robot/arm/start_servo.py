"""The servo that moves an arm to its start on a straight path in joint space, slowly.

An arm outside its workspace follows no ordinary command. This servo replaces the workspace by the path: the measured
joints must stay on it, within OFF_PATH. It rejects targets. CommandKind.CONTINUE_TO_START moves the arm along the path,
up to a share of it, and must be repeated within `action_timeout` like any command. The checks of force limits,
keep-out, partners, link, controller stops and the driver's process are those of the base class.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from robot.arm.channel import CommandKind, Record, WorkerConfig
from robot.arm.servo import Servo
from robot.arm.status import ArmStatus
from robot.arm.trajectory import (
    PERIOD,
    MotionState,
    is_standing_still,
    motion_at_rest,
    reduce_speed,
    step_velocity,
    stopping_distance,
)
from robot.arm.tuning import JOINT_ACCELERATION, JOINT_SPEED, OFF_PATH
from robot.common.kinematics import Kinematics, inverse_frame, rotation_vector
from robot.common.tcp import ArmFrames, Measured
from tacsim.interface import FloatArray

if TYPE_CHECKING:
    from tacsim.models.limits import ArmLimits  # pydantic: a worker starts without it


def sensor_path(kinematics: Kinematics, frames: ArmFrames, joints: FloatArray) -> FloatArray:
    """world_from_sensor (n, 4, 4) at joints (n, 6), by the nominal lengths of the model."""
    flange_from_sensor = frames.flange_from_tool @ frames.tool_from_sensor
    return np.array([frames.world_from_base @ kinematics.forward(q) @ flange_from_sensor for q in joints])


def path_rates(
    kinematics: Kinematics, frames: ArmFrames, begin: FloatArray, end: FloatArray, limits: ArmLimits | WorkerConfig
) -> tuple[float, float]:
    """Top speed [rad/s] and acceleration [rad/s^2] of the joint vector along the straight path from `begin` to `end`
    (6,). With them, neither a joint nor the sensor exceeds its limits."""
    speed_margin = 0.95  # factor on the speeds, which vary between the samples
    sample_count = 100  # points of the path at which speeds are computed
    joints = begin + np.linspace(0.0, 1.0, sample_count)[:, None] * (end - begin)
    step = float(np.linalg.norm(joints[1] - joints[0]))
    if step < 1e-9:
        return JOINT_SPEED, JOINT_ACCELERATION
    path = sensor_path(kinematics, frames, joints)
    shift = float(np.linalg.norm(np.diff(path[:, :3, 3], axis=0), axis=1).max()) / step + 1e-9
    turns = [np.linalg.norm(rotation_vector(b[:3, :3] @ a[:3, :3].T)) for a, b in pairwise(path)]
    turn, joint = float(max(turns)) / step + 1e-9, float(np.abs(joints[1] - joints[0]).max()) / step
    return (
        speed_margin * min(min(JOINT_SPEED, limits.joint_speed) / joint, limits.speed / shift, limits.turn_rate / turn),
        speed_margin * min(JOINT_ACCELERATION / joint, limits.acceleration / shift, limits.turn_acceleration / turn),
    )


def distance_from_path(joints: FloatArray, begin: FloatArray, end: FloatArray) -> float:
    """Largest distance of a joint from the straight path from `begin` to `end` [rad]."""
    along = end - begin
    share = float(np.clip((joints - begin) @ along / max(float(along @ along), 1e-12), 0.0, 1.0))
    return float(np.abs(joints - begin - share * along).max())


@dataclass(frozen=True, slots=True, eq=False)
class _Target:
    """A point of the path, for one period."""

    joints: FloatArray  # (6,) [rad]
    rate: FloatArray  # (6,) [rad/s]
    motion: MotionState  # of the sensor
    stopping_point: FloatArray  # (3,) position at which the sensor comes to rest if it brakes from here on [m]


class StartServo(Servo):
    """The servo for the path of `config.start_path`."""

    def __init__(self, config: WorkerConfig, commands_read: int = 0, tactile_read: int = 0) -> None:
        super().__init__(config, commands_read, tactile_read)
        assert config.start_path is not None
        self._begin, self._end = np.array(config.start_path)
        self._top, self._acceleration = path_rates(self.kinematics, self.frames, self._begin, self._end, config)
        self._flange_from_sensor = self.frames.flange_from_tool @ self.frames.tool_from_sensor
        self._share: float | None = None  # share of the path up to which the arm may move; None: it holds
        self._share_time = 0.0
        self._rate = np.zeros(6)  # of the target [rad/s]
        self._stop = np.zeros(3)  # position at which the sensor would come to rest if the target braked now [m]

    def _check_position(self, measured: Measured) -> None:
        if distance_from_path(measured.joints, self._begin, self._end) > OFF_PATH:
            self.enter_fault(ArmStatus.OFF_PATH)

    def check_faults(self, measured: Measured, partners: Sequence[Record | None]) -> None:
        if self.status == ArmStatus.WAITING:  # commands of this interval are discarded
            self._share = None
        super().check_faults(measured, partners)

    def on_command(self, number: int, command: Record | None) -> None:
        """Accepts CONTINUE_TO_START only, and rejects a target."""
        if command is None or number == self.commands_read:
            return
        super().on_command(number, command)
        self.rejected += self._allowed_target is not None
        self._allowed_target = self._share = None
        share = float(command["fraction"])
        if int(command["kind"]) == CommandKind.CONTINUE_TO_START and 0.0 <= share <= 1.0:
            self._share, self._share_time = share, float(command["time"])

    def step(self, time: float, measured: Measured, partners: Sequence[Record | None]) -> FloatArray | None:
        """The joints (6,) to send in this period; None: send nothing, the controller holds."""
        # the target waits for an arm that lags more, for example with a low speed slider [rad]
        max_lag = 15e-3
        if self.status.is_fault:
            return super().step(time, measured, partners)
        self._previous_step = self.motion, self._sent_joints, self._fault_braking
        if self._is_waiting_for_package(time, measured):
            return self._sent_joints
        is_waiting = self.status == ArmStatus.WAITING
        is_moving = not is_waiting and self._share is not None and time - self._share_time <= self.config.action_timeout
        if not is_waiting:
            self.status = ArmStatus.OK if is_moving else ArmStatus.HOLD
        if (
            self._sent_joints is None
            or self.motion is None
            or (self.motion.is_at_rest and self._was_pushed(self.motion, measured))
            or (self._scaling.value == 0.0 and is_standing_still(measured))
        ):
            if not is_moving:
                return None if self._sent_joints is None else self._sent_joints
            self._start_at(measured)
            assert self._sent_joints is not None
        if is_moving and float(np.abs(measured.joints - self._sent_joints).max()) < max_lag:
            assert self._share is not None
            goal = self._begin + self._share * (self._end - self._begin)
            top = self._scaling.speed(self._top, self._acceleration)
            rate, moved, arrived = step_velocity(goal - self._sent_joints, self._rate, top, self._acceleration)
            target = self._target(
                goal if arrived else self._sent_joints + moved, np.zeros(6) if arrived else rate, measured
            )
            if self._keeps_clear(target, partners):
                return self._follow(target)
        rate = reduce_speed(self._rate, self._acceleration * PERIOD)
        return self._follow(self._target(self._sent_joints + rate * PERIOD, rate, measured))

    def _start_at(self, measured: Measured) -> MotionState:
        self._rate, self._stop = np.zeros(6), measured.sensor[:3, 3]
        return super()._start_at(measured)

    def _scale_velocity(self, factor: float) -> None:
        super()._scale_velocity(factor)
        self._rate = factor * self._rate

    def _slow_after_stall(self, missed: float, twist: FloatArray) -> None:
        """As the base class, in joint space: the joints approach the target by the controller's filter."""
        self._rate = self._rate * math.exp(-missed / self.config.lookahead)

    @property
    def stopping_point(self) -> FloatArray | None:
        return super().stopping_point if self.status.is_fault or self.motion is None else self._stop

    def _follow(self, target: _Target) -> FloatArray:
        self._rate, self._stop = target.rate, target.stopping_point
        return self._set_target(target.motion, target.joints)

    def _target(self, joints: FloatArray, rate: FloatArray, measured: Measured) -> _Target:
        """The target at `joints`. Calibrated lengths of a real arm, which the model lacks, follow from `measured`."""
        model_from_controller = inverse_frame(self.kinematics.forward(measured.joints)) @ measured.flange

        def sensor(q: FloatArray) -> FloatArray:
            flange = self.kinematics.forward(q) @ model_from_controller
            frame: FloatArray = self.frames.world_from_base @ flange @ self._flange_from_sensor
            return frame

        here = sensor(joints)
        if not rate.any():
            return _Target(joints, rate, motion_at_rest(here[:3, 3], here[:3, :3]), here[:3, 3])
        before = sensor(joints - rate * PERIOD)
        velocity = (here[:3, 3] - before[:3, 3]) / PERIOD
        spin = rotation_vector(here[:3, :3] @ before[:3, :3].T) / PERIOD
        speed = float(np.linalg.norm(rate))
        end = sensor(joints + rate * (stopping_distance(speed, self._acceleration) / speed))
        return _Target(joints, rate, MotionState(here[:3, 3], here[:3, :3], velocity, spin), end[:3, 3])

    def _keeps_clear(self, target: _Target, partners: Sequence[Record | None]) -> bool:
        """True if the arm could still stop outside the keep-out of the other arms, or moves away from them."""
        assert self.motion is not None
        before = self._braking_gaps(self.motion, partners, self._stop)
        now = self._braking_gaps(target.motion, partners, target.stopping_point)
        return all(new >= 0.0 or new >= old for new, old in zip(now, before, strict=True))
