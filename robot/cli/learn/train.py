"""`tacsim train`: a policy that only feels, from one that knows the truth; or from the reward alone."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from robot.cli.options import Out, Overrides
from robot.cli.output import busy, new_directory, notes, one_bar, results, say_files, warn

if TYPE_CHECKING:
    from robot.train.run_folder import RunFolder
    from tacsim.models.training import Training


def train(
    task: Annotated[
        str | None, typer.Argument(help="squeeze, reposition, knead, or the path of a training file.")
    ] = None,
    algorithm: Annotated[
        str | None,
        typer.Option(help="dagger (a teacher shows), ppo or sac (from the reward alone).", show_default="the file's"),
    ] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Same seed, same policy.", show_default="the file's")] = None,
    resume: Annotated[
        Path | None, typer.Option(help="The folder of a run that was stopped: it goes on to the same end.")
    ] = None,
    set_: Overrides = None,
    out: Out = None,
) -> None:
    """Train a policy in simulation, and write it as a file for `tacsim run RIG --policy FILE`.

    A checkpoint is kept after each round; whatever ends the run, `--resume` goes on. Needs the extra `train`.

    Example: tacsim train squeeze --out runs/squeeze-0
    """
    require_torch("tacsim train")
    own = [f"algorithm={algorithm}"] * (algorithm is not None) + [f"seed={seed}"] * (seed is not None) + (set_ or [])
    if resume is not None:
        if task is not None or own or out is not None:
            raise typer.BadParameter(
                f"a run goes on with its own settings ({resume / 'run.json'}): leave out all else, or begin a new run",
                param_hint="--resume",
            )
        with busy("loading"):
            from robot.train.run_folder import RunFolder

            run = RunFolder(resume)
    else:
        if task is None:
            raise typer.BadParameter("name a task (squeeze, reposition, knead), or a run that goes on (--resume)")
        from tacsim.config import load
        from tacsim.models.training import Training

        training = load(Training, task, own)
        folder = new_directory(out, f"train-{training.task}")
        run = _begin(training, folder)
    from tacsim.tasks.task import BadDraws

    try:
        path = _train(run)
    except BadDraws:
        if run.last()[0]:
            notes.print(f"What was learned is kept. Make a file of it: tacsim export policy {run.folder}", markup=False)
        raise
    except (KeyboardInterrupt, OSError):
        notes.print(f"What was learned is kept. Go on: tacsim train --resume {run.folder}", markup=False)
        raise
    say_files(path, run.folder / "curve.json")
    notes.print(
        f"Next: tacsim evaluate {task or run.settings.training.task} --policy {path} --policy scripted", markup=False
    )


def require_torch(command: str) -> None:
    """Raises CannotOpen without the extra `train`."""
    from importlib.util import find_spec

    from robot.open import CannotOpen

    missing = [name for name in ("torch", "stable_baselines3", "onnx", "onnxruntime") if find_spec(name) is None]
    if missing:
        raise CannotOpen(
            f"{command} needs {' and '.join(missing)}, which {'is' if len(missing) == 1 else 'are'} not installed: "
            "pip install 'tacsim[train]'"
        )


def _begin(training: Training, folder: Path) -> RunFolder:
    with busy("loading"):
        from robot.train.train import begin

        return begin(training, folder)


def _train(run: RunFolder) -> Path:
    from robot.train.train import train as go_on

    def say(figures: Mapping[str, float]) -> None:
        results.print(
            f"round {figures['round']:.0f}: {1e3 * figures['distance']:.3f} mm from the goal, success "
            f"{100 * figures['success']:.0f} %, {figures['peak_force']:.1f} N at most, "
            f"{figures['steps'] / figures['seconds']:.0f} steps/s"
            + (f", {figures['refused']:.0f} draws refused" if figures["refused"] else ""),
            markup=False,
        )

    with one_bar("starting") as bar:

        def tell(words: str, done: int, of: int) -> None:
            bar.say(words)
            bar.count(done, of)

        return go_on(run, tell, say, warn)
