"""Moves the arms of a rig to the start of an episode: zeroed, then moved, one at a time, each step after the operator
confirms."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass

import numpy as np

from robot.arm.channel import CommandKind
from robot.arm.connections import ControllerReading, read_controller
from robot.arm.examine import format_millimetres
from robot.arm.start_servo import path_rates, sensor_path
from robot.arm.status import ArmStatus
from robot.arm.ur import URArm
from robot.common.kinematics import Kinematics, inverse_frame, matrix
from robot.common.tcp import ArmFrames
from robot.errors import DeviceError
from tacsim import pose as se3
from tacsim.interface import FloatArray, Pose
from tacsim.limits import Region
from tacsim.models.hardware import UrArmConfig, parts_of
from tacsim.models.rig import RigConfig

CLEARANCE_TOLERANCE = 0.5e-3  # a smaller approach to a wall is ignored [m]
JOINTS = ("base", "shoulder", "elbow", "wrist 1", "wrist 2", "wrist 3")  # as on the pendant
MAX_JOINT_DISTANCE = 3e-3  # a joint within this distance of its goal has reached it [rad]
PROGRESS_WINDOW = 10.0  # the time left is estimated from the progress in this window [s]


class NoPathToStart(DeviceError):
    """The arm cannot move to its start. The message gives the reason and what to do."""


@dataclass(frozen=True, slots=True, eq=False)
class JointPath:
    """A straight path in joint space."""

    begin: FloatArray  # (6,) joints [rad]
    end: FloatArray  # (6,)
    sensor_positions: FloatArray  # (n, 3) positions of the sensor's origin along the path, world axes [m]
    seconds: float

    @property
    def is_at_start(self) -> bool:
        """True if the arm is at its start."""
        max_joint_error = 1e-3  # an arm is at its start if all joints are within this distance [rad]
        return float(np.abs(self.end - self.begin).max()) < max_joint_error

    def describe(self) -> str:
        """A description of the motion, for the operator who watches it."""
        turns = np.degrees(self.end - self.begin)
        first, last = (format_millimetres(self.sensor_positions[k]) for k in (0, -1))
        joint = int(np.abs(turns).argmax())
        lowest, highest = self.sensor_positions[:, 2].min(), self.sensor_positions[:, 2].max()
        length = float(np.linalg.norm(np.diff(self.sensor_positions, axis=0), axis=1).sum())
        return (
            f"the joint that turns most is {JOINTS[joint]}, by {turns[joint]:+.0f} deg; the sensor goes "
            f"{1e3 * length:.0f} mm, from {first} to {last} mm in the world, at heights from "
            f"{1e3 * lowest:.0f} to {1e3 * highest:.0f} mm; about {self.seconds:.0f} s"
        )


def find_joint_path(name: str, config: UrArmConfig, reading: ControllerReading, start: Pose) -> JointPath:
    """The straight path in joint space to the nearest posture that has the sensor at `start`.

    Raises:
        NoPathToStart: the start is out of reach, or the sensor would go farther behind a wall (limits.planes) than it
            is at both ends, or, without walls in the file, lower than both ends and the workspace.
    """
    max_sag = 10e-3  # below both ends and the workspace, if the file has no walls and so no table [m]
    sample_distance = 5e-3  # between two checked points of a path [rad of the joint that turns most]
    kinematics, frames, begin = Kinematics(config.model), ArmFrames.of(config), reading.joints
    goal = frames.flange(se3.to_matrix(start))
    if reading.tcp is not None:  # the calibrated lengths of a real arm, as far as this reading contains them
        flange = matrix(reading.tcp_pose) @ inverse_frame(matrix(reading.tcp))
        goal = goal @ inverse_frame(flange) @ kinematics.forward(begin)
    postures = kinematics.solutions(goal, begin)
    if not postures:
        raise NoPathToStart(f"arm '{name}': its start is out of reach; correct start, world_from_base, or the mount")
    end = min(postures, key=lambda q: float(np.abs(q - begin).max()))
    steps = max(2, int(np.abs(end - begin).max() / sample_distance))
    joints = begin + np.linspace(0.0, 1.0, steps + 1)[:, None] * (end - begin)
    path = sensor_path(kinematics, frames, joints)[:, :3, 3]
    region = config.limits.region
    if len(region.normals) > 6:
        walls = Region(region.normals[6:], region.offsets[6:], region.names[6:])  # behind the six faces of the box
        beyond = walls.excess(path)
        worst = int(beyond.argmax())
        if beyond[worst] > max(0.0, beyond[0], beyond[-1]) + CLEARANCE_TOLERANCE:
            raise NoPathToStart(
                f"arm '{name}': on the straight joint path its sensor would come "
                f"{walls.violated_face(path[worst])}; "
                "jog it nearer to its start by hand first"
            )
    else:
        sag = min(path[0, 2], path[-1, 2], config.limits.workspace.lower[2]) - float(path[:, 2].min())
        if sag > max_sag:
            raise NoPathToStart(
                f"arm '{name}': on the straight joint path its sensor would sink {1e3 * sag:.0f} mm below "
                "where it stands, its start and its workspace; give the table as a plane (limits.planes), or jog it "
                "nearer to its start by hand first"
            )
    top, acceleration = path_rates(kinematics, frames, begin, end, config.limits)
    return JointPath(begin, end, path, float(np.linalg.norm(end - begin)) / top + top / acceleration)


def require_clear(name: str, path: JointPath, others: Mapping[str, FloatArray], distances: Mapping[str, float]) -> None:
    """Raises NoPathToStart if the sensor would come too near to those of other arms, at (3,) [m] in the world."""
    keep_out_margin = 10e-3  # added to the keep-out distance between a path and the other sensors [m]
    for other, place in others.items():
        gaps, min_gap = (
            np.linalg.norm(path.sensor_positions - place, axis=1),
            distances.get(other, 0.0) + keep_out_margin,
        )
        if gaps.min() < min(min_gap, gaps[0] - CLEARANCE_TOLERANCE, gaps[-1] - CLEARANCE_TOLERANCE):
            raise NoPathToStart(
                f"arm '{name}': on its path its sensor would come within {1e3 * gaps.min():.0f} mm of that of arm "
                f"'{other}'; jog one of them away by hand first"
            )


class StartArm(URArm):
    """A UR arm that moves on one straight path in joint space, from `begin` to `end` (6,) [rad], by `StartServo`.

    The arm may be outside its workspace, and may be opened while its force is above the limits; then it can be zeroed,
    and moves only after `recover`.
    """

    _accepted_faults = (ArmStatus.FORCE_LIMIT,)

    def __init__(
        self,
        config: UrArmConfig,
        name: str,
        begin: FloatArray,
        end: FloatArray,
        *,
        keep_out: Mapping[str, float] | None = None,
    ) -> None:
        self._begin, self._end = np.array(begin, dtype=np.float64), np.array(end, dtype=np.float64)
        self._start_path = self._begin, self._end
        super().__init__(config, name, keep_out=keep_out)

    def command(self, target: Pose | None, speed: float | None = None) -> Pose | None:
        """Accepts only None: the arm holds."""
        if target is not None:
            raise DeviceError(f"arm '{self.name}' is moving to its start and follows no targets")
        return super().command(None)

    def continue_to(self, share: float) -> None:
        """Moves along the path up to this share of it. Repeat the call within `action_timeout`, else the arm holds.

        Raises the error of the arm's status if it cannot move.
        """
        with self._lock:
            self._require_ready()
            self._send_command(CommandKind.CONTINUE_TO_START, fraction=share)

    def completed_share(self) -> float:
        """The share of the path that the arm has completed."""
        along = self._end - self._begin
        return float((self._joints() - self._begin) @ along / max(float(along @ along), 1e-12))

    def has_reached(self, share: float) -> bool:
        """True if the arm rests at this share of its path."""
        goal = self._begin + share * (self._end - self._begin)
        return float(np.abs(goal - self._joints()).max()) < MAX_JOINT_DISTANCE and self.at_rest()

    def _joints(self) -> FloatArray:
        joints = self.state().joints
        assert joints is not None
        return joints


class Halted(Exception):
    """The operator stopped the motion; the arm rests on its path."""


@dataclass(frozen=True, slots=True)
class Operator:
    """The person at the rig, as callbacks.

    ask: asks a question; True means yes. report: prints a sentence on what happens. show: prints the progress of a
    motion, repeatedly. stop: is polled; True ends the motion.
    """

    ask: Callable[[str], bool]
    report: Callable[[str], None]
    show: Callable[[str], None] = lambda words: None
    stop: Callable[[], bool] = lambda: False


def move_to_start(config: RigConfig, starts: Mapping[str, Pose], operator: Operator) -> dict[str, float]:
    """Moves every arm of a rig to its start after the operator's confirmation; returns its distance from there [m].

    Raises:
        NoPathToStart: before anything is connected.
        Halted: the operator stopped a motion. All arms brake.
        DeviceError: an arm stopped. All arms brake.
    """
    arms = parts_of(config.arms, UrArmConfig)
    missing = [name for name in arms if name not in starts]
    if missing:
        raise DeviceError(
            f"arms.{missing[0]}.start is missing: give the sensor's world pose at the start of an episode"
        )
    paths = {name: find_joint_path(name, arm, read_controller(arm.host), starts[name]) for name, arm in arms.items()}
    if not operator.ask(
        "Connect, with a hand at the emergency stop and no person in reach? Nothing moves yet; the controllers receive "
        "the TCP and the payload of the file."
    ):
        return {}
    with ExitStack() as stack:
        opened: dict[str, StartArm] = {}
        for name, arm in arms.items():
            path = paths[name]
            opened[name] = stack.enter_context(
                StartArm(arm, name, path.begin, path.end, keep_out=config.keep_out_distances(name))
            )
        for each in opened.values():
            _offer_zeroing(each, operator)
        for name, each in opened.items():
            others = {other: arm.state().pose.position for other, arm in opened.items() if other != name}
            require_clear(name, paths[name], others, config.keep_out_distances(name))
            _move_arm_to_start(each, paths[name], operator)
        return {name: se3.pose_distance(each.state().pose, starts[name])[0] for name, each in opened.items()}


def _offer_zeroing(arm: StartArm, operator: Operator) -> None:
    """Offers to zero the force sensor of an arm at rest."""
    max_force = 1.0  # a sensor that reports more at rest needs zeroing [N]
    force = float(np.linalg.norm(arm.state().wrench[:3]))
    too_much = arm.status() == ArmStatus.FORCE_LIMIT
    if force <= max_force and not too_much:
        return
    question = f"Arm '{arm.name}' reports {force:.1f} N at rest. If its sensor touches nothing: zero it now?"
    if operator.ask(question):
        arm.zero_wrench()
        if too_much:
            arm.recover()
        force = float(np.linalg.norm(arm.state().wrench[:3]))
        operator.report(f"Arm '{arm.name}' is zeroed and reports {force:.1f} N.")
    elif too_much:
        operator.report(
            f"Arm '{arm.name}' exceeds its force limits and cannot be moved: check its contact, or zero it."
        )


def _move_arm_to_start(arm: StartArm, path: JointPath, operator: Operator) -> None:
    max_trial_turn = 0.05
    trial_share = 0.1  # of the path, for the first motion; at most max_trial_turn of the fastest joint [rad]
    if path.is_at_start:
        operator.report(f"Arm '{arm.name}' stands at its start.")
        return
    if arm.status() == ArmStatus.FORCE_LIMIT:
        return
    trial = min(trial_share, max_trial_turn / float(np.abs(path.end - path.begin).max()))
    operator.report(f"Arm '{arm.name}': {path.describe()}.")
    operator.report(
        "Only sensor positions and forces are monitored. Check that the whole arm has room, with elbow and cables."
    )
    for share, question in (
        (trial, f"Move arm '{arm.name}' the first {100 * trial:.0f} % of this path (Ctrl-C brakes it)?"),
        (1.0, f"Did arm '{arm.name}' move as expected? Then continue to its start (Ctrl-C brakes it)?"),
    ):
        if not operator.ask(question):
            operator.report(f"Arm '{arm.name}' stays where it is.")
            return
        _follow_path(arm, share, path.seconds, operator)
    operator.report(f"Arm '{arm.name}' stands at its start.")


class Progress:
    """Estimates the time that a path takes, from the progress measured last; `seconds`: planned for the whole path."""

    def __init__(self, seconds: float) -> None:
        self._seconds = seconds
        self._samples: deque[tuple[float, float]] = deque()  # time [s], share

    def add(self, now: float, share: float) -> None:
        """Adds the share of the path that is completed at the time `now` [s]."""
        self._samples.append((now, share))
        while now - self._samples[0][0] > PROGRESS_WINDOW:
            self._samples.popleft()

    def seconds_left(self, goal: float) -> float:
        """Time until the share `goal` of the path [s]: as planned in the first seconds, infinite without progress."""
        (begun, first), (now, last) = self._samples[0], self._samples[-1]
        if now - begun < 0.2 * PROGRESS_WINDOW:
            return max(0.0, goal - last) * self._seconds
        return max(0.0, goal - last) * (now - begun) / (last - first) if last > first else math.inf


def _follow_path(arm: StartArm, share: float, seconds: float, operator: Operator) -> None:
    """Moves the arm to this share of the path. The arm brakes at the end, also after an exception."""
    braking_timeout = 2.0  # longest time to come to rest [s]
    stall_timeout = 10.0  # longest time without progress [s]
    command_interval = 10e-3  # between two commands [s]
    farthest, deadline, progress = -1.0, time.monotonic() + stall_timeout, Progress(seconds)
    try:
        while not arm.has_reached(share):
            if operator.stop():
                raise Halted(f"arm '{arm.name}' was stopped before it reached its start")
            arm.continue_to(share)
            completed, now = arm.completed_share(), time.monotonic()
            if completed > farthest + 1e-3:
                farthest, deadline = completed, now + stall_timeout
            if now > deadline:
                raise DeviceError(
                    f"arm '{arm.name}' makes no progress at {100 * completed:.0f} % of its path; it "
                    f"{arm.explain()}. Check its speed slider and the distance to the other arm."
                )
            progress.add(now, completed)
            left = progress.seconds_left(share)
            estimate = f"about {left:.0f} s left" if math.isfinite(left) else "no progress"
            operator.show(
                f"arm '{arm.name}': {100 * max(0.0, completed):.0f} % of the path, {estimate} (Ctrl-C brakes)"
            )
            time.sleep(command_interval)
    except BaseException:
        arm.stop()
        until = time.monotonic() + braking_timeout
        while time.monotonic() < until and not arm.status().is_fault and not arm.at_rest():
            time.sleep(command_interval)
        raise
    arm.stop()
