"""What the procedures share that lead a person through a calibration: checks of the parts before anything moves,
motions of an arm, pictures of a camera, and the session that tells, keeps what was taken, and stops."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Generic, Protocol, TypeVar

import numpy as np

from calibration.errors import CalibrationError
from robot.arm.ur import URArm
from robot.errors import DeviceError
from robot.rig.commanded_arm import CommandedArm
from tacsim import pose as se3
from tacsim.interface import Arm, EndOfEpisode, Pose, TactileFrame
from tacsim.models.hardware import CameraSensorConfig, UrArmConfig, parts_of
from tacsim.models.rig import RigConfig

Measurement = TypeVar("Measurement")
Part = TypeVar("Part")

POLL = 2e-3  # between two looks at an arm or a camera [s]
PICTURE_TIMEOUT = 15.0  # longest wait for one [s]
SETTLE = 0.2  # a picture that counts is exposed so long after the arm came to rest [s]
GOLDEN_RATIO = 0.618034  # multiples of it, modulo 1, are spread evenly
GOLDEN_ANGLE = math.pi * (3.0 - math.sqrt(5.0))  # multiples of it never repeat


class CannotCalibrate(CalibrationError):
    """These parts cannot be calibrated in this way, or nobody did what was asked for."""


class Stopped(Exception):
    """Somebody asked for the end."""


class OutsideLimits(ValueError):
    """A pose of the plan lies outside the arm's limits."""


class FrameSource(Protocol):
    """What is needed of a camera."""

    def read(self, timeout: float) -> TactileFrame: ...


@dataclass(slots=True)
class Session(Generic[Measurement]):
    """One procedure under way. A stop, and the end of a recorded source, leave what was taken.

    say: is told what the person shall do next, and what became of it, a sentence at a time.
    progress: is told how many steps of the plan are done.
    keep: is given each measurement as soon as it is taken.
    stop: is asked all the time; True ends the procedure.
    """

    say: Callable[[str], None] = lambda words: None
    progress: Callable[[int], None] = lambda done: None
    keep: Callable[[Measurement], None] = lambda measurement: None
    stop: Callable[[], bool] = lambda: False
    taken: list[Measurement] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)  # what was not taken, and why, in order

    def take(self, measurement: Measurement) -> None:
        self.taken.append(measurement)
        self.keep(measurement)

    def check(self) -> None:
        """Raises Stopped."""
        if self.stop():
            raise Stopped

    def until_stopped(self) -> suppress:
        return suppress(Stopped, EndOfEpisode)

    def frames(self, camera: FrameSource) -> Iterator[TactileFrame]:
        """New frames, each once. Raises Stopped, and what the camera raises."""
        index = -1
        while True:
            self.check()
            frame = camera.read(PICTURE_TIMEOUT)
            if frame.index == index:
                time.sleep(POLL)
            else:
                index = frame.index
                yield frame


def hardware_arm(config: RigConfig, arm: str) -> UrArmConfig:
    """Raises CannotCalibrate where the rig has no such arm."""
    return _part(config, config.arms, arm, UrArmConfig, "no arm of hardware, real or mock; there are")


def camera_sensor(config: RigConfig, sensor: str) -> CameraSensorConfig:
    """Raises CannotCalibrate where the rig has no such camera."""
    return _part(config, config.sensors, sensor, CameraSensorConfig, "no sensor with a camera; cameras")


def handheld_camera(config: RigConfig, sensor: str) -> CameraSensorConfig:
    """A sensor before whose camera a person can hold something. Raises CannotCalibrate."""
    camera = camera_sensor(config, sensor)
    if camera.mock is not None:
        raise CannotCalibrate(
            f"rig '{config.name}': sensors.{sensor} has a mock camera that a simulation feeds; nobody can press its "
            "gel, and its model is known"
        )
    return camera


def _part(config: RigConfig, parts: Mapping[str, object], name: str, kind: type[Part], what: str) -> Part:
    found = parts_of(parts, kind)
    if name not in found:
        raise CannotCalibrate(f"rig '{config.name}': '{name}' is {what}: {', '.join(found) or 'none'}")
    return found[name]


def move_to(arm: Arm | URArm, name: str, target: Pose, timeout: float = 60.0) -> None:
    """Moves an arm to a pose of its sensor and waits for standstill. Raises OutsideLimits, ActionError for what is out
    of reach, DeviceError after `timeout` [s] and for what stops an arm."""
    max_shift = 1e-6  # a target that the limits moved by more is not the one of the plan [m, rad]
    max_speed = 1e-3  # slower than this is standing still [m/s]
    max_distance, max_angle = 20e-6, 2e-4  # as near to a target counts as there [m, rad]
    if isinstance(arm, CommandedArm):
        arm.suspend_tactile_guard()  # nothing is observed on the way
    deadline = time.monotonic() + timeout
    while True:
        sent = arm.command(target)
        if sent is not None and max(se3.pose_distance(sent, target)) > max_shift:
            arm.stop()
            raise OutsideLimits("the path leads out of the arm's limits (workspace, planes or keep_out)")
        state = arm.state()
        metres, radians = se3.pose_distance(state.pose, target)
        if metres < max_distance and radians < max_angle and np.linalg.norm(state.twist[:3]) < max_speed:
            return
        if time.monotonic() > deadline:
            raise DeviceError(f"arm '{name}' did not come to its target within {timeout:g} s")
        time.sleep(POLL)


def frame_after(camera: FrameSource, wait: float, timeout: float = PICTURE_TIMEOUT) -> TactileFrame:
    """The first frame exposed at least `wait` [s] from now; each read may take `timeout` [s]."""
    since = time.monotonic() + wait
    while (frame := camera.read(timeout)).time < since:
        time.sleep(POLL)
    return frame
