"""Threads of one environment: how a launch is spread over them and where they meet.

A launch runs many substeps, since starting one costs as much as a draft substep. Its threads meet twice a substep by
turning in place; so two launches at once, each with as many threads as there are cores, would mostly wait for threads
that do not run. What comes out is the same bits with any team, hence its size is free: `run_team` takes the one that
was faster lately.
"""

import math
import time
from collections import deque
from collections.abc import Sequence
from typing import Any

import numpy as np

from tacsim.compute.runtime import launching, ti
from tacsim.compute.threads import threads
from tacsim.physics.exec.lanes import PARTS

CHUNK = 512  # Taichi runs loops of up to 512 iterations on one thread: every member gets a chunk, and does its first
PROBE = 25  # most launches between two tries of a size that was slower
LATELY = 2  # launches of one size, of which the faster counts: what disturbs a launch only makes it slower

WHO = 1  # column of `sync`: the environment whose turn it is

Sync = ti.types.ndarray(dtype=ti.i32, ndim=2)


@ti.func
def meet(sync: ti.template(), turn, team, meeting):
    """Nobody goes on before all members are here; meeting counts from 1."""
    if team > 1:
        ti.atomic_add(sync[turn, 0], 1)
        here = 0
        while here < team * meeting:
            here = ti.atomic_add(sync[turn, 0], 0)


# Loops that run once or not at all, in place of branches: inside a branch the compiler does not merge lanes.


@ti.func
def first_in_chunk(task):
    """How often the work of `task` is done: once for the first of each chunk, else never."""
    return 1 - ti.min(task % CHUNK, 1)


@ti.func
def shares(member, team):
    """How many parts a member does: member, member + team, ..."""
    return (PARTS - member + team - 1) // team


class _Pace:
    """Seconds per unit of work of each team size, of late.

    A size that was slower is tried again after 1, 2, 4 ... launches: its tries may have met a moment in which another
    program had the other processor, and then a size that is twice as fast should not wait long.
    """

    def __init__(self, sizes: tuple[int, ...]) -> None:
        self.sizes = sizes
        self._lately = {size: deque[float](maxlen=LATELY) for size in sizes}
        self.launches = 0
        self._pause = dict.fromkeys(sizes, 1)  # launches until the next try, should this one be slower
        self._due = dict.fromkeys(sizes, 0)  # launch of the next try

    def choose(self) -> int:
        """The first launch compiles and says nothing; then each size has its turn, twice."""
        self.launches += 1
        if self.launches <= 1 + 2 * len(self.sizes):
            return self.sizes[self.launches % len(self.sizes)]
        fastest = self._fastest()
        due = (size for size in self.sizes if size != fastest and self._due[size] <= self.launches)
        return next(due, fastest)

    def note(self, size: int, seconds: float) -> None:
        if self.launches <= 1:
            return
        self._lately[size].append(seconds)
        if size == self._fastest():
            self._pause[size] = 1
        else:
            self._due[size] = self.launches + 1 + self._pause[size]
            self._pause[size] = min(2 * self._pause[size], PROBE)

    def _fastest(self) -> int:
        return min(self.sizes, key=lambda size: min(self._lately[size], default=math.inf))


_paces: dict[Any, _Pace] = {}


def team_sizes(environments: int) -> tuple[int, ...]:
    """Sizes worth trying: with many environments each keeps to one thread. TACSIM_THREADS bounds the threads in all.

    Never more members in all than threads: one would wait for another that has none to run on.
    """
    largest = max(1, min(threads() // environments, PARTS))
    return tuple(size for size in (1, 2, 4) if size <= largest)


@launching()
def run_team(kernel: Any, drive: np.ndarray, *arguments: Any, active: Sequence[int] = (0,)) -> None:
    """Launches `kernel(team, drive, ..., sync)` with the team that is fastest of late; tuples of arguments are spread.

    drive: (environments, substeps, ...); active: those that have substeps to do. Only they take turns: Taichi cuts a
    longer loop into as many equal pieces as there are threads, whether there is work in a piece or not.
    """
    flat = [a for group in arguments for a in (group if isinstance(group, tuple) else (group,))]
    sync = np.zeros((len(active), 16), np.int32)
    sync[:, WHO] = active
    sizes = team_sizes(len(active))
    pace = _paces.setdefault((kernel.__name__, drive.shape[0], len(active), sizes), _Pace(sizes))
    team = pace.choose()
    work = drive.shape[1] * sum(a.size for a in flat if isinstance(a, np.ndarray))
    begin = time.perf_counter()
    kernel(team, drive, *flat, sync)
    pace.note(team, (time.perf_counter() - begin) / work)
