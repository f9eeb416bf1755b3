"""`tacsim bench`: time, error and memory of one run. The benchmarks are in the folder `benchmarks` of the checkout."""

from __future__ import annotations

import sys
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from robot.cli.options import OptionGroup, with_option_groups
from robot.cli.output import busy, choose_json_file, notes, print_json, require_writable
from robot.cli.terminal import EXIT_USAGE, print_error

Group = Literal["all", "press", "squeeze", "materials", "scenes", "oracles", "real", "robot"]


class Cases(OptionGroup):
    """Options that choose what is measured, and how often."""

    baselines: Annotated[bool, typer.Option("--baselines", help="Also other methods: many minutes.")] = False
    long: Annotated[
        bool,
        typer.Option("--long", help="Also long cases (fine meshes, 100,000 substeps at rest): many minutes."),
    ] = False
    data: Annotated[
        Path | None,
        typer.Option("--data", metavar="DIR", help="Real frames, for the group real (or all): see docs/benchmarks.md."),
    ] = None
    repeat: Annotated[
        int | None,
        typer.Option(
            min=1,
            max=1000,
            show_default="5; robot without --long: 1",
            help="Timed repetitions; a case stops after 1 s of them (not robot).",
        ),
    ] = None
    renew: Annotated[
        bool, typer.Option("--renew", help="First compute the limit of the ball's press again: half an hour.")
    ] = False
    promise: Annotated[
        int | None,
        typer.Option(
            metavar="N", help="Of robot: measure promise N alone, and replace its rows in the file of --json."
        ),
    ] = None


@with_option_groups
def bench(
    group: Annotated[Group, typer.Argument(help="Cases; all: all except robot.")] = "all",
    *,
    cases: Cases,
    json_: Annotated[
        Path | None,
        typer.Option(
            "--json",
            metavar="FILE|-",
            callback=choose_json_file,
            help="Write the report here, and speed_vs_error.png next to it (not for robot); or -: print the report.",
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
) -> None:
    """Measure speed, accuracy and memory: every row is time, error and peak memory of one run.

    Compilation is not timed. Exit code 1 if a case failed. After a signal the command shows what it has measured and
    writes it to --json, but no pages.

    Group `real` needs --data; without it `all` omits the group. Group `robot` measures the guarantees of arms and
    cameras on mock hardware; it needs an idle machine, so `all` omits it.

    With TACSIM_DEVICE=cuda the cases run on a GPU, without those that need the CPU. The page shows such a report next
    to one of the CPU: --from CPU.json --from GPU.json --docs docs.

    Example: tacsim bench press --json press.json
    """
    require_checkout("tacsim bench")
    if cases.promise is not None and group != "robot":
        raise typer.BadParameter("promises are of the group robot: tacsim bench robot", param_hint="--promise")
    file = None if json_ == Path("-") else json_
    require_writable(file, "--json")
    with busy("loading"):
        bench = from_checkout("benchmarks.command")
    if from_:
        if json_ is not None and len(from_) > 1:
            raise typer.BadParameter("one file holds one report: give --from once", param_hint="--json")
        reports, stopped = bench.read(from_), 0
        if docs is not None:
            reports = bench.for_a_page(reports, from_)
    else:
        if docs is not None and group != "robot":
            bench.require_cpu_for_a_page()
        report, stopped = _measure(bench, group, cases, file)
        reports = [report]
    bench.show(reports)
    if reports[0].results or not stopped:
        bench.write(reports, file, docs if not stopped else None)
    print_json(reports[0])
    if stopped or any(report.failures for report in reports):
        raise typer.Exit(stopped or 1)


def _measure(bench: Any, group: Group, cases: Cases, file: Path | None) -> tuple[Any, int]:
    """The report, and the exit code of the signal that stopped it, or 0."""
    if cases.promise is not None:
        return bench.measure_promise(cases.promise, cases.repeat, long=cases.long, file=file), 0
    if cases.renew:
        with busy("computing the limit of fine meshes"):
            bench.renew(notes.print)
    return bench.measure(group, cases.repeat, baselines=cases.baselines, long=cases.long, data=cases.data)  # type: ignore[no-any-return]


def require_checkout(what: str) -> None:
    """Makes the folder `benchmarks` of the checkout importable, before any other of that name. Raises Exit without a
    checkout: a wheel does not contain the benchmarks."""
    root = Path(__file__).resolve().parents[2]
    if not ((root / "benchmarks" / "command.py").is_file() and (root / "pyproject.toml").is_file()):
        print_error(
            f"{what} needs a checkout of tacsim, with its folder benchmarks/: clone it and run `pip install -e .`"
        )
        raise typer.Exit(EXIT_USAGE)
    if sys.path[0] != str(root):
        sys.path.insert(0, str(root))


def from_checkout(module: str) -> Any:
    """A module of the folder `benchmarks`, after `require_checkout`. It is imported by name, like a plug-in: the
    benchmarks import this package, which therefore does not import them."""
    return import_module(module)
