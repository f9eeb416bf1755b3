"""The newest input packages of one controller, as they came: within a bound, however long it runs."""

from __future__ import annotations

from collections import deque
from itertools import islice

from robot.mock.ur.fault_client import Input
from robot.mock.ur.wire.rtde import InputRecipe

KEPT = 1 << 24  # of one controller; a minute and a half of a driver at 500 Hz [bytes]
OVERHEAD = 256  # of a package that is kept, besides its payload [bytes]


class Inputs:
    """A ring: the oldest packages go when new ones need their room. Numbers count from 1, and go on after `clear`."""

    def __init__(self) -> None:
        self.arrived = 0  # packages so far
        self._kept: deque[tuple[int, InputRecipe, bytes]] = deque()  # control period, and what came in it
        self._size = 0  # of what is kept [bytes]

    def add(self, tick: int, recipe: InputRecipe, payload: bytes) -> None:
        self.arrived += 1
        self._kept.append((tick, recipe, payload))
        self._size += OVERHEAD + len(payload)
        while self._size > KEPT:
            self._size -= OVERHEAD + len(self._kept.popleft()[2])

    def after(self, number: int, count: int) -> tuple[list[Input], int]:
        """At most `count` packages after the one with this number; and how many after it are not kept any more."""
        oldest = self.arrived - len(self._kept)  # number of the last one that is gone
        begin = max(number, oldest)
        page = islice(self._kept, begin - oldest, begin - oldest + count)
        entries = [
            Input(begin + place, tick, recipe.unpack(payload)) for place, (tick, recipe, payload) in enumerate(page, 1)
        ]
        return entries, max(0, oldest - number)

    def clear(self) -> None:
        self._kept.clear()
        self._size = 0
