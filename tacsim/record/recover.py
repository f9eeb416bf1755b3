"""Makes a finished MCAP file, with its index, of a recording that was cut off (kill -9, full disk) or damaged."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import tempfile
from dataclasses import dataclass, field
from pathlib import Path

from mcap.records import Attachment, Channel, McapRecord, Message, Metadata, Schema
from mcap.writer import CompressionType, Writer

from tacsim.record.episode import EpisodeError
from tacsim.record.reader import closing_counts, open_file
from tacsim.record.records import IntactRecords, check_magic
from tacsim.record.schemas import CLOSE, META, STEP_TOPIC, add_checksum, decode_meta, verify_checksum


@dataclass(slots=True)
class Recovery:
    """Result of the recovery of a recording."""

    steps: int  # complete steps, which are in the new file
    finished: bool  # it has its end and its index
    damaged: list[tuple[int, int]]  # begin and end of each part that cannot be read [bytes]
    missing: list[str] = field(default_factory=list)  # texts that name other missing parts

    @property
    def is_whole(self) -> bool:
        return self.finished and not self.damaged and not self.missing


def recover_recording(path: Path, target: Path) -> Recovery:
    """Writes the complete steps of `path`, and all other intact parts, to the new file `target`, which exists only
    after it is finished. Contents and times do not change; `path` is only read. If `path` is intact, nothing is
    written.

    Raises EpisodeError for a file that is no MCAP file or has nothing to recover, FileExistsError, and OSError if
    `target` cannot be written.
    """
    definitions: list[McapRecord] = []
    found = _copy_records(path, _Copy(None), definitions)
    if found.is_whole:
        return found
    if target.exists():
        raise FileExistsError(errno.EEXIST, "File exists", str(target))
    part: Path | None = None
    try:
        handle, name = tempfile.mkstemp(prefix=f".{target.name}.", suffix=".part", dir=target.parent)
        part = Path(name)
        with os.fdopen(handle, "wb") as file:
            copy = _Copy(Writer(file, chunk_size=1 << 40, compression=CompressionType.NONE))
            copy.copy_records(definitions)
            _copy_records(path, copy, [])
            copy.finish()
            file.flush()
            os.fsync(file.fileno())
        part.chmod(path.stat().st_mode & 0o777)
        part.rename(target)
    except BaseException as failure:
        if part is not None:
            with contextlib.suppress(OSError):
                part.unlink()
        if isinstance(failure, OSError):
            failure.filename = str(target)
        raise
    found.steps, found.missing = copy.steps, copy.missing_parts()
    return found


def _copy_records(path: Path, copy: _Copy, definitions: list[McapRecord]) -> Recovery:
    """Passes intact records to `copy`, and collects definitions of topics, those of intact parts first."""
    with open_file(path) as file:
        size = path.stat().st_size
        if size == 0:
            raise EpisodeError(f"{path}: is empty; nothing was recorded, so nothing can be recovered")
        check_magic(file, str(path))
        intact = IntactRecords(file, size, str(path))
        for records in intact:
            copy.copy_records(records)
            definitions += [record for record in records if isinstance(record, Schema | Channel)]
    definitions += intact.doubtful
    if copy.meta is None and not definitions:
        raise EpisodeError(f"{path}: nothing in it can be recovered, neither metadata nor a whole step")
    return Recovery(copy.steps, intact.footer is not None, intact.damaged, copy.missing_parts())


class _Copy:
    """Copies records to a new file; without a writer it only counts."""

    def __init__(self, writer: Writer | None) -> None:
        self.steps = 0
        self.meta: Metadata | None = None
        self._writer = writer
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._new_schemas: dict[int, int] = {}  # numbers in the new file
        self._new_channels: dict[int, int] = {}
        self._attachments: dict[str, Attachment] = {}
        self._closing: dict[str, int] | None = None
        self._begun = False
        self._unknown = 0  # steps with channels whose definition is lost

    def copy_records(self, records: list[McapRecord]) -> None:
        """Copies the records of one chunk, or a single record."""
        messages = []
        for record in records:
            if isinstance(record, Schema):
                self._schemas.setdefault(record.id, record)
            elif isinstance(record, Channel):
                self._channels.setdefault(record.id, record)
            elif isinstance(record, Attachment):
                self._attachments.setdefault(record.name, record)
            elif isinstance(record, Metadata) and record.name == META:
                self.meta = self.meta or record
            elif isinstance(record, Metadata) and record.name == CLOSE:
                self._closing = closing_counts(record)
            elif isinstance(record, Message):
                messages.append(record)
        if all(message.channel_id in self._channels for message in messages):
            for message in messages:
                self._copy_message(message, self._channels[message.channel_id])
        else:  # an incomplete step is left out
            self._unknown += 1

    def _copy_message(self, message: Message, channel: Channel) -> None:
        ends_step = channel.topic == STEP_TOPIC
        if self._writer is not None:
            self._begin(self._writer)
            number = self._channel(self._writer, channel)
            # Steps get consecutive numbers: for readers, a missing number is the end.
            sequence = message.sequence if self.meta is None else self.steps % 2**32
            self._writer.add_message(number, message.log_time, message.data, message.publish_time, sequence)
            if ends_step:
                self._writer.flush()  # type: ignore[no-untyped-call]  # one chunk a step
        self.steps += ends_step

    def _begin(self, writer: Writer) -> None:
        """Writes the metadata and the present attachments, before the first message."""
        if self._begun:
            return
        self._begun = True
        writer.start(library="tacsim recover")
        if self.meta is not None:
            values = self.meta.metadata
            with contextlib.suppress(EpisodeError):
                present = [name for name in self._named_attachments() if name in self._attachments]
                values = add_checksum({**verify_checksum(values, META), "attachments": json.dumps(present)})
            writer.add_metadata(META, values)
        for each in self._attachments.values():
            writer.add_attachment(each.create_time, each.log_time, each.name, each.media_type, each.data)

    def _named_attachments(self) -> tuple[str, ...]:
        """Raises EpisodeError where the metadata are missing or damaged."""
        if self.meta is None:
            raise EpisodeError("the metadata are missing")
        return decode_meta(self.meta.metadata, META)[1]

    def _channel(self, writer: Writer, channel: Channel) -> int:
        if channel.id not in self._new_channels:
            schema = self._schemas.get(channel.schema_id)
            if schema is not None and schema.id not in self._new_schemas:
                self._new_schemas[schema.id] = writer.register_schema(schema.name, schema.encoding, schema.data)
            number = 0 if schema is None else self._new_schemas[schema.id]
            self._new_channels[channel.id] = writer.register_channel(
                channel.topic, channel.message_encoding, number, channel.metadata
            )
        return self._new_channels[channel.id]

    def missing_parts(self) -> list[str]:
        """Texts that name missing parts, in addition to damaged ones."""
        words = []
        try:
            missing = [name for name in self._named_attachments() if name not in self._attachments]
            words += [f"the attachment '{name}'" for name in missing]
        except EpisodeError:
            words.append("the metadata of the episode: viewers show the new file, tacsim cannot")
        if self._closing is not None and self._closing["steps"] != self.steps:
            words.append(f"steps: {self._closing['steps']} were recorded")
        if self._unknown:
            words.append(f"{self._unknown} steps whose topics were defined in a part that is damaged")
        return words

    def finish(self) -> None:
        assert self._writer is not None
        self._begin(self._writer)
        if self.meta is not None:
            dropped = 0 if self._closing is None else self._closing["dropped"]
            account = {"steps": str(self.steps), "dropped": str(dropped)}
            self._writer.add_metadata(CLOSE, add_checksum({**account, "cut": "1"}))
        self._writer.finish()  # type: ignore[no-untyped-call]
