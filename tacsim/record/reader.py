"""Reads episodes, finished or cut off. Steps are read from the file at access."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import BinaryIO, NamedTuple, Self, overload

from mcap.records import Attachment, Channel, Footer, Header, Message, Metadata

from tacsim.models.text import suggest_file
from tacsim.record.episode import Episode, EpisodeError, EpisodeMeta, Step
from tacsim.record.messages import Messages, decode_step
from tacsim.record.records import check_magic, foreign_file_error, listed_topics, read_records
from tacsim.record.schemas import CLOSE, META, STEP_TOPIC, decode_meta, verify_checksum


class Place(NamedTuple):
    """The beginning of a step in a file."""

    offset: int  # of the outermost record with the beginning [bytes]
    skip: int = 0  # records in that record that belong to earlier steps


def read_episode(path: Path | str) -> Episode:
    """An episode from its file, which must stay in its place: steps are read, and pictures decoded, at access. A file
    that is cut off or damaged gives the steps before the damage, and `complete` is False.

    Raises EpisodeError if there is no such file, or it is no episode; an access to a picture may raise it, too.
    """
    with EpisodeFile(path) as file:
        for _ in file.steps():
            pass
        steps = RecordedSteps(file.path, file.places, file.topics)
        return Episode(meta=file.meta, steps=steps, complete=file.complete, dropped=file.dropped)


def iter_steps(path: Path | str) -> Iterator[Step]:
    """The steps of an episode, one at a time in memory. Raises EpisodeError like `read_episode`."""
    with EpisodeFile(path) as file:
        yield from file.steps()


class RecordedSteps(Sequence[Step]):
    """The steps in an episode's file. A step is read at each access, and not stored.

    Args:
        path: of the file.
        places: beginnings of its steps; may grow with the file.
        topics: of its channels, by their numbers in the file.

    An access raises EpisodeError if the file is missing or has changed.
    """

    def __init__(self, path: Path, places: Sequence[Place], topics: Mapping[int, str]) -> None:
        self._path, self._places, self._topics = path, places, topics
        self._sizes: dict[str, tuple[int, int]] = {}

    def __len__(self) -> int:
        return len(self._places)

    @overload
    def __getitem__(self, index: int) -> Step: ...
    @overload
    def __getitem__(self, index: slice) -> list[Step]: ...
    def __getitem__(self, index: int | slice) -> Step | list[Step]:
        if isinstance(index, slice):
            return [self[k] for k in range(*index.indices(len(self)))]
        number = range(len(self))[index]  # IndexError, and counting from the end
        place, gathered = self._places[number], _StepMessages(dict(self._topics))
        with open_file(self._path) as file:
            file.seek(place.offset)
            records = read_records(file, self._path.stat().st_size, str(self._path))
            for _, record in islice(records, place.skip, None):
                if (message := gathered.add(record)) is not None:
                    return _decode_record(message.data, gathered.messages, self._sizes, self._path, number)
        raise EpisodeError(f"{self._path}: step number {number} is missing; the file has changed")


class EpisodeFile:
    """An open episode file: metadata are read when it is opened, steps one by one. Raises EpisodeError."""

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        self.complete = False  # after the last step: whether the file has its footer and all its steps
        self.dropped = 0  # after the last step
        self.places: list[Place] = []  # of the steps so far
        self.topics: dict[int, str] = {}
        self._file = open_file(self.path)
        try:
            check_magic(self._file, str(self.path))
            self._records = read_records(self._file, self.path.stat().st_size, str(self.path))
            self.meta = self._read_meta()
        except EpisodeError:
            with self._file:
                if (topics := listed_topics(self._file)) and STEP_TOPIC not in topics:
                    raise foreign_file_error(self._file, str(self.path)) from None
            raise
        except BaseException:
            self._file.close()
            raise

    def _read_meta(self) -> EpisodeMeta:
        """Metadata and attachments, which precede the first step."""
        found: tuple[EpisodeMeta, tuple[str, ...]] | None = None
        attachments: dict[str, bytes] = {}
        for _, record in self._records:
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
        sizes: dict[str, tuple[int, int]] = {}
        closing: dict[str, int] | None = None
        gathered, begin, last, inside = _StepMessages(self.topics), None, -1, 0
        for offset, record in self._records:
            last, inside = offset, inside + 1 if offset == last else 0
            begin = begin or Place(offset, inside)
            if isinstance(record, Metadata) and record.name == CLOSE:
                closing = closing_counts(record)
            elif isinstance(record, Footer) and closing is not None:
                self.complete = closing["steps"] == len(self.places) and not closing["cut"]
                self.dropped = closing["dropped"]
            elif isinstance(record, Message) and record.channel_id not in self.topics:
                return
            elif (message := gathered.add(record)) is not None:
                number = len(self.places)
                if message.sequence != number % 2**32:  # a damaged record hid a step
                    return
                step = _decode_record(message.data, gathered.messages, sizes, self.path, number)
                self.places.append(begin)
                yield step
                gathered, begin = _StepMessages(self.topics), None

    def close(self) -> None:
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()


class _StepMessages:
    """The messages of one step."""

    def __init__(self, topics: dict[int, str]) -> None:
        self.topics = topics
        self.messages: dict[str, list[bytes]] = defaultdict(list)

    def add(self, record: object) -> Message | None:
        """Adds a record; returns the message that completes the step."""
        if isinstance(record, Channel):
            self.topics.setdefault(record.id, record.topic)  # a repetition, in the summary, may be damaged
        elif isinstance(record, Message):
            topic = self.topics.get(record.channel_id, "")
            if topic == STEP_TOPIC:
                return record
            self.messages[topic].append(record.data)
        return None


def _decode_record(data: bytes, messages: Messages, sizes: dict[str, tuple[int, int]], path: Path, number: int) -> Step:
    try:
        return decode_step(data, messages, f"{path}: step number {number}", sizes)
    except EpisodeError as failure:
        raise EpisodeError(f"{path}: step number {number}: {failure}") from failure


def open_file(path: Path) -> BinaryIO:
    """Raises EpisodeError."""
    try:
        if not path.is_file():
            raise EpisodeError(_describe_no_file(path))
        return path.open("rb")
    except OSError as failure:
        raise EpisodeError(f"{path}: cannot be opened: {failure.strerror}") from failure


def _describe_no_file(path: Path) -> str:
    if not path.exists():
        return f"{path}: no such file{suggest_file(path, ('.mcap',)) or '; `tacsim run` records an episode.mcap'}"
    return f"{path}: is {'a folder; name the episode.mcap in it' if path.is_dir() else 'no file'}"


def closing_counts(record: Metadata) -> dict[str, int] | None:
    """Numbers in the closing record; None if it is damaged."""
    try:
        values = verify_checksum(record.metadata, CLOSE)
        return {key: int(values.get(key, "0") if key == "cut" else values[key]) for key in ("steps", "dropped", "cut")}
    except (EpisodeError, KeyError, ValueError):
        return None
