"""Compressed pictures of ROS 2 bags: topics of type sensor_msgs/msg/CompressedImage in MCAP files."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import SeekingReader
from mcap.records import Message, Schema

from tacsim.interface import TactileFrame
from tacsim.models.text import suggest_word
from tacsim.record.episode import EpisodeError
from tacsim.record.images import decode_image
from tacsim.record.reader import open_file
from tacsim.record.records import listed_topics, read_profile
from tacsim.record.sources import visible_files

BAG_SUFFIX = ".mcap"
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
# The message as ROS 2 defines it (common_interfaces, rcl_interfaces); the definition in a file is not interpreted
DEFINITION = b"""std_msgs/Header header
string format
uint8[] data
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
PICTURE_FORMATS = {"jpeg": "JPEG", "jpg": "JPEG", "png": "PNG"}  # of Pillow, by words of a message's format
MAX_CHUNK = 256 << 20  # [bytes] of a decompressed chunk


def is_ros_bag(path: Path) -> bool:
    """True for the folder of a bag, and for an MCAP file of ROS 2 or with a topic of compressed pictures."""
    if path.is_dir():
        metadata = path / "metadata.yaml"
        return metadata.is_file() and b"rosbag2_bagfile_information" in _read_head(metadata)
    if path.suffix.lower() != BAG_SUFFIX or not path.is_file():
        return False
    with open_file(path) as file:
        return read_profile(file) == "ros2" or COMPRESSED_IMAGE in listed_topics(file).values()


def _read_head(path: Path) -> bytes:
    with open_file(path) as file:
        return file.read(200)


@dataclass(frozen=True, slots=True)
class PictureTopic:
    """One topic of compressed pictures. `files`: those of the bag, in the order in which they were recorded."""

    files: tuple[Path, ...]
    topic: str

    def frames(self) -> Iterator[TactileFrame]:
        """The pictures in order of their log time, decoded one by one; `time`: of their header [s].

        Raises EpisodeError for a damaged file, a message that cannot be read, a format other than JPEG and PNG, and a
        picture that cannot be decoded.
        """
        for index, (message, what) in enumerate(self._messages()):
            content = _decode_message(message, what)
            if not content.data:
                raise EpisodeError(f"{what}: no picture in the message")
            image = decode_image(content.data, what, (_picture_format(content.format, what),))
            yield TactileFrame(image=image, time=_header_time(content), index=index)

    def count(self) -> int:
        """Number of messages. Raises EpisodeError for a damaged file."""
        return sum(1 for _ in self._messages())

    def period(self) -> float | None:
        """Median time between two pictures [s], of the first ones: by the headers if their times increase, otherwise by
        the log. None if neither increases. Raises EpisodeError."""
        considered = 200  # pictures; a median needs no more
        first = islice(self._messages(), considered)
        times = [(_header_time(_decode_message(each, what)), each.log_time * 1e-9) for each, what in first]
        for steps in np.diff(np.array(times), axis=0).T:
            if len(steps) and steps.min() > 0.0:
                return float(np.median(steps))
        return None

    def _messages(self) -> Iterator[tuple[Message, str]]:
        """Each message, and its name for errors."""
        number = 0
        for path in self.files:
            for message in _read_messages(path, self.topic):
                yield message, f"{path}: {self.topic}, message {number}"
                number += 1


def _read_messages(path: Path, topic: str) -> Iterator[Message]:
    with open_file(path) as file:
        reader = SeekingReader(file, validate_crcs=True, record_size_limit=MAX_CHUNK)
        messages = _messages_of_topic(reader, path, topic)
        while True:
            try:
                message = next(messages)
            except StopIteration:
                return
            except EpisodeError:
                raise
            except Exception as failure:  # damaged bytes may lead to any error of the reader
                raise EpisodeError(f"{path}: damaged ({failure}); {_repair_advice(path)}") from failure
            yield message


