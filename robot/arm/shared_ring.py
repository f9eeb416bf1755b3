"""Shared memory between two processes: a :class:`Ring` of records, one writer, many readers.

A record is written into the next slot, and only then counted. A reader copies the newest counted slot and counts again:
the copy is consistent unless the writer has reached that slot meanwhile. It is a sequence lock whose writer never waits
and whose readers hardly ever repeat, and it keeps the last records.

This relies on the memory order of x86-64, which keeps the order of stores, and of loads (Intel SDM 3A, 8.2.2), and in
which an aligned 8-byte store is atomic. ur_rtde has wheels for nothing else; on other processors :func:`create` raises.

A segment is a mapped file in the system's shared memory folder, owned by the process that made it, whose id is in its
name. multiprocessing.shared_memory is not used: before Python 3.13 its resource tracker also removes segments that a
dying process had only attached. Here the owner removes its segments when it closes, a worker those of an owner that
died, and :func:`sweep` whatever is left.
"""

from __future__ import annotations

import contextlib
import mmap
import os
import platform
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

PREFIX = "tacsim"
FOLDER = Path("/dev/shm") if Path("/dev/shm").is_dir() else Path(tempfile.gettempdir())
_HEAD = 64  # bytes before the slots: the count, on a cache line of its own

Record = NDArray[np.void]  # one record (shape ()) or several (n,)


class Ring:
    """The last `slots` records of type `record` in `memory`; new memory is zeroed."""

    def __init__(self, memory: memoryview | mmap.mmap, record: np.dtype[np.void], slots: int) -> None:
        self._count: NDArray[np.uint64] = np.ndarray((1,), np.uint64, memory)
        # As plain bytes: NumPy copies records field by field, twenty times slower.
        self._record, self._bytes = record, np.dtype((np.void, record.itemsize))
        self._slots: Record = np.ndarray((slots,), self._bytes, memory, offset=_HEAD)

    @staticmethod
    def size(record: np.dtype[np.void], slots: int) -> int:
        """Size of such a ring in memory [bytes]; a multiple of a cache line."""
        return _HEAD + -(-record.itemsize * slots // _HEAD) * _HEAD

    @property
    def count(self) -> int:
        """How many records were ever written."""
        return int(self._count[0])

    def write(self, record: Record) -> None:
        """Adds a record; from one thread of one process only."""
        count = int(self._count[0])
        self._slots[count % len(self._slots)] = np.asarray(record, self._record).view(self._bytes)
        self._count[0] = count + 1  # only now it can be read

    def latest(self) -> Record | None:
        """A copy of the newest record, None before the first."""
        return self.newest()[1]

    def newest(self) -> tuple[int, Record | None]:
        """The newest record and its number, counted from 1; 0 and None before the first. (Reading `count` separately
        could give the number of a later record.)"""
        while count := int(self._count[0]):
            slot = (count - 1) % len(self._slots)
            copy: Record = self._slots[slot : slot + 1].copy().view(self._record).reshape(())
            if int(self._count[0]) - count < len(self._slots) - 1:  # else the writer may be in this slot by now
                return count, copy
        return 0, None

    def recent(self, number: int) -> Record:
        """Copies of the newest records (n,), at most `number`, oldest first."""
        slots = len(self._slots)
        count = int(self._count[0])
        first = max(0, count - min(number, slots - 1))
        index = np.arange(first, count)
        copies = self._slots[index % slots]
        whole = index > int(self._count[0]) - slots
        kept: Record = copies[whole].view(self._record)
        return kept


class Segment:
    """A piece of shared memory. Its owner (:func:`create`) removes it in `close`; who attached does not."""

    def __init__(self, path: Path, memory: mmap.mmap, *, owned: bool) -> None:
        self.name, self.memory = path.name, memory
        self._path, self._owned = path, owned

    def close(self) -> None:
        """Releases the memory, and removes it if owned. A ring that is still held keeps the memory mapped."""
        if self._owned:
            self.remove()
        with contextlib.suppress(BufferError):  # a ring still uses it
            self.memory.close()

    def remove(self) -> None:
        """Removes the name; processes that are attached stay so."""
        self._path.unlink(missing_ok=True)


def segment_name(owner: int, arm: str) -> str:
    """The name of the segment that process `owner` makes for `arm`."""
    return f"{PREFIX}-{owner}-{arm}"


def create(name: str, size: int) -> Segment:
    """A new zeroed segment. Raises FileExistsError if the name is taken, OSError on a processor other than x86-64."""
    if platform.machine().lower() not in ("x86_64", "amd64"):
        raise OSError(f"records in shared memory need the store order of x86-64; this is {platform.machine()}")
    path = FOLDER / name
    with path.open("x+b") as file:
        try:
            path.chmod(0o600)
            file.truncate(size)
            if hasattr(os, "posix_fallocate"):  # a full folder is an error here, not a bus error later
                os.posix_fallocate(file.fileno(), 0, size)
            return Segment(path, mmap.mmap(file.fileno(), size), owned=True)
        except BaseException:
            path.unlink(missing_ok=True)
            raise


def attach(name: str) -> Segment:
    """A segment that another process made. Raises FileNotFoundError."""
    path = FOLDER / name
    with path.open("r+b") as file:
        return Segment(path, mmap.mmap(file.fileno(), 0), owned=False)


def sweep() -> list[str]:
    """Removes segments whose owner is gone; returns their names. Containers that share this folder but not the process
    ids would remove each other's segments: give them separate folders."""
    removed = []
    for path in FOLDER.glob(f"{PREFIX}-*-*"):
        owner = path.name.split("-")[1]
        if owner.isdigit() and not _alive(int(owner)):
            path.unlink(missing_ok=True)
            removed.append(path.name)
    return removed


def _alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        return True
    return True
