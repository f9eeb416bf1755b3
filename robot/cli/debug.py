"""`tacsim debug`: what a diverged simulation left behind."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from robot.cli.errors import FAILED
from robot.cli.output import busy, results, say_files

if TYPE_CHECKING:
    from robot.studies.dump_view import Replay
    from tacsim.physics.failure.dump import Dump


def debug(
    dump: Annotated[Path, typer.Argument(help="Folder of a dump, named in the error: OUT/diverged/00.")],
    again: Annotated[bool, typer.Option("--replay/--no-replay", help="Run the motion again.")] = True,
) -> None:
    """Look into a diverged simulation: a table, a cut through body and gels (debug.png), and the motion run again.

    Exit code 1 if it diverges again. Dumps are written by tacsim run and reproduce below their --out folder, and by any
    simulation into the folder that the environment variable TACSIM_DUMPS names.

    Example: tacsim debug runs/first/diverged/00
    """
    with busy("reading"):
        from robot.studies import dump_view as dumps
        from tacsim.physics.failure.dump import read

        found = read(dump)
        world = dumps.open_world(found)
    _print_facts(found)
    _print_table(dumps.table(found))
    picture = (dump.parent if dump.name == "dump.json" else dump) / "debug.png"
    with busy("drawing"):
        dumps.draw(found, picture)
    if again:
        with busy("running the motion again"):
            outcome = dumps.replay(found, world)
        results.print(_said(outcome), markup=False)
    say_files(picture)
    if again and outcome.failure is not None:
        raise typer.Exit(FAILED)


def _print_facts(dump: Dump) -> None:
    info = dump.info
    results.print(f"cause     {info.cause}", markup=False)
    if info.place:
        results.print(f"at        {info.place}", markup=False)
    results.print(f"where     {info.where}", markup=False)
    if info.refine > 1:
        results.print(f"retried   down to 1/{info.refine} of the time step")
    made = ", ".join(f"{name} {version}" for name, version in info.versions.items())
    results.print(f"written   {info.time}, {made}", markup=False)
    results.print(f"advice    {info.advice}", markup=False)


def _print_table(rows: list[tuple[str, dict[str, str]]]) -> None:
    from rich.markup import escape
    from rich.table import Table

    from robot.studies.dump_view import TITLES

    shown = [moment for moment in TITLES if any(moment in values for _, values in rows)]
    table = Table("", *(TITLES[moment] for moment in shown), box=None, padding=(0, 2, 0, 0))
    for what, values in rows:
        table.add_row(what, *(escape(values.get(moment, "")) for moment in shown))
    results.print(table)


def _said(outcome: Replay) -> str:
    """What the replay showed, in words."""
    if outcome.stats is not None:
        stats = outcome.stats
        how = f"after {stats.retries} retries" if stats.retries else "at the first attempt"
        return f"replay    does not diverge: reached its targets {how}, settled: {'yes' if stats.settled else 'no'}"
    words = (
        "exactly as recorded, to the last bit" if outcome.identical else f"otherwise than recorded: {outcome.failure}"
    )
    return f"replay    diverges again, {words}"
