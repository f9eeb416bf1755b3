"""Reads episodes, finished or cut off: as a whole, or step by step.

The readers of the `mcap` package need a finished file and trust the lengths in it. Here each length is checked
against the size of the file before anything is read; `mcap` parses the records themselves.
Format: https://mcap.dev/spec
"""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Callable, Container, Iterator
from dataclasses import replace
from pathlib import Path
from typing import BinaryIO, Self

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Footer, Header, McapRecord, Message, Metadata, Schema
from mcap.writer import MCAP0_MAGIC

from tacsim.interface import TactileFrame
from tacsim.record.episode import Episode, EpisodeError, EpisodeMeta, Step
from tacsim.record.messages import decode_step
from tacsim.record.schemas import CLOSE, META, STEP_TOPIC, decode_meta, unsealed

MAX_MEMORY = 4 << 30  # [bytes] of arrays in one episode in memory
MAX_RECORD = 256 << 20  # [bytes]
_HEAD = struct.Struct("<BQ")  # opcode, length
_PARSERS: dict[int, Callable[[ReadDataStream], McapRecord]] = {
    Opcode.HEADER: Header.read,
    Opcode.FOOTER: Footer.read,
    Opcode.SCHEMA: Schema.read,
    Opcode.CHANNEL: Channel.read,
    Opcode.CHUNK: Chunk.read,
    Opcode.ATTACHMENT: Attachment.read,
    Opcode.METADATA: Metadata.read,
}


def read_episode(path: Path | str, *, max_memory: int = MAX_MEMORY) -> Episode:
    """The whole episode. A file that is cut off or damaged gives the steps before that, and `complete` is False.

    Raises EpisodeError when there is no such file, it is no episode, or it exceeds `max_memory` [bytes] when decoded.
    """
    with EpisodeFile(path) as file:
        episode = Episode(meta=file.meta)
        memory = 0
        for step in file.steps():
            memory += sum(_memory(frame) for frame in step.frames.values())
            if memory > max_memory:
                raise EpisodeError(f"{path}: more than {max_memory} bytes decoded at step {step.index}; use iter_steps")
            episode.steps.append(step)
        episode.complete, episode.dropped = file.complete, file.dropped
        return episode


def iter_steps(path: Path | str) -> Iterator[Step]:
    """The steps of an episode, one at a time in memory. Raises EpisodeError like `read_episode`."""
    with EpisodeFile(path) as file:
        yield from file.steps()


class EpisodeFile:
    """An open episode file: the metadata at once, the steps one by one.

    Args:
        path: of the file.
        sensors: whose frames are decoded; None: all.

    Raises EpisodeError.
    """

    def __init__(self, path: Path | str, sensors: Container[str] | None = None) -> None:
        self.path = Path(path)
        self.complete = False  # after the last step: the file has its footer and all steps it claims
        self.dropped = 0  # after the last step
        self._sensors = sensors
        try:
            if not self.path.is_file():
                raise EpisodeError(f"{self.path}: {'is no file' if self.path.exists() else 'no such file'}")
            self._file = self.path.open("rb")
        except OSError as failure:
            raise EpisodeError(f"{self.path}: cannot be opened: {failure.strerror}") from failure
        try:
            self._records = _read_records(self._file, self.path.stat().st_size, str(self.path))
            self.meta = self._read_meta()
        except BaseException:
            self._file.close()
            raise

    def _read_meta(self) -> EpisodeMeta:
        """Metadata and attachments, which precede the first step."""
        found: tuple[EpisodeMeta, tuple[str, ...]] | None = None
        attachments: dict[str, bytes] = {}
        for record in self._records:
            if isinstance(record, Metadata) and record.name == META:
                found = decode_meta(record.metadata, str(self.path))
            elif isinstance(record, Attachment):
                attachments[record.name] = record.data
            elif not isinstance(record, Header):
                break
            if found is not None and set(found[1]) <= set(attachments):
                return replace(found[0], attachments=attachments)
        if found is None:
            raise EpisodeError(f"{self.path}: no episode: its metadata are missing or damaged (record '{META}')")
        missing = sorted(set(found[1]) - set(attachments))
        raise EpisodeError(f"{self.path}: attachment '{missing[0]}' is missing or damaged")

    def steps(self) -> Iterator[Step]:
        """The steps in order, up to the end of the file or the first damage."""
        topics: dict[int, str] = {}
        pending: dict[str, bytes] = {}
        closing: dict[str, int] | None = None
        count = 0
        for record in self._records:
            if isinstance(record, Channel):
                topics[record.id] = record.topic
            elif isinstance(record, Metadata) and record.name == CLOSE:
                closing = _closing(record)
            elif isinstance(record, Footer) and closing is not None:
                self.complete, self.dropped = closing["steps"] == count, closing["dropped"]
            elif isinstance(record, Message):
                if record.channel_id not in topics:
                    return
                topic = topics[record.channel_id]
                if topic != STEP_TOPIC:
                    pending[topic] = record.data
                    continue
                if record.sequence != count % 2**32:  # a damaged record hid a step
                    return
                try:
                    yield decode_step(record.data, pending, self._sensors)
                except EpisodeError as failure:
                    raise EpisodeError(f"{self.path}: step number {count}: {failure}") from failure
                pending.clear()
                count += 1

    def close(self) -> None:
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()


