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
from tacsim.record.reader import closing_account, open_file
from tacsim.record.records import Survivors, check_magic
from tacsim.record.schemas import CLOSE, META, STEP_TOPIC, decode_meta, sealed, unsealed


@dataclass(slots=True)
class Recovery:
    """What was found in a recording."""

    steps: int  # that are whole, and in the new file
    finished: bool  # it has its end and its index
    damaged: list[tuple[int, int]]  # beginning and end of what cannot be read [bytes]
    lacking: list[str] = field(default_factory=list)  # what else is lost, in words

    @property
    def whole(self) -> bool:
        return self.finished and not self.damaged and not self.lacking


def recover(path: Path, target: Path) -> Recovery:
    """Writes the whole steps of `path`, and everything else of it that is whole, to the new file `target`, which is
    there only once it is finished. Contents and times stay as they are; `path` is only read. Where it is whole itself,
    nothing is written.

    Raises EpisodeError for what is no MCAP file or has nothing that could be recovered, FileExistsError, and OSError
    when `target` cannot be written.
    """
    definitions: list[McapRecord] = []
    found = _copy(path, _Copy(None), definitions)
    if found.whole:
        return found
    if target.exists():
        raise FileExistsError(errno.EEXIST, "File exists", str(target))
    part: Path | None = None
    try:
        handle, name = tempfile.mkstemp(prefix=f".{target.name}.", suffix=".part", dir=target.parent)
        part = Path(name)
        with os.fdopen(handle, "wb") as file:
            copy = _Copy(Writer(file, chunk_size=1 << 40, compression=CompressionType.NONE))
            copy.take(definitions)
            _copy(path, copy, [])
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
    found.steps, found.lacking = copy.steps, copy.lacking()
    return found


def _copy(path: Path, copy: _Copy, definitions: list[McapRecord]) -> Recovery:
    """Hands what is whole to `copy`, and gathers definitions of topics: first those of whole parts."""
    with open_file(path) as file:
        size = path.stat().st_size
        if size == 0:
            raise EpisodeError(f"{path}: is empty; nothing was recorded, so nothing can be recovered")
        check_magic(file, str(path))
        survivors = Survivors(file, size, str(path))
        for records in survivors:
            copy.take(records)
            definitions += [record for record in records if isinstance(record, Schema | Channel)]
    definitions += survivors.doubtful
    if copy.meta is None and not definitions:
        raise EpisodeError(f"{path}: nothing in it can be recovered, neither metadata nor a whole step")
    return Recovery(copy.steps, survivors.footer is not None, survivors.damaged, copy.lacking())


class _Copy:
    """Takes records, and writes them to a new file; without a writer it only looks."""

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

    def take(self, records: list[McapRecord]) -> None:
        """The records of one chunk, or a record by itself."""
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
                self._closing = closing_account(record)
            elif isinstance(record, Message):
                messages.append(record)
        if all(message.channel_id in self._channels for message in messages):
            for message in messages:
                self._take_message(message, self._channels[message.channel_id])
        else:  # half a step is none
            self._unknown += 1

    def _take_message(self, message: Message, channel: Channel) -> None:
        ends_step = channel.topic == STEP_TOPIC
        if self._writer is not None:
            self._begin(self._writer)
            number = self._channel(self._writer, channel)
            # Steps are numbered on, else readers would take what was lost between them for the end.
            sequence = message.sequence if self.meta is None else self.steps % 2**32
            self._writer.add_message(number, message.log_time, message.data, message.publish_time, sequence)
            if ends_step:
                self._writer.flush()  # type: ignore[no-untyped-call]  # one chunk a step
        self.steps += ends_step

    def _begin(self, writer: Writer) -> None:
        """Before the first message: the metadata, with those attachments that are there."""
        if self._begun:
            return
        self._begun = True
        writer.start(library="tacsim recover")
        if self.meta is not None:
            values = self.meta.metadata
            with contextlib.suppress(EpisodeError):
                there = [name for name in self._named_attachments() if name in self._attachments]
                values = sealed({**unsealed(values, META), "attachments": json.dumps(there)})
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

    def lacking(self) -> list[str]:
        """What is lost besides damaged parts, in words."""
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
            self._writer.add_metadata(CLOSE, sealed({**account, "cut": "1"}))
        self._writer.finish()  # type: ignore[no-untyped-call]
