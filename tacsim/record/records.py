"""The records of an MCAP file in file order, finished or cut off.

The readers of the `mcap` package need a finished file and do not check the lengths in it. This module compares each
length with the size of the file before it reads; `mcap` parses the records.
Format: https://mcap.dev/spec
"""

from __future__ import annotations

import contextlib
import io
import mmap
import re
import struct
import zlib
from collections.abc import Callable, Iterator
from typing import BinaryIO

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Footer, Header, McapRecord, Message, Metadata, Schema
from mcap.writer import MCAP0_MAGIC

from tacsim.record.episode import EpisodeError

_HEAD = struct.Struct("<BQ")  # opcode, length
_FOOTER = _HEAD.size + 20  # bytes of the last record
_PARSERS: dict[int, Callable[[ReadDataStream], McapRecord]] = {
    Opcode.HEADER: Header.read,
    Opcode.FOOTER: Footer.read,
    Opcode.SCHEMA: Schema.read,
    Opcode.CHANNEL: Channel.read,
    Opcode.CHUNK: Chunk.read,
    Opcode.ATTACHMENT: Attachment.read,
    Opcode.METADATA: Metadata.read,
}


class _BadRecord(Exception):
    """The readable part of the file ends here."""


def check_magic(file: BinaryIO, what: str) -> None:
    """Raises EpisodeError for a file that does not begin like an MCAP file, and for one with the profile of another
    program, such as a ROS 2 bag: tacsim's files have no profile."""
    if file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
        raise EpisodeError(
            f"{what}: not an MCAP file (it does not begin with the MCAP magic bytes); name the episode.mcap of a run"
        )
    if read_profile(file):
        raise foreign_file_error(file, what)
    file.seek(len(MCAP0_MAGIC))


def read_profile(file: BinaryIO) -> str:
    """Profile of an MCAP file, such as "ros2"; empty for files of tacsim, and for an unreadable header."""
    size = file.seek(0, io.SEEK_END)
    file.seek(len(MCAP0_MAGIC))
    with contextlib.suppress(_BadRecord):
        _, first = next(_records(file, size - file.tell()), (0, None))
        return first.profile if isinstance(first, Header) else ""
    return ""


def foreign_file_error(file: BinaryIO, what: str) -> EpisodeError:
    """The error for an MCAP file of another program: its kind, its topics, and advice."""
    max_topics = 20  # named in an error
    kind = {"ros1": "a ROS 1 bag", "ros2": "a ROS 2 bag"}.get(read_profile(file), "a recording of another program")
    topics = listed_topics(file)
    listed = sorted(f"{topic} ({schema})" if schema else topic for topic, schema in topics.items())
    more = f" and {len(listed) - max_topics} more" if len(listed) > max_topics else ""
    has = ", ".join(listed[:max_topics]) + more if listed else "not listed (the file was cut off before its index)"
    return EpisodeError(
        f"{what}: {kind} in MCAP, no episode of tacsim. Its topics: {has}. Export the "
        "camera's pictures to a folder of 8-bit PNG files, or to a video, and forces to a CSV file with a row a "
        "picture; then replay those. `tacsim run replay` also plays the compressed pictures of a ROS 2 bag itself "
        "(docs/recording.md)"
    )


def listed_topics(file: BinaryIO) -> dict[str, str]:
    """Topics of a finished file and the names of their schemas, from its index, which is never compressed; empty
    without an index."""
    size = file.seek(0, io.SEEK_END)
    end = size - len(MCAP0_MAGIC) - _FOOTER
    if end < len(MCAP0_MAGIC):
        return {}
    file.seek(end)
    schemas: dict[int, str] = {}
    channels: list[Channel] = []
    with contextlib.suppress(_BadRecord):
        _, footer = next(_records(file, _FOOTER), (0, None))
        if not isinstance(footer, Footer) or not len(MCAP0_MAGIC) <= footer.summary_start < end:
            return {}
        file.seek(footer.summary_start)
        for _, record in _records(file, end - footer.summary_start):
            if isinstance(record, Schema):
                schemas[record.id] = record.name
            elif isinstance(record, Channel):
                channels.append(record)
    return {each.topic: schemas.get(each.schema_id, "") for each in channels}


def read_records(file: BinaryIO, size: int, what: str) -> Iterator[tuple[int, McapRecord]]:
    """Records from the present position of `file` to its end at `size` [bytes], with the contents of chunks, without
    indexes and statistics; each with the position of the outermost record around it.

    Ends without an exception at the first record that is cut off or damaged. The last record is a Footer only if the
    file was finished. Raises EpisodeError for compressed chunks.
    """
    try:
        for place, record in _records(file, size - file.tell()):
            if isinstance(record, Chunk):
                for _, inner in open_chunk(record, what):
                    yield place, inner
            elif isinstance(record, Footer):
                if file.read(len(MCAP0_MAGIC) + 1) == MCAP0_MAGIC:
                    yield place, record
                return
            else:
                yield place, record
    except _BadRecord:
        return