def _closing(record: Metadata) -> dict[str, int] | None:
    """Numbers of the closing record; None when it is damaged."""
    try:
        values = unsealed(record.metadata, CLOSE)
        return {key: int(values[key]) for key in ("steps", "dropped")}
    except (EpisodeError, KeyError, ValueError):
        return None


def _memory(frame: TactileFrame) -> int:
    """Bytes of the arrays of a frame."""
    if frame.surface is None:
        return frame.image.nbytes
    flow = 0 if frame.surface.flow is None else frame.surface.flow.nbytes
    return frame.image.nbytes + frame.surface.height.nbytes + frame.surface.gradient.nbytes + flow


class _BadRecord(Exception):
    """The readable part of the file ends here."""


def _read_records(file: BinaryIO, size: int, what: str) -> Iterator[McapRecord]:
    """Records in file order, chunks unpacked, without indexes and statistics.

    Ends without an exception at the first record that is cut off or damaged. The last record is a Footer only if the
    file was finished. Raises EpisodeError for a file that is not MCAP or has compressed chunks.
    """
    if file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
        raise EpisodeError(f"{what}: not an MCAP file (it does not begin with the MCAP magic bytes)")
    try:
        for record in _records(file, size - len(MCAP0_MAGIC)):
            if isinstance(record, Chunk):
                yield from _open_chunk(record, what)
            elif isinstance(record, Footer):
                if file.read(len(MCAP0_MAGIC) + 1) == MCAP0_MAGIC:
                    yield record
                return
            else:
                yield record
    except _BadRecord:
        return


def _records(stream: BinaryIO, size: int) -> Iterator[McapRecord]:
    """Parsed records of the next `size` bytes."""
    left = size
    while left >= _HEAD.size:
        head = stream.read(_HEAD.size)
        if len(head) < _HEAD.size:
            raise _BadRecord
        opcode, length = _HEAD.unpack(head)
        left -= _HEAD.size + length
        if left < 0 or length > MAX_RECORD or opcode not in Opcode.__members__.values():
            raise _BadRecord
        body = stream.read(length)
        if len(body) < length:
            raise _BadRecord
        record = _parse(opcode, body)
        if record is not None:
            yield record
    if left:
        raise _BadRecord


def _parse(opcode: int, body: bytes) -> McapRecord | None:
    """The record; None for kinds that episodes do not need. No read reaches beyond `body`."""
    stream = ReadDataStream(io.BytesIO(body))
    try:
        if opcode == Opcode.MESSAGE:
            message: McapRecord = Message.read(stream, len(body))
            return message
        if opcode == Opcode.ATTACHMENT and zlib.crc32(body[:-4]).to_bytes(4, "little") != body[-4:]:
            raise _BadRecord
        parse = _PARSERS.get(opcode)
        return None if parse is None else parse(stream)
    except (McapError, struct.error, UnicodeDecodeError, OverflowError, ValueError) as failure:
        raise _BadRecord from failure


def _open_chunk(chunk: Chunk, what: str) -> Iterator[McapRecord]:
    if chunk.compression in ("zstd", "lz4"):
        raise EpisodeError(f"{what}: compressed chunks ({chunk.compression}); run 'mcap decompress' on it first")
    if chunk.compression or zlib.crc32(chunk.data) != chunk.uncompressed_crc:
        raise _BadRecord
    yield from _records(io.BytesIO(chunk.data), len(chunk.data))
