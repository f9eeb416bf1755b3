"""Commands on recorded episodes: `tacsim view` (also of a rig while it runs), `export lerobot`, `recover`."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from robot.cli.options import Out, Overrides, complete_names
from robot.cli.output import busy, counted, new_directory, notes, print_files, print_json, results
from robot.cli.run import run


def view(
    episode: Annotated[
        str,
        typer.Argument(
            metavar="EPISODE|RIG",
            help="An episode.mcap, complete or cut off; or a rig, shown live.",
            autocompletion=complete_names("rig"),
        ),
    ],
    save: Annotated[
        Path | None, typer.Option(metavar="FILE.rrd", help="Write a file for the viewer instead of starting one.")
    ] = None,
    task: Annotated[
        str | None,
        typer.Option(
            help="Of a rig, as in tacsim run.", show_default="the rig's own", autocompletion=complete_names("task")
        ),
    ] = None,
    steps: Annotated[
        int | None, typer.Option(min=0, help="Of a rig: control steps.", show_default="the task's; else 40")
    ] = None,
    set_: Overrides = None,
    out: Out = None,
) -> None:
    """Show an episode or a rig in Rerun: gels, flow and forces in space, images, plots, on one time line.

    A rig of hardware is only observed (tacsim run --dry-run), a simulated one runs its task (tacsim run). Needs the
    extra 'viz'; without it, `tacsim replay` makes a report.

    Example: tacsim view runs/first/episode.mcap
    """
    if save is not None and save.suffix != ".rrd":
        raise typer.BadParameter(f"{save} must end in .rrd, as the viewer's files do", param_hint="--save")
    path = Path(episode)
    if path.is_dir():
        raise typer.BadParameter(f"{path} is a folder; name the episode.mcap in it", param_hint="EPISODE|RIG")
    if path.suffix != ".mcap" and not (path.is_file() and path.suffix != ".yaml"):
        _view_live(episode, save, task, steps, set_, out)
        return
    for name, given in (("--task", task), ("--steps", steps), ("--set", set_), ("--out", out)):
        if given:
            raise typer.BadParameter(f"{episode} is a recording; this option is for rigs", param_hint=name)
    with busy("loading"):
        from robot.export.rerun_view import view_episode
    with counted("reading") as on_step:
        view_episode(path, save, on_step)
    if save is not None:
        print_files(save)
    print_json({}, [] if save is None else [save])


def _view_live(
    rig: str, save: Path | None, task: str | None, steps: int | None, set_: list[str] | None, out: Path | None
) -> None:
    from robot.open import load_with_task

    hardware = load_with_task(rig, task, set_ or []).config.clock == "wall"
    run(rig, task=task, steps=steps, dry_run=hardware, view=save is None, save_view=save, set_=set_, out=out)


def lerobot(
    episodes: Annotated[
        list[Path], typer.Argument(help="Recordings (episode.mcap), in their order, or folders of them.")
    ],
    out: Annotated[Path, typer.Option(metavar="DIR", help="New folder of the data set.")],
    task: Annotated[
        str | None,
        typer.Option(metavar="TEXT", help="Description of the task.", show_default="from each episode's task and goal"),
    ] = None,
    maps: Annotated[
        bool, typer.Option("--maps/--no-maps", help="With heights, gradients and flow; without, it loads faster.")
    ] = True,
    cut: Annotated[bool, typer.Option("--cut", help="Include recordings that were cut off.")] = False,
    video: Annotated[
        bool, typer.Option("--video", help="Images as H.264 video: a sixth of the size, error about 1 grey level.")
    ] = False,
) -> None:
    """Make a LeRobot data set (v3.0) of recorded episodes; for lerobot-train, Hugging Face datasets, pandas.

    Images are stored without loss, as PNG inside the files. Needs the extra 'export'; with --video the extra 'video'.

    Example: tacsim export lerobot runs/*/episode.mcap --out data/squeeze
    """
    folder = new_directory(out, "lerobot")
    with busy("loading"):
        from robot.export.lerobot import export_lerobot

    with counted("exporting") as on_step:
        export_lerobot(_find_recordings(episodes), folder, task=task, maps=maps, cut=cut, video=video, on_step=on_step)
    notes.print(f'Load it: LeRobotDataset("{folder.name}", root="{folder}")')
    print_files(folder)
    print_json({}, [folder])


def _find_recordings(given: list[Path]) -> list[Path]:
    """The given files, and those in the given folders by name. Raises typer.BadParameter for a folder without files."""
    found: list[Path] = []
    for path in given:
        inside = [path]
        if path.is_dir():
            inside = sorted(each for each in path.glob("*.mcap") if not each.name.startswith("."))
        if not inside:
            raise typer.BadParameter(f"{path} holds no recording (*.mcap)", param_hint="EPISODES")
        found += inside
    return found


def recover(
    file: Annotated[Path, typer.Argument(help="A recording that was cut off or damaged; it is only read.")],
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="The new file.", show_default="FILE.recovered.mcap next to it")
    ] = None,
) -> None:
    """Make a finished MCAP file of a recording that was cut off (killed, power, full disk) or damaged.

    tacsim reads recordings that were cut off as they are; other tools (Foxglove, mcap) need the end of the file with
    its index. Every complete step is kept; lost parts are listed.

    Example: tacsim recover runs/first/episode.mcap
    """
    new = file.with_name(f"{file.stem}.recovered.mcap") if out is None else out
    with busy("recovering"):
        from tacsim.record.recover import recover_recording as recover_file

        found = recover_file(file, new)
    if found.is_whole:
        results.print(f"{file} is complete: {found.steps} steps, its end and its index; nothing to recover")
        print_json(asdict(found), [])
        return
    lost = [] if found.finished else ["the end: the recording was cut off, or its index is damaged"]
    lost += [f"bytes {begin} to {end}: a step that was not finished, or is damaged" for begin, end in found.damaged]
    results.print(f"{found.steps} steps recovered; without:")
    for words in [
        *lost[:20],
        *([f"... and {len(lost) - 20} more parts"] if len(lost) > 20 else []),
        *found.missing[:20],
    ]:
        results.print(f"  {words}")
    print_files(new)
    print_json(asdict(found), [new])
