"""How many threads this process may use, and several calls at once on them."""

from __future__ import annotations

import os
from collections import deque
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
    """What the calls return, as many at once as there are threads, this one among them: for long calculations that
    release the interpreter's lock. None of them may call this itself: it could wait for its own thread for ever. When
    some fail, all are done before the first failure, in their order, is raised; an interruption leaves out what has
    not begun."""
    count = min(threads(), len(calls))
    if count < 2:
        return map_serial(calls)
    waiting = deque(range(len(calls)))  # threads take the next one from it
    found: dict[int, Result] = {}
    failures: dict[int, Exception] = {}

    def work() -> None:
        while True:
            try:
                index = waiting.popleft()
            except IndexError:
                return
            try:
                found[index] = calls[index]()
            except Exception as failure:
                failures[index] = failure
            except BaseException:
                waiting.clear()
                raise

    pool = _pool(os.getpid())
    others = [pool.submit(work) for _ in range(count - 1)]
    try:
        work()
    finally:
        wait(others)
    for other in others:
        other.result()  # raises an interruption of its thread
    if failures:
        raise failures[min(failures)]
    return [found[index] for index in range(len(calls))]


@lru_cache(maxsize=1)
def _pool(process: int) -> ThreadPoolExecutor:
    """Of this process: a forked one has the pool, and none of its threads."""
    return ThreadPoolExecutor(max(1, threads() - 1), thread_name_prefix="tacsim")
