"""A control step <-> its messages. Lossless: a decoded step equals the encoded one bit for bit."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.Grid_pb2 import Grid
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.message import DecodeError, Message
from google.protobuf.timestamp_pb2 import Timestamp

from tacsim.interface import Action, ArmState, Float32, GripperState, GripperTarget, Pose, SurfaceMap, TactileFrame
from tacsim.models.text import printable_line
from tacsim.record.episode import ArmPackages, EpisodeError, LazyRecords, Step
from tacsim.record.images import decode_image, encode_png
from tacsim.record.schemas import (
    BODY_TOPIC,
    PACKAGE_FIELDS,
    STEP_TOPIC,
    TWIST,
    WRENCH,
    Arm,
    ArmPackage,
    Gripper,
    Scalar,
    arm_message,
    joints_of,
    package_message,
    package_row,
    parse_message,
    set_pose,
    vectors_of,
)
from tacsim.record.schemas import Step as StepMessage

Messages = Mapping[str, Sequence[bytes]]  # of one step, by topic; only packages have several

WORLD = "world"  # the frame of all poses
_FLOAT = np.dtype("<f4")
_SURFACE_FIELDS = ("height", "gradient_x", "gradient_y")
_FLOW_FIELDS = ("flow_x", "flow_y")


@dataclass(frozen=True, slots=True)
class Encoded:
    """One message of a step."""

    topic: str
    schema: type[Message]
    log_time: int  # time in viewers: of its step, for a package its own; wall clock [ns]
    time: int  # time of its content, wall clock [ns]
    data: bytes


@dataclass(frozen=True, slots=True)
class _Clock:
    """Converts rig times to wall clock times."""

    step: int  # rig time of the step [ns]
    offset: int  # wall clock minus rig clock [ns]

    @property
    def now(self) -> int:
        return max(self.step + self.offset, 0)

    def __call__(self, seconds: float) -> int:
        """Wall clock time [ns] for viewers, never before 1970; /step and /{arm}/arm hold the exact rig time."""
        return max(nanoseconds(max(seconds, 0.0)) + self.offset, 0)


def nanoseconds(seconds: float) -> int:
    """Rig time [s] as MCAP time [ns]. Raises ValueError for times that MCAP cannot hold."""
    if not 0.0 <= seconds < 9e9:
        raise ValueError(f"time {seconds} s is outside 0 ... 9e9 s; rig clocks start at 0 or later")
    return round(seconds * 1e9)


def encode_step(step: Step, pitch: float, wall_offset: int = 0) -> list[Encoded]:
    """All messages of a step; the last one completes it. `pitch` of the surface grid is for viewers [m]; `wall_offset`:
    wall clock minus rig clock [ns].

    Raises ValueError for arrays of the wrong type or shape and for a step at a negative time.
    """
    messages: list[Encoded] = []
    clock = _Clock(nanoseconds(step.time), wall_offset)
    for name, frame in step.frames.items():
        messages += _encode_frame(name, frame, pitch, clock)
    for name, arm in step.arms.items():
        messages += _encode_arm(name, arm, clock)
    for name, gripper in step.grippers.items():
        data = Gripper(time=gripper.time, width=gripper.width, force=gripper.force).SerializeToString()
        messages.append(Encoded(f"/{name}/gripper", Gripper, clock.now, clock(gripper.time), data))
    for name, packages in step.packages.items():
        messages += _encode_packages(name, packages, clock)
    if step.body is not None:
        messages.append(Encoded(BODY_TOPIC, PointCloud, clock.now, clock.now, _encode_points(step.body, clock.now)))
    for key, value in step.info.items():
        data = Scalar(value=value).SerializeToString()
        messages.append(Encoded(f"{STEP_TOPIC}/{key}", Scalar, clock.now, clock.now, data))
    messages.append(Encoded(STEP_TOPIC, StepMessage, clock.now, clock.now, _step_message(step).SerializeToString()))
    return messages


def decode_step(
    data: bytes, messages: Messages, what: str = "a recording", sizes: dict[str, tuple[int, int]] | None = None
) -> Step:
    """The step from a /step message and the other messages of that step by topic. Its frames are decoded at access.
    Raises EpisodeError.

    Args:
        what: name of the recording in errors of its frames.
        sizes: rows and columns of the pictures by sensor, set by the first decoded one: others are refused.
    """
    try:
        record = parse_message(StepMessage, data)
        info = {key: parse_message(Scalar, _last_message(messages, f"{STEP_TOPIC}/{key}")).value for key in record.info}
        frames = {frame.sensor: frame for frame in record.frames}
        for frame in frames.values():
            for topic in _frame_topics(frame):
                _last_message(messages, topic)
        packages = {each.arm: each for each in record.packages}
        return Step(
            index=record.index,
            time=record.time,
            frames=LazyRecords(
                {name: frame.time for name, frame in frames.items()},
                partial(_decode_frame, frames, messages, what, {} if sizes is None else sizes),
            ),
            arms={name: _decode_arm(name, messages) for name in record.arms},
            action=Action(_decode_poses(record.asked), _decode_grips(record.asked_grips)) if record.acted else None,
            sent=_decode_poses(record.sent),
            reward=record.reward if record.HasField("reward") else None,
            distance=record.distance if record.HasField("distance") else None,
            info=info,
            seconds=record.seconds,
            body=_decode_points(_last_message(messages, BODY_TOPIC)) if record.body else None,
            grippers={name: _decode_gripper(name, messages) for name in record.grippers},
            sent_grippers=_decode_grips(record.sent_grips),
            packages=LazyRecords(
                {name: each.lost for name, each in packages.items()},
                partial(_decode_packages, packages, messages, what),
            ),
        )
    except EpisodeError:
        raise
    except (DecodeError, ValueError) as failure:
        raise EpisodeError(f"a step cannot be decoded: {failure}") from failure


def _step_message(step: Step) -> Any:
    made = StepMessage(index=int(step.index), time=step.time, seconds=step.seconds, acted=step.action is not None)
    if step.reward is not None:
        made.reward = step.reward
    if step.distance is not None:
        made.distance = step.distance
    for targets, poses in ((made.asked, step.action.tool if step.action else {}), (made.sent, step.sent)):
        for name, pose in poses.items():
            target = targets.add(arm=name)
            if pose is not None:
                set_pose(target, pose.position.tolist(), pose.quaternion.tolist())
    asked_grips = step.action.grippers if step.action else {}
    for grips, targets in ((made.asked_grips, asked_grips), (made.sent_grips, step.sent_grippers)):
        for name, each in targets.items():
            grips.add(gripper=name, **({} if each is None else {"width": each.width, "force": each.force}))
    made.grippers.extend(step.grippers)
    for name, frame in step.frames.items():
        surface = frame.surface
        flow = surface is not None and surface.flow is not None
        made.frames.add(sensor=name, time=frame.time, index=int(frame.index), surface=surface is not None, flow=flow)
    made.arms.extend(step.arms)
    made.body = step.body is not None
    made.info.extend(step.info)
    for name, packages in step.packages.items():
        made.packages.add(arm=name, count=len(packages.stamp), lost=packages.lost)
    return made


def _last_message(messages: Messages, topic: str) -> bytes:
    found = messages.get(topic)
    if not found:
        raise EpisodeError(f"a step names the message '{printable_line(topic, 200)}', which is missing")
    return found[-1]


def _encode_frame(name: str, frame: TactileFrame, pitch: float, clock: _Clock) -> Iterator[Encoded]:
    time = clock(frame.time)
    stamp = _timestamp(time)
    image = CompressedImage(timestamp=stamp, frame_id=name, data=encode_png(frame.image), format="png")
    yield Encoded(f"/{name}/image", CompressedImage, clock.now, time, image.SerializeToString())
    if frame.surface is None:
        return
    surface = frame.surface
    width = pitch * surface.height.shape[-1]  # [m] of the whole map
    cells = _join_arrays(name, _SURFACE_FIELDS, surface.height[..., None], surface.gradient)
    yield Encoded(f"/{name}/surface", Grid, clock.now, time, _encode_grid(name, stamp, cells, _SURFACE_FIELDS, width))
    rows, columns = surface.height.shape
    height = RawImage(timestamp=stamp, frame_id=name, width=columns, height=rows, encoding="32FC1", step=4 * columns)
    height.data = (1e3 * surface.height).astype(_FLOAT).tobytes()
    yield Encoded(f"/{name}/height", RawImage, clock.now, time, height.SerializeToString())
    if surface.flow is not None:
        cells = _join_arrays(name, _FLOW_FIELDS, surface.flow)
        yield Encoded(f"/{name}/flow", Grid, clock.now, time, _encode_grid(name, stamp, cells, _FLOW_FIELDS, width))


def _frame_topics(record: Any) -> list[str]:
    """The topics of a frame's messages."""
    present = {"image": True, "surface": record.surface, "flow": record.surface and record.flow}
    return [f"/{record.sensor}/{part}" for part, is_there in present.items() if is_there]


