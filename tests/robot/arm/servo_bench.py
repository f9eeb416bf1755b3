"""A servo without sockets and clocks, on an arm that follows its joints with a lag."""

from __future__ import annotations

import math

import numpy as np

from robot.arm.channel import STATE, CommandKind, Record, WorkerConfig, make_command_record
from robot.arm.servo import Servo
from robot.arm.start_servo import StartServo
from robot.arm.status import ArmStatus
from robot.arm.trajectory import PERIOD
from robot.common.kinematics import Kinematics, pose, rotation
from robot.common.tcp import Measured, pose_of
from robot.mock.ur.machine.arm import Arm, MotionSteps
from robot.mock.ur.machine.machine import SLIDER_RATE
from robot.mock.ur.machine.motion import servoj
from tacsim.interface import FloatArray, Pose

HOME = np.array([0.0, -math.pi / 2, math.pi / 2, -math.pi / 2, -math.pi / 2, 0.0])
KINEMATICS = Kinematics("ur5e")
EYE = np.eye(4).tolist()


def worker_config(**changes: object) -> WorkerConfig:
    sensor = np.eye(4)
    sensor[:3, :3], sensor[:3, 3] = rotation([0.0, 0.0, 0.4]), [0.0, 0.01, 0.05]
    plain: dict[str, object] = {
        "name": "left",
        "host": "127.0.0.2",
        "model": "ur5e",
        "refused_serial": None,
        "realtime": False,
        "parent": 1,
        "segment": -1,
        "world_from_base": EYE,
        "flange_from_tool": EYE,
        "tool_from_sensor": sensor.tolist(),
        "tcp": [0.0] * 6,
        "mass": 0.0,
        "mass_centre": [0.0] * 3,
        "lower": [-0.6, -0.3, 0.3],
        "upper": [-0.3, 0.1, 0.6],
        "planes": [],
        "speed": 0.1,
        "turn_rate": 0.5,
        "acceleration": 0.5,
        "turn_acceleration": 5.0,
        "joint_speed": 1.0,
        "force": 30.0,
        "torque": 3.0,
        "following_error": 3.25e-3,
        "following_turn": 23e-3,
        "depth": None,
        "shear": None,
        "link_timeout": 0.05,
        "action_timeout": 0.2,
        "observation_timeout": 0.5,
        "watchdog": 10.0,
        "lookahead": 0.03,
        "gain": 600.0,
        "partners": [],
    }
    return WorkerConfig(**{**plain, **changes})  # type: ignore[arg-type]


class Bench:
    """A servo and an arm whose joints make up a part of their error in each period."""

    def __init__(self, calibration: FloatArray | None = None, **changes: object) -> None:
        config = worker_config(**changes)
        self.servo = Servo(config) if config.start_path is None else StartServo(config)
        self.q, self.time, self.number = HOME.copy(), 0.0, 0
        self.calibration = np.eye(4) if calibration is None else calibration  # the true flange, seen from the nominal
        self.record: Record = np.zeros((), STATE)
        self.partners: list[Record | None] = [None] * len(self.servo.config.partners)
        self.sent: list[FloatArray] = []
        self.look()

    def look(self, force: tuple[float, ...] = (0.0,) * 6) -> None:
        before = self.record["tcp_pose"].copy()
        self.record["stamp"], self.record["joints"] = self.time, self.q
        self.record["tcp_pose"] = pose(KINEMATICS.forward(self.q) @ self.calibration)
        if before.any():
            self.record["tcp_speed"][:3] = (self.record["tcp_pose"][:3] - before[:3]) / PERIOD
        self.record["tcp_force"] = force
        self.now = self.servo.frames.measure(self.record)

    @property
    def at(self) -> Pose:
        return pose_of(self.now.sensor)

    def ask(self, target: Pose | np.ndarray, kind: CommandKind = CommandKind.TARGET, speed: float = math.inf) -> None:
        row = target if isinstance(target, np.ndarray) else np.array([*target.position, *target.quaternion])
        self.number += 1
        self.servo.on_command(self.number, make_command_record(self.time, kind, row, speed))

    def run(self, periods: int, force: tuple[float, ...] = (0.0,) * 6) -> None:
        for _ in range(periods):
            self.time += PERIOD
            self.servo.check_faults(self.now, self.partners)
            self.servo.check_following(self.now, self.q, np.zeros(6))
            joints = self.servo.step(self.time, self.now, self.partners)
            if joints is not None:
                self.sent.append(joints)
                self.q = self.q + 0.2 * (joints - self.q)
            self.look(force)

    def path(self) -> FloatArray:
        """(n, 3) origins of the sensor at the joints that were sent."""
        frames = [KINEMATICS.forward(q) @ self.calibration @ self.servo.frames.tool_from_sensor for q in self.sent]
        return np.array([frame[:3, 3] for frame in frames])


