"""Episodes of format 1: JSON in place of tacsim's own protobuf messages.

Numbers that JSON cannot write are the texts "NaN", "Infinity", "-Infinity".
"""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field

from tacsim.record.protobuf import Step, arm_message, package_message, put_pose

Vector3 = tuple[float, float, float]
Vector6 = tuple[float, float, float, float, float, float]


class _Message(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class PoseMessage(_Message):
    position: Vector3  # [m]
    quaternion: tuple[float, float, float, float]  # x, y, z, w


class ArmMessage(_Message):
    twist: Vector6  # world axes [m/s, rad/s]
    wrench: Vector6  # sensor axes [N, N m]
    joints: tuple[float, ...] | None  # [rad]
    time: float  # [s]


class PackageMessage(_Message):
    """One package of an arm's controller, as it came: base axes, not those of the sensor."""

    time: float  # when it was read, rig clock [s]
    stamp: float  # time on the controller's own clock [s]
    joints: Vector6  # [rad]
    joint_speeds: Vector6  # [rad/s]
    tcp_pose: Vector6  # position and rotation vector [m, rad]
    tcp_speed: Vector6  # [m/s, rad/s]
    tcp_force: Vector6  # [N, N m]
    runtime_state: int  # of the controller's program: 1 stopped, 2 playing, 4 paused
    safety_bits: int  # safety_status_bits of the controller
    status: int  # what the driver made of it: robot.ArmStatus


class PackagesMessage(_Message):
    count: int  # messages /{arm}/packages that belong to this step
    lost: int  # packages of the controller that are missing among and before them


class FrameMessage(_Message):
    time: float  # of exposure, rig clock [s]
    index: int
    surface: bool  # this step has /{sensor}/surface
    flow: bool  # and /{sensor}/flow


class StepMessage(_Message):
    index: Annotated[int, Field(gt=-(2**53), lt=2**53)]
    time: float  # rig clock [s]
    seconds: float  # wall time of the step [s]
    reward: float | None
    distance: float | None  # [m]
    info: dict[str, float]
    action: dict[str, PoseMessage | None] | None  # asked: world_from_sensor by arm
    sent: dict[str, PoseMessage | None]  # executed
    frames: dict[str, FrameMessage]  # by sensor
    arms: tuple[str, ...]
    packages: dict[str, PackagesMessage] = {}  # by arm


def is_json(data: bytes) -> bool:
    """No protobuf message of an episode begins with this byte: it would open a group, which proto3 does not have."""
    return data[:1] == b"{"


def step(data: bytes) -> tuple[Any, dict[str, float]]:
    """The step of a JSON message, and its info. Raises ValueError."""
    record = StepMessage.model_validate_json(data)
    made = Step(index=record.index, time=record.time, seconds=record.seconds, acted=record.action is not None)
    if record.reward is not None:
        made.reward = record.reward
    if record.distance is not None:
        made.distance = record.distance
    for targets, poses in ((made.asked, record.action or {}), (made.sent, record.sent)):
        for name, pose in poses.items():
            target = targets.add(arm=name)
            if pose is not None:
                put_pose(target, pose.position, pose.quaternion)
    for name, frame in record.frames.items():
        made.frames.add(sensor=name, **frame.model_dump())
    made.arms.extend(record.arms)
    for name, packages in record.packages.items():
        made.packages.add(arm=name, **packages.model_dump())
    return made, record.info


def arm(data: bytes) -> Any:
    """The arm of a JSON message. Raises ValueError."""
    return arm_message(**ArmMessage.model_validate_json(data).model_dump())


def package(data: bytes) -> Any:
    """The package of a JSON message. Raises ValueError."""
    return package_message(PackageMessage.model_validate_json(data).model_dump())
