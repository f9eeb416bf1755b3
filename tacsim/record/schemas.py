"""Content of an episode file: its topics, its metadata, and tacsim's protobuf messages. All messages are protobuf.

Topics: /{sensor}/image foxglove.CompressedImage (PNG), /{sensor}/surface and /{sensor}/flow foxglove.Grid (float32),
/{sensor}/height foxglove.RawImage (the same height once more, float32 [mm], for viewers that draw no grid),
/{gripper}/gripper tacsim.Gripper, /{arm}/pose foxglove.PoseInFrame, /{arm}/transform foxglove.FrameTransform (the
same pose as a tree of frames), /{arm}/arm tacsim.Arm; if requested, /{arm}/packages tacsim.ArmPackage (each package
of the controller) and /body foxglove.PointCloud (particles of a simulated body, float32 [m]); /step/{name}
tacsim.Scalar (each number of the step's info), and at the end of a step /step tacsim.Step, which names the others.

Clocks: each `time` in tacsim's messages is on the rig's clock [s], exact; a rig of hardware uses its computer's
monotonic clock. Times of MCAP and of Foxglove's messages are on the wall clock [ns since 1970, UTC]: the rig's clock
plus `wall_offset` of the metadata, which is measured once at the start; later changes of the wall clock have no effect.
log_time: of the step (for a package, its own time); publish_time and `timestamp`: of exposure or measurement.

Each number that users may plot is a separate field of nested messages: viewers (Foxglove, Rerun) plot these, but no
maps, and lists only in part.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Mapping, Sequence
from datetime import datetime
from typing import Any

from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from google.protobuf.descriptor_pb2 import FieldDescriptorProto as Field
from google.protobuf.descriptor_pb2 import FileDescriptorProto
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
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
MAX_JOINTS = 7  # in an arm's message
_PACKAGE_VECTORS = {
    "tcp_pose": ("tcp_position", "tcp_rotation"),
    "tcp_speed": ("tcp_linear", "tcp_angular"),
    "tcp_force": ("tcp_force", "tcp_torque"),
}
_PACKAGE_JOINTS = ("joints", "joint_speeds")
_PACKAGE_NUMBERS = ("time", "stamp", "runtime_state", "safety_bits", "status")


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
    max_parts = 64  # sensors, arms, and grippers of an episode
    if max(len(meta.spec.sensors), len(meta.spec.arms), len(meta.spec.grippers)) > max_parts:
        raise ValueError(f"more than {max_parts} sensors, arms or grippers")
    if max(len(attachments), len(meta.versions)) > MAX_FILES:
        raise ValueError(f"more than {MAX_FILES} attachments or versions")
    for name in meta.spec.sensors:
        check_name(name, "sensor")
    for name in meta.spec.arms:
        check_name(name, "arm")
    for name in meta.spec.grippers:
        check_name(name, "gripper")
    for name in attachments:
        check_name(name, "attachment", max_file_name)


def _checksum(values: Mapping[str, str]) -> str:
    return f"{zlib.crc32(json.dumps(sorted(values.items())).encode()):08x}"


_NUMBERS = {
    "double": Field.TYPE_DOUBLE,
    "int64": Field.TYPE_INT64,
    "bool": Field.TYPE_BOOL,
    "string": Field.TYPE_STRING,
}
# The order of fields defines their numbers on the wire: add new ones at the end.
_MESSAGES: dict[str, dict[str, str]] = {
    "Joints": {f"joint_{number + 1}": "optional double" for number in range(MAX_JOINTS)},
    "Arm": {
        "time": "optional double",  # rig clock [s]; always set
        "linear": "foxglove.Vector3",  # velocity of the sensor, world axes [m/s]
        "angular": "foxglove.Vector3",  # [rad/s]
        "force": "foxglove.Vector3",  # force of the object on the sensor, sensor axes [N]
        "torque": "foxglove.Vector3",  # about the sensor's origin [N m]
        "joints": "tacsim.Joints",  # [rad]; absent: not known
    },
    # One package of an arm's controller, unchanged: base axes, not sensor axes.
    "ArmPackage": {
        "time": "optional double",  # when it was read, rig clock [s]; always set
        "stamp": "double",  # time on the controller's own clock [s]
        "joints": "tacsim.Joints",  # [rad]
        "joint_speeds": "tacsim.Joints",  # [rad/s]
        "tcp_position": "foxglove.Vector3",  # [m]
        "tcp_rotation": "foxglove.Vector3",  # rotation vector [rad]
        "tcp_linear": "foxglove.Vector3",  # [m/s]
        "tcp_angular": "foxglove.Vector3",  # [rad/s]
        "tcp_force": "foxglove.Vector3",  # [N]
        "tcp_torque": "foxglove.Vector3",  # [N m]
        "runtime_state": "int64",  # of the controller's program: 1 stopped, 2 playing, 4 paused
        "safety_bits": "int64",  # safety_status_bits of the controller
        "status": "int64",  # status by the driver: robot.ArmStatus
    },
    "Gripper": {
        "time": "optional double",  # rig clock [s]; always set
        "width": "double",  # between the surfaces that grip [m]
        "force": "optional double",  # of each finger [N]; absent: not measured
    },
    "Scalar": {"value": "optional double"},  # always set
    "Target": {"arm": "string", "pose": "foxglove.Pose"},  # world_from_sensor [m]; no pose: the arm holds
    "Grip": {
        "gripper": "string",
        "width": "optional double",  # [m]; absent: the gripper holds
        "force": "double",  # [N]
    },
    "Frame": {
        "sensor": "string",
        "time": "double",  # of exposure, rig clock [s]
        "index": "int64",
        "surface": "bool",  # this step has /{sensor}/surface
        "flow": "bool",  # and /{sensor}/flow
    },
    "Packages": {
        "arm": "string",
        "count": "int64",  # messages /{arm}/packages that belong to this step
        "lost": "int64",  # packages of the controller that are missing among and before them
    },
    "Step": {
        "index": "optional int64",  # always set
        "time": "double",  # rig clock [s]
        "seconds": "double",  # wall time of the step [s]
        "reward": "optional double",
        "distance": "optional double",  # [m]
        "acted": "bool",  # the step has an action
        "asked": "repeated tacsim.Target",  # the action
        "sent": "repeated tacsim.Target",  # the executed part of the action
        "frames": "repeated tacsim.Frame",
        "arms": "repeated string",
        "info": "repeated string",  # each is a Scalar /step/{name}
        "packages": "repeated tacsim.Packages",
        "body": "bool",  # this step has /body
        "grippers": "repeated string",
        "asked_grips": "repeated tacsim.Grip",  # the action
        "sent_grips": "repeated tacsim.Grip",  # the executed part of the action
    },
}


def _make_classes() -> dict[str, Any]:
    file = FileDescriptorProto(name="tacsim/episode.proto", package="tacsim", syntax="proto3")
    pool = DescriptorPool()  # a separate one: names cannot clash with those of another library
    for known in (Vector3, Pose):
        _add_file(pool, known.DESCRIPTOR.file)
        file.dependency.append(known.DESCRIPTOR.file.name)
    for name, fields in _MESSAGES.items():
        message = file.message_type.add(name=name)
        for number, (field, words) in enumerate(fields.items(), 1):
            *label, kind = words.split()
            made = message.field.add(name=field, number=number, label=Field.LABEL_OPTIONAL)
            if kind in _NUMBERS:
                made.type = _NUMBERS[kind]
            else:
                made.type, made.type_name = Field.TYPE_MESSAGE, f".{kind}"
            if label == ["repeated"]:
                made.label = Field.LABEL_REPEATED
            elif label == ["optional"]:  # proto3 marks presence by a group of one
                made.proto3_optional, made.oneof_index = True, len(message.oneof_decl)
                message.oneof_decl.add(name=f"_{field}")
    pool.AddSerializedFile(file.SerializeToString())
    return {name: GetMessageClass(pool.FindMessageTypeByName(f"tacsim.{name}")) for name in _MESSAGES}


def _add_file(pool: DescriptorPool, file: Any) -> None:
    for needed in file.dependencies:
        _add_file(pool, needed)
    pool.AddSerializedFile(file.serialized_pb)


_made = _make_classes()
Arm, ArmPackage, Gripper, Scalar, Step = (_made[name] for name in ("Arm", "ArmPackage", "Gripper", "Scalar", "Step"))

# Two vectors of a message hold six numbers.
TWIST, WRENCH = ("linear", "angular"), ("force", "torque")
PACKAGE_FIELDS = (*_PACKAGE_NUMBERS, *_PACKAGE_JOINTS, *_PACKAGE_VECTORS)


def arm_message(time: float, twist: Sequence[float], wrench: Sequence[float], joints: Sequence[float] | None) -> Any:
    """An Arm. Raises ValueError for more than MAX_JOINTS joints."""
    made = Arm(time=time)
    _set_vectors(made, TWIST, twist)
    _set_vectors(made, WRENCH, wrench)
    if joints is not None:
        made.joints.SetInParent()
        _set_joints(made.joints, joints)
    return made


def package_message(row: Mapping[str, Any]) -> Any:
    """An ArmPackage of a package's fields. Raises ValueError for more than MAX_JOINTS joints."""
    made = ArmPackage(**{name: row[name] for name in _PACKAGE_NUMBERS})
    for name, pair in _PACKAGE_VECTORS.items():
        _set_vectors(made, pair, row[name])
    for name in _PACKAGE_JOINTS:
        _set_joints(getattr(made, name), row[name])
    return made


