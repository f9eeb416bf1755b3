"""What is collected, cut into pieces: each one file of a set, made by anybody, anywhere, to the same bytes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol


class SetError(ValueError):
    """A set that cannot be begun, or cannot go on."""


@dataclass(frozen=True, slots=True)
class Piece:
    """One file of a set."""

    number: int
    data: bytes | None  # None: nothing came of it
    failures: Mapping[int, str]  # why, by the number of the press or episode
    made: int  # presses or episodes in it
    seconds: Mapping[str, float] = field(default_factory=dict)  # what they took, by part
    worker: str = ""  # who made it


class Worker(Protocol):
    """Makes pieces in one process; never pickled."""

    def piece(self, number: int) -> Piece: ...


class Job(Protocol):
    """A set in the making; may be pickled."""

    @property
    def count(self) -> int: ...
    @property
    def pieces(self) -> int: ...
    def name(self, piece: int) -> str:
        """Of its file, in the set's folder."""
        ...

    def numbers(self, piece: int) -> Sequence[int]:
        """Of the presses or episodes in it."""
        ...

    def worker(self, folder: Path) -> Worker:
        """folder: the set's, or a copy of the files that it was begun with."""
        ...


class Seconds:
    """Time by what it went into."""

    def __init__(self) -> None:
        self.by_part: dict[str, float] = {}

    def add(self, part: str, seconds: float) -> None:
        self.by_part[part] = self.by_part.get(part, 0.0) + seconds
