"""Shared memory between two processes: a :class:`Ring` of records, one writer, many readers.

A record is written into the next slot, and only then counted. A reader copies the newest counted slot and counts again:
the copy is consistent unless the writer has reached that slot meanwhile. It is a sequence lock whose writer never waits
and whose readers hardly ever repeat, and it keeps the last records.

This relies on the memory order of x86-64, which keeps the order of stores, and of loads (Intel SDM 3A, 8.2.2), and in
which an aligned 8-byte store is atomic. ur_rtde has wheels for nothing else; on other processors :func:`create` raises.

A segment is memory that has a descriptor and no name: it is handed to a child process by that number (`pass_fds`),
nobody else can open or replace it, and it is gone when the last process that holds it is, however that one ended.
"""

from __future__ import annotations

import fcntl
import mmap
import os
import platform
import tempfile
import weakref

import numpy as np
from numpy.typing import NDArray

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
        count = self.count
        return self._copies(count - number, count)

    def since(self, number: int) -> tuple[int, Record]:
        """The number of the newest record, and copies of those after `number` (counted from 1) that are still kept,
        oldest first."""
        count = self.count
        return count, self._copies(number, count)

    def _copies(self, after: int, last: int) -> Record:
        """Copies of the records after number `after` up to number `last`, as far as they are kept."""
        slots = len(self._slots)
        index = np.arange(max(0, after, last - (slots - 1)), last)
        copies = self._slots[index % slots]
        whole = index > self.count - slots
        kept: Record = copies[whole].view(self._record)
        return kept


class Segment:
    """The shared memory behind `descriptor`, which it closes when nobody holds it any more; a ring keeps the memory."""

    def __init__(self, descriptor: int) -> None:
        self.descriptor = descriptor
        weakref.finalize(self, os.close, descriptor)
        self.memory = mmap.mmap(descriptor, 0)


def create(size: int) -> Segment:
    """A new zeroed segment. Raises OSError where there is no such memory, or a processor other than x86-64."""
    if platform.machine().lower() not in ("x86_64", "amd64"):
        raise OSError(f"records in shared memory need the store order of x86-64; this is {platform.machine()}")
    with (
        os.fdopen(os.memfd_create("tacsim"), "w+b") if hasattr(os, "memfd_create") else tempfile.TemporaryFile() as file
    ):
        file.truncate(size)
        if hasattr(os, "posix_fallocate"):  # memory that is missing is an error here, not a bus error later
            os.posix_fallocate(file.fileno(), 0, size)
        # Above 2: in a child those are its standard streams, also where this program was started without them.
        return Segment(fcntl.fcntl(file.fileno(), fcntl.F_DUPFD_CLOEXEC, 3))
