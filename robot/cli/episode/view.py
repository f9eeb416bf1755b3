"""`tacsim view`: a recorded episode, or a rig while it runs, in the Rerun viewer."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from robot.cli.options import Out, Overrides
from robot.cli.output import busy, counted, say_files
from robot.cli.run import run


def view(
    episode: Annotated[
        str,
        typer.Argument(metavar="EPISODE|RIG", help="An episode.mcap, cut off or not; or a rig, looked at live."),
    ],
    save: Annotated[
        Path | None, typer.Option(metavar="FILE.rrd", help="Write a file for the viewer instead of starting one.")
    ] = None,
    task: Annotated[str | None, typer.Option(help="Of a rig, as in tacsim run.", show_default="the rig's own")] = None,
    steps: Annotated[
        int | None, typer.Option(min=0, help="Of a rig: control steps.", show_default="the task's; else 40")
    ] = None,
    set_: Overrides = None,
    out: Out = None,
) -> None:
    """Look at an episode or a rig in Rerun: gels, flow and forces in space, pictures, plots, on one time line.

    A rig of hardware is only looked at (tacsim run --dry-run), a simulated one runs its task (tacsim run). Needs the
    extra 'viz'; without it, `tacsim replay` makes a report.

    Example: tacsim view runs/first/episode.mcap
    """
    if save is not None and save.suffix != ".rrd":
        raise typer.BadParameter(f"{save} must end in .rrd, as the viewer's files do", param_hint="--save")
    path = Path(episode)
    if path.is_dir():
        raise typer.BadParameter(f"{path} is a folder; name the episode.mcap in it", param_hint="EPISODE|RIG")
    if path.suffix != ".mcap" and not (path.is_file() and path.suffix != ".yaml"):
        _live(episode, save, task, steps, set_, out)
        return
    for name, given in (("--task", task), ("--steps", steps), ("--set", set_), ("--out", out)):
        if given:
            raise typer.BadParameter(f"{episode} is a recording; this is for rigs", param_hint=name)
    with busy("loading"):
        from robot.export.rerun_view import view_episode
    with counted("reading") as on_step:
        view_episode(path, save, on_step)
    if save is not None:
        say_files(save)


def _live(
    rig: str, save: Path | None, task: str | None, steps: int | None, set_: list[str] | None, out: Path | None
) -> None:
    from robot.open import load_with_task

    hardware = load_with_task(rig, task, set_ or []).config.clock == "wall"
    run(rig, task=task, steps=steps, dry_run=hardware, view=save is None, save_view=save, set_=set_, out=out)
