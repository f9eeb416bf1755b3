"""A pool of processes that never outlive this one, as the children of robot.common.process."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor
from types import TracebackType
from typing import Any, ParamSpec, TypeVar

from robot.common.process import blocking_signals, end_with_parent, without_working_folder

Given = ParamSpec("Given")
Result = TypeVar("Result")


class ProcessPool(ProcessPoolExecutor):
    """A ProcessPoolExecutor whose processes end when this process ends (also by kill -9), and at once if an exception
    leaves its block. Only this process gets the signals that end a program.

    begin, given: function and arguments, called in each process before its first task.
    """

    def __init__(self, processes: int, begin: Callable[..., object] | None = None, given: tuple[Any, ...] = ()) -> None:
        context = multiprocessing.get_context("spawn")  # Taichi does not survive a fork
        super().__init__(processes, context, _start_process, (os.getpid(), begin, given))

    def submit(self, work: Callable[Given, Result], /, *args: Given.args, **more: Given.kwargs) -> Future[Result]:
        """As ProcessPoolExecutor.submit, which starts processes when there are tasks for them."""
        with without_working_folder(), blocking_signals():
            return super().submit(work, *args, **more)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> bool | None:
        if kind is not None:
            for process in multiprocessing.active_children():
                process.kill()  # it does not get other signals (`blocking_signals`)
        return super().__exit__(kind, error, trace)


def _start_process(parent: int, begin: Callable[..., object] | None, given: tuple[Any, ...]) -> None:
    end_with_parent(parent)
    if begin is not None:
        begin(*given)
