"""ROS 2 bags in MCAP: topics of compressed pictures are replayed; everything else about them is a clear error."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from mcap.writer import CompressionType
from mcap_ros2.writer import Writer

from tacsim.interface import EndOfEpisode
from tacsim.record.episode import EpisodeError
from tacsim.record.replay import ReplayClock, ReplaySensor, match_sources, recorded_period
from tacsim.record.ros_bag import COMPRESSED_IMAGE, DEFINITION
from tests.tacsim.record.replayed import picture, sensor_facts

TOPIC = "/finger/image/compressed"
PNG, JPEG = "rgb8; png compressed bgr8", "jpeg"
Message = tuple[str, bytes]  # format, data


def encoded(k: int, ending: str = ".png", size: tuple[int, int] = (20, 30)) -> bytes:
    return cv2.imencode(ending, cv2.cvtColor(picture(k, size), cv2.COLOR_RGB2BGR))[1].tobytes()


def write_bag(
    path: Path,
    topics: dict[str, Sequence[Message]],
    *,
    compression: CompressionType = CompressionType.NONE,
    stamped: bool = True,
    first: int = 0,
) -> Path:
    """A bag with a message every 20 ms. `stamped`: headers have the time; otherwise 0."""
    with path.open("wb") as file:
        writer = Writer(file, compression=compression)
        kind = writer.register_msgdef(COMPRESSED_IMAGE, DEFINITION.decode())
        other = writer.register_msgdef("std_msgs/msg/Float64", "float64 data")
        writer.write_message("/force", other, {"data": 1.5}, log_time=0)
        for topic, messages in topics.items():
            for k, (form, data) in enumerate(messages, start=first):
                stamp = {"sec": k // 50, "nanosec": 20_000_000 * (k % 50)} if stamped else {"sec": 0, "nanosec": 0}
                content: Any = {"header": {"stamp": stamp, "frame_id": "gel"}, "format": form, "data": data}
                writer.write_message(topic, kind, content, log_time=20_000_000 * k + 1000)
        writer.finish()
    return path


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    return write_bag(tmp_path / "bag_0.mcap", {TOPIC: [(PNG, encoded(k)) for k in range(3)]})


def replayed(path: Path, **more: object) -> ReplaySensor:
    return ReplaySensor(sensor_facts(path, **more), "finger", ReplayClock(0.02))


def play(path: Path, **more: object) -> list[np.ndarray]:
    clock = ReplayClock(0.02)
    sensor = ReplaySensor(sensor_facts(path, **more), "finger", clock)
    images = []
    while True:
        try:
            frame = sensor.read(0.0)
        except EndOfEpisode:
            return images
        assert frame.time == pytest.approx(clock.now()) and frame.index == len(images)
        images.append(frame.image)
        clock.tick()


@pytest.mark.parametrize("compression", list(CompressionType))
def test_the_pictures_of_the_only_topic_are_played(tmp_path: Path, compression: CompressionType) -> None:
    path = write_bag(tmp_path / "b.mcap", {TOPIC: [(PNG, encoded(k)) for k in range(3)]}, compression=compression)
    assert all(np.array_equal(image, picture(k)) for k, image in enumerate(play(path)))
    assert len(play(path)) == 3
    assert recorded_period(sensor_facts(path), "finger") == pytest.approx(0.02)


@pytest.mark.parametrize("form", [JPEG, "jpg", "bgr8; jpeg compressed bgr8"])
def test_jpeg(tmp_path: Path, form: str) -> None:
    (image,) = play(write_bag(tmp_path / "b.mcap", {TOPIC: [(form, encoded(5, ".jpg"))]}))
    assert np.abs(image.astype(int) - picture(5)).max() < 8


def test_a_folder_of_a_bag_is_played_file_by_file(tmp_path: Path) -> None:
    folder = tmp_path / "drive"
    folder.mkdir()
    (folder / "metadata.yaml").write_text("rosbag2_bagfile_information:\n  version: 8\n")
    for part in (0, 10):  # drive_10 comes after drive_9, of which there is none
        write_bag(folder / f"drive_{part}.mcap", {TOPIC: [(PNG, encoded(part + k)) for k in range(2)]}, first=part)
    assert [int(image[0, 0, 0]) for image in play(folder)] == [0, 10, 100, 110]


def test_times_of_the_log_count_where_headers_have_none(tmp_path: Path) -> None:
    frames = [(PNG, encoded(k)) for k in range(3)]
    path = write_bag(tmp_path / "b.mcap", {TOPIC: frames}, stamped=False)
    assert recorded_period(sensor_facts(path), "finger") == pytest.approx(0.02)
    one = write_bag(tmp_path / "one.mcap", {TOPIC: frames[:1]})
    assert recorded_period(sensor_facts(one, fps=25.0), "finger") == pytest.approx(0.04)


def test_of_several_topics_one_is_chosen(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "b.mcap", {"/left": [(PNG, encoded(1))], "/right": [(PNG, encoded(7))]})
    assert play(path, topic="/right")[0][0, 0, 0] == 70
    for topic, said in [
        (None, r"several topics with compressed pictures: /left, /right; choose one: sensors\.finger\.topic=TOPIC"),
        ("/rigth", r"sensors\.finger\.topic: '/rigth' is not in .*did you mean '/right'\?; topics .*: /left, /right"),
        ("/force", r"'/force' is of type std_msgs/msg/Float64; topics with compressed pictures: /left, /right"),
    ]:
        with pytest.raises(EpisodeError, match=said):
            replayed(path, topic=topic)


def test_topics_of_one_rig_need_the_same_number_of_pictures(tmp_path: Path) -> None:
    frames = [(PNG, encoded(k)) for k in range(3)]
    path = write_bag(tmp_path / "b.mcap", {"/left": frames, "/right": frames[:2]})
    left, right = (replayed(path, topic=topic) for topic in ("/left", "/right"))
    with pytest.raises(EpisodeError, match=r"b\.mcap: /left has 3; .*b\.mcap: /right has 2\. Which"):
        match_sources({"left": left, "right": right}, {})


@pytest.mark.parametrize(
    ("messages", "said"),
    [
        ([("h264", b"\0\0\0\1")], "message 0: format 'h264'; pictures in jpeg or png are read"),
        ([("", encoded(0))], "message 0: format ''; pictures in jpeg or png"),
        ([("16UC1; compressedDepth png", encoded(0))], "format '16UC1; compressedDepth png'"),
        ([("jpeg; png", encoded(0))], "format 'jpeg; png'"),
        ([(JPEG, encoded(0))], r"message 0: no readable picture \(JPEG\)"),
        ([(PNG, encoded(0)[:-30])], r"message 0: no readable picture \(PNG\)"),
        ([(JPEG, encoded(0, ".jpg")[:300])], r"message 0: no readable picture \(JPEG\)"),
        ([(PNG, b"")], "message 0: no picture in the message"),
        ([(PNG, cv2.imencode(".png", np.zeros((4, 4), np.uint16))[1].tobytes())], "message 0: 16 bits a channel"),
        ([(PNG, encoded(0)), (PNG, encoded(1)[:-30])], "message 1: no readable picture"),
        ([(PNG, encoded(0)), (PNG, encoded(1, size=(10, 10)))], r"frame 1 has \(10, 10\) rows and columns"),
    ],
)
def test_pictures_that_cannot_be_read(tmp_path: Path, messages: list[Message], said: str) -> None:
    path = write_bag(tmp_path / "b.mcap", {TOPIC: messages})
    with pytest.raises(EpisodeError, match=said):
        play(path)


def test_an_empty_topic(tmp_path: Path) -> None:
    path = tmp_path / "b.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        kind = writer.register_msgdef(COMPRESSED_IMAGE, DEFINITION.decode())
        writer._writer.register_channel(TOPIC, "cdr", kind.id)
        writer.finish()
    with pytest.raises(EpisodeError, match=f"topic '{TOPIC}' has no messages"):
        replayed(path)


def test_a_bag_without_compressed_pictures(tmp_path: Path) -> None:
    with pytest.raises(EpisodeError, match=r"no topic of type .*CompressedImage; it has: /force .*republish raw"):
        replayed(write_bag(tmp_path / "b.mcap", {}))


def test_a_bag_that_was_cut_off(bag: Path) -> None:
    bag.write_bytes(bag.read_bytes()[:-100])
    with pytest.raises(EpisodeError, match=r"bag_0\.mcap: cut off, or without an index; repair it: mcap recover"):
        replayed(bag)


def test_a_damaged_chunk_and_a_damaged_message(bag: Path, tmp_path: Path) -> None:
    data = bytearray(bag.read_bytes())
    data[data.index(encoded(1)) + 20] ^= 1
    bag.write_bytes(data)
    with pytest.raises(EpisodeError, match=r"bag_0\.mcap: damaged .*mcap recover"):
        replayed(bag)
    path = tmp_path / "short.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        kind = writer.register_msgdef(COMPRESSED_IMAGE, DEFINITION.decode())
        channel = writer._writer.register_channel(TOPIC, "cdr", kind.id)
        writer._writer.add_message(channel, 1, b"\0\1\0\0\1\0", 1)
        writer.finish()
    with pytest.raises(EpisodeError, match=f"{TOPIC}, message 0: no readable sensor_msgs/msg/CompressedImage"):
        replayed(path)


def test_a_bag_in_sqlite(tmp_path: Path) -> None:
    (tmp_path / "metadata.yaml").write_text("rosbag2_bagfile_information:\n  version: 8\n")
    (tmp_path / "drive_0.db3").write_bytes(b"SQLite format 3\0")
    with pytest.raises(EpisodeError, match=r"SQLite \(drive_0\.db3\); bags in MCAP are read: convert it"):
        replayed(tmp_path)


def test_a_topic_of_another_recording(tmp_path: Path) -> None:
    (tmp_path / "0.png").write_bytes(encoded(0))
    with pytest.raises(EpisodeError, match=r"sensors\.finger\.topic: a topic is one of a ROS 2 bag in MCAP"):
        replayed(tmp_path, topic=TOPIC)
