"""Damaged and hostile files: the reader gives the steps before the damage or raises EpisodeError, nothing else."""

from __future__ import annotations

import struct
import tracemalloc
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.Grid_pb2 import Grid
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer

from tacsim.record import writer
from tacsim.record.episode import Episode, EpisodeError, EpisodeMeta, Step
from tacsim.record.messages import Encoded, decode_step, encode_step
from tacsim.record.reader import read_episode
from tacsim.record.schemas import META, Scalar, add_checksum, encode_meta
from tacsim.record.writer import Recorder


@pytest.fixture
def small(tmp_path: Path, meta: EpisodeMeta, make_step: Callable[..., Step]) -> Path:
    """An episode of three steps with tiny pictures."""
    path = tmp_path / "small.mcap"
    with Recorder(path, replace(meta, attachments={"rig.yaml": b"name: sim\n"})) as recorder:
        for k in range(3):
            step = make_step(k, image=(4, 4), grid=(2, 2))
            recorder.write(replace(step, frames={"lower": step.frames["lower"]}, arms={}))
    return path


def image_of(step: Step) -> bytes:
    return step.frames["lower"].image.tobytes()


def is_prefix(episode: Episode, whole: Episode) -> bool:
    """Same facts, and the first steps with the same content."""
    return (
        episode.meta.spec == whole.meta.spec
        and (episode.meta.seed, episode.meta.attachments) == (whole.meta.seed, whole.meta.attachments)
        and len(episode.steps) <= len(whole.steps)
        and all(
            (a.index, a.time, a.reward, image_of(a)) == (b.index, b.time, b.reward, image_of(b))
            for a, b in zip(episode.steps, whole.steps, strict=False)
        )
    )


def read_or_refuse(path: Path, data: bytes) -> Episode | None:
    path.write_bytes(data)
    try:
        return read_episode(path)
    except EpisodeError:
        return None


def records(data: bytes) -> list[tuple[int, int]]:
    """Place and opcode of the top-level records."""
    found, place = [], len(MCAP0_MAGIC)
    while place < len(data) - len(MCAP0_MAGIC):
        opcode, length = struct.unpack_from("<BQ", data, place)
        found.append((place, opcode))
        place += 9 + length
    return found


@pytest.mark.slow
def test_a_cut_anywhere_leaves_the_steps_before_it(small: Path, tmp_path: Path) -> None:
    """At each byte round the beginning of a record, and at every eleventh between."""
    data, whole = small.read_bytes(), read_episode(small)
    whole.steps = list(whole.steps)
    assert len(whole.steps) == 3
    counts = []
    edges = {place + offset for place, _ in records(data) for offset in range(-12, 13)} | set(range(0, len(data), 11))
    for length in sorted(edge for edge in edges if 0 <= edge < len(data)):
        episode = read_or_refuse(tmp_path / "cut.mcap", data[:length])
        if episode is None:
            counts.append(-1)
            continue
        assert is_prefix(episode, whole)
        assert not episode.complete
        counts.append(len(episode.steps))
    assert counts == sorted(counts)  # a longer file never has fewer steps
    assert set(counts) == {-1, 0, 1, 2, 3}


@pytest.mark.slow
def test_a_changed_byte_never_goes_unseen(small: Path, tmp_path: Path) -> None:
    data, whole = small.read_bytes(), read_episode(small)
    whole.steps = list(whole.steps)
    rng = np.random.default_rng(0)
    outcomes = []
    places = {place + offset for place, _ in records(data) for offset in range(9)} | set(range(0, len(data), 17))
    for place in sorted(place for place in places if place < len(data)):
        damaged = bytearray(data)
        damaged[place] ^= int(rng.integers(1, 256))
        episode = read_or_refuse(tmp_path / "flipped.mcap", bytes(damaged))
        outcomes.append(-1 if episode is None else len(episode.steps))
        assert episode is None or is_prefix(episode, whole)
        assert episode is None or not episode.complete or len(episode.steps) == 3
    assert set(outcomes) == {-1, 0, 1, 2, 3}


