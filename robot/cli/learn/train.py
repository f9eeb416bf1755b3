"""Policies learned in simulation: `tacsim train`, `export policy`, `export policy-range`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from robot.cli.options import Out, Overrides, RayCluster, complete_names, require_packages
from robot.cli.output import (
    busy,
    new_directory,
    notes,
    one_bar,
    print_files,
    print_json,
    results,
    warn,
)

if TYPE_CHECKING:
    from robot.train.run_folder import RunFolder

TRAINING = ("torch", "stable_baselines3", "onnx", "onnxruntime")  # packages of the extra `train`
export = typer.Typer(no_args_is_help=True, help="Write policies and recordings as files for others.")

NewPolicyFile = Annotated[Path, typer.Option("--out", help="The file to be written, FILE.onnx; it must not exist.")]


def train(
    task: Annotated[
        str | None,
        typer.Argument(
            help="A shipped training file (`tacsim list training`), or the path of one.",
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
    run = _open_run(resume, bool(task or own or out)) if resume is not None else _begin_run(task, own, out, tensorboard)
    _require_logged(run.settings.training.algorithm, tensorboard)
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


def _open_run(folder: Path, has_other_options: bool) -> RunFolder:
    """The run in `folder`, to be continued."""
    if has_other_options:
        raise typer.BadParameter(
            f"a run keeps its settings ({folder / 'run.json'}): omit other options, or start a new run",
            param_hint="--resume",
        )
    with busy("loading"):
        from robot.train.run_folder import RunFolder

        return RunFolder(folder)


def _begin_run(task: str | None, overrides: Sequence[str], out: Path | None, tensorboard: bool) -> RunFolder:
    """A new run in a new folder."""
    if task is None:
        raise typer.BadParameter("name a training file (`tacsim list training`), or a run to continue (--resume)")
    from tacsim.config import load_model
    from tacsim.models.policy import Training

    training = load_model(Training, task, overrides)
    _require_logged(training.algorithm, tensorboard)  # before there is a folder
    folder = new_directory(out, f"train-{training.task}")
    with busy("loading"):
        from robot.train.train import begin_run

        return begin_run(training, folder)


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
