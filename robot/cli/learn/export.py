"""`tacsim export policy`: what was learned, as a file for a rig."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from robot.cli.learn.train import require_torch
from robot.cli.options import Overrides
from robot.cli.output import busy, one_bar, results

export = typer.Typer(no_args_is_help=True, help="Write policies and recordings as files for others.")


def policy(
    run: Annotated[Path, typer.Argument(help="The folder of a training run, finished or not.")],
    out: Annotated[Path, typer.Option("--out", help="The file to be written, FILE.onnx; it must not exist.")],
) -> None:
    """Write the policy of a training run as one ONNX file, which says of itself what it sees and does.

    Needs the extra `train`; who runs the file needs the extra `policy` alone.

    Example: tacsim export policy runs/squeeze-0 --out squeeze.onnx
    """
    require_torch("tacsim export policy")
    _require_new(out)
    with busy("exporting, and observing episodes of its training"):
        from robot.train.run_folder import RunFolder
        from robot.train.train import export_policy

        worst = export_policy(RunFolder(run), out)
    results.print(f"{out} ({out.stat().st_size / 1024:.0f} KiB), within {worst:.1g} of the network", markup=False)


def policy_range(
    policy: Annotated[Path, typer.Argument(help="A policy, FILE.onnx.")],
    out: Annotated[Path, typer.Option("--out", help="The file to be written, FILE.onnx; it must not exist.")],
    training: Annotated[
        str | None,
        typer.Option(help="Name or path of the training file.", show_default="as the policy says that it was trained"),
    ] = None,
    episodes: Annotated[
        int | None, typer.Option(min=2, max=10_000, help="To be played.", show_default="4 of each environment")
    ] = None,
    set_: Overrides = None,
) -> None:
    """Write a policy again, with the range of what it observes in episodes of its training.

    The policy acts itself in episodes drawn as the training file says. `tacsim run` and `tacsim evaluate` then say when
    observations leave that range, and which parameters of a simulated scene do. Needs onnx (extra `train`).

    Example: tacsim export policy-range mine.onnx --training squeeze --out mine-with-range.onnx
    """
    from importlib.util import find_spec

    from robot.open import CannotOpen

    if find_spec("onnx") is None:
        raise CannotOpen("tacsim export policy-range needs onnx, which is not installed: pip install 'tacsim[train]'")
    _require_new(out)
    if set_ and training is None:
        raise typer.BadParameter("--set changes a training file: name it with --training", param_hint="--set")
    from robot.train.measure_range import measure_range, write_range
    from tacsim.config import load
    from tacsim.models.training import Training

    settings = None if training is None else load(Training, training, set_ or [])
    with one_bar("starting") as bar:

        def tell(words: str, done: int, of: int) -> None:
            bar.say(words)
            bar.count(done, of)

        found = measure_range(policy, settings, episodes, tell)
    write_range(policy, out, found)
    results.print(f"{out}: range of {found.episodes} episodes", markup=False)


def _require_new(out: Path) -> None:
    if out.suffix != ".onnx":
        raise typer.BadParameter(f"{out} must end in .onnx", param_hint="--out")
    if out.exists():
        raise typer.BadParameter(f"{out} exists already; name a new file, nothing is overwritten", param_hint="--out")
