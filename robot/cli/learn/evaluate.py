"""Policies judged in simulation and on a hidden twin: `tacsim evaluate`, `tacsim transfer`."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from robot.cli.options import Overrides, TrainingFile, complete_names
from robot.cli.output import (
    choose_json_file,
    notes,
    one_bar,
    print_files,
    print_json,
    require_writable,
    show_table,
    warn,
    writing,
)

if TYPE_CHECKING:
    from robot.train.evaluate import EvaluationResult, Interval
    from robot.train.transfer import SummaryRow
    from tacsim.models.task import Unit


def evaluate(
    task: TrainingFile,
    policy: Annotated[
        list[str] | None,
        typer.Option(
            help="teacher (uses the truth), random, scripted, learned (the shipped one), FILE.onnx; may be repeated.",
            show_default="teacher, scripted, random",
            autocompletion=complete_names(words=("teacher", "random", "scripted", "learned")),
        ),
    ] = None,
    episodes: Annotated[int, typer.Option(min=2, max=10_000, help="Of each policy.")] = 200,
    seed: Annotated[int, typer.Option(min=0, help="Same seed, same episodes.")] = 0,
    json_: Annotated[
        Path | None,
        typer.Option(
            "--json",
            metavar="FILE|-",
            callback=choose_json_file,
            help="Write the result of each episode, during the evaluation; or -: print the result as JSON.",
            show_default=False,
        ),
    ] = None,
    set_: Overrides = None,
) -> None:
    """Compare policies in the same episodes, with bodies and goals that do not occur in training.

    Success with Wilson's interval, distance and improvement (share of the distance at the start) with a bootstrap's,
    all of 95 %; the peak of the normal force as mean and 95 % quantile; the share of episodes in which observations of
    a learned policy left its training range.

    Example: tacsim evaluate squeeze --policy learned --policy scripted --episodes 50
    """
    file = None if json_ == Path("-") else json_
    require_writable(file, "--json", new=True)
    from robot.train.evaluate import evaluate as evaluate_policies
    from tacsim.config import load_model
    from tacsim.models.policy import Training

    training = load_model(Training, task, set_ or [])
    played: dict[str, EvaluationResult] = {}
    with one_bar("starting") as bar:

        def print_result(so_far: EvaluationResult) -> None:
            played[so_far.policy] = so_far
            if file is not None:
                _write_results(file, played.values())
            done, success = len(so_far.episodes), _interval_text(so_far.success, 100, 0)
            notes.print(f"{so_far.policy}: {done} of {episodes} episodes, success {success} %")

        evaluation_results = evaluate_policies(
            training, policy or ["teacher", "scripted", "random"], episodes, seed, bar.report, print_result, warn
        )
    _show_evaluation(evaluation_results)
    print_json({each.policy: _describe_evaluation(each) for each in evaluation_results})


def _write_results(path: Path, evaluation_results: Iterable[EvaluationResult]) -> None:
    import json

    from robot.common.whole_file import write_whole

    ends = {each.policy: [end._asdict() for end in each.episodes] for each in evaluation_results}
    write_whole(path, (json.dumps(ends, indent=1) + "\n").encode())


def _describe_evaluation(found: EvaluationResult) -> dict[str, Any]:
    mean, quantile = found.peak_force
    return {
        "success": found.success,
        "distance": found.distance,  # [m]
        "improvement": found.improvement,
        "peak_force": {"mean": mean, "quantile_95": quantile},  # [N]
        "outside_training": found.outside,
        "episodes": [each._asdict() for each in found.episodes],
    }


def _show_evaluation(evaluation_results: list[EvaluationResult]) -> None:
    names, rows = [Path(each.policy).name for each in evaluation_results], []
    if len(set(names)) < len(names):
        names = [each.policy for each in evaluation_results]
    for name, each in zip(names, evaluation_results, strict=True):
        mean, quantile = each.peak_force
        rows.append(
            (
                name,
                _interval_text(each.success, 100, 0),
                _interval_text(each.distance, each.unit.factor, 3),
                _interval_text(each.improvement, 100, 0),
                f"{mean:.1f}, {quantile:.1f}",
                "–" if each.outside is None else f"{100 * each.outside:.0f}",
            )
        )
    distance = f"distance [{evaluation_results[0].unit.symbol}]"
    columns = ("policy", "success [%]", distance, "improvement [%]", "peak force [N]", "outside training [%]")
    show_table(f"{len(evaluation_results[0].episodes)} unseen episodes, 95 % intervals", columns, rows, left={0})


def _interval_text(interval: Interval, scale: float, digits: int) -> str:
    value, low, high = (f"{scale * number:.{digits}f}" for number in (interval.value, interval.low, interval.high))
    return f"{value} ({low} to {high})"


def transfer(
    task: Annotated[
        str,
        typer.Argument(
            help="squeeze, hold, turn, peg, drawer; another shipped task or the path of a task file needs --twin.",
            autocompletion=complete_names("task"),
        ),
    ],
    policy: Annotated[
        list[str] | None,
        typer.Option(
            help="learned (the shipped one), scripted, FILE.onnx; may be repeated.",
            show_default="learned, scripted",
            autocompletion=complete_names(words=("learned", "scripted")),
        ),
    ] = None,
    twin: Annotated[
        str | None,
        typer.Option(
            help="Randomisation that draws the hidden twins: a name or path.",
            show_default="TASK-twin",
            autocompletion=complete_names("randomisation"),
        ),
    ] = None,
    episodes: Annotated[int, typer.Option(min=2, max=10_000, help="Of each policy on each side.")] = 20,
    every: Annotated[int, typer.Option(min=1, max=10_000, help="Number of episodes with the same hidden twin.")] = 5,
    steps: Annotated[
        int | None, typer.Option(min=1, help="Control steps of an episode.", show_default="the task's")
    ] = None,
    workers: Annotated[int, typer.Option(min=1, max=64, help="Parallel rigs, each in a separate process.")] = 1,
    out: Annotated[Path, typer.Option(help="Folder; a study in it is continued.")] = Path("runs/transfer"),
    set_: Overrides = None,
) -> None:
    """Compare results of policies in simulation and on a hidden twin: mock hardware with the real protocols, or for a
    task with a rigid object another simulated hand.

    Each episode runs on both sides; the simulation knows only the goal and the body's size of the twin. After an
    interruption, the same command continues, also with more policies. Writes transfer.json, transfer.png and the
    result of each episode.

    Example: tacsim transfer squeeze --policy learned --policy scripted --episodes 20
    """
    import json
    from dataclasses import asdict

    from robot.deploy.policy import require_policy_name
    from robot.train.transfer import Study, draw_figure, play_study, summarise
    from tacsim.config import load_model
    from tacsim.config.kinds import is_name
    from tacsim.models.randomisation import Randomisation

    if twin is None and not is_name(task):
        raise typer.BadParameter(f"'{task}' has no twin of its own: give --twin, the randomisation that draws one")
    twins = load_model(Randomisation, f"{task}-twin" if twin is None else twin)
    policies = tuple(policy or ("learned", "scripted"))
    for name in policies:
        require_policy_name(name)
    study = Study(task, policies, twins, episodes, every, steps, tuple(set_ or ()))
    with writing(out):
        out.mkdir(parents=True, exist_ok=True)
    with one_bar("starting") as bar:

        def report(words: str, done: int, of: int) -> None:
            bar.report(words, done, of)
            if not notes.is_terminal:
                notes.print(f"{done} of {of}: {words}")

        rows = summarise(play_study(study, out, report, workers))
    table, picture = out / "transfer.json", out / "transfer.png"
    with writing(out):
        table.write_text(json.dumps([asdict(row) for row in rows], indent=1) + "\n", encoding="utf-8")
        draw_figure(rows, picture, study.config.unit)
    _show_transfer(rows, episodes, study.config.unit)
    print_files(table, picture)
    print_json({"rows": rows}, [table, picture])


def _show_transfer(rows: list[SummaryRow], episodes: int, unit: Unit) -> None:
    shown = [
        (
            row.policy,
            row.side,
            _interval_text(row.success, 100, 0),
            "–" if row.distance is None else _interval_text(row.distance, unit.factor, 3),
            "–" if row.agreement is None else f"{unit.factor * row.agreement:.3f}",
            str(row.failures),
        )
        for row in rows
    ]
    distances = (f"{what} [{unit.symbol}]" for what in ("distance", "tactile - true, rms"))
    columns = ("policy", "", "success [%]", *distances, "errors")
    show_table(f"{episodes} episodes each, 95 % intervals", columns, shown, left={0, 1})
