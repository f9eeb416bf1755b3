"""The newest input packages of one controller, within a limit of memory."""

from __future__ import annotations

from collections import deque
from itertools import islice

from robot.mock.ur.fault_client import Input
from robot.mock.ur.wire.rtde import InputRecipe

MAX_STORED_BYTES = 1 << 24  # of one controller; 1.5 minutes of a driver at 500 Hz [bytes]
PACKAGE_OVERHEAD = 256  # of a stored package, in addition to its payload [bytes]


class Inputs:
    """A ring buffer: new packages replace the oldest ones. Numbers count from 1 and continue after `clear`."""

    def __init__(self) -> None:
        self.arrived = 0  # number of packages so far
        self._packages: deque[tuple[int, InputRecipe, bytes]] = deque()  # control period, recipe and payload of each
        self._size = 0  # of the stored packages [bytes]

    def add(self, tick: int, recipe: InputRecipe, payload: bytes) -> None:
        self.arrived += 1
        self._packages.append((tick, recipe, payload))
        self._size += PACKAGE_OVERHEAD + len(payload)
        while self._size > MAX_STORED_BYTES:
            self._size -= PACKAGE_OVERHEAD + len(self._packages.popleft()[2])

    def after(self, number: int, count: int) -> tuple[list[Input], int]:
        """At most `count` packages after the one with this number; and how many after it are no longer stored."""
        oldest = self.arrived - len(self._packages)  # number of the last package that was removed
        begin = max(number, oldest)
        page = islice(self._packages, begin - oldest, begin - oldest + count)
        entries = [
            Input(begin + place, tick, recipe.unpack(payload)) for place, (tick, recipe, payload) in enumerate(page, 1)
        ]
        return entries, max(0, oldest - number)

    def clear(self) -> None:
        self._packages.clear()
        self._size = 0