def _records(stream: BinaryIO, size: int) -> Iterator[tuple[int, McapRecord]]:
    """Parsed records of the next `size` bytes, each with its position."""
    max_bytes = 256 << 20  # [bytes]
    left = size
    while left >= _HEAD.size:
        place = stream.tell()
        head = stream.read(_HEAD.size)
        if len(head) < _HEAD.size:
            raise _BadRecord
        opcode, length = _HEAD.unpack(head)
        left -= _HEAD.size + length
        if left < 0 or length > max_bytes or opcode not in Opcode.__members__.values():
            raise _BadRecord
        body = stream.read(length)
        if len(body) < length:
            raise _BadRecord
        record = _parse(opcode, body)
        if record is not None:
            yield place, record
    if left:
        raise _BadRecord


def _parse(opcode: int, body: bytes) -> McapRecord | None:
    """The record; None for kinds that episodes do not use. Nothing is read after the end of `body`."""
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


def open_chunk(chunk: Chunk, what: str) -> Iterator[tuple[int, McapRecord]]:
    """The records in a chunk. Raises EpisodeError for a compressed chunk, _BadRecord for a damaged one."""
    if chunk.compression in ("zstd", "lz4"):
        raise EpisodeError(f"{what}: compressed chunks ({chunk.compression}); run 'mcap decompress' on it first")
    if chunk.compression or zlib.crc32(chunk.data) != chunk.uncompressed_crc:
        raise _BadRecord
    yield from _records(io.BytesIO(chunk.data), len(chunk.data))


# A chunk that is not compressed: opcode, length, times of its messages, size, checksum, "", size again.
_CHUNK = re.compile(rb"\x06.{4}\0{4}.{16}.{4}\0{4}.{4}\0{4}.{4}\0{4}", re.DOTALL)


class IntactRecords:
    """The intact records of a file that was cut off or damaged: after damage, it searches for the next intact chunk.

    Iterates over lists of records: all records of a chunk, or a single record between chunks. After the iteration
    `damaged` has begin and end of each part that was left out [bytes], `doubtful` the definitions of topics in damaged
    chunks, and `footer` the last record of a file that was finished with an index. Raises EpisodeError for compressed
    chunks.
    """

    def __init__(self, file: BinaryIO, size: int, what: str) -> None:
        self.damaged: list[tuple[int, int]] = []
        self.doubtful: list[Schema | Channel] = []
        self.footer: Footer | None = None
        self._file, self._size, self._what = file, size, what

    def __iter__(self) -> Iterator[list[McapRecord]]:
        place = len(MCAP0_MAGIC)
        with mmap.mmap(self._file.fileno(), 0, access=mmap.ACCESS_READ) as memory:
            while place < self._size:
                self._file.seek(place)
                try:
                    for _, record in _records(self._file, self._size - place):
                        end = self._file.tell()
                        if isinstance(record, Footer):
                            self._keep_footer(record)
                            return
                        yield self._open_chunk_records(record) if isinstance(record, Chunk) else [record]
                        place = end
                    return
                except _BadRecord:
                    found = _CHUNK.search(memory, place + 1)
                    after = self._size if found is None else found.start()
                    if self.damaged and self.damaged[-1][1] == place:  # the match is no intact chunk either
                        self.damaged[-1] = (self.damaged[-1][0], after)
                    else:
                        self.damaged.append((place, after))
                    place = after

    def _open_chunk_records(self, chunk: Chunk) -> list[McapRecord]:
        try:
            return [record for _, record in open_chunk(chunk, self._what)]
        except _BadRecord:
            with contextlib.suppress(_BadRecord):
                for _, record in _records(io.BytesIO(chunk.data), len(chunk.data)):
                    if isinstance(record, Schema | Channel):
                        self.doubtful.append(record)
            raise

    def _keep_footer(self, footer: Footer) -> None:
        """Stores the footer if the file ends with it, and its index is complete and intact."""
        end = self._file.tell()
        if footer.summary_start == 0 or self._file.read(len(MCAP0_MAGIC) + 1) != MCAP0_MAGIC:
            return
        checksum = 0
        self._file.seek(footer.summary_start)
        left = end - 4 - footer.summary_start  # up to the checksum itself, which ends the footer
        while left > 0 and (part := self._file.read(min(left, 1 << 20))):
            checksum, left = zlib.crc32(part, checksum), left - len(part)
        if left == 0 and checksum == footer.summary_crc:
            self.footer = footer