@pytest.mark.slow
def test_garbage_in_the_middle(small: Path, tmp_path: Path) -> None:
    data, whole = small.read_bytes(), read_episode(small)
    whole.steps = list(whole.steps)
    rng = np.random.default_rng(1)
    for _ in range(100):
        begin = int(rng.integers(0, len(data)))
        length = int(rng.integers(1, 200))
        for damaged in (
            data[:begin] + rng.bytes(length) + data[begin + length :],  # overwritten
            data[:begin] + data[begin + length :],  # lost
            data[:begin] + rng.bytes(length) + data[begin:],  # inserted
        ):
            episode = read_or_refuse(tmp_path / "garbage.mcap", damaged)
            assert episode is None or is_prefix(episode, whole)


def test_a_step_lost_in_the_middle_ends_the_episode(small: Path, tmp_path: Path) -> None:
    """The chunk of step 1 turned into a record that readers skip: step 2 must not follow step 0."""
    data = bytearray(small.read_bytes())
    chunks = [place for place, opcode in records(data) if opcode == 0x06]
    data[chunks[1]] = 0x07  # message index
    episode = read_or_refuse(tmp_path / "lost.mcap", bytes(data))
    assert episode is not None
    assert [step.index for step in episode.steps] == [0]
    assert not episode.complete


def test_changed_byte_of_message_is_detected(small: Path, tmp_path: Path) -> None:
    """It would still be a valid message: only the checksum of its chunk tells."""
    data = bytearray(small.read_bytes())
    residual = Scalar(value=read_episode(small).steps[1].info["residual"]).SerializeToString()
    data[data.index(residual) + len(residual) - 1] ^= 0x80  # its sign
    episode = read_or_refuse(tmp_path / "digit.mcap", bytes(data))
    assert episode is not None
    assert [step.index for step in episode.steps] == [0]


def test_a_step_is_not_completed_with_messages_of_another(
    tmp_path: Path, meta: EpisodeMeta, make_step: Callable[..., Step], monkeypatch: pytest.MonkeyPatch
) -> None:
    def forgetful(step: Step, pitch: float, offset: int) -> list[Encoded]:
        return [m for m in encode_step(step, pitch, offset) if step.index == 0 or m.topic != "/lower/image"]

    monkeypatch.setattr(writer, "encode_step", forgetful)
    with Recorder(tmp_path / "e.mcap", meta) as recorder:
        recorder.write(make_step(0))
        recorder.write(make_step(1))
    with pytest.raises(EpisodeError, match=r"step number 1: a step names the message '/lower/image', which is missing"):
        read_episode(tmp_path / "e.mcap")


@pytest.mark.parametrize("opcode", range(1, 16))
def test_a_lying_length_allocates_nothing(small: Path, tmp_path: Path, opcode: int) -> None:
    lie = MCAP0_MAGIC + struct.pack("<BQ", opcode, 2**62)
    inner = MCAP0_MAGIC + struct.pack("<BQ", opcode, 64) + struct.pack("<16I", *[2**32 - 1] * 16)
    tracemalloc.start()
    try:
        for data in (lie, inner, small.read_bytes()[:-200] + inner[8:]):
            read_or_refuse(tmp_path / "lie.mcap", data)
        assert tracemalloc.get_traced_memory()[1] < 4 << 20
    finally:
        tracemalloc.stop()


def test_file_that_is_no_episode_is_refused_with_reason(tmp_path: Path, meta: EpisodeMeta) -> None:
    with pytest.raises(EpisodeError, match="no such file"):
        read_episode(tmp_path / "missing.mcap")
    with pytest.raises(EpisodeError, match="is a folder; name the episode"):
        read_episode(tmp_path)
    for content, message in (
        (b"", "magic"),
        (b"hello world, this is text", "magic"),
        (MCAP0_MAGIC, "metadata are missing"),
    ):
        (tmp_path / "x.mcap").write_bytes(content)
        with pytest.raises(EpisodeError, match=message):
            read_episode(tmp_path / "x.mcap")


def test_other_formats_and_compressed_chunks_are_named(tmp_path: Path, meta: EpisodeMeta) -> None:
    config = encode_meta(replace(meta, attachments={}))
    with (tmp_path / "zstd.mcap").open("wb") as file:
        stock = Writer(file, compression=CompressionType.ZSTD)
        stock.start()
        stock.add_metadata(META, config)
        stock.add_message(stock.register_channel("/step", "json", 0), 0, b"{}", 0)
        stock.finish()
    with pytest.raises(EpisodeError, match="mcap decompress"):
        read_episode(tmp_path / "zstd.mcap")
    for other in ("1", "3"):
        with (tmp_path / "other.mcap").open("wb") as file:
            stock = Writer(file, compression=CompressionType.NONE)
            stock.start()
            changed = {key: value for key, value in config.items() if key != "crc32"} | {"format": other}
            stock.add_metadata(META, add_checksum(changed))
            stock.finish()
        with pytest.raises(EpisodeError, match=f"episode format '{other}', but this tacsim reads 2"):
            read_episode(tmp_path / "other.mcap")


