"""Runs cases one after the other in separate processes, and collects the report.

The memory of a case that shares a process includes what the kernels of earlier cases still hold. If a process dies, one
case fails, and the following cases run in a new process.
"""

from __future__ import annotations

import gc
import multiprocessing
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any

from benchmarks.harness.machine import Run
from benchmarks.harness.measure import Measurement, peak_memory, reset_peak_memory
from benchmarks.harness.schema import Failure, Group, Missing, Report, Row
from robot.common.process import end_with_parent, without_working_folder

EXIT_TIMEOUT = 10.0  # [s] for a process to end after its last message


@dataclass(frozen=True, slots=True)
class Case:
    """One case, by one method at one resolution. `measure` is a function of a module, or a partial of one."""

    group: Group
    name: str
    method: str
    resolution: str
    measure: Callable[[int], list[Measurement]]  # repetitions -> rows
    baseline: bool = False  # only with --baselines: a method that is not ours
    long: bool = False  # only with --long: ours, but takes many seconds
    cpu: bool = False  # ours, but in NumPy or with kernels for the CPU only
    missing: str = ""  # reason why it cannot be measured: what the user's folder lacks

    @property
    def short(self) -> bool:
        """True if it needs neither --baselines nor --long."""
        return not (self.baseline or self.long)

    @property
    def needs_cpu(self) -> bool:
        """True if it cannot measure a device. Other methods are written for the CPU, or in NumPy."""
        return self.cpu or self.method != "tacsim"


def missing_case(name: str, reason: str, resolution: str = "") -> Case:
    """A case with real frames that cannot be measured, and the reason."""
    return Case("real", name, "tacsim", resolution, _raise_missing, missing=reason)


def _raise_missing(repeat: int) -> list[Measurement]:
    raise AssertionError("a case that lacks its frames was measured")


NOT_MEASURED = "the run was stopped before it was measured"


def run_cases(
    cases: Sequence[Case], repeat: int, *, baselines: bool, long: bool = False,
    on_start: Callable[[Case], None] = lambda case: None, on_rows: Callable[[list[Row]], None] = lambda rows: None,
    stop: Callable[[], bool] = lambda: False,
) -> Report:  # fmt: skip
    """Runs `cases` in turn until `stop`. A case that raises, dies or is not reached becomes a failure of the report.
    on_rows: gets the rows of a case as soon as they are measured."""
    run = Run()
    rows: list[Row] = []
    failures: list[Failure] = []
    missing = [Missing(**_names(case), cause=case.missing) for case in cases if case.missing]
    group_seconds: dict[Group, float] = {}
    measurable = [case for case in cases if not case.missing]
    for together in _by_process(measurable):
        started = time.perf_counter()
        for case, found in _run_in_process(together, repeat, on_start, stop):
            if isinstance(found, str):
                failures.append(Failure(**_names(case), cause=found))
            else:
                rows += found
                on_rows(found)
        if together[0].short:
            group = together[0].group
            group_seconds[group] = group_seconds.get(group, 0.0) + time.perf_counter() - started
    groups = list(dict.fromkeys(case.group for case in cases))
    order = {tuple(_names(case).values()): number for number, case in enumerate(cases)}
    rows.sort(key=lambda row: order[row.group, row.case, row.method, row.resolution])
    return Report(
        metadata=run.metadata(groups, repeat, baselines=baselines, long=long, group_seconds=group_seconds),
        results=rows,
        failures=failures,
        missing=missing,
    )


def _names(case: Case) -> dict[str, Any]:
    return {"group": case.group, "case": case.name, "method": case.method, "resolution": case.resolution}


def _by_process(cases: Sequence[Case]) -> list[list[Case]]:
    """Our short cases of a group share a process, because loading the kernels takes longer than most of them; other
    methods and long cases have their own."""
    parts: dict[object, list[Case]] = {}
    for case in cases:
        parts.setdefault(case.group if case.short else case, []).append(case)
    return list(parts.values())


class _Worker:
    """A process that runs cases in turn. If it dies, another one is started for the remaining cases."""

    def __init__(self, cases: Sequence[Case], repeat: int) -> None:
        context = multiprocessing.get_context("spawn")  # Taichi does not survive a fork
        self._receiver, sender = context.Pipe(duplex=False)
        self._process = context.Process(target=_run_worker, args=(list(cases), repeat, sender), daemon=True)
        with without_working_folder():
            self._process.start()
        sender.close()

    def next(self, stop: Callable[[], bool]) -> list[Row] | str | None:
        """Rows of the next case, or its error as text; None if the process has died."""
        try:
            while not self._receiver.poll(0.1):
                if stop():
                    return NOT_MEASURED
            found: list[Row] | str = self._receiver.recv()
            return found
        except EOFError:
            self._process.join(EXIT_TIMEOUT)
            return NOT_MEASURED if stop() else None  # the signal reached all processes

    @property
    def exit_code(self) -> int | None:
        return self._process.exitcode

    def close(self) -> None:
        self._process.kill()  # without effect on a process that has ended
        self._process.join()
        self._receiver.close()


def _run_in_process(
    cases: Sequence[Case], repeat: int, on_start: Callable[[Case], None], stop: Callable[[], bool]
) -> Iterator[tuple[Case, list[Row] | str]]:
    """Result of each case; all run in one process until it dies."""
    worker: _Worker | None = None
    try:
        for index, case in enumerate(cases):
            if stop():
                yield case, NOT_MEASURED
                continue
            on_start(case)
            worker = worker or _Worker(cases[index:], repeat)
            found = worker.next(stop)
            if found is not None:
                yield case, found
            else:
                yield case, f"its process died with exit code {worker.exit_code}"
                worker.close()
                worker = None
    finally:
        if worker is not None:
            worker.close()


def _run_worker(cases: Sequence[Case], repeat: int, report: Connection) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all processes; the main process ends the others
    parent = multiprocessing.parent_process()
    assert parent is not None and parent.pid is not None
    end_with_parent(parent.pid)
    for case in cases:
        gc.collect()
        reset_peak_memory()
        try:
            report.send(measure(case, repeat))
        except Exception as error:  # the report names the error, and the other cases continue
            report.send(f"{type(error).__name__}: {error}")
    report.close()


def measure(case: Case, repeat: int) -> list[Row]:
    """Runs one case in this process."""
    found = case.measure(repeat)
    memory = peak_memory()
    return [
        Row(
            group=case.group,
            case=case.name,
            variant=one.variant,
            method=case.method,
            resolution=case.resolution,
            seconds=one.timing.median,
            spread=one.timing.spread,
            cpu_seconds=one.timing.processor,
            repeats=len(one.timing.samples),
            error=one.error,
            error_unit=one.error_unit,
            against=one.against,
            peak_mb=memory,
            substeps=one.substeps,
            figures=one.figures,
            note=one.note,
        )
        for one in found
    ]
