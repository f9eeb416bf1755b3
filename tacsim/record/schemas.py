"""What an episode file holds: topics, and the JSON messages as pydantic models (their JSON schemas are in the file).

Topics: /{sensor}/image foxglove.CompressedImage (PNG), /{sensor}/surface and /{sensor}/flow foxglove.Grid (float32),
/{arm}/pose foxglove.PoseInFrame, /{arm}/arm tacsim.Arm, and last in a step /step tacsim.Step, which names the others.
Numbers that JSON cannot write are the texts "NaN", "Infinity", "-Infinity".
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Mapping

from pydantic import BaseModel, ConfigDict, TypeAdapter, ValidationError

from tacsim.interface import RigSpec
from tacsim.record.episode import EpisodeError, EpisodeMeta
from tacsim.text import printable

FORMAT = "1"  # of the file; raised when an old reader would misread a new file
MAX_ATTACHMENT = 64 << 20  # [bytes]
META, CLOSE = "tacsim.episode", "tacsim.close"  # metadata records at the start and at the end
STEP_TOPIC = "/step"
STEP_SCHEMA, ARM_SCHEMA = "tacsim.Step", "tacsim.Arm"

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


class FrameMessage(_Message):
    time: float  # of exposure, rig clock [s]
    index: int
    surface: bool  # this step has /{sensor}/surface
    flow: bool  # and /{sensor}/flow


class StepMessage(_Message):
    index: int
    time: float  # rig clock [s]
    seconds: float  # wall time of the step [s]
    reward: float | None
    distance: float | None  # [m]
    info: dict[str, float]
    action: dict[str, PoseMessage | None] | None  # asked: world_from_sensor by arm
    sent: dict[str, PoseMessage | None]  # executed
    frames: dict[str, FrameMessage]  # by sensor
    arms: tuple[str, ...]


JSON_SCHEMAS: Mapping[str, type[BaseModel]] = {STEP_SCHEMA: StepMessage, ARM_SCHEMA: ArmMessage}

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
    }
    return sealed(values if meta.task is None else {**values, "task": meta.task})


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
        )
        for name in (*meta.spec.sensors, *meta.spec.arms):
            if not name.isprintable():
                raise ValueError(f"the name {printable(name)} holds control characters")
        return meta, _ATTACHMENTS.validate_json(values["attachments"])
    except (KeyError, ValueError, ValidationError) as failure:
        raise EpisodeError(f"{what}: its metadata cannot be read: {printable(str(failure))}") from failure


def _checksum(values: Mapping[str, str]) -> str:
    return f"{zlib.crc32(json.dumps(sorted(values.items())).encode()):08x}"
