"""Configuration of arms, sensors and grippers: UR arms, cameras, the reset. Drivers: models/driver.py."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from operator import attrgetter
from pathlib import Path
from typing import Annotated, ClassVar, Literal, Self, TypeVar

import numpy as np
from pydantic import BeforeValidator, Field, field_validator, model_validator

from tacsim import pose as se3
from tacsim.interface import Pose
from tacsim.models.limits import ArmLimits, Vector
from tacsim.models.quantity import Angle, Config, Length, Speed, Stiffness, Time
from tacsim.models.sensor import PictureRegion, SensorModel
from tacsim.models.text import MAX_NAME

Name = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*$", max_length=MAX_NAME)]
Corner = tuple[float, float]
Delay = Annotated[int, Field(ge=0, le=20)]  # [control periods]

POLYSCOPE = r"[0-9]{1,9}(\.[0-9]{1,9}){1,3}"  # a version of it


def _serial_text(value: object) -> object:
    """A serial number without quotes is an integer to YAML."""
    return str(value) if isinstance(value, int) and not isinstance(value, bool) else value


Model = Literal["ur3e", "ur5e", "ur10e"]


class Placement(Config):
    """A rigid transform in a file: position and rotation of one frame in another."""

    position: Vector = (0.0, 0.0, 0.0)  # [m]
    rotation: tuple[Angle, Angle, Angle] = (0.0, 0.0, 0.0)  # rotation vector: axis times angle [rad], as UR writes it

    @property
    def pose(self) -> Pose:
        return se3.from_rotation_vector(self.position, self.rotation)


class SensorConfig(Config):
    """What a rig file says of one sensor. That of a driver derives from it, says its `driver: Literal["..."]`, and adds
    what it is about (docs/drivers.md)."""

    is_simulated: ClassVar[bool] = False  # its frames come from the simulation of the rig's scene
    driver: str
    arm: Name | None = None  # that carries it, or:
    gripper: Name | None = None

    @property
    def sensor_model(self) -> SensorModel | None:
        """The model of what its picture shows, where the file gives one."""
        return None

    @property
    def bundle(self) -> str | None:
        """The path of its calibration, where the file gives one."""
        return None

    @property
    def is_mock(self) -> bool:
        """A mock of it is started with the rig."""
        return False

    @property
    def may_find_height(self) -> bool:
        """False where the file rules out that it delivers the height of its gel."""
        return True

    def rendered_model(self, load: Callable[[Path], SensorModel]) -> SensorModel | None:
        """What is rendered of it, where it is simulated or its camera is a mock. `load` reads a bundle's model."""
        return None

    def without_gel_size(self) -> Self:
        """The same, where the rig's scene says how large the gel is and not its model."""
        return self


class ArmConfig(Config):
    """What a rig file says of one arm; see SensorConfig. An arm of hardware has `limits: ArmLimits`, and may have a
    `start: Placement`."""

    records_packages: ClassVar[bool] = False  # its driver can record every package of its controller
    driver: str

    @property
    def is_real(self) -> bool:
        """A command of ours moves a machine, so a person must have said yes. A maker's simulator counts."""
        return True

    @property
    def joint_count(self) -> int:
        """Of a simulated arm: how many joint angles its state has."""
        return 0

    @property
    def stop_limits(self) -> ArmLimits | None:
        """Its limits, where it has some."""
        return getattr(self, "limits", None)

    @property
    def start_pose(self) -> Pose | None:
        """world_from_sensor where an episode begins, where the file says it."""
        start: Placement | None = getattr(self, "start", None)
        return None if start is None else start.pose

    def weakened_limits(self, before: ArmConfig) -> list[str]:
        """The limits that are weaker than in `before`, as "key: from -> to"."""
        return _weakened(before, self, LIMIT_KEYS)


class GripperConfig(Config):
    """What a rig file says of one parallel gripper; see SensorConfig."""

    driver: str
    arm: Name | None = None  # that carries it

    @property
    def is_real(self) -> bool:
        """As of an arm."""
        return True


