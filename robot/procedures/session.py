"""Common parts of the procedures that guide a person through a calibration: checks of the rig's parts before any
motion, motions of an arm, pictures of a camera, and the session with reports, measurements and stop."""

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
from tacsim.models.text import suggest_word

Measurement = TypeVar("Measurement")
Part = TypeVar("Part")

POLL_PERIOD = 2e-3  # between two reads of an arm or a camera [s]
PICTURE_TIMEOUT = 15.0  # for one picture [s]
SETTLING_TIME = 0.2  # of an arm at rest before the exposure of a picture [s]
GOLDEN_RATIO = 0.618034  # its multiples modulo 1 are spread evenly
GOLDEN_ANGLE = math.pi * (3.0 - math.sqrt(5.0))  # its multiples never repeat


class CannotCalibrate(CalibrationError):
    """These parts cannot be calibrated in this way, or the person did not do the requested step."""


class Stopped(Exception):
    """The person stopped the procedure."""


class OutsideLimits(ValueError):
    """A pose of the plan is outside the arm's limits."""


class FrameSource(Protocol):
    """A camera, as the procedures use it."""

    def read(self, timeout: float) -> TactileFrame: ...


@dataclass(slots=True)
class Session(Generic[Measurement]):
    """One running procedure. After a stop, or the end of a recorded source, its measurements remain.

    report: called with each instruction and result, one sentence at a time.
    progress: called with the number of completed steps of the plan.
    store: called with each measurement, at once.
    stop: called repeatedly; True ends the procedure.
    """

    report: Callable[[str], None] = lambda words: None
    progress: Callable[[int], None] = lambda done: None
    store: Callable[[Measurement], None] = lambda measurement: None
    stop: Callable[[], bool] = lambda: False
    measurements: list[Measurement] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)  # reasons of rejected measurements, in order

    def add_measurement(self, measurement: Measurement) -> None:
        self.measurements.append(measurement)
        self.store(measurement)

    def check(self) -> None:
        """Raises Stopped."""
        if self.stop():
            raise Stopped

    def until_stopped(self) -> suppress:
        return suppress(Stopped, EndOfEpisode)

    def frames(self, camera: FrameSource) -> Iterator[TactileFrame]:
        """New frames, each once. Raises Stopped and the errors of the camera."""
        index = -1
        while True:
            self.check()
            frame = camera.read(PICTURE_TIMEOUT)
            if frame.index == index:
                time.sleep(POLL_PERIOD)
            else:
                index = frame.index
                yield frame


def hardware_arm(config: RigConfig, arm: str) -> UrArmConfig:
    """The hardware arm of this name. Raises CannotCalibrate if the rig has none."""
    return _part(config, config.arms, arm, UrArmConfig, "not a hardware arm, real or mock; such arms")


def camera_sensor(config: RigConfig, sensor: str) -> CameraSensorConfig:
    """The camera sensor of this name. Raises CannotCalibrate if the rig has none."""
    return _part(config, config.sensors, sensor, CameraSensorConfig, "not a sensor with a camera; such sensors")


def handheld_camera(config: RigConfig, sensor: str) -> CameraSensorConfig:
    """A sensor whose camera is real, so that a person can use it. Raises CannotCalibrate."""
    camera = camera_sensor(config, sensor)
    if camera.mock is not None:
        raise CannotCalibrate(
            f"rig '{config.name}': sensors.{sensor} has a mock camera with simulated pictures; its gel cannot be "
            "pressed by hand, and its model is known"
        )
    return camera


def _part(config: RigConfig, parts: Mapping[str, object], name: str, kind: type[Part], what: str) -> Part:
    found = parts_of(parts, kind)
    if name not in found:
        listed = f"{', '.join(found) or 'none'}{suggest_word(name, found)}"
        raise CannotCalibrate(f"rig '{config.name}': '{name}' is {what}: {listed}")
    return found[name]


def move_to(arm: Arm | URArm, name: str, target: Pose, timeout: float = 60.0) -> None:
    """Moves an arm to a pose of its sensor and waits for rest. Raises OutsideLimits, ActionError if the pose is out of
    reach, DeviceError after `timeout` [s] and if the arm stops."""
    max_shift = 1e-6  # of a target by the limits; with more it is not the one of the plan [m, rad]
    max_speed = 1e-3  # of an arm at rest [m/s]
    max_distance, max_angle = 20e-6, 2e-4  # of an arm at its target [m, rad]
    if isinstance(arm, CommandedArm):
        arm.suspend_tactile_guard()  # no observation during the motion
    deadline = time.monotonic() + timeout
    while True:
        sent = arm.command(target)
        if sent is not None and max(se3.pose_distance(sent, target)) > max_shift:
            arm.stop()
            raise OutsideLimits("the path leaves the arm's limits (workspace, planes or keep_out)")
        state = arm.state()
        metres, radians = se3.pose_distance(state.pose, target)
        if metres < max_distance and radians < max_angle and np.linalg.norm(state.twist[:3]) < max_speed:
            return
        if time.monotonic() > deadline:
            raise DeviceError(f"arm '{name}' did not reach its target within {timeout:g} s")
        time.sleep(POLL_PERIOD)


def frame_after(camera: FrameSource, wait: float, timeout: float = PICTURE_TIMEOUT) -> TactileFrame:
    """The first frame exposed at least `wait` [s] from now; each read may take `timeout` [s]."""
    since = time.monotonic() + wait
    while (frame := camera.read(timeout)).time < since:
        time.sleep(POLL_PERIOD)
    return frame