def _decode_frame(
    records: Mapping[str, Any],
    messages: Messages,
    what: str,
    sizes: dict[str, tuple[int, int]],
    name: str,
) -> TactileFrame:
    record = records[name]
    try:
        image = CompressedImage.FromString(_last_message(messages, f"/{name}/image"))
        surface = None
        if record.surface:
            cells = _decode_grid(_last_message(messages, f"/{name}/surface"), _SURFACE_FIELDS)
            flow = _decode_grid(_last_message(messages, f"/{name}/flow"), _FLOW_FIELDS) if record.flow else None
            surface = SurfaceMap(height=cells[..., 0].copy(), gradient=cells[..., 1:].copy(), flow=flow)
        pixels = decode_image(image.data, f"/{name}/image", formats=("PNG",), size=sizes.get(name))
    except (EpisodeError, DecodeError, ValueError) as failure:
        raise EpisodeError(f"{what}: {failure}") from failure
    sizes.setdefault(name, pixels.shape[:2])
    return TactileFrame(image=pixels, time=record.time, index=record.index, surface=surface)


def _join_arrays(name: str, fields: tuple[str, ...], *arrays: Float32) -> Float32:
    """(h, w, fields) float32 from arrays that share (h, w). Raises ValueError for any other type or shape."""
    shapes = ", ".join(f"{array.shape} {array.dtype}" for array in arrays)
    rows_columns = {array.shape[:2] for array in arrays}
    channels = sum(array.shape[-1] for array in arrays)
    if any(array.dtype != np.float32 or array.ndim != 3 or array.size == 0 for array in arrays):
        raise ValueError(f"{'/'.join(fields)} of sensor '{name}' must be float32 maps, got {shapes}")
    if len(rows_columns) != 1 or channels != len(fields):
        raise ValueError(f"{'/'.join(fields)} of sensor '{name}' do not belong together: {shapes}")
    return np.concatenate(arrays, axis=-1)