Part = TypeVar("Part")


def parts_of(parts: Mapping[str, object], config_class: type[Part]) -> dict[str, Part]:
    """The arms, grippers or sensors of a rig whose configuration is of this class, by name."""
    return {name: part for name, part in parts.items() if isinstance(part, config_class)}


class Payload(Config):
    """The mass on the flange, for the controller's gravity compensation."""

    mass: Annotated[float, Field(ge=0, le=20)] = 0.0  # [kg]
    centre: Vector = (0.0, 0.0, 0.0)  # centre of gravity, flange axes [m]


class MountConfig(Config):
    """What holds a sensor to its arm: a spring with a damper, the same along all axes. The arm does not observe how far
    it gives way."""

    # None: rigid. A mount of 500 N/m gives way by 2 mm under 1 N; softer ones are not tested.
    stiffness: Annotated[Stiffness, Field(ge=500.0)] | None = None
    damping_time: Annotated[Time, Field(ge=0.1)] = 0.3  # of the displacement to 63 % of what the force asks [s]


class MockArmConfig(Config):
    """A mock controller on loopback is started for this arm and stopped with the rig."""

    joints: tuple[Angle, Angle, Angle, Angle, Angle, Angle] | None = None  # at power-on; None: at the arm's `start`
    # Of PolyScope, which the controller claims: "5.11", "5.11.0.108150". A text: YAML reads 5.10 without quotes as 5.1.
    version: str | None = None
    # Pose of the sensor by the file, relative to its true pose in the mock: the error that a calibration leaves.
    error: Placement = Placement()
    mount: MountConfig = MountConfig()  # between the arm and its sensor, in the mock; needs `lock_step`
    # Controller and worker ask for real-time priority, as the worker of a real arm does: to measure timing. Otherwise
    # they share a busy machine with whatever else the mock rig needs.
    realtime: bool = False

    @field_validator("version")
    @classmethod
    def _is_a_version(cls, version: str | None) -> str | None:
        if version is not None and not re.fullmatch(POLYSCOPE, version):
            raise ValueError(f"a version of PolyScope is a text such as '5.11' or '5.11.0.108150', got {version!r:.40}")
        return version


class UrArmConfig(ArmConfig):
    """A Universal Robots arm through RTDE. With `mock` the same driver talks to a mock controller on loopback."""

    records_packages: ClassVar[bool] = True
    driver: Literal["ur"]
    host: Annotated[str, Field(min_length=1, max_length=253)]
    model: Model = "ur5e"
    # Serial number that the robot must have, as its dashboard reports it; None: any.
    serial: Annotated[str, BeforeValidator(_serial_text), Field(min_length=1, max_length=64)] | None = None
    world_from_base: Placement
    flange_from_tool: Placement = Placement()  # the tool centre point (TCP) that the controller is given
    tool_from_sensor: Placement = Placement()
    payload: Payload = Payload()
    limits: ArmLimits
    start: Placement | None = None  # world_from_sensor, clear of everything; None: where the scene of a mock rig says
    link_timeout: Annotated[Time, Field(ge=0.01, le=2.0)] = 50e-3  # without a package, the link is lost [s]
    # Without an action for so long the arm holds. An action reaches at most limits.speed x action_timeout ahead: an arm
    # that a program leaves hanging comes to rest within that distance. Two control periods are enough: no two actions
    # that each come within their own period are farther apart [s].
    action_timeout: Annotated[Time, Field(ge=0.02, le=60.0)] = 0.2
    # The arm holds, whatever is asked, when the newest observation is older [s].
    observation_timeout: Annotated[Time, Field(ge=0.02, le=600.0)] = 1.0
    # The controller stops the arm after 1 / watchdog without a command [Hz].
    watchdog: Annotated[float, Field(ge=0.2, le=125.0)] = 10.0
    lookahead: Annotated[Time, Field(ge=0.03, le=0.2)] = 0.03  # of servoj [s]
    gain: Annotated[float, Field(ge=100, le=2000)] = 600.0  # of servoj
    latency: Annotated[Time, Field(ge=0, le=1.0)] = 0.0  # how old a state is when its package arrives [s]
    # The controller at `host` is the maker's simulator (URSim) on this machine; it may have a slower watchdog, and
    # its driver no real-time priority; in all else it counts as a real arm.
    simulator: bool = False
    mock: MockArmConfig | None = None

    @property
    def is_real(self) -> bool:
        return self.mock is None

    def weakened_limits(self, before: ArmConfig) -> list[str]:
        found = _weakened(before, self, (*LIMIT_KEYS, "link_timeout", "action_timeout", "observation_timeout"))
        was = getattr(before, "watchdog", None)
        if was is not None and self.watchdog < was:
            found.append(f"watchdog: {was:g} -> {self.watchdog:g}")
        return found

    @model_validator(mode="after")
    def _simulator_or_mock(self) -> Self:
        if self.simulator and self.mock is not None:
            raise ValueError("is either a maker's simulator (simulator: true) or our mock (mock: {}), not both")
        return self

    @model_validator(mode="after")
    def _real_arms_have_a_watchdog(self) -> Self:
        min_rate = 10.0  # of a real arm [Hz]
        if self.mock is None and not self.simulator and self.watchdog < min_rate:
            raise ValueError(
                f"watchdog {self.watchdog:g} Hz: a real arm would go on for {1 / self.watchdog:.2g} s after its driver "
                f"died; at least {min_rate:g} Hz (only a mock or a simulator may be slower)"
            )
        return self