@pytest.mark.parametrize("compression", [CompressionType.NONE, CompressionType.ZSTD, CompressionType.LZ4])
@pytest.mark.parametrize("profile", ["ros2", ""])
def test_recording_of_another_program_is_reported_with_its_topics(
    tmp_path: Path, compression: CompressionType, profile: str
) -> None:
    path = tmp_path / "bag_0.mcap"
    with path.open("wb") as file:
        stock = Writer(file, compression=compression)
        stock.start(profile=profile)
        schema = stock.register_schema("sensor_msgs/msg/CompressedImage", "ros2msg", b"string format\nuint8[] data")
        channel = stock.register_channel("/finger/image/compressed", "cdr", schema)
        for k in range(3):
            stock.add_message(channel, k, b"\0\1\0\0" + bytes(40), k)
        stock.finish()
    kind = "a ROS 2 bag" if profile else "a recording of another program"
    message = rf"{kind} in MCAP.* /finger/image/compressed \(sensor_msgs/msg/CompressedImage\)\. Export"
    with pytest.raises(EpisodeError, match=message):
        read_episode(path)
    path.write_bytes(path.read_bytes()[:-200])  # cut off
    if profile:
        with pytest.raises(EpisodeError, match=r"a ROS 2 bag .* not listed"):
            read_episode(path)


def hostile(make_step: Callable[..., Step]) -> tuple[bytes, dict[str, bytes]]:
    messages = {message.topic: message.data for message in encode_step(make_step(1), 1e-3)}
    return messages.pop("/step"), messages


def decoded(step: bytes, messages: dict[str, bytes]) -> Step:
    """With all its frames."""
    found = decode_step(step, {topic: [data] for topic, data in messages.items()})
    dict(found.frames)
    return found


def test_a_huge_picture_is_refused_before_it_is_decoded(make_step: Callable[..., Step]) -> None:
    step, messages = hostile(make_step)
    image = CompressedImage.FromString(messages["/lower/image"])
    header = bytearray(image.data)
    header[16:24] = struct.pack(">II", 5000, 5000)
    header[29:33] = struct.pack(">I", zlib.crc32(bytes(header[12:29])))
    messages["/lower/image"] = CompressedImage(data=bytes(header), format="png").SerializeToString()
    with pytest.raises(EpisodeError, match=r"/lower/image: 5000 x 5000 pixels; .* at most 4096"):
        decoded(step, messages)


@pytest.mark.parametrize(
    ("topic", "content"),
    [
        ("/lower/image", b"\xff\xff"),
        ("/lower/image", CompressedImage(data=b"\x89PNG\r\n\x1a\nrest").SerializeToString()),
        ("/lower/surface", Grid().SerializeToString()),
        ("/lower/surface", Grid(column_count=2**31, data=b"0").SerializeToString()),
        ("/upper/arm", b""),
        ("/upper/arm", b'{"twist": [1, 2], "wrench": []}'),
        ("/step/residual", b""),
        ("/upper/arm", b"[" * 100_000),
        ("/upper/pose", b""),
    ],
)
def test_hostile_content_is_refused(make_step: Callable[..., Step], topic: str, content: bytes) -> None:
    step, messages = hostile(make_step)
    decoded(step, messages)
    with pytest.raises(EpisodeError):
        decoded(step, {**messages, topic: content})


def test_a_step_without_its_messages_is_refused(make_step: Callable[..., Step]) -> None:
    step, messages = hostile(make_step)
    for topic in messages:
        if topic.endswith(("/height", "/transform")):  # for viewers; the same is in /surface and /pose
            continue
        rest = {name: data for name, data in messages.items() if name != topic}
        with pytest.raises(EpisodeError, match=topic):
            decoded(step, rest)
    for content in (b"", b"null", b"{}", b"\xff", step[:-1], b"1" * 10_000):
        with pytest.raises(EpisodeError):
            decoded(content, messages)
