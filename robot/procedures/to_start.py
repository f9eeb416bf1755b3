"""Arms are led to where an episode begins: zeroed, then moved, one after the other, each step after a person's yes."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass

import numpy as np

from robot.arm.channel import CommandKind
from robot.arm.controller.rtde import ControllerReading, read_controller
from robot.arm.start_servo import sensor_path, way_rates
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

NEAR_LINE = 0.5e-3  # nearer to a wall by no more than that is not nearer [m]
JOINTS = ("base", "shoulder", "elbow", "wrist 1", "wrist 2", "wrist 3")  # as on the pendant
THERE = 3e-3  # a joint this near to where it shall be is there [rad]
PROGRESS = 10.0  # the time that is left is estimated from the progress in the last so many seconds


class NoWay(DeviceError):
    """The arm cannot be led to its start; the words say why, and what to do."""


@dataclass(frozen=True, slots=True, eq=False)
class Way:
    """Straight in joint space."""

    begin: FloatArray  # (6,) joints [rad]
    end: FloatArray  # (6,)
    path: FloatArray  # (n, 3) of the sensor's origin on the way, world axes [m]
    seconds: float

    @property
    def is_there(self) -> bool:
        """True if the arm stands at its start."""
        max_joint_error = 1e-3  # an arm whose joints are all this near to the start's stands there [rad]
        return float(np.abs(self.end - self.begin).max()) < max_joint_error

    def describe(self) -> str:
        """What a person should know who watches it."""
        turns = np.degrees(self.end - self.begin)
        joint = int(np.abs(turns).argmax())
        lowest, highest = self.path[:, 2].min(), self.path[:, 2].max()
        length = float(np.linalg.norm(np.diff(self.path, axis=0), axis=1).sum())
        return (
            f"the joint that turns most is {JOINTS[joint]}, by {turns[joint]:+.0f} deg; the sensor goes "
            f"{1e3 * length:.0f} mm, from {_mm(self.path[0])} to {_mm(self.path[-1])} mm in the world, at heights from "
            f"{1e3 * lowest:.0f} to {1e3 * highest:.0f} mm; about {self.seconds:.0f} s"
        )


def find_way(name: str, config: UrArmConfig, reading: ControllerReading, start: Pose) -> Way:
    """The straight way in joint space to the nearest posture that has the sensor at `start`.

    Raises NoWay: out of reach, or the sensor would go farther behind a wall (limits.planes) than it is at both ends; in
    a file without walls, lower than both ends and the workspace.
    """
    max_sag = 10e-3  # below both ends and the workspace, where the file has no walls, and so no table [m]
    sample_distance = 5e-3  # between two points of a way at which it is checked [rad of the joint that turns most]
    kinematics, frames, begin = Kinematics(config.model), ArmFrames.of(config), reading.joints
    goal = frames.flange(se3.to_matrix(start))
    if reading.tcp is not None:  # a real arm's own lengths, as far as they show here
        flange = matrix(reading.tcp_pose) @ inverse_frame(matrix(reading.tcp))
        goal = goal @ inverse_frame(flange) @ kinematics.forward(begin)
    postures = kinematics.solutions(goal, begin)
    if not postures:
        raise NoWay(f"arm '{name}': its start is out of reach; correct start, world_from_base, or the mount")
    end = min(postures, key=lambda q: float(np.abs(q - begin).max()))
    steps = max(2, int(np.abs(end - begin).max() / sample_distance))
    joints = begin + np.linspace(0.0, 1.0, steps + 1)[:, None] * (end - begin)
    path = sensor_path(kinematics, frames, joints)[:, :3, 3]
    region = config.limits.region
    if len(region.normals) > 6:
        walls = Region(region.normals[6:], region.offsets[6:], region.names[6:])  # behind the six faces of the box
        beyond = walls.excess(path)
        worst = int(beyond.argmax())
        if beyond[worst] > max(0.0, beyond[0], beyond[-1]) + NEAR_LINE:
            raise NoWay(
                f"arm '{name}': on the straight way of the joints its sensor would come "
                f"{walls.violated_face(path[worst])}; "
                "jog it nearer to its start by hand first"
            )
    else:
        sunk = min(path[0, 2], path[-1, 2], config.limits.workspace.lower[2]) - float(path[:, 2].min())
        if sunk > max_sag:
            raise NoWay(
                f"arm '{name}': on the straight way of the joints its sensor would sink {1e3 * sunk:.0f} mm below "
                "where it stands, its start and its workspace; give the table as a plane (limits.planes), or jog it "
                "nearer to its start by hand first"
            )
    top, acceleration = way_rates(kinematics, frames, begin, end, config.limits)
    return Way(begin, end, path, float(np.linalg.norm(end - begin)) / top + top / acceleration)


def require_clear(name: str, way: Way, others: Mapping[str, FloatArray], distances: Mapping[str, float]) -> None:
    """Raises NoWay where the sensor would come too near to those of other arms, at (3,) [m] in the world."""
    keep_out_margin = 10e-3  # beyond the keep-out distance, between a way and the other sensors [m]
    for other, place in others.items():
        gaps, least = np.linalg.norm(way.path - place, axis=1), distances.get(other, 0.0) + keep_out_margin
        if gaps.min() < min(least, gaps[0] - NEAR_LINE, gaps[-1] - NEAR_LINE):
            raise NoWay(
                f"arm '{name}': on its way its sensor would come within {1e3 * gaps.min():.0f} mm of that of arm "
                f"'{other}'; jog one of them away by hand first"
            )


def _mm(point: FloatArray) -> str:
    return "[" + ", ".join(str(round(1e3 * value)) for value in point) + "]"


class StartArm(URArm):
    """As URArm, for one straight path in joint space, from `begin` to `end` (6,) [rad] (robot.arm.start_servo). The arm
    may stand outside its workspace, and be opened while it feels more than its limits; then it can be zeroed, and does
    not move before `recover`."""

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
        """Only None, which holds."""
        if target is not None:
            raise DeviceError(f"arm '{self.name}' is being led to its start and follows no targets")
        return super().command(None)

    def go_on(self, share: float) -> None:
        """Moves along the path up to this share of it; must be repeated within `action_timeout`, else the arm holds.

        Raises the error of its status when it cannot.
        """
        with self._lock:
            self._require_ready()
            self._send_command(CommandKind.CONTINUE_TO_START, fraction=share)

    def gone(self) -> float:
        """The share of the path that lies behind the arm."""
        along = self._end - self._begin
        return float((self._joints() - self._begin) @ along / max(float(along @ along), 1e-12))

    def has_gone(self, share: float) -> bool:
        """True if the arm rests at this share of its path."""
        goal = self._begin + share * (self._end - self._begin)
        return float(np.abs(goal - self._joints()).max()) < THERE and self.at_rest()

    def _joints(self) -> FloatArray:
        joints = self.state().joints
        assert joints is not None
        return joints


class Halted(Exception):
    """Somebody stopped the motion; the arm stands on its way."""


@dataclass(frozen=True, slots=True)
class Guide:
    """The person at the rig.

    ask: a question; True for yes. tell: is told what happens, a sentence at a time.
    show: is told, again and again, what an arm is doing. stop: True once somebody wants the motion to end.
    """

    ask: Callable[[str], bool]
    tell: Callable[[str], None]
    show: Callable[[str], None] = lambda words: None
    stop: Callable[[], bool] = lambda: False


def lead_to_start(config: RigConfig, starts: Mapping[str, Pose], guide: Guide) -> dict[str, float]:
    """Leads every arm of a rig to its start, if the person wants it; how far each then stands from there [m].

    Raises NoWay before anything is connected, Halted, and the error of an arm that is stopped; all arms brake then.
    """
    arms = parts_of(config.arms, UrArmConfig)
    missing = [name for name in arms if name not in starts]
    if missing:
        raise DeviceError(
            f"arms.{missing[0]}.start is missing: give the sensor's world pose at the start of an episode"
        )
    ways = {name: find_way(name, arm, read_controller(arm.host), starts[name]) for name, arm in arms.items()}
    if not guide.ask(
        "Connect, with a hand at the emergency stop and nobody in reach? Nothing moves yet; the controllers are told "
        "the TCP and the payload of the file."
    ):
        return {}
    with ExitStack() as stack:
        opened: dict[str, StartArm] = {}
        for name, arm in arms.items():
            way = ways[name]
            opened[name] = stack.enter_context(
                StartArm(arm, name, way.begin, way.end, keep_out=config.keep_out_distances(name))
            )
        for each in opened.values():
            _zero(each, guide)
        for name, each in opened.items():
            others = {other: arm.state().pose.position for other, arm in opened.items() if other != name}
            require_clear(name, ways[name], others, config.keep_out_distances(name))
            _lead(each, ways[name], guide)
        return {name: se3.pose_distance(each.state().pose, starts[name])[0] for name, each in opened.items()}


def _zero(arm: StartArm, guide: Guide) -> None:
    """Offers to zero the force sensor of an arm at rest."""
    max_force = 1.0  # a sensor that feels more at rest is to be zeroed [N]
    force = float(np.linalg.norm(arm.state().wrench[:3]))
    too_much = arm.status() == ArmStatus.FORCE_LIMIT
    if force <= max_force and not too_much:
        return
    question = f"Arm '{arm.name}' feels {force:.1f} N at rest. Does its sensor touch nothing, and shall it be zeroed?"
    if guide.ask(question):
        arm.zero_wrench()
        if too_much:
            arm.recover()
        force = float(np.linalg.norm(arm.state().wrench[:3]))
        guide.tell(f"Arm '{arm.name}' is zeroed and feels {force:.1f} N.")
    elif too_much:
        guide.tell(f"Arm '{arm.name}' feels more than its limits and cannot be moved: see what it touches, or zero it.")


def _lead(arm: StartArm, way: Way, guide: Guide) -> None:
    max_trial_turn = 0.05
    trial_share = 0.1  # share of a way that is gone first, and at most so many radians of the fastest joint
    if way.is_there:
        guide.tell(f"Arm '{arm.name}' stands at its start.")
        return
    if arm.status() == ArmStatus.FORCE_LIMIT:
        return
    trial = min(trial_share, max_trial_turn / float(np.abs(way.end - way.begin).max()))
    guide.tell(f"Arm '{arm.name}': {way.describe()}.")
    guide.tell("Only the sensors' places and the forces are watched. Has the whole arm room, elbow and cables too?")
    for share, question in (
        (trial, f"Move arm '{arm.name}' the first {100 * trial:.0f} % of this way (Ctrl-C brakes it)?"),
        (1.0, f"Did arm '{arm.name}' go the right way, and shall it go on to its start (Ctrl-C brakes it)?"),
    ):
        if not guide.ask(question):
            guide.tell(f"Arm '{arm.name}' stays where it is.")
            return
        _move(arm, share, way.seconds, guide)
    guide.tell(f"Arm '{arm.name}' stands at its start.")


class Progress:
    """Estimates the time that a path takes, from the progress measured last; `seconds`: planned for the whole path."""

    def __init__(self, seconds: float) -> None:
        self._seconds = seconds
        self._samples: deque[tuple[float, float]] = deque()  # time [s], share

    def add(self, now: float, share: float) -> None:
        """Takes the share of the path that lies behind at the time `now` [s]."""
        self._samples.append((now, share))
        while now - self._samples[0][0] > PROGRESS:
            self._samples.popleft()

    def seconds_left(self, goal: float) -> float:
        """Until the share `goal` of the path [s]: as planned in the first seconds, infinite if there is no progress."""
        (begun, first), (now, last) = self._samples[0], self._samples[-1]
        if now - begun < 0.2 * PROGRESS:
            return max(0.0, goal - last) * self._seconds
        return max(0.0, goal - last) * (now - begun) / (last - first) if last > first else math.inf


def _move(arm: StartArm, share: float, seconds: float, guide: Guide) -> None:
    """Goes on until this share of the way. Whatever ends it brakes the arm."""
    braking_timeout = 2.0  # longest time to come to rest [s]
    stall_timeout = 10.0  # longest time without getting on [s]
    command_interval = 10e-3  # between two commands on a way [s]
    farthest, deadline, progress = -1.0, time.monotonic() + stall_timeout, Progress(seconds)
    try:
        while not arm.has_gone(share):
            if guide.stop():
                raise Halted(f"arm '{arm.name}' was stopped on its way to the start")
            arm.go_on(share)
            gone, now = arm.gone(), time.monotonic()
            if gone > farthest + 1e-3:
                farthest, deadline = gone, now + stall_timeout
            if now > deadline:
                raise DeviceError(
                    f"arm '{arm.name}' does not get on, {100 * gone:.0f} % of its way gone; it "
                    f"{arm.explain()}. Is its speed slider low, or the other arm near?"
                )
            progress.add(now, gone)
            left = progress.seconds_left(share)
            estimate = f"about {left:.0f} s left" if math.isfinite(left) else "no progress"
            guide.show(f"arm '{arm.name}': {100 * max(0.0, gone):.0f} % of the way, {estimate} (Ctrl-C brakes)")
            time.sleep(command_interval)
    except BaseException:
        arm.stop()
        until = time.monotonic() + braking_timeout
        while time.monotonic() < until and not arm.status().is_fault and not arm.at_rest():
            time.sleep(command_interval)
        raise
    arm.stop()
