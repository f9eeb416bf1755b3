"""The recorder: writes control steps to an MCAP file during an episode, in a separate thread."""

from __future__ import annotations

import contextlib
import mimetypes
import queue
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO, Self

from google.protobuf.message import Message
from mcap.well_known import MessageEncoding
from mcap.writer import CompressionType, Writer
from mcap_protobuf.schema import register_schema

from tacsim.record.episode import EpisodeMeta, Step
from tacsim.record.messages import encode_step
from tacsim.record.reader import Place, RecordedSteps
from tacsim.record.schemas import CLOSE, FORMAT, MAX_ATTACHMENT, META, add_checksum, encode_meta


class Recorder:
    """Writes an episode. The control loop passes steps and never waits: another thread encodes and writes them.

    Each step is one chunk, flushed to the operating system, and stays readable if the process is killed. Metadata and
    attachments are written first. If the disk is full, or a step cannot be encoded, the recording ends; the reason is
    in `error`, and the steps written before stay readable.

    The arrays of a step must not change after `write`: they are encoded later.

    Args:
        path: of the new file.
        meta: of the episode, with its attachments.
        capacity: largest number of waiting steps; with more, complete steps are dropped and counted.
        pitch: of the canonical grid [m]; viewers draw the surface maps with it.

    Raises:
        FileExistsError: an existing file is never overwritten.
        OSError: the file cannot be created or written.
        ValueError: an attachment is larger than 64 MiB.
    """

    def __init__(self, path: Path | str, meta: EpisodeMeta, *, capacity: int = 64, pitch: float = 0.25e-3) -> None:
        for name, content in meta.attachments.items():
            if len(content) > MAX_ATTACHMENT:
                raise ValueError(f"attachment '{name}' has {len(content)} bytes; at most {MAX_ATTACHMENT} are allowed")
        if capacity < 1:
            raise ValueError(f"capacity must be at least 1 step, got {capacity}")
        self.path = Path(path)
        self._pitch = pitch
        self._queue: queue.Queue[Step | None] = queue.Queue(capacity)
        self._change = threading.Condition()  # guards the next four
        self._accepted = self._handled = self._dropped = self._written = 0
        self._error: Exception | None = None
        self._closed = False
        self._schemas: dict[type[Message], int] = {}
        self._channels: dict[str, int] = {}
        self._offset = meta.wall_offset
        self._places: list[Place] = []
        self._topics: dict[int, str] = {}
        self._file = open_new_file(self.path)
        try:
            self._writer = _start_file(self._file, meta)
        except BaseException:  # the file has no step yet
            with contextlib.suppress(OSError):
                self._file.close()
            self.path.unlink(missing_ok=True)
            raise
        self._thread = threading.Thread(target=self._write_queue, name=f"recorder {self.path.name}", daemon=True)
        self._thread.start()

    @property
    def written(self) -> int:
        """Number of steps in the file, flushed."""
        with self._change:
            return self._written

    @property
    def steps(self) -> Sequence[Step]:
        """The steps in the file, read from it at access."""
        return RecordedSteps(self.path, self._places, self._topics)

    @property
    def dropped(self) -> int:
        """Number of steps that are not in the file: the queue was full, or the recording had ended with an error."""
        with self._change:
            return self._dropped

    @property
    def error(self) -> Exception | None:
        """The error that ended the recording: OSError from the disk, ValueError from a step that cannot be encoded."""
        return self._error

    def write(self, step: Step) -> bool:
        """Passes a step to the writer without blocking. False: it was dropped (see `error`). Raises ValueError if
        closed.
        """
        if self._closed:
            raise ValueError(f"the recorder of '{self.path}' is closed")
        with self._change:
            try:
                if self._error is not None:
                    raise queue.Full
                self._queue.put_nowait(step)
            except queue.Full:
                self._dropped += 1
                return False
            self._accepted += 1
            return True

    def flush(self, timeout: float = 10.0) -> bool:
        """Waits until all accepted steps are in the file (or dropped); False if `timeout` [s] was too short."""
        with self._change:
            goal = self._accepted
            return self._change.wait_for(lambda: self._handled >= goal, timeout)

    def close(self) -> None:
        """Writes waiting steps, finishes the file and closes it. Errors of the disk are in `error`."""
        if self._closed:
            return
        self._closed = True
        self._queue.put(None)  # waits until the thread has taken a step
        self._thread.join()
        try:
            if not isinstance(self._error, OSError):  # otherwise the file is cut off, and must not look complete
                self._finish_file()
            self._file.close()
        except OSError as failure:
            self._error = self._error or failure
            with contextlib.suppress(OSError):
                self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def _write_queue(self) -> None:
        while (step := self._queue.get()) is not None:
            try:
                if self._error is None:
                    self._append_step(step)
            except Exception as failure:  # recording must not end the control loop
                self._error = failure
            with self._change:
                if self._error is None:
                    self._written += 1
                else:
                    self._dropped += 1
                self._handled += 1
                self._change.notify_all()

    def _append_step(self, step: Step) -> None:
        messages = encode_step(step, self._pitch, self._offset)  # all messages, before one of them is written
        place = Place(self._file.tell())
        for message in messages:
            channel = self._register_channel(message.topic, message.schema)
            # the number of written steps: readers detect a missing step by it
            self._writer.add_message(channel, message.log_time, message.data, message.time, sequence=self._written)
        _flush_file(self._writer)
        self._places.append(place)

    def _register_channel(self, topic: str, schema: type[Message]) -> int:
        if topic not in self._channels:
            if schema not in self._schemas:
                self._schemas[schema] = register_schema(self._writer, schema)
            number = self._writer.register_channel(topic, MessageEncoding.Protobuf, self._schemas[schema])
            self._channels[topic] = number
            self._topics[number] = topic
        return self._channels[topic]

    def _finish_file(self) -> None:
        account = {"steps": str(self._written), "dropped": str(self._dropped)}
        if self._error is not None:
            account["error"] = str(self._error)
        self._writer.add_metadata(CLOSE, add_checksum(account))
        self._writer.finish()  # type: ignore[no-untyped-call]


def open_new_file(path: Path) -> BinaryIO:
    """A new file for writing. Raises FileExistsError, OSError."""
    return path.open("xb")


def _start_file(file: BinaryIO, meta: EpisodeMeta) -> Writer:
    # Uncompressed: the pictures are PNG already, and a reader needs no limit against decompression bombs.
    one_chunk = 1 << 40  # [bytes] a chunk ends with its step, never by size
    writer = Writer(file, chunk_size=one_chunk, compression=CompressionType.NONE)
    writer.start(library=f"tacsim episode {FORMAT}")
    writer.add_metadata(META, encode_meta(meta))
    start = 0 if meta.started is None else max(round(meta.started.timestamp() * 1e9), 0)
    for name, content in meta.attachments.items():
        media = mimetypes.guess_type(name)[0] or "application/octet-stream"
        writer.add_attachment(create_time=start, log_time=start, name=name, media_type=media, data=content)
    _flush_file(writer)
    return writer


def _flush_file(writer: Writer) -> None:
    """Writes the present chunk to the file, and the file to the operating system."""
    writer.flush()  # type: ignore[no-untyped-call]
