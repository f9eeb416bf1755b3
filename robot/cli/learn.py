"""Policies learned in simulation: `tacsim train`, `evaluate`, `transfer`, `export policy`, `export policy-range`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from robot.cli.options import Out, Overrides, RayCluster, TrainingFile, complete_names, require_packages
from robot.cli.output import (
    busy,
    choose_json_file,
    new_directory,
    notes,
    one_bar,
    print_files,
    print_json,
    require_writable,
    results,
    show_table,
    warn,
    writing,
)

if TYPE_CHECKING:
    from robot.train.evaluate import EvaluationResult, Interval
    from robot.train.run_folder import RunFolder
    from robot.train.transfer import SummaryRow
    from tacsim.models.task import Unit

TRAINING = ("torch", "stable_baselines3", "onnx", "onnxruntime")  # packages of the extra `train`
export = typer.Typer(no_args_is_help=True, help="Write policies and recordings as files for others.")

NewPolicyFile = Annotated[Path, typer.Option("--out", help="The file to be written, FILE.onnx; it must not exist.")]


def train(
    task: Annotated[
        str | None,
        typer.Argument(
            help="squeeze, reposition, knead, or the path of a training file.",
            autocompletion=complete_names("training"),
        ),
    ] = None,
    algorithm: Annotated[
        str | None,
        typer.Option(
            help="dagger (from a teacher), ppo or sac (from the reward).",
            show_default="the file's",
            autocompletion=complete_names(words=("dagger", "ppo", "sac")),
        ),
    ] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Same seed, same policy.", show_default="the file's")] = None,
    resume: Annotated[
        Path | None, typer.Option(help="The folder of a run that was stopped: it is continued to the same result.")
    ] = None,
    tensorboard: Annotated[
        bool,
        typer.Option("--tensorboard", help="PPO, SAC: also log for TensorBoard, to OUT/tensorboard (its package)."),
    ] = False,
    processes: Annotated[
        int | None,
        typer.Option(
            "--processes", min=1, help="Processes that simulate; the policy does not depend on it. One a core."
        ),
    ] = None,
    ray: RayCluster = None,
    set_: Overrides = None,
    out: Out = None,
) -> None:
    """Train a policy in simulation, and write it as a file for `tacsim run RIG --policy FILE`.

    A checkpoint and the learning curve (curve.png) are written after each round; `--resume` continues a run that was
    stopped. Needs the extra `train`.

    Example: tacsim train squeeze --out runs/squeeze-0
    """
    require_packages("tacsim train", "train", *TRAINING)
    if ray is not None:
        from robot.common.cluster import require_cluster

        require_cluster(ray)
    if tensorboard:
        _require_tensorboard()
    own = [f"algorithm={algorithm}"] * (algorithm is not None) + [f"seed={seed}"] * (seed is not None) + (set_ or [])
    if resume is not None:
        if task is not None or own or out is not None:
            raise typer.BadParameter(
                f"a run keeps its settings ({resume / 'run.json'}): omit other options, or start a new run",
                param_hint="--resume",
            )
        with busy("loading"):
            from robot.train.run_folder import RunFolder

            run = RunFolder(resume)
        _require_logged(run.settings.training.algorithm, tensorboard)
    else:
        if task is None:
            raise typer.BadParameter("name a task (squeeze, reposition, knead), or a run to continue (--resume)")
        from tacsim.config import load_model
        from tacsim.models.policy import Training

        training = load_model(Training, task, own)
        _require_logged(training.algorithm, tensorboard)
        folder = new_directory(out, f"train-{training.task}")
        with busy("loading"):
            from robot.train.train import begin_run

            run = begin_run(training, folder)
    from robot.common.cluster import ClusterError
    from robot.rig.env_workers import WorkerFailed
    from tacsim.tasks.task import BadDraws

    try:
        path, rounds = _run_training(run, tensorboard, processes, ray)
    except BadDraws:
        if run.load_checkpoint()[0]:
            notes.print(f"The last checkpoint is kept. Write it as a file: tacsim export policy {run.folder}")
        raise
    except (KeyboardInterrupt, OSError, WorkerFailed, ClusterError):
        where = "" if ray is None else f" --ray {ray}"
        notes.print(f"The last checkpoint is kept. Continue: tacsim train --resume {run.folder}{where}")
        raise
    print_files(path, run.folder / "curve.png", run.folder / "curve.json")
    print_json({"rounds": rounds}, [path, run.folder / "curve.png", run.folder / "curve.json"])
    notes.print(f"Next: tacsim evaluate {task or run.settings.training.task} --policy {path} --policy scripted")


def _require_tensorboard() -> None:
    from importlib.util import find_spec

    from robot.open import CannotOpen

    if find_spec("tensorboard") is None:
        raise CannotOpen("--tensorboard needs tensorboard, which is not installed: pip install tensorboard")


def _require_logged(algorithm: str, tensorboard: bool) -> None:
    if tensorboard and algorithm == "dagger":
        raise typer.BadParameter(
            "dagger writes no log for TensorBoard: see curve.png, or choose --algorithm ppo or sac",
            param_hint="--tensorboard",
        )


def _run_training(
    run: RunFolder, tensorboard: bool, processes: int | None, cluster: str | None
) -> tuple[Path, list[Mapping[str, float]]]:
    """Trains; returns the file of the policy and the figures of each round."""
    from robot.train.train import train as continue_training
    from tacsim.models.task import unit_of

    rounds: list[Mapping[str, float]] = []
    unit = unit_of(run.settings.spec.task)

    def print_result(figures: Mapping[str, float]) -> None:
        rounds.append(figures)
        results.print(
            f"round {figures['round']:.0f}: {unit.show(figures['distance'])} from the goal, success "
            f"{100 * figures['success']:.0f} %, {figures['peak_force']:.1f} N at most, "
            f"{figures['steps'] / figures['seconds']:.0f} steps/s"
            + (f", {figures['refused']:.0f} draws refused" if figures["refused"] else "")
        )

    with one_bar("starting") as bar:
        return continue_training(run, bar.report, print_result, warn, tensorboard, processes, cluster), rounds


def policy(
    run: Annotated[Path, typer.Argument(help="The folder of a training run, finished or not.")],
    out: NewPolicyFile,
) -> None:
    """Write the policy of a training run as one ONNX file, which contains a description of its inputs and outputs.

    Needs the extra `train`; to run the file, the extra `policy` is sufficient.

    Example: tacsim export policy runs/squeeze-0 --out squeeze.onnx
    """
    require_packages("tacsim export policy", "train", *TRAINING)
    _require_new(out)
    with busy("exporting, and observing episodes of its training"):
        from robot.train.run_folder import RunFolder
        from robot.train.train import export_policy

        worst = export_policy(RunFolder(run), out)
    results.print(f"{out} ({out.stat().st_size / 1024:.0f} KiB), within {worst:.1g} of the network")
    print_json({"error": worst}, [out])


def policy_range(
    policy: Annotated[Path, typer.Argument(help="A policy, FILE.onnx.")],
    out: NewPolicyFile,
    training: Annotated[
        str | None,
        typer.Option(help="Name or path of the training file.", show_default="as recorded in the policy"),
    ] = None,
    episodes: Annotated[
        int | None, typer.Option(min=2, max=10_000, help="Number of episodes.", show_default="4 of each environment")
    ] = None,
    set_: Overrides = None,
) -> None:
    """Write a policy again, with the range of its observations in episodes of its training.

    The policy acts in episodes drawn as in the training file. `tacsim run` and `tacsim evaluate` then report when
    observations leave that range, and which parameters of a simulated scene do. Needs onnx (extra `train`).

    Example: tacsim export policy-range mine.onnx --training squeeze --out mine-with-range.onnx
    """
    require_packages("tacsim export policy-range", "train", "onnx")
    _require_new(out)
    if set_ and training is None:
        raise typer.BadParameter("--set changes a training file: name it with --training", param_hint="--set")
    from robot.train.measure_range import measure_range, write_range
    from tacsim.config import load_model
    from tacsim.models.policy import Training

    settings = None if training is None else load_model(Training, training, set_ or [])
    with one_bar("starting") as bar:
        found = measure_range(policy, settings, episodes, bar.report)
    write_range(policy, out, found)
    results.print(f"{out}: range of {found.episodes} episodes")
    print_json({"episodes": found.episodes}, [out])


def _require_new(out: Path) -> None:
    if out.suffix != ".onnx":
        raise typer.BadParameter(f"{out} must end in .onnx", param_hint="--out")
    if out.exists():
        raise typer.BadParameter(f"{out} exists already; name a new file, nothing is overwritten", param_hint="--out")


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
            help="squeeze, reposition, knead, hold, or the path of a task file.", autocompletion=complete_names("task")
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
    from tacsim.models.randomisation import Randomisation

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
