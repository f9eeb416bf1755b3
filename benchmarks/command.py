"""The actions of `tacsim bench`: measure or read reports, print them, write files and pages. robot/cli/bench.py has the
options."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

import typer
from rich.console import Console
from rich.table import Table

from benchmarks.cases.press import renew as renew
from benchmarks.cases.real.labels import BadData
from benchmarks.cases.registry import select_cases
from benchmarks.harness.machine import backend
from benchmarks.harness.runner import NOT_MEASURED, Case, run_cases
from benchmarks.harness.schema import GROUPS, Report
from benchmarks.pages.page import COLUMNS, cells, setting, write_pages
from benchmarks.pages.picture import PICTURE, draw
from benchmarks.pages.reliability import PROMISES, ROOT, marked_tests, replace_promise, write_reliability
from robot.cli.output import busy, notes, print_files, progress, results
from robot.cli.terminal import Interrupt, print_error


def read(paths: Sequence[Path]) -> list[Report]:
    """Reads reports of earlier runs. Raises BadParameter."""
    return [_read(path) for path in paths]


def _read(path: Path) -> Report:
    from pydantic import ValidationError

    try:
        return Report.model_validate_json(path.read_bytes())
    except OSError as error:
        raise typer.BadParameter(f"{path} cannot be read: {error.strerror}", param_hint="--from") from None
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, first["loc"])) or "the whole file"
        words = f"{path} is not a report of tacsim bench: {place}: {first['msg']} ({error.error_count()} problems)"
        raise typer.BadParameter(words, param_hint="--from") from None


def require_cpu_for_a_page() -> None:
    """Raises BadParameter on a GPU: the page needs a report of the CPU, and can add those of GPUs."""
    if backend() != "cpu":
        words = f"TACSIM_DEVICE is '{backend()}', but a page needs the CPU's report too: use --json now, then --from"
        raise typer.BadParameter(words, param_hint="--docs")


def for_a_page(reports: Sequence[Report], paths: Sequence[Path]) -> list[Report]:
    """The one report of the CPU, then those of devices. Raises BadParameter."""
    of_cpu = [report.metadata.machine.device is None for report in reports]
    if sum(of_cpu) != 1:
        found = ", ".join(str(path) for path, cpu in zip(paths, of_cpu, strict=True) if cpu) or "none"
        raise typer.BadParameter(f"a page is made of one report of the CPU; given are: {found}", param_hint="--from")
    report = reports[of_cpu.index(True)]
    if len(reports) > 1 and report.metadata.groups == ["robot"]:
        raise typer.BadParameter("reports of GPUs belong to one of the physics, not of the robot", param_hint="--from")
    return [report, *(each for each in reports if each is not report)]


def measure(group: str, repeat: int | None, *, baselines: bool, long: bool, data: Path | None) -> tuple[Report, int]:
    """Measures a group, or all except robot. Returns the report and the exit code of the signal that stopped it, or 0.

    Raises BadParameter; Exit if the group robot is stopped.
    """
    if group == "real" and data is None:
        raise typer.BadParameter("the group real needs frames of a real sensor: --data DIR", param_hint="--data")
    if group not in ("real", "all") and data is not None:
        raise typer.BadParameter(f"the group {group} uses no real frames", param_hint="--data")
    if group == "robot":
        return _measure_robot(_repetitions(repeat, long=long)), 0
    wanted = [name for name in GROUPS if group == name or (group == "all" and name != "robot")]
    try:
        cases = select_cases(wanted, baselines=baselines, long=long, data=data)
    except BadData as error:
        raise typer.BadParameter(str(error), param_hint="--data") from None
    with Interrupt() as interrupt, progress() as bar:
        row = bar.add_task("starting", total=len(cases))
        begun = 0

        def report_case(case: Case) -> None:
            nonlocal begun
            words = f"{case.name}, {case.method}, {case.resolution}"
            bar.update(row, completed=begun, description=words)
            if not notes.is_terminal:  # a log shows no bar
                notes.print(f"{begun + 1}/{len(cases)} {words}")
            begun += 1

        report = run_cases(cases, repeat or 5, baselines=baselines, long=long, on_start=report_case, stop=interrupt)
    return report, interrupt.exit_code


def measure_promise(number: int, repeat: int | None, *, long: bool, file: Path | None) -> Report:
    """The report in `file` of all promises, in which those of one promise are measured again. Raises BadParameter;
    Exit if it is stopped."""
    if not 1 <= number <= len(PROMISES):
        words = f"there is no promise {number}; docs/reliability.md lists 1 to {len(PROMISES)}"
        raise typer.BadParameter(words, param_hint="--promise")
    if file is None or not file.is_file():
        words = "one promise is measured into the report of all of them: --json benchmarks/reliability.json"
        raise typer.BadParameter(words, param_hint="--json")
    report = _read(file)
    if report.metadata.groups != ["robot"]:
        raise typer.BadParameter(f"{file} is not a report of the group robot", param_hint="--json")
    _require_tests()
    with tempfile.TemporaryDirectory() as folder, Interrupt() as interrupt:
        found = Path(folder) / "promise.json"
        new = _run_promises("promise", _repetitions(repeat, long=long), found, interrupt, *marked_tests()[number])
    if not any(row.case == PROMISES[number - 1][0] for row in new.results):
        for failure in new.failures:
            print_error(f"{failure.case}: {failure.cause}")
        print_error(f"no figure of promise {number} was recorded; {file} stays as it is")
        raise typer.Exit(1)
    return replace_promise(report, new, number)


def _repetitions(repeat: int | None, *, long: bool) -> int:
    return repeat or (5 if long else 1)


def _require_tests() -> None:
    """Raises BadParameter where the tests of the promises cannot run."""
    if find_spec("pytest") is None or not (ROOT / "tests").is_dir():
        raise typer.BadParameter("the group robot is measured by tests: pip install -e '.[dev]'", param_hint="GROUP")


def _measure_robot(repeat: int) -> Report:
    """Runs the tests of the promises, which record figures (tests/promises.py). Those marked `often` mostly wait, so
    three of them run at a time, after the others."""
    _require_tests()
    with tempfile.TemporaryDirectory() as folder, Interrupt() as interrupt:
        once = _run_promises("promise and not often", repeat, Path(folder) / "once.json", interrupt)
        often = _run_promises("promise and often", repeat, Path(folder) / "often.json", interrupt, "-n", "3")
    seconds = once.metadata.seconds + often.metadata.seconds
    return once.model_copy(
        update={
            "metadata": once.metadata.model_copy(update={"seconds": seconds}),
            "results": [*once.results, *often.results],
            "failures": [*once.failures, *often.failures],
        }
    )


def _run_promises(marked: str, repeat: int, file: Path, interrupt: Interrupt, *options: str) -> Report:
    words = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-m", marked, "--repeat", str(repeat)]
    words += ["--reliability", str(file), *options]
    with subprocess.Popen(words, cwd=ROOT, stdout=sys.stderr, start_new_session=True) as tests:
        while tests.poll() is None:
            if interrupt():
                os.killpg(tests.pid, signal.SIGTERM)  # also the servers and mocks that the tests have started
                tests.wait()
                print_error("stopped by a signal; no file is written")
                raise typer.Exit(interrupt.exit_code)
            time.sleep(0.1)
    if not file.is_file():
        print_error(f"the tests of the promises ended with exit code {tests.returncode} before any of them ran")
        raise typer.Exit(1)
    return _read(file)


def show(reports: Sequence[Report]) -> None:
    """Prints the rows to stdout, and missing and failed cases to stderr."""
    for report in reports:
        table = Table(box=None, padding=(0, 1))
        for column in COLUMNS:
            table.add_column(column, justify="left" if column in COLUMNS[:3] else "right", overflow="fold")
        for row in report.results:
            table.add_row(*cells(row))
        # a file or a pipe has no width, and a table folded to 80 columns is hard to read
        console = Console(width=None if results.is_terminal else 160, highlight=False, quiet=results.quiet)
        if len(reports) > 1:
            console.print(setting(report))
        console.print(table)
        for lack in report.missing:
            notes.print(f"not measured: {lack.case}: {lack.cause}")
        failed = [failure for failure in report.failures if failure.cause != NOT_MEASURED]
        for failure in failed:
            print_error(f"{failure.case}, {failure.method}, {failure.resolution}: {failure.cause}")
        if left := len(report.failures) - len(failed):
            print_error(f"stopped by a signal: {left} cases were not measured")


def write(reports: Sequence[Report], json: Path | None, docs: Path | None) -> None:
    """Writes the first report as a file and a picture, and all reports as pages. Raises OSError."""
    report, *devices = reports
    physics = report.metadata.groups != ["robot"]
    written: list[Path] = []
    with busy("writing") if json or docs else progress():
        if json is not None:
            json.parent.mkdir(parents=True, exist_ok=True)
            json.write_text(report.model_dump_json(indent=1) + "\n", encoding="utf-8")
            written.append(json)
            if physics:
                draw(report.results, json.with_name(PICTURE))
                written.append(json.with_name(PICTURE))
        if docs is not None:
            written += write_pages(report, docs, devices) if physics else []
            written += [write_reliability(report, docs)] if "robot" in report.metadata.groups else []
    print_files(*written)