def _encode_grid(name: str, stamp: Timestamp, cells: Float32, fields: tuple[str, ...], width: float) -> bytes:
    rows, columns, channels = cells.shape
    stride = channels * _FLOAT.itemsize
    pitch = width / columns
    grid = Grid(timestamp=stamp, frame_id=name, column_count=columns, row_stride=columns * stride, cell_stride=stride)
    grid.cell_size.x = grid.cell_size.y = pitch
    grid.pose.position.x, grid.pose.position.y = -columns * pitch / 2, -rows * pitch / 2
    grid.pose.orientation.w = 1.0
    for number, field in enumerate(fields):
        grid.fields.add(name=field, offset=number * _FLOAT.itemsize, type=PackedElementField.FLOAT32)
    grid.data = cells.astype(_FLOAT, copy=False).tobytes()
    return grid.SerializeToString()


def _decode_grid(data: bytes, fields: tuple[str, ...]) -> Float32:
    grid = Grid.FromString(data)
    layout = tuple((field.name, field.offset, field.type) for field in grid.fields)
    expected = tuple((name, i * _FLOAT.itemsize, PackedElementField.FLOAT32) for i, name in enumerate(fields))
    stride = len(fields) * _FLOAT.itemsize
    columns = grid.column_count
    if layout != expected or grid.cell_stride != stride or grid.row_stride != columns * stride or columns == 0:
        raise EpisodeError(f"a grid of {'/'.join(fields)} has another layout: {layout}")
    if len(grid.data) == 0 or len(grid.data) % grid.row_stride:
        raise EpisodeError(f"a grid of {'/'.join(fields)} has {len(grid.data)} bytes, rows have {grid.row_stride}")
    cells = np.frombuffer(grid.data, dtype=_FLOAT).reshape(-1, columns, len(fields))
    return cells.astype(np.float32)


def _encode_points(points: Float32, time: int) -> bytes:
    """(n, 3) [m], in the world's frame. Raises ValueError for any other type or shape."""
    if points.dtype != np.float32 or points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"particles of the body must be (n, 3) float32, got {points.shape} {points.dtype}")
    cloud = PointCloud(timestamp=_timestamp(time), frame_id=WORLD, point_stride=3 * _FLOAT.itemsize)
    cloud.pose.orientation.w = 1.0
    for number, axis in enumerate("xyz"):
        cloud.fields.add(name=axis, offset=number * _FLOAT.itemsize, type=PackedElementField.FLOAT32)
    cloud.data = points.astype(_FLOAT, copy=False).tobytes()
    return cloud.SerializeToString()


