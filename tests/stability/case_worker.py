"""One process that runs hard cases one after the other; a case that kills it or hangs costs only itself."""

from __future__ import annotations

import multiprocessing
import queue
import time
import traceback
from multiprocessing.process import BaseProcess
from types import TracebackType
from typing import Any, Self

import case_run
from case_run import Outcome


class CaseDied(Exception):
    """The process ended or hung while it ran a case."""


def serve(requests: Any, answers: Any) -> None:
    """In the worker: runs what is asked for until None comes."""
    while (request := requests.get()) is not None:
        try:
            answers.put(case_run.run(*request))
        except Exception:
            answers.put(traceback.format_exc())


class Worker:
    """Starts its process when the first case comes, and a new one after a death. `deaths` counts them.

    start: what the first case of a process has on top of its own time: kernels are compiled or loaded [s].
    """

    def __init__(self, start: float = 300.0) -> None:
        self._start = start
        self._context = multiprocessing.get_context("spawn")  # Taichi does not survive a fork
        self._process: BaseProcess | None = None
        self.deaths = 0

    def run(self, name: str, physics: str, seconds: float) -> Outcome:
        """Raises CaseDied; AssertionError with the worker's traceback when the case fails in itself."""
        end = time.monotonic() + seconds
        if self._process is None:
            end += self._start
            self._requests, self._answers = self._context.Queue(), self._context.Queue()
            self._process = self._context.Process(target=serve, args=(self._requests, self._answers), daemon=True)
            self._process.start()
        self._requests.put((name, physics))
        while True:
            try:
                answer = self._answers.get(timeout=0.2)
                break
            except queue.Empty:
                alive = self._process.is_alive()
                if not alive or time.monotonic() > end:
                    code = self._process.exitcode
                    self.close()
                    self.deaths += 1
                    how = f"took more than {seconds:.0f} s" if alive else f"ended the process (exit code {code})"
                    raise CaseDied(f"'{name}' with physics '{physics}' {how}") from None
        if isinstance(answer, str):
            raise AssertionError(f"in the worker:\n{answer}")
        return answer

    def close(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.join()
            self._process.close()
            self._process = None
            for pipe in (self._requests, self._answers):
                pipe.cancel_join_thread()
                pipe.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
