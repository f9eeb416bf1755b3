"""What is read equals what was written, bit for bit; and readers of others can read it too."""

from __future__ import annotations

import gc
import weakref
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from mcap_protobuf.decoder import DecoderFactory

from tacsim.interface import Pose, TactileFrame
from tacsim.record import messages
from tacsim.record.episode import EpisodeError, EpisodeMeta, Step
from tacsim.record.images import decode_image, encode_png, reference_attachments, reference_image
from tacsim.record.reader import iter_steps, read_episode
from tacsim.record.writer import Recorder


def same(a: object, b: object) -> bool:
    """Equal bit for bit, arrays with type and shape, through mappings, sequences and the contract's dataclasses."""
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
    if isinstance(a, float) and isinstance(b, float):
        return a.hex() == b.hex()
    if isinstance(a, Mapping) and isinstance(b, Mapping):
        return list(a) == list(b) and all(same(a[key], b[key]) for key in a)
    if hasattr(a, "__dataclass_fields__"):
        return type(a) is type(b) and all(same(getattr(a, f), getattr(b, f)) for f in a.__dataclass_fields__)
    return type(a) is type(b) and a == b


def record(path: Path, meta: EpisodeMeta, steps: list[Step]) -> None:
    with Recorder(path, meta) as recorder:
        for step in steps:
            assert recorder.write(step)
    assert recorder.error is None
    assert (recorder.written, recorder.dropped) == (len(steps), 0)


def test_episode_comes_back_bit_for_bit(tmp_path: Path, meta: EpisodeMeta, make_step: Callable[..., Step]) -> None:
    steps = [make_step(k) for k in range(4)]
    record(tmp_path / "e.mcap", meta, steps)
    episode = read_episode(tmp_path / "e.mcap")
    assert same(episode.meta, meta)
    assert episode.complete
    assert episode.dropped == 0
    assert [step.index for step in episode.steps] == [0, 1, 2, 3]
    for written, read in zip(steps, episode.steps, strict=True):
        assert same(read, written)
    assert episode.steps[0].frames["upper"].surface is not None
    assert episode.steps[0].frames["upper"].surface.flow is None
    assert episode.steps[0].frames["side"].surface is None
    assert episode.steps[0].action is None
    assert all(same(a, b) for a, b in zip(iter_steps(tmp_path / "e.mcap"), steps, strict=True))


def test_particles_of_a_body_come_back_bit_for_bit(
    tmp_path: Path, meta: EpisodeMeta, make_step: Callable[..., Step]
) -> None:
    steps = [make_step(k, body=k != 1) for k in range(3)]
    record(tmp_path / "e.mcap", meta, steps)
    episode = read_episode(tmp_path / "e.mcap")
    assert all(same(read, written) for read, written in zip(episode.steps, steps, strict=True))
    assert episode.steps[1].body is None
    with pytest.raises(ValueError, match=r"must be \(n, 3\) float32, got \(4, 2\) float32"):
        messages.encode_step(replace(steps[0], body=np.zeros((4, 2), np.float32)), 1e-3)


@pytest.mark.parametrize("goal", [None, 7e-3, (0.1, 0.2, 0.3)])
def test_facts_that_may_be_missing(tmp_path: Path, meta: EpisodeMeta, goal: float | tuple[float, ...] | None) -> None:
    config = replace(meta, goal=goal, task=None, attachments={}, versions={})
    record(tmp_path / "e.mcap", config, [])
    episode = read_episode(tmp_path / "e.mcap")
    assert same(episode.meta, config)
    assert episode.complete
    assert len(episode.steps) == 0


def test_a_unit_quaternion_keeps_its_bits() -> None:
    rng = np.random.default_rng(0)
    for _ in range(1000):
        quaternion = rng.normal(size=4)
        pose = Pose(np.zeros(3), quaternion / np.linalg.norm(quaternion))
        assert same(Pose(pose.position, pose.quaternion), pose)