class MockCameraConfig(Config):
    """A mock camera on loopback is started for this sensor; the simulated gel feeds it."""

    fps: Annotated[float, Field(gt=0, le=240)] = 30.0
    quality: Annotated[int, Field(ge=50, le=100)] = 95  # of JPEG
    delay: Delay = 0  # its pictures are those of so many motions of the cell ago


class CameraSensorConfig(SensorConfig):
    """A tactile sensor seen by a camera: UVC, MJPEG over HTTP, a video or a folder of images as a stand-in."""

    driver: Literal["camera"]
    # http://... (MJPEG), a device by its serial path (/dev/v4l/by-id/...), a video file, or a folder of images.
    source: Annotated[str, Field(min_length=1, max_length=4096)]
    # What the picture shows, one of four: `model` (its geometry; of a mock also what is rendered), gel `corners`,
    # `calibration` (path of a bundle that `tacsim calibrate sensor` wrote; only it gives a real sensor's height), or
    # `marker_pitch` (distance of the dots printed on the gel: the first reference shows them; flow, but no height).
    model: SensorModel | None = None
    corners: tuple[Corner, Corner, Corner, Corner] | None = None  # top left, top right, bottom right, bottom left [px]
    size: tuple[Annotated[Length, Field(gt=0)], Annotated[Length, Field(gt=0)]] = (16e-3, 16e-3)  # between them [m]
    calibration: Annotated[str, Field(min_length=1, max_length=4096)] | None = None
    marker_pitch: Annotated[Length, Field(gt=0)] | None = None  # [m]
    region: PictureRegion | None = None  # part of the picture that shows gel; None: all of it between the corners
    width: Annotated[int, Field(ge=16, le=8192)] = 640  # of the frames that are expected; others are refused [px]
    height: Annotated[int, Field(ge=16, le=8192)] = 480
    fps: Annotated[float, Field(gt=0, le=1000)] = 30.0  # asked of the camera; of a folder: how fast it is played
    exposure: float | None = None  # fixed, in the driver's own unit, and read back; None: left as it is
    white_balance: Annotated[float, Field(gt=0)] | None = None  # colour temperature, fixed and read back [K]
    stamped: bool = False  # frames carry the strip with number and clock that tacsim's mock camera burns in
    # The source may show the very same picture for long, as no real sensor does: a frozen one cannot be detected.
    repeats: bool = False
    max_age: Annotated[Time, Field(gt=0, le=60.0)] = 0.2  # an older frame is refused [s]
    latency: Annotated[Time, Field(ge=0, le=2.0)] = 0.0  # from exposure to arrival [s]
    mock: MockCameraConfig | None = None

    @property
    def sensor_model(self) -> SensorModel | None:
        return self.model

    @property
    def bundle(self) -> str | None:
        return self.calibration

    @property
    def is_mock(self) -> bool:
        return self.mock is not None

    @property
    def may_find_height(self) -> bool:
        return self.model is not None or self.calibration is not None

    def rendered_model(self, load: Callable[[Path], SensorModel]) -> SensorModel | None:
        if self.mock is None:
            return None
        return self.model if self.model is not None else load(Path(self.calibration or ""))

    @model_validator(mode="after")
    def _require_one_geometry(self) -> Self:
        if sum(each is not None for each in (self.model, self.corners, self.calibration, self.marker_pitch)) > 1:
            raise ValueError(
                "give one of model, corners, calibration, marker_pitch (the others null): each says where the gel lies "
                "in the picture"
            )
        if self.region is not None and self.calibration is not None:
            raise ValueError("a calibration brings its own region: give it to `tacsim calibrate sensor --region`")
        if self.mock is not None and self.model is None and self.calibration is None:
            raise ValueError("a mock camera needs a model or a calibration: it says what is rendered")
        return self


