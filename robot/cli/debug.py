"""`tacsim debug`: what a diverged simulation left behind."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from robot.cli.errors import FAILED
from robot.cli.output import busy, results, say_files

if TYPE_CHECKING:
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
        from robot.studies import dump_view
        from tacsim.physics.failure.dump import read

        found = read(dump)
        world = dump_view.open_world(found)
    _print_error(found)
    rows = {"": dump_view.TITLES, **dump_view.table(found)}
    for row, values in rows.items():
        shown = "".join(f"{values.get(moment, ''):50}" for moment in dump_view.TITLES)
        results.print(f"{row:38}{shown.rstrip()}", markup=False)
    picture = (dump.parent if dump.name == "dump.json" else dump) / "debug.png"
    with busy("drawing"):
        dump_view.draw(found, picture)
    diverged = False
    if again:
        with busy("running the motion again"):
            outcome = dump_view.replay(found, world)
        diverged = outcome.failure is not None
        if outcome.stats is not None:
            retries, settled = outcome.stats.retries, "yes" if outcome.stats.settled else "no"
            how = f"after {retries} retries" if retries else "at the first attempt"
            said = f"does not diverge: reached its targets {how}, settled: {settled}"
        elif outcome.identical:
            said = "diverges again, exactly as recorded, to the last bit"
        else:
            said = f"diverges again, otherwise than recorded: {outcome.failure}"
        results.print(f"replay    {said}", markup=False)
    say_files(picture)
    if diverged:
        raise typer.Exit(FAILED)


def _print_error(dump: Dump) -> None:
    info = dump.info
    made = ", ".join(f"{name} {version}" for name, version in info.versions.items())
    lines = {
        "cause": info.cause,
        "at": info.place,
        "where": info.where,
        "retried": f"down to 1/{info.refine} of the time step" if info.refine > 1 else "",
        "written": f"{info.time}, {made}",
        "advice": info.advice,
    }
    for name, line in lines.items():
        if line:
            results.print(f"{name:10}{line}", markup=False)
