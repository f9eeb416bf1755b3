"""A set is divided into pieces, made on this machine, in this process or in several. Each piece is one file, with the
same bytes whichever process makes it."""

from __future__ import annotations

import os
import tempfile
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol

from robot.common.process_pool import ProcessPool
from tacsim.geometry.tiles import share_tiles

PIECES_PER_WORKER = 2  # pieces for each worker that are queued or being made
# set to 1 in each worker, because there is a worker for each core
ONE_THREAD = ("TACSIM_THREADS", "OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS")


class SetError(ValueError):
    """A set cannot be started or continued."""


@dataclass(frozen=True, slots=True)
class Piece:
    """One file of a set."""

    number: int
    data: bytes | None  # None: all presses or episodes of the piece failed
    failures: Mapping[int, str]  # reason, by the number of the press or episode
    made: int  # presses or episodes in it
    seconds: Mapping[str, float] = field(default_factory=dict)  # time spent, by part of the work
    worker: str = ""  # name of the worker that made it


class Worker(Protocol):
    """Makes pieces in one process; never pickled."""

    def piece(self, number: int) -> Piece: ...


class Job(Protocol):
    """A set that is being made; can be pickled."""

    @property
    def count(self) -> int: ...
    @property
    def pieces(self) -> int: ...
    def name(self, piece: int) -> str:
        """Path of the file of a piece in the set's folder."""
        ...

    def numbers(self, piece: int) -> Sequence[int]:
        """Numbers of the presses or episodes in a piece."""
        ...

    def worker(self, folder: Path) -> Worker:
        """A worker of this job. folder: that of the set, or one with copies of its input files."""
        ...


class Seconds:
    """Time by part of the work."""

    def __init__(self) -> None:
        self.by_part: dict[str, float] = {}

    def add(self, part: str, seconds: float) -> None:
        self.by_part[part] = self.by_part.get(part, 0.0) + seconds


Stop = Callable[[], bool]


class CollectFailed(RuntimeError):
    """A worker or the cluster failed. The written pieces are complete."""


class Stopped(Exception):
    """A request to stop ended the set."""


def make_in_this_process(job: Job, folder: Path, numbers: Sequence[int], stop: Stop) -> Iterator[Piece]:
    """Makes the pieces one after the other. Raises Stopped, and the errors of the worker."""
    worker = job.worker(folder) if numbers else None
    for number in numbers:
        if stop():
            raise Stopped
        assert worker is not None
        yield worker.piece(number)


def make_in_processes(job: Job, folder: Path, numbers: Sequence[int], stop: Stop, workers: int) -> Iterator[Piece]:
    """Makes the pieces in several processes, and yields them as they finish. Raises Stopped, CollectFailed."""
    waiting, running = deque(numbers), set[Future[Piece | str]]()
    with (
        _limit_threads(),
        tempfile.TemporaryDirectory(prefix="tacsim-collect-", ignore_cleanup_errors=True) as shared,
        ProcessPool(min(workers, max(1, len(numbers))), _start_worker, (job, folder, Path(shared))) as pool,
    ):
        try:
            while waiting or running:
                if stop():
                    raise Stopped
                while waiting and len(running) < PIECES_PER_WORKER * workers:
                    running.add(pool.submit(_make_piece, waiting.popleft()))
                done, running = wait(running, timeout=0.1, return_when=FIRST_COMPLETED)
                for future in done:
                    yield piece_of_result(future.result())
        except BrokenProcessPool as failure:
            if stop():  # the signal reached all processes
                raise Stopped from failure
            raise CollectFailed("a worker was killed; is there enough memory for all workers (--workers)?") from failure


def piece_of_result(made: Piece | str) -> Piece:
    """The piece that a worker sent. Raises CollectFailed with the error that it sent instead."""
    if isinstance(made, str):
        raise CollectFailed(made)
    return made


@contextmanager
def _limit_threads() -> Iterator[None]:
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


def _start_worker(job: Job, folder: Path, shared: Path) -> None:
    """shared: folder in which workers share distance fields of meshes; one takes as long as ten presses."""
    global _worker
    share_tiles(shared)
    made: list[Worker] = []

    def worker() -> Worker:
        if not made:
            made.append(job.worker(folder))
        return made[0]

    _worker = worker


def _make_piece(number: int) -> Piece | str:
    """The piece, or an error as text: some exceptions cannot be pickled."""
    assert _worker is not None
    return piece_or_error(_worker, number, str(os.getpid()))


def piece_or_error(worker: Callable[[], Worker], number: int, name: str) -> Piece | str:
    """The piece, or an error as text. name: of the worker."""
    try:
        return replace(worker().piece(number), worker=name)
    except Exception as error:
        return f"{type(error).__name__}: {error}"