class KeepOut(Config):
    """The sensors of two arms stay apart: a sphere between them that neither may enter."""

    arms: tuple[Name, Name]
    distance: Annotated[Length, Field(gt=0)]  # least distance of the two sensors' origins [m]

    @model_validator(mode="after")
    def _two_arms(self) -> Self:
        if self.arms[0] == self.arms[1]:
            raise ValueError(f"needs two different arms, got '{self.arms[0]}' twice")
        return self


class ResetConfig(Config):
    """How an episode begins on hardware: retreat to `start`, references, a person's confirmation, slow approach."""

    approach_speed: Annotated[Speed, Field(gt=0, le=20e-3)] = 2e-3  # [m/s]
    approach_step: Annotated[Length, Field(gt=0, le=1e-3)] = 20e-6  # where a simulation follows: between looks [m]
    approach_distance: Annotated[Length, Field(gt=0, le=0.1)] = 10e-3  # no touch after that: NoTouch [m]
    touch_signal: Annotated[float, Field(gt=0)] | None = None  # contact signal that counts as touch; None: by force


LIMIT_KEYS = (
    *(f"limits.{key}" for key in ("speed", "turn_rate", "acceleration", "turn_acceleration", "joint_speed")),
    *("limits.force", "limits.torque", "limits.max_following_error", "limits.max_following_turn"),
    *("limits.depth", "limits.shear"),
)


def _weakened(before: ArmConfig, after: ArmConfig, keys: Sequence[str]) -> list[str]:
    """Which of the limits `keys` of `after` are weaker than those of `before`, as "key: from -> to"."""
    if type(before) is not type(after):
        return [f"driver: {before.driver} -> {after.driver}"]
    old_limits, new_limits = before.stop_limits, after.stop_limits
    if old_limits is None or new_limits is None:
        return []
    found = []
    for key in keys:
        old, new = (attrgetter(key)(config) for config in (before, after))
        if old is not None and (new is None or new > old):
            key = key.replace("max_following", "following")  # what holds, whether the file names it or not
            found.append(f"{key}: {old:g} -> {'not watched' if new is None else f'{new:g}'}")
    was, now = old_limits.workspace, new_limits.workspace
    if (np.array(now.lower) < was.lower).any() or (np.array(now.upper) > was.upper).any():
        found.append("limits.workspace: reaches farther")
    if not set(old_limits.planes) <= set(new_limits.planes):
        found.append("limits.planes: one is gone")
    return found
