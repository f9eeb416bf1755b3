"""What an episode file holds: topics, and the JSON messages as pydantic models (their JSON schemas are in the file).

Topics: /{sensor}/image foxglove.CompressedImage (PNG), /{sensor}/surface and /{sensor}/flow foxglove.Grid (float32),
/{arm}/pose foxglove.PoseInFrame, /{arm}/arm tacsim.Arm, if asked for /{arm}/packages tacsim.ArmPackage (each package of
the controller), and last in a step /step tacsim.Step, which names the others.
Numbers that JSON cannot write are the texts "NaN", "Infinity", "-Infinity".

Clocks: every `time` in the JSON messages is the rig's own clock [s], exact; a rig of hardware counts its computer's
monotonic clock. Times of MCAP and of Foxglove's messages are the wall clock [ns since 1970, UTC]: the rig's clock plus
`wall_offset` of the metadata, which is measured once at the start; setting the wall clock meanwhile changes nothing.
log_time: of the step (of a package its own); publish_time and `timestamp`: of exposure or measurement.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Mapping
from datetime import datetime
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from tacsim.interface import RigSpec
from tacsim.models.text import printable
from tacsim.record.episode import EpisodeError, EpisodeMeta

FORMAT = "1"  # of the file; raised when an old reader would misread a new file
MAX_ATTACHMENT = 64 << 20  # [bytes]
MAX_PARTS = 64  # sensors, and arms, of an episode
META, CLOSE = "tacsim.episode", "tacsim.close"  # metadata records at the start and at the end
STEP_TOPIC = "/step"
STEP_SCHEMA, ARM_SCHEMA, PACKAGE_SCHEMA = "tacsim.Step", "tacsim.Arm", "tacsim.ArmPackage"

Vector3 = tuple[float, float, float]
Vector6 = tuple[float, float, float, float, float, float]


class _Message(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", ser_json_inf_nan="strings")


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


JSON_SCHEMAS: Mapping[str, type[BaseModel]] = {
    STEP_SCHEMA: StepMessage,
    ARM_SCHEMA: ArmMessage,
    PACKAGE_SCHEMA: PackageMessage,
}

_SPEC = TypeAdapter(RigSpec)
_NAMES = TypeAdapter(dict[str, str])
_ATTACHMENTS = TypeAdapter(tuple[str, ...])
_GOAL: TypeAdapter[float | tuple[float, ...] | None] = TypeAdapter(
    float | tuple[float, ...] | None, config=ConfigDict(ser_json_inf_nan="strings")
)


def sealed(values: Mapping[str, str]) -> dict[str, str]:
    """`values` with a checksum added: an MCAP metadata record has none of its own."""
    return {**values, "crc32": _checksum(values)}


def unsealed(values: Mapping[str, str], what: str) -> dict[str, str]:
    """The values without their checksum. Raises EpisodeError when it is wrong."""
    bare = {key: value for key, value in values.items() if key != "crc32"}
    if values.get("crc32") != _checksum(bare):
        raise EpisodeError(f"{what}: its metadata are damaged (checksum)")
    return bare


def encode_meta(meta: EpisodeMeta) -> dict[str, str]:
    """The metadata record of an episode, with the names of its attachments, which are records of their own."""
    values = {
        "format": FORMAT,
        "rig": meta.rig,
        "policy": meta.policy,
        "seed": str(meta.seed),
        "goal": _GOAL.dump_json(meta.goal).decode(),
        "spec": _SPEC.dump_json(meta.spec).decode(),
        "versions": json.dumps(dict(meta.versions)),
        "attachments": json.dumps(list(meta.attachments)),
        "wall_offset": str(meta.wall_offset),
    }
    if meta.task is not None:
        values["task"] = meta.task
    if meta.started is not None:
        values |= {"started": meta.started.isoformat(), "time_zone": meta.started.tzname() or ""}
    return sealed(values)


def decode_meta(record: Mapping[str, str], what: str) -> tuple[EpisodeMeta, tuple[str, ...]]:
    """The metadata of an episode without its attachments, and their names. Raises EpisodeError."""
    values = unsealed(record, what)
    if values.get("format") != FORMAT:
        raise EpisodeError(f"{what}: episode format '{values.get('format')}', but this tacsim reads '{FORMAT}'")
    try:
        task = values.get("task")
        meta = EpisodeMeta(
            rig=printable(values["rig"]),
            task=None if task is None else printable(task),
            policy=printable(values["policy"]),
            seed=int(values["seed"]),
            spec=_SPEC.validate_json(values["spec"]),
            versions={printable(k): printable(v) for k, v in _NAMES.validate_json(values["versions"]).items()},
            goal=_GOAL.validate_json(values["goal"]),
            started=datetime.fromisoformat(values["started"]) if "started" in values else None,
            wall_offset=int(values.get("wall_offset", "0")),
        )
        if max(len(meta.spec.sensors), len(meta.spec.arms)) > MAX_PARTS:
            raise ValueError(f"more than {MAX_PARTS} sensors or arms")
        for name in (*meta.spec.sensors, *meta.spec.arms):
            if not name.isprintable():
                raise ValueError(f"the name {printable(name)} holds control characters")
        return meta, _ATTACHMENTS.validate_json(values["attachments"])
    except (KeyError, ValueError, ValidationError) as failure:
        raise EpisodeError(f"{what}: its metadata cannot be read: {printable(str(failure))}") from failure


def _checksum(values: Mapping[str, str]) -> str:
    return f"{zlib.crc32(json.dumps(sorted(values.items())).encode()):08x}"
