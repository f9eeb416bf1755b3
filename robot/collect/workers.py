"""Pieces of a set made on this machine: in this process, or in several."""

from __future__ import annotations

import os
import tempfile
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from robot.collect.job import Job, Piece, Worker
from robot.common.process import ProcessPool
from tacsim.geometry.tiles import share_tiles

AHEAD = 2  # pieces for each worker that wait or are being made
ONE_THREAD = ("TACSIM_THREADS", "OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS")  # of a worker: as many as cores work
Stop = Callable[[], bool]


class CollectFailed(RuntimeError):
    """What made the pieces failed. Those that are written are whole."""


class Stopped(Exception):
    """The set was ended from outside."""


def in_this_process(job: Job, folder: Path, numbers: Sequence[int], stop: Stop) -> Iterator[Piece]:
    """Makes the pieces one after the other. Raises Stopped, and what making them raises."""
    worker = job.worker(folder) if numbers else None
    for number in numbers:
        if stop():
            raise Stopped
        assert worker is not None
        yield worker.piece(number)


def in_processes(job: Job, folder: Path, numbers: Sequence[int], stop: Stop, workers: int) -> Iterator[Piece]:
    """Makes the pieces in so many processes, and gives them as they are done. Raises Stopped, CollectFailed."""
    waiting, running = deque(numbers), set[Future[Piece | str]]()
    with (
        _one_thread(),
        tempfile.TemporaryDirectory(prefix="tacsim-collect-", ignore_cleanup_errors=True) as shared,
        ProcessPool(min(workers, max(1, len(numbers))), _begin, (job, folder, Path(shared))) as pool,
    ):
        try:
            while waiting or running:
                if stop():
                    raise Stopped
                while waiting and len(running) < AHEAD * workers:
                    running.add(pool.submit(_piece, waiting.popleft()))
                done, running = wait(running, timeout=0.1, return_when=FIRST_COMPLETED)
                for future in done:
                    yield result_of(future.result())
        except BrokenProcessPool as failure:
            if stop():  # the signal was for all processes
                raise Stopped from failure
            raise CollectFailed("a worker was killed; is there memory enough for all? (--workers)") from failure


def result_of(made: Piece | str) -> Piece:
    """What a worker has sent. Raises CollectFailed with its error."""
    if isinstance(made, str):
        raise CollectFailed(made)
    return made


@contextmanager
def _one_thread() -> Iterator[None]:
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ |= dict.fromkeys(ONE_THREAD, "1")
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


_worker: Callable[[], Worker] | None = None  # of this process


def _begin(job: Job, folder: Path, shared: Path) -> None:
    """shared: where workers leave distances of meshes to each other, which take as long as ten presses each."""
    global _worker
    share_tiles(shared)
    made: list[Worker] = []

    def worker() -> Worker:
        if not made:
            made.append(job.worker(folder))
        return made[0]

    _worker = worker


def _piece(number: int) -> Piece | str:
    """The piece, or an error as text: not every exception can be sent to another process."""
    assert _worker is not None
    return piece_or_error(_worker, number, str(os.getpid()))


def piece_or_error(worker: Callable[[], Worker], number: int, name: str) -> Piece | str:
    """name: of the worker."""
    try:
        return replace(worker().piece(number), worker=name)
    except Exception as error:
        return f"{type(error).__name__}: {error}"
