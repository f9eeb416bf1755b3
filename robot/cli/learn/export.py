"""`tacsim export policy`: what was learned, as a file for a rig."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from robot.cli.learn.train import require_torch
from robot.cli.output import busy, results

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
    if out.suffix != ".onnx":
        raise typer.BadParameter(f"{out} must end in .onnx", param_hint="--out")
    if out.exists():
        raise typer.BadParameter(f"{out} exists already; name a new file, nothing is overwritten", param_hint="--out")
    with busy("exporting"):
        from robot.train.run_folder import RunFolder
        from robot.train.train import export_policy

        worst = export_policy(RunFolder(run), out)
    results.print(f"{out} ({out.stat().st_size / 1024:.0f} KiB), within {worst:.1g} of the network", markup=False)