def test_stock_reader_finds_order_types_and_content(
    tmp_path: Path, meta: EpisodeMeta, make_step: Callable[..., Step]
) -> None:
    steps = [make_step(k) for k in range(3)]
    record(tmp_path / "e.mcap", meta, steps)
    with (tmp_path / "e.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert summary.statistics.chunk_count == 3  # one a step
        names = {channel.topic: summary.schemas[channel.schema_id].name for channel in summary.channels.values()}
        assert names["/lower/image"] == "foxglove.CompressedImage"
        assert names["/lower/surface"] == names["/lower/flow"] == "foxglove.Grid"
        assert names["/upper/pose"] == "foxglove.PoseInFrame"
        assert names["/step"] == "tacsim.Step"
        topics = [channel.topic for _, channel, _ in reader.iter_messages()]
        assert len(topics) == 3 * 21
        assert topics[20::21] == ["/step"] * 3
        decoded = list(reader.iter_decoded_messages(topics=["/lower/image", "/lower/surface", "/upper/pose"]))
        image, surface, pose = (entry.decoded_message for entry in decoded[-3:])
        assert image.format == "png"
        assert image.frame_id == "lower"
        exposed = meta.wall_offset + round(steps[2].frames["lower"].time * 1e9)  # viewers show the date
        assert image.timestamp.seconds * 10**9 + image.timestamp.nanos == exposed
        assert decoded[-1].message.log_time == meta.wall_offset + round(steps[2].time * 1e9)
        assert [field.name for field in surface.fields] == ["height", "gradient_x", "gradient_y"]
        assert surface.cell_size.x == pytest.approx(0.25e-3)
        assert pose.frame_id == "world"
        assert pose.pose.position.z == steps[2].arms["upper"].pose.position[2]
        assert [a.name for a in reader.iter_attachments()] == list(meta.attachments)


def test_each_number_is_a_separate_field_for_viewers(
    tmp_path: Path, meta: EpisodeMeta, make_step: Callable[..., Step]
) -> None:
    """As a viewer decodes them: by the schemas in the file, without tacsim."""
    step = make_step(1, packages=True)
    record(tmp_path / "e.mcap", meta, [step])
    with (tmp_path / "e.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        found = {entry.channel.topic: entry.decoded_message for entry in reader.iter_decoded_messages()}
        assert {channel.message_encoding for _, channel, _ in reader.iter_messages()} == {"protobuf"}
    arm = step.arms["upper"]
    assert [getattr(found["/upper/arm"].force, axis) for axis in "xyz"] == arm.wrench[:3].tolist()
    assert [getattr(found["/upper/arm"].torque, axis) for axis in "xyz"] == arm.wrench[3:].tolist()
    assert [getattr(found["/upper/arm"].linear, axis) for axis in "xyz"] == arm.twist[:3].tolist()
    assert [getattr(found["/upper/arm"].angular, axis) for axis in "xyz"] == arm.twist[3:].tolist()
    assert arm.joints is not None
    assert [getattr(found["/upper/arm"].joints, f"joint_{k}") for k in range(1, 7)] == arm.joints.tolist()
    assert not found["/lower/arm"].HasField("joints")
    step_message = found["/step"]
    assert (step_message.index, step_message.reward, step_message.distance) == (1, step.reward, step.distance)
    assert {name: found[f"/step/{name}"].value for name in ("residual", "most", "hits")} == {
        name: step.info[name] for name in ("residual", "most", "hits")
    }
    package, sent = found["/upper/packages"], step.packages["upper"]
    row = sent.time.tolist().index(package.time)
    assert [getattr(package.tcp_rotation, axis) for axis in "xyz"] == sent.tcp_pose[row, 3:].tolist()
    assert (package.joint_speeds.joint_6, package.status) == (sent.joint_speeds[row, 5], sent.status[row])
    height, surface = found["/lower/height"], step.frames["lower"].surface
    assert surface is not None and (height.encoding, height.frame_id) == ("32FC1", "lower")
    pixels = np.frombuffer(height.data, "<f4").reshape(height.height, height.step // 4)
    assert pixels.shape == surface.height.shape and height.width == surface.height.shape[1]
    np.testing.assert_allclose(pixels, 1e3 * surface.height, rtol=1e-6)  # [mm]
    frame = found["/upper/transform"]
    assert (frame.parent_frame_id, frame.child_frame_id) == ("world", "upper")
    assert [getattr(frame.translation, axis) for axis in "xyz"] == arm.pose.position.tolist()
    assert [getattr(frame.rotation, axis) for axis in "xyzw"] == arm.pose.quaternion.tolist()


def test_an_arm_with_too_many_joints_ends_the_recording(
    tmp_path: Path, meta: EpisodeMeta, make_step: Callable[..., Step]
) -> None:
    step = make_step(1)
    arms = {**step.arms, "upper": replace(step.arms["upper"], joints=np.zeros(8))}
    with Recorder(tmp_path / "e.mcap", meta) as recorder:
        recorder.write(replace(step, arms=arms))
        recorder.flush()
        assert "an arm of 8 joints; episodes have room for 7" in str(recorder.error)
    assert len(read_episode(tmp_path / "e.mcap").steps) == 0


def test_png_holds_rgb_not_bgr() -> None:
    red = np.zeros((4, 5, 3), np.uint8)
    red[..., 0] = 255
    data = encode_png(red)
    assert np.array_equal(decode_image(data, "red"), red)
    assert cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[0, 0].tolist() == [0, 0, 255]  # BGR: red


def test_references_travel_as_attachments(tmp_path: Path, meta: EpisodeMeta) -> None:
    image = np.random.default_rng(0).integers(0, 256, (24, 32, 3), dtype=np.uint8)
    attachments = reference_attachments({"lower": TactileFrame(image, time=0.0, index=0)})
    record(tmp_path / "e.mcap", replace(meta, attachments=attachments), [])
    read = read_episode(tmp_path / "e.mcap").meta.attachments
    assert same(reference_image(read, "lower"), image)
    assert reference_image(read, "upper") is None


@pytest.mark.slow
def test_picture_is_decoded_at_access_and_not_stored(
    tmp_path: Path, meta: EpisodeMeta, make_step: Callable[..., Step], monkeypatch: pytest.MonkeyPatch
) -> None:
    record(tmp_path / "e.mcap", meta, [make_step(k) for k in range(5)])
    decoded: list[str] = []

    def counting(data: bytes, what: str, **options: Any) -> Any:
        decoded.append(what)
        return decode_image(data, what, **options)

    monkeypatch.setattr(messages, "decode_image", counting)
    episode = read_episode(tmp_path / "e.mcap")
    assert [step.exposed for step in episode.steps] == [
        {name: frame.time for name, frame in make_step(k).frames.items()} for k in range(5)
    ]
    assert decoded == []
    frame = weakref.ref(episode.steps[-1].frames["upper"].image)
    assert decoded == ["/upper/image"]
    gc.collect()
    assert frame() is None


def test_packages_of_arm_are_restored_with_their_times(
    tmp_path: Path, meta: EpisodeMeta, make_step: Callable[..., Step]
) -> None:
    steps = [make_step(k, packages=True) for k in range(4)]  # 0, 3, 6, 9 packages
    record(tmp_path / "e.mcap", meta, steps)
    episode = read_episode(tmp_path / "e.mcap")
    assert all(same(a, b) for a, b in zip(episode.steps, steps, strict=True))
    assert [step.packages["upper"].lost for step in episode.steps] == [0, 3, 6, 9]
    with (tmp_path / "e.mcap").open("rb") as file:
        found = list(make_reader(file).iter_messages(topics=["/upper/packages"]))
    times = np.sort(np.concatenate([step.packages["upper"].time for step in steps]))
    assert [message.log_time for _, _, message in found] == [meta.wall_offset + round(1e9 * each) for each in times]
    assert {schema.name for schema, _, _ in found if schema} == {"tacsim.ArmPackage"}


def test_a_step_is_read_by_its_number(tmp_path: Path, meta: EpisodeMeta, make_step: Callable[..., Step]) -> None:
    written = [make_step(k) for k in range(5)]
    record(tmp_path / "e.mcap", meta, written)
    steps = read_episode(tmp_path / "e.mcap").steps
    assert same(steps[3], written[3]) and same(steps[-1], written[4])
    assert all(same(a, b) for a, b in zip(steps[1:4:2], written[1:4:2], strict=True))
    with pytest.raises(IndexError):
        steps[5]
    (tmp_path / "e.mcap").unlink()
    with pytest.raises(EpisodeError, match="no such file"):
        steps[0]


def test_step_is_read_by_number_from_repacked_file(
    tmp_path: Path, meta: EpisodeMeta, make_step: Callable[..., Step]
) -> None:
    """Tools that copy MCAP files make chunks of their own: many steps in one, or none at all."""
    written = [make_step(k) for k in range(4)]
    record(tmp_path / "e.mcap", meta, written)
    for chunked in (True, False):
        path = tmp_path / f"packed-{chunked}.mcap"
        with (tmp_path / "e.mcap").open("rb") as file, path.open("wb") as packed:
            reader, writer = make_reader(file), Writer(packed, compression=CompressionType.NONE, use_chunking=chunked)
            writer.start()
            first, last = reader.iter_metadata()
            writer.add_metadata(first.name, first.metadata)
            for each in reader.iter_attachments():
                writer.add_attachment(each.create_time, each.log_time, each.name, each.media_type, each.data)
            numbers: dict[str, int] = {}
            for schema, channel, message in reader.iter_messages(log_time_order=False):
                assert schema is not None
                if channel.topic not in numbers:
                    kind = writer.register_schema(schema.name, schema.encoding, schema.data)
                    numbers[channel.topic] = writer.register_channel(channel.topic, channel.message_encoding, kind)
                writer.add_message(
                    numbers[channel.topic], message.log_time, message.data, message.publish_time, message.sequence
                )
            writer.add_metadata(last.name, last.metadata)
            writer.finish()
        assert read_episode(path).complete
        assert all(same(a, b) for a, b in zip(read_episode(path).steps, written, strict=True))


def test_pictures_of_one_sensor_have_one_size(
    tmp_path: Path, meta: EpisodeMeta, make_step: Callable[..., Step]
) -> None:
    record(tmp_path / "e.mcap", meta, [make_step(0), make_step(1, image=(48, 64))])
    steps = read_episode(tmp_path / "e.mcap").steps
    assert steps[0].frames["upper"].image.shape == (24, 32, 3)
    with pytest.raises(EpisodeError, match=r"step number 1: /upper/image: 64 x 48 pixels, but others .* 32 x 24"):
        steps[1].frames["upper"]
