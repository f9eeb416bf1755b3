"""Number of threads that this process may use, and parallel calls on them."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from functools import lru_cache
from typing import TypeVar

Result = TypeVar("Result")


def core_count() -> int:
    """Processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def thread_count() -> int:
    """Number of threads that may compute at the same time: one for each core, at most TACSIM_THREADS. Raises ValueError
    if that is no integer from 1."""
    wanted = os.environ.get("TACSIM_THREADS", str(core_count()))
    if not wanted.isdecimal() or int(wanted) < 1:
        raise ValueError(f"TACSIM_THREADS must be a whole number from 1 on, found '{wanted}'")
    return min(int(wanted), core_count())


def has_one_thread() -> bool:
    """Whether only one thread may compute; False where `thread_count` raises."""
    return os.environ.get("TACSIM_THREADS") == "1" or core_count() == 1


def map_serial(calls: Sequence[Callable[[], Result]]) -> list[Result]:
    """Results of the calls; after the first failure, the rest is not called."""
    return [call() for call in calls]


def map_parallel(calls: Sequence[Callable[[], Result]]) -> list[Result]:
    """Results of the calls, on as many threads as may compute at the same time, with this one: for long calculations
    that release the interpreter's lock. A call must not use this function itself: it could wait for its own thread. If
    some calls fail, all are run before the first failure, in their order, is raised; after an interruption, calls that
    have not begun are left out."""
    count = min(thread_count(), len(calls))
    if count < 2:
        return map_serial(calls)
    waiting = deque(range(len(calls)))  # each thread takes the next one
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

    pool = _thread_pool(os.getpid())
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
def _thread_pool(process: int) -> ThreadPoolExecutor:
    """Pool of this process: a forked process has a copy of the pool without its threads."""
    return ThreadPoolExecutor(max(1, thread_count() - 1), thread_name_prefix="tacsim")
