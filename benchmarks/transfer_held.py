"""Which observations of a held object transfer: `python -m benchmarks.transfer_held FOLDER`.

Students of `hold` learn with equal budgets from the same teacher. They see the weight and the grip force, and in
addition one of: the flow of the markers, depth and area of the contact, the change of the picture, nothing of the gels.
`tacsim transfer` then plays all of them in their own simulation and on hidden twins
(configs/randomisations/hold-twin.yaml). After an interruption the same command continues. docs/measurements/training.md
has the table.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from benchmarks.transfer import run_tacsim, set_options
from tacsim.config import load_model
from tacsim.models.policy import Training

ROUNDS = 4  # of each training: 3,840 control steps
# One box, as of the twins: the shipped training has boxes of many sizes.
ONE_BOX = """randomise={draws: 128, values: {
    scene.object.mass: {log_uniform: [0.03, 0.25]}, scene.object.friction: {uniform: [0.35, 0.9]},
    scene.gel.material.youngs_modulus: {normal: [0.145 MPa, 0.02 MPa], within: [0.1 MPa, 0.2 MPa]}}}"""
# Pictures are what one policy sees: 320 x 240 px of a sensor, four by four in one. The others see none.
PICTURES = [
    f"sensors.{side}.model.geometry.{key}"
    for side in ("left", "right")
    for key in ("width=80", "height=60", "pixel_pitch=0.25 mm")
]
# What differs between the trainings. A network with maps learns in fewer epochs, as in squeeze-pictures.yaml.
POLICIES = {
    "flow": ["features.flow=true", "features.touch=[shear, wrench, grip]"],
    "depth": ["features.flow=false", "features.touch=[area, depth, wrench, grip]"],
    "pictures": [
        "features.flow=false",
        "features.touch=[wrench, grip]",
        "features.maps=[image]",
        "dagger.epochs=20",
        f"overrides=[{', '.join(['scene.preset=learn', 'motion=flowing', *PICTURES])}]",
    ],
    "blind": ["features.flow=false", "features.touch=[wrench, grip]", "features.sensors=[]"],
}


def training(policy: str) -> Training:
    """The shipped training of `hold` with one box, and the features of this policy."""
    return load_model(Training, "hold", [ONE_BOX, *POLICIES[policy], f"dagger.rounds={ROUNDS}"])


def train(folder: Path, policies: list[str]) -> None:
    """Trains those that the folder does not have. Needs the extra `train`."""
    from robot.train.run_folder import RunFolder
    from robot.train.train import POLICY, begin_run
    from robot.train.train import train as continue_training

    for policy in policies:
        run = folder / "runs" / policy
        if (run / POLICY).exists():
            continue
        if not run.exists():
            begin_run(training(policy), run)
        typer.echo(policy)
        continue_training(RunFolder(run), report_result=lambda figures: typer.echo(str(figures)))


def play(folder: Path, policies: list[str], episodes: int, motion: str) -> None:
    """Plays them, and the scripted policy. Needs the extra `policy`."""
    files = [str(folder / "runs" / policy / "policy.onnx") for policy in policies]
    words = [part for file in (*files, "scripted") for part in ("--policy", file)]
    words += ["--episodes", str(episodes), "--every", "1", *set_options([f"motion={motion}"])]
    run_tacsim("transfer", "hold", *words, "--out", str(folder / f"transfer-{motion}"))


def main(
    folder: Annotated[Path, typer.Argument(help="Folder of all results.")] = Path("runs/transfer-held"),
    policy: Annotated[list[str] | None, typer.Option(help=f"Of {', '.join(POLICIES)}; none: all.")] = None,
    episodes: int = 32,
    motion: Annotated[str, typer.Option(help="Of the twins: flowing, settled or dynamic.")] = "flowing",
) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    train(folder, policy or list(POLICIES))
    play(folder, policy or list(POLICIES), episodes, motion)


if __name__ == "__main__":
    typer.run(main)
