"""Content of an episode file: its topics and its metadata. All messages are protobuf.

Topics: /{sensor}/image foxglove.CompressedImage (PNG), /{sensor}/surface and /{sensor}/flow foxglove.Grid (float32),
/{sensor}/height foxglove.RawImage (the same height once more, float32 [mm], for viewers that draw no grid),
/{arm}/pose foxglove.PoseInFrame, /{arm}/transform foxglove.FrameTransform (the same pose as a tree of frames),
/{arm}/arm tacsim.Arm; if requested, /{arm}/packages tacsim.ArmPackage (each package of the controller) and /body
foxglove.PointCloud (particles of a simulated body, float32 [m]); /step/{name} tacsim.Scalar (each number of the step's
info), and at the end of a step /step tacsim.Step, which names the others.

Clocks: each `time` in tacsim's messages is on the rig's clock [s], exact; a rig of hardware uses its computer's
monotonic clock. Times of MCAP and of Foxglove's messages are on the wall clock [ns since 1970, UTC]: the rig's clock
plus `wall_offset` of the metadata, which is measured once at the start; later changes of the wall clock have no effect.
log_time: of the step (for a package, its own time); publish_time and `timestamp`: of exposure or measurement.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Mapping
from datetime import datetime

from pydantic import ConfigDict, TypeAdapter, ValidationError

from tacsim.interface import RigSpec
from tacsim.models.text import check_name, printable_line
from tacsim.record.episode import EpisodeError, EpisodeMeta

FORMAT = "2"  # of the file; increased when an old reader would misread a new file
MAX_ATTACHMENT = 64 << 20  # [bytes]
MAX_FILES = 1000  # attachments, and versions
META, CLOSE = "tacsim.episode", "tacsim.close"  # metadata records at the start and at the end
STEP_TOPIC, BODY_TOPIC = "/step", "/body"

_SPEC = TypeAdapter(RigSpec)
_NAMES = TypeAdapter(dict[str, str])
_ATTACHMENTS = TypeAdapter(tuple[str, ...])
_GOAL: TypeAdapter[float | tuple[float, ...] | None] = TypeAdapter(
    float | tuple[float, ...] | None, config=ConfigDict(ser_json_inf_nan="strings")
)


def add_checksum(values: Mapping[str, str]) -> dict[str, str]:
    """`values` with a checksum, since an MCAP metadata record has none."""
    return {**values, "crc32": _checksum(values)}


def verify_checksum(values: Mapping[str, str], what: str) -> dict[str, str]:
    """The values without their checksum. Raises EpisodeError if it is wrong."""
    bare = {key: value for key, value in values.items() if key != "crc32"}
    if values.get("crc32") != _checksum(bare):
        raise EpisodeError(f"{what}: its metadata are damaged (checksum)")
    return bare


def encode_meta(meta: EpisodeMeta) -> dict[str, str]:
    """The metadata record of an episode, with the names of its attachments, which are separate records. Raises
    ValueError for metadata that `decode_meta` would refuse: too many parts, or a name that is too long."""
    _check_parts(meta, tuple(meta.attachments))
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
    return add_checksum(values)


def decode_meta(record: Mapping[str, str], what: str) -> tuple[EpisodeMeta, tuple[str, ...]]:
    """The metadata of an episode without its attachments, and their names. Raises EpisodeError."""
    values = verify_checksum(record, what)
    if values.get("format") != FORMAT:
        raise EpisodeError(f"{what}: episode format '{values.get('format')}', but this tacsim reads {FORMAT}")
    try:
        task = values.get("task")
        meta = EpisodeMeta(
            rig=printable_line(values["rig"]),
            task=None if task is None else printable_line(task),
            policy=printable_line(values["policy"]),
            seed=int(values["seed"]),
            spec=_SPEC.validate_json(values["spec"]),
            versions={
                printable_line(k): printable_line(v) for k, v in _NAMES.validate_json(values["versions"]).items()
            },
            goal=_GOAL.validate_json(values["goal"]),
            started=datetime.fromisoformat(values["started"]) if "started" in values else None,
            wall_offset=int(values["wall_offset"]),
        )
        attachments = _ATTACHMENTS.validate_json(values["attachments"])
        _check_parts(meta, attachments)
        return meta, attachments
    except (KeyError, ValueError, ValidationError) as failure:
        raise EpisodeError(f"{what}: its metadata cannot be read: {printable_line(str(failure))}") from failure


def _check_parts(meta: EpisodeMeta, attachments: tuple[str, ...]) -> None:
    """Raises ValueError for more parts, or longer names, than a report supports."""
    max_file_name = 300  # characters of the name of an attachment
    max_parts = 64  # sensors, and arms, of an episode
    if max(len(meta.spec.sensors), len(meta.spec.arms)) > max_parts:
        raise ValueError(f"more than {max_parts} sensors or arms")
    if max(len(attachments), len(meta.versions)) > MAX_FILES:
        raise ValueError(f"more than {MAX_FILES} attachments or versions")
    for name in meta.spec.sensors:
        check_name(name, "sensor")
    for name in meta.spec.arms:
        check_name(name, "arm")
    for name in attachments:
        check_name(name, "attachment", max_file_name)


def _checksum(values: Mapping[str, str]) -> str:
    return f"{zlib.crc32(json.dumps(sorted(values.items())).encode()):08x}"
