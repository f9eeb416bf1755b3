"""`tacsim transfer`: the same policies in simulation and on the mock rig with a hidden twin."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from robot.cli.options import Overrides
from robot.cli.output import notes, one_bar, results, show_table, writing

if TYPE_CHECKING:
    from robot.train.transfer import Row


def transfer(
    task: Annotated[str, typer.Argument(help="squeeze, reposition, knead, or the path of a task file.")],
    policy: Annotated[
        list[str] | None,
        typer.Option(
            help="learned (the shipped one), scripted, FILE.onnx; may be repeated.", show_default="learned, scripted"
        ),
    ] = None,
    twin: Annotated[
        str | None,
        typer.Option(help="Randomisation that draws the hidden twins: a name or path.", show_default="TASK-twin"),
    ] = None,
    episodes: Annotated[int, typer.Option(min=2, max=10_000, help="Of each policy on each side.")] = 20,
    every: Annotated[int, typer.Option(min=1, max=10_000, help="Another twin every so many episodes.")] = 5,
    steps: Annotated[
        int | None, typer.Option(min=1, help="Control steps of an episode.", show_default="the task's")
    ] = None,
    workers: Annotated[int, typer.Option(min=1, max=64, help="Rigs side by side, each in a process of its own.")] = 1,
    out: Annotated[Path, typer.Option(help="Folder; one that was begun goes on.")] = Path("runs/transfer"),
    set_: Overrides = None,
) -> None:
    """Compare what policies reach in simulation and, over the real wire, on mock hardware whose hidden twin differs.

    Each episode is played on both sides; the simulation has of the twin only the goal and the body's size. Killed
    anywhere, the same command goes on, with further policies too. Writes transfer.json, transfer.png and how each
    episode ended.

    Example: tacsim transfer squeeze --policy learned --policy scripted --episodes 20
    """
    import json
    from dataclasses import asdict

    from robot.train.transfer import Study, picture, play, summary
    from tacsim.config import load
    from tacsim.models.randomisation import Randomisation

    twins = load(Randomisation, f"{task}-twin" if twin is None else twin)
    policies = tuple(policy or ("learned", "scripted"))
    study = Study(task, policies, twins, episodes, every, steps, tuple(set_ or ()))
    with writing(out):
        out.mkdir(parents=True, exist_ok=True)
    with one_bar("starting") as bar:

        def tell(words: str, done: int, of: int) -> None:
            bar.say(words)
            bar.count(done, of)
            if not notes.is_terminal:
                notes.print(f"{done} of {of}: {words}", markup=False)

        rows = summary(play(study, out, tell, workers))
    with writing(out):
        (out / "transfer.json").write_text(json.dumps([asdict(row) for row in rows], indent=1) + "\n", encoding="utf-8")
        picture(rows, out / "transfer.png")
    _show(rows, episodes)
    for name in ("transfer.json", "transfer.png"):
        results.print(str(out / name))


def _show(rows: list[Row], episodes: int) -> None:
    from robot.cli.learn.evaluate import interval_text

    shown = [
        (
            row.policy,
            row.side,
            interval_text(row.success, 100, 0),
            "–" if row.distance is None else interval_text(row.distance, 1e3, 3),
            "–" if row.agreement is None else f"{1e3 * row.agreement:.3f}",
            str(row.failures),
        )
        for row in rows
    ]
    columns = ("policy", "", "success [%]", "distance [mm]", "felt - true, rms [mm]", "errors")
    show_table(f"{episodes} episodes each, 95 % intervals", columns, shown, left={0, 1})
