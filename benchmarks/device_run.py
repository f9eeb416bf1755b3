"""Figures and tests of a GPU within a budget of time: `make test-gpu`, or `python -m benchmarks.device_run`.

First the figures that users of many environments ask for, then the physics suite, with `--all` then all cases of
`tacsim bench all --long`. Each row is in the file of `--json` as soon as it is measured, so a killed run keeps it.
Exit code 77 without a device, 1 if something failed or was not reached. TACSIM_DEVICE chooses the device (default:
cuda); with `cpu` and a small `--largest` the program itself is tried without a GPU.
"""

from __future__ import annotations

import os
import re
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from benchmarks.cases.environments import flowing_actions
from benchmarks.cases.registry import select_cases
from benchmarks.cases.scenes import batch
from benchmarks.cases.squeeze import PRESETS
from benchmarks.command import show
from benchmarks.harness.machine import Run, backend
from benchmarks.harness.runner import Case, run_cases
from benchmarks.harness.schema import Failure, Group, Report, Row
from robot.cli.output import notes
from robot.cli.terminal import Interrupt, print_error
from robot.common.whole_file import write_whole

ROOT = Path(__file__).resolve().parents[1]
EXIT_NO_DEVICE = 77  # as automake's tests say "skipped"
SUMMARY_TIMEOUT = 20.0  # for pytest to print its summary after it was stopped [s]
GROUPS: tuple[Group, ...] = ("press", "squeeze", "materials", "scenes", "oracles")


def wanted_cases(largest: int) -> list[Case]:
    """Cost of a substep and steps of environments by the number of worlds, the smaller numbers first."""

    def numbers(*all_: int) -> list[int]:
        return sorted({min(number, largest) for number in all_})

    substeps = [("learn", number) for number in numbers(1, 64, 1024)] + [("draft", number) for number in numbers(1, 64)]
    cases = [
        Case("scenes", "batch", "tacsim", f"{number} x {PRESETS[preset]}", partial(batch, number, preset=preset))
        for preset, number in substeps
    ]
    cases += [
        Case("scenes", "random_actions", "tacsim", f"{n} x {PRESETS['learn']}, flowing", partial(flowing_actions, n))
        for n in numbers(16, 256, 1024)
    ]
    return sorted(cases, key=lambda case: int(case.resolution.partition(" ")[0]))


class Record:
    """The rows so far, in a file."""

    def __init__(self, file: Path) -> None:
        self._file, self._run = file, Run()
        self.rows: list[Row] = []
        self.failures: list[Failure] = []
        file.parent.mkdir(parents=True, exist_ok=True)

    def add(self, rows: Sequence[Row]) -> None:
        self.rows += rows
        for row in rows:
            figures = ", ".join(f"{name} {value:.4g}" for name, value in row.figures.items())
            notes.print(f"  {row.case}, {row.resolution}: {row.seconds:.3g} s, error {row.error:.3g} {row.error_unit}")
            notes.print(f"    {figures}")
        self.write()

    def write(self) -> Report:
        metadata = self._run.metadata(GROUPS, 1, long=True)
        report = Report(metadata=metadata, results=self.rows, failures=self.failures)
        write_whole(self._file, (report.model_dump_json(indent=1) + "\n").encode())
        return report


