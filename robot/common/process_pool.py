"""Pieces of work in several processes, none of which outlives this one."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor
from types import TracebackType
from typing import Any, ParamSpec, TypeVar

from robot.common.process import end_with_parent, outside_working_folder, shielded

Given = ParamSpec("Given")
Result = TypeVar("Result")


class ProcessPool(ProcessPoolExecutor):
    """A ProcessPoolExecutor whose processes end with this one, however that ends (kill -9), and at once where its block
    is left by an exception. Signals that end a program are for this process alone.

    begin, given: called in each process before its first piece.
    """

    def __init__(self, processes: int, begin: Callable[..., object] | None = None, given: tuple[Any, ...] = ()) -> None:
        context = multiprocessing.get_context("spawn")  # Taichi does not survive a fork
        super().__init__(processes, context, _begin, (os.getpid(), begin, given))

    def submit(self, work: Callable[Given, Result], /, *args: Given.args, **more: Given.kwargs) -> Future[Result]:
        """As ProcessPoolExecutor.submit, which starts processes when there is work for them."""
        with outside_working_folder(), shielded():
            return super().submit(work, *args, **more)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> bool | None:
        if kind is not None:
            for process in multiprocessing.active_children():
                process.kill()  # signals that could be caught never reach it (`shielded`)
        return super().__exit__(kind, error, trace)


def _begin(parent: int, begin: Callable[..., object] | None, given: tuple[Any, ...]) -> None:
    end_with_parent(parent)
    if begin is not None:
        begin(*given)
