"""The benchmark of policies: `tacsim benchmark run`, `verify`, `compare`, `table`, `rank`, `tasks`,
`draw`, `fit-blind`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from robot.cli.options import complete_names
from robot.cli.output import notes, one_bar, print_files, print_json, results, show_table, warn
from robot.cli.terminal import EXIT_UNTRUSTED, EXIT_UNVERIFIED, Interrupt

if TYPE_CHECKING:
    from robot.train.benchmark.compare import Row
    from robot.train.benchmark.score import Score
    from robot.train.evaluate import Interval
    from tacsim.models.task import Unit

benchmark = typer.Typer(
    no_args_is_help=True, help="Rank policies: frozen episodes, scores with hashes, paired comparison (version v1)."
)


class RigChoice(StrEnum):
    """Where episodes are played."""

    sim = "sim"
    mock = "mock"


POLICIES = ("random", "blind", "analytic", "scripted", "teacher", "learned")
TaskFile = Annotated[
    str,
    typer.Argument(
        metavar="TASK",
        help="A task of the benchmark (tacsim benchmark tasks), or the path of a task file.",
        autocompletion=complete_names("benchmark"),
    ),
]
ScoreFile = Annotated[Path, typer.Argument(exists=True, dir_okay=False, help="A score file of `tacsim benchmark run`.")]


def tasks() -> None:
    """List the tasks of the benchmark, with their splits and the hash of their episodes.

    Example: tacsim benchmark tasks
    """
    from robot.train.benchmark.episodes import load_split, shipped_tasks

    splits = [load_split(name) for name in shipped_tasks()]
    print_json(
        [
            {
                "task": each.task_name,
                "level": each.task.level,
                "reason": each.task.reason,
                "splits": each.task.splits,
                "episodes": len(each.episodes),
                "test_sha256": each.sha256,
            }
            for each in splits
        ]
    )
    rows = [
        (each.task_name, each.task.level, str(len(each.episodes)), each.sha256[:12], ", ".join(each.task.splits))
        for each in splits
    ]
    show_table("", ("task", "level", "episodes a split", "hash of test", "splits"), rows, left={0, 1, 3, 4})


def run(
    task: TaskFile,
    policy: Annotated[
        list[str] | None,
        typer.Option(
            help="random, blind, analytic, scripted, teacher, learned, FILE.onnx, module:Class; may be repeated.",
            show_default="random, blind, analytic, scripted, teacher",
            autocompletion=complete_names(words=POLICIES),
        ),
    ] = None,
    split: Annotated[
        list[str] | None, typer.Option(help="test, shift-..., or all; may be repeated.", show_default="test")
    ] = None,
    full: Annotated[bool, typer.Option("--full", help="All 200 episodes of a split, not the first 24.")] = False,
    episodes: Annotated[
        int | None, typer.Option(min=1, help="Only the first N for now; a later run continues.", show_default="all")
    ] = None,
    rig: Annotated[RigChoice, typer.Option(help="mock: over the real wire on loopback.")] = RigChoice.sim,
    environments: Annotated[
        int, typer.Option(min=1, max=1024, help="Simulated episodes that move together; results do not depend on it.")
    ] = 8,
    out: Annotated[Path, typer.Option(help="Folder of the scores; what it has is not played again.")] = Path(
        "runs/benchmark"
    ),
) -> None:
    """Play the frozen episodes of a task with policies, and write a score file for each policy and split.

    After an interruption the same command continues. An episode in which a policy raises is a failed episode, with the
    reason in the score file. `module:Class` runs code of that module.

    Example: tacsim benchmark run squeeze --policy analytic --policy learned --policy mine.onnx
    """
    from robot.train.benchmark.compare import make_rows
    from robot.train.benchmark.episodes import load_task_file
    from robot.train.benchmark.run import Run, run_benchmark

    policies = tuple(dict.fromkeys(policy or POLICIES[:5]))
    known = load_task_file(task).splits
    splits = known if split == ["all"] else tuple(dict.fromkeys(split or ["test"]))
    work = Run(task, policies, splits, "full" if full else "quick", out, environments, rig.value, episodes)

    with Interrupt(), one_bar("starting") as bar:
        try:
            found = run_benchmark(work, bar.report, _report_score, warn)
        except KeyboardInterrupt:
            notes.print(f"The episodes that are done are kept in {out}. The same command continues.")
            raise
    rows = make_rows([score for _, score in found])
    _show_rows(rows)
    print_files(*(path for path, _ in found))
    print_json({"rows": rows}, [path for path, _ in found])


def _report_score(path: Path, score: Score) -> None:
    """Prints the success of a complete score, and what must be checked before it is trusted."""
    failed = sum(each.end in ("error", "not begun") for each in score.episodes)
    notes.print(f"{score.policy}, {score.where}: success {_percent(score.success)} %, {path}")
    if failed:
        first = next(each for each in score.episodes if each.end in ("error", "not begun"))
        warn(f"{score.policy}: {failed} episodes failed; episode {first.episode}: {first.reason}")
    if outside := sum(bool(each.outside) for each in score.episodes):
        warn(
            f"{score.policy}: in {outside} of {len(score.episodes)} episodes of {score.split} its observations "
            "leave the range of its training"
        )


def verify(
    score: ScoreFile,
    episodes: Annotated[int | None, typer.Option(min=1, help="How many to play again.", show_default="3")] = None,
    all_: Annotated[bool, typer.Option("--all", help="Play all episodes again.")] = False,
    policy: Annotated[
        str | None, typer.Option(help="Where the policy is here.", show_default="as in the score")
    ] = None,
    task: Annotated[
        str | None, typer.Option(help="Path of the task file of a task that is not shipped.", show_default=False)
    ] = None,
) -> None:
    """Play a sample of the episodes of a score again, and compare the bits.

    Exit code 0: they are equal. 3: they are not, or the file was edited. 4: they are not, and the simulator, the vector
    width of the processor or a package differs, so nothing can be said here. 2: another policy file, task or episodes.

    Example: tacsim benchmark verify runs/benchmark/squeeze/test/analytic.quick.json
    """
    from robot.train.benchmark.verify import verify_score

    with _refuse_edited_scores(), one_bar("reading") as bar:
        found = verify_score(score, None if all_ else episodes or 3, policy, task, bar.report)
    for check in found.checks:
        if check.is_equal:
            continue
        what = [
            *["actions"] * (not check.same_actions),
            *["states"] * (not check.same_states),
            *["numbers in the file"] * (check.same_states and not check.same_numbers),
        ]
        recorded, now, unit = check.recorded, check.found, found.score.unit
        warn(
            f"episode {check.episode}: {', '.join(what) or 'numbers'} differ; in the file a distance of "
            f"{_distance(recorded.distance, unit)}, here {_distance(now.distance, unit)}; success "
            f"{recorded.success} and {now.success}"
        )
    for words in found.differences:
        notes.print(f"differs from where it was computed: {words}")
    agreeing = sum(check.is_equal for check in found.checks)
    results.print(f"{found.verdict}: {agreeing} of {len(found.checks)} episodes have the bits of the score")
    print_json(
        {
            "verdict": found.verdict,
            "differences": found.differences,
            "episodes": [{"episode": each.episode, "agrees": each.is_equal} for each in found.checks],
            "result_sha256": found.score.result_sha256,
        }
    )
    if found.verdict != "agrees":
        raise typer.Exit(EXIT_UNTRUSTED if found.verdict == "differs" else EXIT_UNVERIFIED)


def compare(first: ScoreFile, second: ScoreFile) -> None:
    """Compare two policies in the episodes that both have played: McNemar's exact test, difference of the distance.

    Example: tacsim benchmark compare runs/benchmark/squeeze/test/analytic.json runs/benchmark/squeeze/test/learned.json
    """
    from robot.train.benchmark.compare import compare_scores
    from robot.train.benchmark.score import read_score

    with _refuse_edited_scores():
        one, two = read_score(first), read_score(second)
    found = compare_scores(one, two)
    if not found.same_physics:
        warn("the two scores were computed with another simulator or another vector width (tacsim benchmark verify)")
    alone = [str(found.first_alone), str(found.second_alone)]
    safe_alone = [str(found.safe_first_alone), str(found.safe_second_alone)]
    rows = [
        ("success", str(found.both), *alone, str(found.neither), f"{found.p_value:.3g}"),
        ("safe success", "–", *safe_alone, "–", f"{found.safe_p_value:.3g}"),
    ]
    columns = ("episodes", "both", f"{one.policy} alone", f"{two.policy} alone", "neither", "p (McNemar, exact)")
    show_table(f"{found.episodes} episodes of {one.task}, {one.split}", columns, rows, left={0})
    if found.difference is not None:
        results.print(f"distance of {one.policy} minus that of {two.policy}: {_with_unit(found.difference, one.unit)}")
    print_json(found)


def table(
    folder: Annotated[Path, typer.Argument(exists=True, file_okay=False, help="Folder with score files.")],
    markdown: Annotated[bool, typer.Option("--markdown", help="Print the table as Markdown.")] = False,
) -> None:
    """Print the table of all scores in a folder. Distances are normalised by those of random and teacher there.

    Example: tacsim benchmark table runs/benchmark
    """
    from robot.train.benchmark.compare import make_rows
    from robot.train.benchmark.score import find_scores

    with _refuse_edited_scores():
        scores = find_scores(folder)
    if not scores:
        raise typer.BadParameter(f"{folder} has no score files; tacsim benchmark run writes them", param_hint="FOLDER")
    rows = make_rows([score for _, score in scores])
    if markdown:
        cells = [_COLUMNS, ["---"] * len(_COLUMNS), *map(_cells, rows)]
        results.print("\n".join(f"| {' | '.join(each)} |" for each in cells))
    else:
        _show_rows(rows)
    print_json({"rows": rows})


def rank(
    folder: Annotated[Path, typer.Argument(exists=True, file_okay=False, help="Folder with score files.")],
    other: Annotated[
        Path | None,
        typer.Argument(exists=True, file_okay=False, help="Folder with those of the twin.", show_default="the same"),
    ] = None,
    split: Annotated[str, typer.Option(help="Split in simulation.")] = "test",
    other_split: Annotated[str, typer.Option(help="Split of the twin.")] = "shift-all",
    other_rig: Annotated[RigChoice, typer.Option(help="Rig of the twin.")] = RigChoice.sim,
    out: Annotated[Path | None, typer.Option(help="Draw the figure here (PNG).", show_default=False)] = None,
) -> None:
    """Compare the order of policies in simulation with their order on a twin: Spearman's and Kendall's correlation.

    Example: tacsim benchmark rank runs/benchmark --out ranking.png
    """
    from robot.train.benchmark.rank import draw_ranking, rank_policies
    from robot.train.benchmark.score import find_scores

    with _refuse_edited_scores():
        here, there = ([score for _, score in find_scores(each)] for each in (folder, other or folder))
    twins = [each for each in there if (each.split, each.rig) == (other_split, other_rig.value)]
    found = rank_policies([each for each in here if (each.split, each.rig) == (split, "sim")], twins)
    names = split, other_split if other_rig == RigChoice.sim else f"{other_split} ({other_rig.value})"
    for each in found:
        rows = [(pair.policy, str(pair.episodes), *map(_percent, pair.success)) for pair in each.pairs]
        show_table(each.task, ("policy", "episodes", *(f"{name} [%]" for name in names)), rows, left={0})
    rows = [
        (each.task, measure, str(len(each.pairs)), *map(_correlation, (order.spearman, order.kendall)), violation)
        for each in found
        for measure, order, violation in (
            ("success", each.by_success, f"{100 * each.by_success.violation:.1f} %"),
            ("distance", each.by_distance, each.unit.show(each.by_distance.violation)),
        )
    ]
    columns = ("task", "order by", "policies", "Spearman", "Kendall", "mean largest violation")
    show_table("95 % intervals by a bootstrap over episodes", columns, rows, left={0, 1}, width=170)
    if out is not None:
        draw_ranking(found, out, names)
        print_files(out)
    print_json({"rankings": found}, [] if out is None else [out])


def draw(
    task: Annotated[str, typer.Argument(metavar="TASK.yaml", help="Path of a task file.")],
    episodes: Annotated[int, typer.Option(min=2, max=10_000, help="Of each split.")] = 200,
) -> None:
    """Draw the episodes of a new task once, and write them next to its file, with their hash. Nothing is overwritten.

    Example: tacsim benchmark draw mine.yaml
    """
    from robot.train.benchmark.episodes import draw_episodes

    path = draw_episodes(task, episodes)
    print_files(path)
    print_json({}, [path])
    notes.print(f"Next: tacsim benchmark fit-blind {task}")


def fit_blind(
    task: Annotated[str, typer.Argument(metavar="TASK.yaml", help="Path of a task file.")],
    episodes: Annotated[int, typer.Option(min=8, max=10_000, help="Of the teacher, to fit to.")] = 96,
    environments: Annotated[int, typer.Option(min=1, max=1024, help="Episodes that move together.")] = 16,
) -> None:
    """Fit the baseline `blind` of a new task to its teacher, and write it next to the task file.

    Example: tacsim benchmark fit-blind mine.yaml
    """
    from robot.train.benchmark.fit import fit_task

    with one_bar("starting") as bar:
        path = fit_task(task, episodes, environments, bar.report)
    print_files(path)
    print_json({}, [path])


@contextmanager
def _refuse_edited_scores() -> Iterator[None]:
    """Ends the command with the exit code of a result that is not to be trusted."""
    from robot.cli.terminal import print_error
    from robot.train.benchmark.score import ScoreEdited

    try:
        yield
    except ScoreEdited as failure:
        print_error(str(failure))
        raise typer.Exit(EXIT_UNTRUSTED) from None


_COLUMNS = [
    "task", "split", "policy", "episodes", "success [%]", "safe [%]", "distance", "normalised",
    "peak force [N]", "steps to goal", "outside [%]",
]  # fmt: skip


def _cells(row: Row) -> list[str]:
    return [
        row.task,
        row.split,
        row.policy if ":" in row.policy else Path(row.policy).name,
        f"{row.episodes}{'' if row.complete else ' (not complete)'}",
        _percent(row.success),
        _percent(row.safe_success),
        "–" if row.distance is None else _with_unit(row.distance, row.unit),
        "–" if row.normalised is None else f"{row.normalised:.2f}",
        f"{row.peak_force:.1f}",
        "–" if row.steps != row.steps else f"{row.steps:.0f}",
        "–" if row.outside is None else f"{100 * row.outside:.0f}",
    ]


def _show_rows(rows: Sequence[Row]) -> None:
    show_table("95 % intervals; outside: of the training range", _COLUMNS, map(_cells, rows), left={0, 1, 2}, width=170)


def _percent(interval: Interval) -> str:
    return _interval(interval, 100, 0)


def _interval(interval: Interval, scale: float, digits: int) -> str:
    value, low, high = (f"{scale * number:.{digits}f}" for number in (interval.value, interval.low, interval.high))
    return f"{value} ({low} to {high})"


def _correlation(interval: Interval | None) -> str:
    return "–" if interval is None else _interval(interval, 1, 2)


def _with_unit(interval: Interval, unit: Unit) -> str:
    return f"{_interval(interval, unit.factor, 3)} {unit.symbol}"


def _distance(distance: float | None, unit: Unit) -> str:
    return "–" if distance is None else f"{unit.factor * distance:.6g} {unit.symbol}"
