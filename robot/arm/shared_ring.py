"""Shared memory between two processes: a :class:`Ring` of records, one writer, many readers.

A record is written into the next slot and counted after that. A reader copies the newest counted slot and reads the
count again: the copy is consistent unless the writer has reached that slot in between. It is a sequence lock: the
writer never waits, readers rarely repeat, and the last records stay available.

It relies on the memory order of x86-64, which keeps the order of stores and of loads (Intel SDM 3A, 8.2.2), and in
which an aligned 8-byte store is atomic. ur_rtde has wheels for x86-64 only; on others :func:`create_segment` raises.

A segment is memory with a descriptor and without a name. A child process gets it by that number (`pass_fds`); no other
process can open or replace it. The kernel frees it when the last process that holds it ends, in whatever way.
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

_HEADER_SIZE = 64  # bytes before the slots: the count, on a cache line of its own

Record = NDArray[np.void]  # one record (shape ()) or several (n,)


class Ring:
    """The last `slots` records of type `record` in `memory`; new memory is zeroed."""

    def __init__(self, memory: memoryview | mmap.mmap, record: np.dtype[np.void], slots: int) -> None:
        self._count: NDArray[np.uint64] = np.ndarray((1,), np.uint64, memory)
        # As plain bytes: NumPy copies records field by field, twenty times slower.
        self._record, self._bytes = record, np.dtype((np.void, record.itemsize))
        self._slots: Record = np.ndarray((slots,), self._bytes, memory, offset=_HEADER_SIZE)

    @staticmethod
    def size(record: np.dtype[np.void], slots: int) -> int:
        """Size of a ring in memory [bytes], a multiple of a cache line."""
        return _HEADER_SIZE + -(-record.itemsize * slots // _HEADER_SIZE) * _HEADER_SIZE

    @property
    def count(self) -> int:
        """Number of records written so far."""
        return int(self._count[0])

    def write(self, record: Record) -> None:
        """Adds a record. Only one thread of one process may write."""
        count = int(self._count[0])
        self._slots[count % len(self._slots)] = np.asarray(record, self._record).view(self._bytes)
        self._count[0] = count + 1  # readers see it from here on

    def latest(self) -> Record | None:
        """A copy of the newest record, None before the first."""
        return self.newest()[1]

    def newest(self) -> tuple[int, Record | None]:
        """The newest record and its number, counted from 1; 0 and None before the first. (Reading `count` separately
        could give the number of a later record.)"""
        while count := int(self._count[0]):
            slot = (count - 1) % len(self._slots)
            copy: Record = self._slots[slot : slot + 1].copy().view(self._record).reshape(())
            if int(self._count[0]) - count < len(self._slots) - 1:  # otherwise the writer may be in this slot
                return count, copy
        return 0, None

    def recent(self, number: int) -> Record:
        """Copies of the newest records (n,), at most `number`, oldest first."""
        count = self.count
        return self._copy_records(count - number, count)

    def since(self, number: int) -> tuple[int, Record]:
        """The number of the newest record, and copies of those after `number` (counted from 1) that the ring still has,
        oldest first."""
        count = self.count
        return count, self._copy_records(number, count)

    def _copy_records(self, after: int, last: int) -> Record:
        """Copies of the records after number `after` up to number `last` that the ring still has."""
        slots = len(self._slots)
        index = np.arange(max(0, after, last - (slots - 1)), last)
        copies = self._slots[index % slots]
        whole = index > self.count - slots
        intact: Record = copies[whole].view(self._record)
        return intact


class Segment:
    """The shared memory of `descriptor`, which is closed with the last reference; a ring keeps the memory mapped."""

    def __init__(self, descriptor: int) -> None:
        self.descriptor = descriptor
        weakref.finalize(self, os.close, descriptor)
        self.memory = mmap.mmap(descriptor, 0)


def create_segment(size: int) -> Segment:
    """Creates a zeroed segment. Raises OSError without such memory, or on a processor other than x86-64."""
    if platform.machine().lower() not in ("x86_64", "amd64"):
        raise OSError(f"records in shared memory need the store order of x86-64; this is {platform.machine()}")
    with (
        os.fdopen(os.memfd_create("tacsim"), "w+b") if hasattr(os, "memfd_create") else tempfile.TemporaryFile() as file
    ):
        file.truncate(size)
        if hasattr(os, "posix_fallocate"):  # missing memory is an error here, not a bus error later
            os.posix_fallocate(file.fileno(), 0, size)
        # Above 2: these are the standard streams of a child, even if this program was started without them.
        return Segment(fcntl.fcntl(file.fileno(), fcntl.F_DUPFD_CLOEXEC, 3))
