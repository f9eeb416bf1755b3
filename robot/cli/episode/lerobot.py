"""`tacsim export lerobot`: recorded episodes as a LeRobot data set."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from robot.cli.output import busy, counted, new_directory, notes, say_files


def lerobot(
    episodes: Annotated[
        list[Path], typer.Argument(help="Recordings (episode.mcap), in their order, or folders of them.")
    ],
    out: Annotated[Path, typer.Option(metavar="DIR", help="New folder of the data set.")],
    task: Annotated[
        str | None,
        typer.Option(metavar="TEXT", help="The task in words.", show_default="made of each episode's task and goal"),
    ] = None,
    maps: Annotated[
        bool, typer.Option("--maps/--no-maps", help="With heights, gradients and flow; without, it loads faster.")
    ] = True,
    cut: Annotated[bool, typer.Option("--cut", help="Take recordings that were cut off, up to there.")] = False,
    video: Annotated[
        bool, typer.Option("--video", help="Pictures as H.264 video: a sixth of the room, about 1 grey level off.")
    ] = False,
) -> None:
    """Make a LeRobot data set (v3.0) of recorded episodes; for lerobot-train, Hugging Face datasets, pandas.

    Pictures are PNG inside the files, without loss. Needs the extra 'export'; with --video the extra 'video'.

    Example: tacsim export lerobot runs/*/episode.mcap --out data/squeeze
    """
    folder = new_directory(out, "lerobot")
    with busy("loading"):
        from robot.export.lerobot import export_lerobot

    with counted("exporting") as on_step:
        export_lerobot(_recordings(episodes), folder, task=task, maps=maps, cut=cut, video=video, on_step=on_step)
    notes.print(f'Load it: LeRobotDataset("{folder.name}", root="{folder}")', markup=False)
    say_files(folder)


def _recordings(given: list[Path]) -> list[Path]:
    """The files, and those in the folders by name. Raises typer.BadParameter for a folder without any."""
    found: list[Path] = []
    for path in given:
        inside = [path]
        if path.is_dir():
            inside = sorted(each for each in path.glob("*.mcap") if not each.name.startswith("."))
        if not inside:
            raise typer.BadParameter(f"{path} holds no recording (*.mcap)", param_hint="EPISODES")
        found += inside
    return found
