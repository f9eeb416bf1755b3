"""`tacsim bench`: time, error and memory, from one run."""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from robot.cli.errors import complain
from robot.cli.interrupt import Interrupt
from robot.cli.output import busy, notes, progress, results, say_files

if TYPE_CHECKING:
    from benchmarks.harness.schema import Report


class Groups(StrEnum):
    """What is measured."""

    all = "all"
    press = "press"
    squeeze = "squeeze"
    materials = "materials"
    scenes = "scenes"
    real = "real"
    robot = "robot"


def bench(
    group: Annotated[Groups, typer.Argument(help="Which cases; all: all but robot.")] = Groups.all,
    json_: Annotated[
        Path | None,
        typer.Option(
            "--json", metavar="FILE", help="Write the report here, and speed_vs_error.png beside it (not for robot)."
        ),
    ] = None,
    baselines: Annotated[bool, typer.Option("--baselines", help="Also other methods: many minutes.")] = False,
    long: Annotated[
        bool,
        typer.Option("--long", help="Also our long rows (fine meshes, 100,000 substeps of rest): many minutes."),
    ] = False,
    data: Annotated[
        Path | None,
        typer.Option("--data", metavar="DIR", help="Real frames, for the group real (or all): see docs/benchmarks.md."),
    ] = None,
    repeat: Annotated[
        int | None,
        typer.Option(
            min=1,
            max=1000,
            show_default="5; robot without --long: 1",
            help="Timed repetitions; a case stops at 1 s of them (not robot).",
        ),
    ] = None,
    docs: Annotated[
        Path | None,
        typer.Option("--docs", metavar="DIR", help="Write the pages here: benchmarks.md, reliability.md."),
    ] = None,
    from_: Annotated[
        list[Path] | None,
        typer.Option(
            "--from",
            metavar="FILE",
            help="Measure nothing: show this report of an earlier run. Repeat it to add reports of GPUs.",
        ),
    ] = None,
    renew: Annotated[
        bool, typer.Option("--renew", help="First compute the limit of the ball's press anew: half an hour.")
    ] = False,
) -> None:
    """Measure how fast, how exact and how large: every row is time, error and peak memory of one run.

    Compiling is not timed. Exit code 1 if a case failed.

    Group `real` needs --data; `all` leaves it out without. Group `robot` measures what is promised of arms and cameras,
    on mock hardware; it wants an idle machine, so `all` leaves it out.

    With TACSIM_DEVICE=cuda the cases run on a GPU, without those that need the CPU. Such a report comes on the page
    beside one of the CPU: --from CPU.json --from GPU.json --docs docs.

    Example: tacsim bench press --json press.json
    """
    if from_:
        if json_ is not None and len(from_) > 1:
            raise typer.BadParameter("one file holds one report: give --from once", param_hint="--json")
        reports = [_read(path) for path in from_]
        if docs is not None:
            reports = _for_a_page(reports, from_)
    else:
        if docs is not None:
            _refuse_a_page_of_a_device()
        if renew:
            from benchmarks.truth.limit import renew as compute

            with busy("computing the limit of fine meshes"):
                compute(notes.print)
        if repeat is None:
            repeat = 1 if group is Groups.robot and not long else 5
        reports = [_measure(group, repeat, baselines=baselines, long=long, data=data)]
    for report in reports:
        _show(report, titled=len(reports) > 1)
    report, *devices = reports
    measured = report.metadata.groups
    physics = measured != ["robot"]
    written: list[Path] = []
    with busy("writing") if json_ or docs else progress():
        if json_ is not None:
            json_.parent.mkdir(parents=True, exist_ok=True)
            json_.write_text(report.model_dump_json(indent=1) + "\n", encoding="utf-8")
            written.append(json_)
            if physics:
                from benchmarks.pages.picture import PICTURE, draw

                draw(report.results, json_.with_name(PICTURE))
                written.append(json_.with_name(PICTURE))
        if docs is not None:
            from benchmarks.pages.page import write_page
            from benchmarks.reliability.page import write_reliability

            written += write_page(report, docs, devices) if physics else []
            written += [write_reliability(report, docs)] if "robot" in measured else []
    say_files(*written)
    if any(report.failures for report in reports):
        raise typer.Exit(1)