def open_topic(path: Path, topic: str | None, option: str) -> PictureTopic:
    """The `topic` of a bag, or its only one with compressed pictures. option: where the topic is given, for errors.

    Raises EpisodeError for a file that is cut off, an unknown topic, none or several without a name, and an empty one.
    """
    files = _bag_files(path)
    topics: dict[str, str] = {}
    for each in files:
        with open_file(each) as file:
            found = listed_topics(file)
            if not found:
                raise EpisodeError(f"{each}: cut off, or without an index; {_repair_advice(each)}")
            topics.update(found)
    pictures = sorted(name for name, kind in topics.items() if kind == COMPRESSED_IMAGE)
    listed = ", ".join(pictures)
    if not pictures:
        others = ", ".join(f"{name} ({kind})" for name, kind in sorted(topics.items())[:20])
        raise EpisodeError(
            f"{path}: no topic of type {COMPRESSED_IMAGE}; it has: {others}. Raw images are compressed by: "
            "ros2 run image_transport republish raw compressed"
        )
    if topic is not None and topic not in pictures:
        wrong = f"is of type {topics[topic]}" if topic in topics else f"is not in {path}{suggest_word(topic, pictures)}"
        raise EpisodeError(f"{option}: '{topic}' {wrong}; topics with compressed pictures: {listed}")
    if topic is None and len(pictures) > 1:
        raise EpisodeError(f"{path}: several topics with compressed pictures: {listed}; choose one: {option}=TOPIC")
    chosen = PictureTopic(tuple(files), pictures[0] if topic is None else topic)
    if next(chosen._messages(), None) is None:
        raise EpisodeError(f"{path}: topic '{chosen.topic}' has no messages")
    return chosen


def _bag_files(path: Path) -> list[Path]:
    if path.is_file():
        return [path]
    if files := visible_files(path, (BAG_SUFFIX,)):
        return files
    if databases := visible_files(path, (".db3",)):
        raise EpisodeError(
            f"{path}: a ROS 2 bag in SQLite ({databases[0].name}); bags in MCAP are read: convert it with "
            "`ros2 bag convert`, storage_id: mcap"
        )
    raise EpisodeError(f"{path}: the folder of a ROS 2 bag without an MCAP file; decompress its files first")


def _repair_advice(path: Path) -> str:
    return f"repair it: mcap recover {path.name} -o repaired.mcap"


def _messages_of_topic(reader: SeekingReader, path: Path, topic: str) -> Iterator[Message]:
    summary = reader.get_summary()
    largest = max((each.uncompressed_size for each in summary.chunk_indexes), default=0) if summary else 0
    if largest > MAX_CHUNK:
        raise EpisodeError(f"{path}: a chunk of {largest} bytes; at most {MAX_CHUNK} are read")
    yield from (message for _, _, message in reader.iter_messages(topics=[topic]))


@cache
def _message_decoder() -> Any:
    from mcap_ros2.decoder import DecoderFactory

    return DecoderFactory().decoder_for("cdr", Schema(1, DEFINITION, "ros2msg", COMPRESSED_IMAGE))


def _decode_message(message: Message, what: str) -> Any:
    """The message, with `header`, `format` and `data`."""
    try:
        return _message_decoder()(message.data)
    except Exception as failure:  # damaged bytes may lead to any error of the decoder
        raise EpisodeError(f"{what}: no readable {COMPRESSED_IMAGE}: {failure}") from failure


def _header_time(content: Any) -> float:
    return float(content.header.stamp.sec) + 1e-9 * float(content.header.stamp.nanosec)


def _picture_format(text: str, what: str) -> str:
    """Pillow's name of the format of a message, such as "jpeg" or "rgb8; png compressed bgr8"."""
    words = re.findall(r"[a-z0-9]+", text.lower())
    found = {PICTURE_FORMATS[word] for word in words if word in PICTURE_FORMATS}
    if len(found) != 1 or "compresseddepth" in words:
        raise EpisodeError(f"{what}: format '{text}'; pictures in jpeg or png are read")
    return found.pop()