class OnController:
    """A servo on the mock's own arm: its servoj, its joints, its packages; one `period` after the other."""

    def __init__(self, **changes: object) -> None:
        self.servo = Servo(worker_config(**changes))
        self.arm = Arm("ur5e", HOME)
        self.joints: FloatArray | None = None  # of the newest servoj; the controller repeats it by itself
        self.tick, self.number = 0, 0
        self.partners: list[Record | None] = [other([9.0, 9.0, 9.0])] * len(self.servo.config.partners)  # far away
        self.force, self.jump = 0.0, 0.0  # on the tool [N]; of the controller's clock [s]
        self.slider, self.slider_rate = 1.0, SLIDER_RATE  # on the pendant; the speed scaling follows it
        self.foreign: MotionSteps | None = None  # another program, which runs instead of ours
        self.packages: list[Measured] = []
        self.reports: list[
            tuple[float, FloatArray, FloatArray]
        ] = []  # speed scaling, target_q, target_qd: one a package
        self.twists: list[FloatArray] = []  # (6,) of the sensor itself, one a period
        self._number = -1  # of the package that was read last
        self.statuses: list[ArmStatus] = []  # one a call of `period`
        self.ours: list[bool] = []  # whether the newest target in this period was made in it
        self.run(None)

    @property
    def time(self) -> float:
        return self.tick * PERIOD

    @property
    def at(self) -> Pose:
        return pose_of(self.packages[-1].sensor)

    def ask(self, target: Pose, age: float = 0.0) -> None:
        self.number += 1
        row = np.array([*target.position, *target.quaternion])
        self.servo.on_command(self.number, make_command_record(self.time - age, CommandKind.TARGET, row))

    def hold(self) -> None:
        self.number += 1
        self.servo.on_command(self.number, make_command_record(self.time, CommandKind.HOLD, np.full(7, np.nan)))

    @property
    def target(self) -> FloatArray:
        """(3,) of the sensor's origin at the joints that were sent last [m]."""
        assert self.joints is not None
        frame: FloatArray = KINEMATICS.forward(self.joints) @ self.servo.frames.tool_from_sensor
        return frame[:3, 3]

    def period(self, late: int = 1) -> None:
        """The newest package that the worker knows is `late` periods old."""
        number = max(0, len(self.packages) - 1 - late)
        known, (scaling, target, speeds) = self.packages[number], self.reports[number]
        self.servo.on_speed_scaling(scaling)
        self.servo.check_faults(known, self.partners)
        if number != self._number:
            self.servo.check_following(known, target, speeds)
        self._number = number
        self.statuses.append(self.servo.status)
        self.run(self.servo.step(self.time, known, self.partners))

    def stall(self, periods: int) -> None:
        """The worker is suspended."""
        for _ in range(periods):
            self.run(None)

    def run(self, joints: FloatArray | None) -> None:
        """One period of the controller, with the joints that were sent in it."""
        self.ours.append(joints is not None and (self.joints is None or bool((joints != self.joints).any())))
        self.joints = self.joints if joints is None else joints
        step = self.slider_rate * PERIOD
        self.arm.scale += max(-step, min(step, self.slider - self.arm.scale))
        if self.foreign is not None:
            next(self.foreign, None)
        elif self.joints is not None:
            next(servoj(self.arm, self.joints, PERIOD, self.servo.config.lookahead))
        self.arm.advance()
        self.tick += 1
        package = np.zeros((), STATE)
        package["stamp"], package["joints"] = self.time + self.jump, self.arm.q
        package["tcp_pose"], package["tcp_speed"] = self.arm.pose, self.arm.twist
        package["tcp_force"][2] = self.force
        self.packages.append(self.servo.frames.measure(package))
        self.reports.append((self.arm.scale, self.arm.target_q, self.arm.target_qd))
        self.twists.append(self.packages[-1].twist)


def other(position: list[float], stop: list[float] | None = None, status: ArmStatus = ArmStatus.OK) -> Record:
    """The state of another arm."""
    record = np.zeros((), STATE)
    record["position"], record["stopping_point"] = position, stop or position
    record["status"], record["top_speed"] = status, 0.1
    return record


def shifted(start: Pose, x: float, y: float = 0.0, z: float = 0.0) -> Pose:
    return Pose(start.position + [x, y, z], start.quaternion)
