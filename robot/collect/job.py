"""A set is divided into pieces. Each piece is one file, with the same bytes whichever process makes it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol


class SetError(ValueError):
    """A set cannot be started or continued."""


@dataclass(frozen=True, slots=True)
class Piece:
    """One file of a set."""

    number: int
    data: bytes | None  # None: all presses or episodes of the piece failed
    failures: Mapping[int, str]  # reason, by the number of the press or episode
    made: int  # presses or episodes in it
    seconds: Mapping[str, float] = field(default_factory=dict)  # time spent, by part of the work
    worker: str = ""  # name of the worker that made it


class Worker(Protocol):
    """Makes pieces in one process; never pickled."""

    def piece(self, number: int) -> Piece: ...


class Job(Protocol):
    """A set that is being made; can be pickled."""

    @property
    def count(self) -> int: ...
    @property
    def pieces(self) -> int: ...
    def name(self, piece: int) -> str:
        """Path of the file of a piece in the set's folder."""
        ...

    def numbers(self, piece: int) -> Sequence[int]:
        """Numbers of the presses or episodes in a piece."""
        ...

    def worker(self, folder: Path) -> Worker:
        """A worker of this job. folder: that of the set, or one with copies of its input files."""
        ...


class Seconds:
    """Time by part of the work."""

    def __init__(self) -> None:
        self.by_part: dict[str, float] = {}

    def add(self, part: str, seconds: float) -> None:
        self.by_part[part] = self.by_part.get(part, 0.0) + seconds