def run_tests(path: Path, stop: Callable[[], bool]) -> tuple[list[Row], str]:
    """Runs the tests below `path` until `stop`, and prints their output. Returns a row with their numbers, and a text:
    what went wrong, or ""."""
    program = (  # a killed run leaves no tests behind
        f"import sys, pytest; from robot.common.process import end_with_parent; end_with_parent({os.getpid()}); "
        "sys.exit(pytest.main(sys.argv[1:]))"
    )
    words = [sys.executable, "-c", program, "-q", "-m", "not deep", "-p", "no:cacheprovider", str(path)]
    began, stopped = time.perf_counter(), ""
    with tempfile.TemporaryFile("w+", encoding="utf-8") as output:
        tests = subprocess.Popen(words, cwd=ROOT, stdout=output, stderr=subprocess.STDOUT)
        try:
            while tests.poll() is None:
                time.sleep(0.1)
                if stop() and not stopped:
                    stopped = f"stopped after {time.perf_counter() - began:.0f} s, before all tests had run"
                    tests.send_signal(signal.SIGINT)
                    tests.wait(SUMMARY_TIMEOUT)
        except subprocess.TimeoutExpired:  # it is in a kernel, or compiles one
            pass
        finally:
            tests.kill()  # without effect on a process that has ended
            tests.wait()
        output.seek(0)
        said = output.read()
    notes.print(said)
    found = {word: int(number) for number, word in re.findall(r"(\d+) (passed|failed|errors?|skipped)", said[-400:])}
    wrong = found.get("failed", 0) + found.get("error", 0) + found.get("errors", 0)
    if "passed" not in found and not wrong:
        return [], stopped or f"pytest ended with exit code {tests.returncode}"
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    row = Row(
        group="scenes", case="device_tests", method="tacsim", resolution=path.name, seconds=time.perf_counter() - began,
        spread=None, cpu_seconds=usage.ru_utime + usage.ru_stime, repeats=1, error=wrong, error_unit="failed tests",
        against="the tests of the physics", peak_mb=max(usage.ru_maxrss / 1024, 1.0),
        figures={name: float(found.get(name, 0)) for name in ("passed", "skipped")}, note=stopped,
    )  # fmt: skip
    return [row], stopped or (f"{wrong} tests failed" if wrong else "")


def has_device() -> bool:
    """Whether Taichi starts on the device, asked in another process."""
    words = [sys.executable, "-c", "from tacsim.compute.runtime import start_taichi; start_taichi()"]
    return subprocess.run(words, cwd=ROOT, capture_output=True).returncode == 0


def main(
    budget: Annotated[float, typer.Option(min=20.0, help="Time for all [s]; 20 are for the end of the tests.")] = 480.0,
    json_: Annotated[Path, typer.Option("--json", help="File of the report.")] = Path("runs/gpu/report.json"),
    largest: Annotated[int, typer.Option(min=1, help="No batch has more worlds.")] = 1024,
    tests: Annotated[Path, typer.Option(help="Tests of the device.")] = Path("tests/tacsim/physics"),
    all_cases: Annotated[bool, typer.Option("--all", help="Then the cases of tacsim bench all --long.")] = False,
) -> None:
    """Measure and test a GPU within a budget of time."""
    os.environ.setdefault("TACSIM_DEVICE", "cuda")
    deadline = time.monotonic() + budget - SUMMARY_TIMEOUT
    if not has_device():
        print_error(f"Taichi finds no device '{backend()}' (or no driver) on this machine, so nothing was measured")
        raise typer.Exit(EXIT_NO_DEVICE)
    record = Record(json_)
    with Interrupt() as interrupt:

        def stop() -> bool:
            return interrupt() or time.monotonic() > deadline

        def measure(cases: Sequence[Case], repeat: int) -> None:
            run = partial(run_cases, baselines=False, on_start=_print_case, on_rows=record.add, stop=stop)
            record.failures += run(cases, repeat).failures
            record.write()

        measure(wanted_cases(largest), 3)
        rows, wrong = ([], "the budget was spent") if stop() else run_tests(tests, stop)
        if wrong:
            names = {"group": "scenes", "case": "device_tests", "method": "tacsim", "resolution": tests.name}
            record.failures.append(Failure(**names, cause=wrong))
        record.add(rows)
        if all_cases:
            measure(select_cases(GROUPS, baselines=False, long=True), 5)
    report = record.write()
    show([report.model_copy(update={"failures": []})])
    for failure in report.failures:
        print_error(f"not taken: {failure.case}, {failure.resolution}: {failure.cause}")
    notes.print(f"{len(report.results)} rows in {json_}")
    if report.failures:
        raise typer.Exit(1)


def _print_case(case: Case) -> None:
    notes.print(f"{case.name}, {case.resolution}")


if __name__ == "__main__":
    typer.run(main)