def _decode_points(data: bytes) -> Float32:
    cloud = PointCloud.FromString(data)
    if cloud.point_stride != 3 * _FLOAT.itemsize or len(cloud.data) % cloud.point_stride:
        raise EpisodeError(f"particles of the body: {len(cloud.data)} bytes, of {cloud.point_stride} each")
    return np.frombuffer(cloud.data, dtype=_FLOAT).reshape(-1, 3).astype(np.float32)


def _encode_arm(name: str, arm: ArmState, clock: _Clock) -> Iterator[Encoded]:
    time = clock(arm.time)
    stamp = _timestamp(time)
    pose = PoseInFrame(timestamp=stamp, frame_id=WORLD)
    set_pose(pose, arm.pose.position.tolist(), arm.pose.quaternion.tolist())
    yield Encoded(f"/{name}/pose", PoseInFrame, clock.now, time, pose.SerializeToString())
    transform = FrameTransform(timestamp=stamp, parent_frame_id=WORLD, child_frame_id=name)
    transform.translation.x, transform.translation.y, transform.translation.z = arm.pose.position.tolist()
    transform.rotation.CopyFrom(pose.pose.orientation)
    yield Encoded(f"/{name}/transform", FrameTransform, clock.now, time, transform.SerializeToString())
    joints = None if arm.joints is None else arm.joints.tolist()
    message = arm_message(arm.time, arm.twist.tolist(), arm.wrench.tolist(), joints)
    yield Encoded(f"/{name}/arm", Arm, clock.now, time, message.SerializeToString())


def _decode_arm(name: str, messages: Messages) -> ArmState:
    pose = PoseInFrame.FromString(_last_message(messages, f"/{name}/pose")).pose
    arm = parse_message(Arm, _last_message(messages, f"/{name}/arm"))
    return ArmState(
        pose=_decode_pose(pose),
        twist=np.array(vectors_of(arm, TWIST)),
        wrench=np.array(vectors_of(arm, WRENCH)),
        joints=np.array(joints_of(arm.joints)) if arm.HasField("joints") else None,
        time=arm.time,
    )


def _decode_gripper(name: str, messages: Messages) -> GripperState:
    gripper = parse_message(Gripper, _last_message(messages, f"/{name}/gripper"))
    return GripperState(gripper.width, gripper.force if gripper.HasField("force") else None, gripper.time)


def _decode_grips(grips: Any) -> dict[str, GripperTarget | None]:
    return {each.gripper: GripperTarget(each.width, each.force) if each.HasField("width") else None for each in grips}


def _encode_packages(name: str, packages: ArmPackages, clock: _Clock) -> Iterator[Encoded]:
    columns = {field: getattr(packages, field).tolist() for field in PACKAGE_FIELDS}
    for values in zip(*columns.values(), strict=True):
        message = package_message(dict(zip(columns, values, strict=True)))
        time = clock(message.time)
        yield Encoded(f"/{name}/packages", ArmPackage, time, time, message.SerializeToString())


def _decode_packages(records: Mapping[str, Any], messages: Messages, what: str, name: str) -> ArmPackages:
    present, record = messages.get(f"/{name}/packages", ()), records[name]
    if len(present) != record.count:
        raise EpisodeError(f"{what}: it names {record.count} packages of arm '{name}', but has {len(present)}")
    try:
        rows = [package_row(parse_message(ArmPackage, data)) for data in present]
        return ArmPackages.from_columns({field: [row[field] for row in rows] for field in PACKAGE_FIELDS}, record.lost)
    except (DecodeError, ValueError) as failure:
        raise EpisodeError(f"{what}: a package of arm '{name}' cannot be decoded: {failure}") from failure


def _decode_poses(targets: Any) -> dict[str, Pose | None]:
    return {target.arm: _decode_pose(target.pose) if target.HasField("pose") else None for target in targets}


def _decode_pose(pose: Any) -> Pose:
    place, turn = pose.position, pose.orientation
    return Pose(np.array([place.x, place.y, place.z]), np.array([turn.x, turn.y, turn.z, turn.w]))


def _timestamp(time: int) -> Timestamp:
    return Timestamp(seconds=time // 10**9, nanos=time % 10**9)