def _read(path: Path) -> Report:
    from pydantic import ValidationError

    from benchmarks.harness.schema import Report

    try:
        return Report.model_validate_json(path.read_bytes())
    except OSError as error:
        raise typer.BadParameter(f"{path} cannot be read: {error.strerror}", param_hint="--from") from None
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, first["loc"])) or "the whole file"
        words = f"{path} is no report of tacsim bench: {place}: {first['msg']} ({error.error_count()} problems)"
        raise typer.BadParameter(words, param_hint="--from") from None


def _refuse_a_page_of_a_device() -> None:
    from benchmarks.harness.runner import backend

    if backend() != "cpu":
        words = f"TACSIM_DEVICE is '{backend()}', but a page needs the CPU's report too: use --json now, then --from"
        raise typer.BadParameter(words, param_hint="--docs")


def _for_a_page(reports: Sequence[Report], paths: Sequence[Path]) -> list[Report]:
    """The one report of the CPU, then those of devices."""
    of_cpu = [report.metadata.machine.device is None for report in reports]
    if sum(of_cpu) != 1:
        found = ", ".join(str(path) for path, cpu in zip(paths, of_cpu, strict=True) if cpu) or "none"
        raise typer.BadParameter(f"a page is made of one report of the CPU; given are: {found}", param_hint="--from")
    report = reports[of_cpu.index(True)]
    if len(reports) > 1 and report.metadata.groups == ["robot"]:
        raise typer.BadParameter("reports of GPUs belong to one of the physics, not of the robot", param_hint="--from")
    return [report, *(each for each in reports if each is not report)]


def _measure(group: Groups, repeat: int, *, baselines: bool, long: bool, data: Path | None) -> Report:
    with busy("loading"):
        from benchmarks.cases.real.labels import BadData
        from benchmarks.cases.registry import chosen
        from benchmarks.harness.runner import Case, Stopped, run_cases
        from benchmarks.harness.schema import GROUPS

    if group is Groups.real and data is None:
        raise typer.BadParameter("the group real needs frames of a real sensor: --data DIR", param_hint="--data")
    if group not in (Groups.real, Groups.all) and data is not None:
        raise typer.BadParameter(f"the group {group.value} looks at no real frames", param_hint="--data")
    wanted = [name for name in GROUPS if group == name or (group is Groups.all and name != "robot")]
    try:
        cases = chosen(wanted, baselines=baselines, long=long, data=data)
    except BadData as error:
        raise typer.BadParameter(str(error), param_hint="--data") from None
    with Interrupt() as interrupt, progress() as bar:
        row = bar.add_task("starting", total=len(cases))
        begun = 0

        def say(case: Case) -> None:
            nonlocal begun
            words = f"{case.name}, {case.method}, {case.resolution}"
            bar.update(row, completed=begun, description=words)
            if not notes.is_terminal:  # a log has no bar
                notes.print(f"{begun + 1}/{len(cases)} {words}", markup=False)
            begun += 1

        try:
            return run_cases(cases, repeat, baselines=baselines, long=long, on_start=say, stop=interrupt)
        except Stopped:
            complain("stopped by a signal; nothing is written")
            raise typer.Exit(interrupt.exit_code) from None


def _show(report: Report, *, titled: bool) -> None:
    """titled: says first where it was measured."""
    from rich.console import Console
    from rich.table import Table

    from benchmarks.pages.page import COLUMNS, cells, setting

    table = Table(box=None, padding=(0, 1))
    for column in COLUMNS:
        table.add_column(column, justify="left" if column in COLUMNS[:3] else "right", overflow="fold")
    for row in report.results:
        table.add_row(*cells(row))
    # a file or a pipe has no width; a table folded to 80 columns cannot be read there
    console = Console(width=None if results.is_terminal else 160, highlight=False)
    if titled:
        console.print(setting(report), markup=False)
    console.print(table)
    for lack in report.missing:
        notes.print(f"not measured: {lack.case}: {lack.cause}", markup=False)
    for failure in report.failures:
        complain(f"{failure.case}, {failure.method}, {failure.resolution}: {failure.cause}")
