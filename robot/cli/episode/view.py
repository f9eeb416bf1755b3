"""`tacsim view`: a recorded episode in the Rerun viewer."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from robot.cli.output import busy, counted, say_files


def view(
    episode: Annotated[Path, typer.Argument(help="An episode.mcap; a recording that was cut off will do.")],
    save: Annotated[
        Path | None, typer.Option(metavar="FILE.rrd", help="Write a file for the viewer instead of starting one.")
    ] = None,
) -> None:
    """Look at a recorded episode in Rerun: gels, flow and forces in space, pictures, plots, on one time line.

    Needs the extra 'viz'; without it, `tacsim replay` makes a report.

    Example: tacsim view runs/first/episode.mcap
    """
    if save is not None and save.suffix != ".rrd":
        raise typer.BadParameter(f"{save} must end in .rrd, as the viewer's files do", param_hint="--save")
    with busy("loading"):
        from robot.export.rerun_view import view_episode
    with counted("reading") as on_step:
        view_episode(episode, save, on_step)
    if save is not None:
        say_files(save)