def package_row(package: Any) -> dict[str, Any]:
    """The fields of a package."""
    row = {name: getattr(package, name) for name in _PACKAGE_NUMBERS}
    row |= {name: vectors_of(package, pair) for name, pair in _PACKAGE_VECTORS.items()}
    return row | {name: joints_of(getattr(package, name)) for name in _PACKAGE_JOINTS}


def parse_message(kind: Any, data: bytes) -> Any:
    """A message of class `kind`. Raises ValueError if its first field is missing, since protobuf accepts other data."""
    made, first = kind.FromString(data), kind.DESCRIPTOR.fields[0].name
    if not made.HasField(first):
        raise ValueError(f"a message {kind.DESCRIPTOR.name} without its {first}")
    return made


def set_pose(message: Any, position: Sequence[float], quaternion: Sequence[float]) -> None:
    """Writes position [m] and quaternion (x, y, z, w) into `message.pose`."""
    pose = message.pose
    pose.position.x, pose.position.y, pose.position.z = position
    pose.orientation.x, pose.orientation.y, pose.orientation.z, pose.orientation.w = quaternion


def vectors_of(message: Any, pair: tuple[str, str]) -> list[float]:
    """The six numbers of two vectors of a message."""
    return [getattr(getattr(message, name), axis) for name in pair for axis in "xyz"]


def joints_of(joints: Any) -> list[float]:
    """The joints that are set, in order."""
    return [value for _, value in joints.ListFields()]


def _set_vectors(message: Any, pair: tuple[str, str], values: Sequence[float]) -> None:
    for number, value in enumerate(values):
        setattr(getattr(message, pair[number // 3]), "xyz"[number % 3], value)


def _set_joints(joints: Any, values: Sequence[float]) -> None:
    if len(values) > MAX_JOINTS:
        raise ValueError(f"an arm of {len(values)} joints; episodes have room for {MAX_JOINTS}")
    for number, value in enumerate(values):
        setattr(joints, f"joint_{number + 1}", value)
