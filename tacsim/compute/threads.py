"""How many threads this process may use, and several calls at once on them."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from functools import lru_cache
from typing import TypeVar

Result = TypeVar("Result")


def cores() -> int:
    """Processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def threads() -> int:
    """Threads that may compute at the same time: one a core, at most TACSIM_THREADS. Raises ValueError if that is no
    whole number from 1 on."""
    wanted = os.environ.get("TACSIM_THREADS", str(cores()))
    if not wanted.isdecimal() or int(wanted) < 1:
        raise ValueError(f"TACSIM_THREADS must be a whole number from 1 on, found '{wanted}'")
    return min(int(wanted), cores())


def map_serial(calls: Sequence[Callable[[], Result]]) -> list[Result]:
    """What the calls return; the first that fails is the last that is called."""
    return [call() for call in calls]


def map_parallel(calls: Sequence[Callable[[], Result]]) -> list[Result]:
    """What the calls return, each called on a thread of its own as far as there are some: for long calculations that
    release the interpreter's lock. None of them may call this itself: it could wait for its own thread for ever. When
    one fails the others are waited for, then the first failure, in their order, is raised."""
    if len(calls) < 2 or threads() < 2:
        return map_serial(calls)
    pool = _pool(os.getpid())
    others = [pool.submit(call) for call in calls[1:]]
    try:
        first = calls[0]()
    finally:
        wait(others)
    return [first, *(other.result() for other in others)]


@lru_cache(maxsize=1)
def _pool(process: int) -> ThreadPoolExecutor:
    """Of this process: a forked one has the pool, and none of its threads."""
    return ThreadPoolExecutor(max(1, threads() - 1), thread_name_prefix="tacsim")
