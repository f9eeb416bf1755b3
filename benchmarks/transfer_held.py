"""Which observations of a held object transfer: `python -m benchmarks.transfer_held FOLDER --task hold`.

Students of `hold`, `turn` or `drawer` learn with equal budgets from the same teacher. They see what the shipped
student of the task sees of hand and grip, and in addition one of: the flow of the markers, the height of the gels, the
change of the picture, nothing of the gels. `tacsim transfer` then plays all of them in their own simulation and on
hidden twins (configs/randomisations/TASK-twin.yaml). After an interruption the same command continues.
docs/measurements/training.md has the tables.
"""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from benchmarks.transfer import run_tacsim, set_options
from tacsim.config import load_model
from tacsim.models.policy import Training

ROUNDS = 4  # of each training: 7,680 control steps of hold, 5,120 of turn, 12,800 of drawer


class HeldTask(StrEnum):
    hold = "hold"
    turn = "turn"
    drawer = "drawer"


# One box, gripped as those of the twins: the shipped training of hold has boxes of many sizes. Others have one object.
ONE_BOX = """randomise={draws: 128, values: {
    scene.object.mass: {log_uniform: [0.03, 0.25]}, scene.object.friction: {uniform: [0.35, 0.9]},
    scene.gel.material.youngs_modulus: {normal: [0.145 MPa, 0.02 MPa], within: [0.1 MPa, 0.2 MPa]},
    scene.object.grip: {uniform: [[0 mm, -1 mm, -1 mm], [0 mm, 1 mm, 1 mm]]},
    arms.hand.error.position: {uniform: [[-0.3 mm, -0.3 mm, -0.3 mm], [0.3 mm, 0.3 mm, 0.3 mm]]},
    arms.hand.error.rotation: {uniform: [[-0.02, -0.02, -0.02], [0.02, 0.02, 0.02]]}}}"""
# What all students of a task see: all that its shipped student sees, but for the gels.
HAND = {"hold": ("wrench", "grip"), "turn": ("grip",), "drawer": ("wrench", "moved", "grip")}
# What `depth` sees in addition: all that comes from the height of the gels. The shipped students of hold and drawer see
# how far the contact is `dragged`; that of turn finds the angle by edges (`turned`), which are slopes of the height.
HEIGHT = {
    "hold": ("area", "depth", "dragged"),
    "turn": ("area", "depth", "turned"),
    "drawer": ("area", "depth", "dragged"),
}
# Pictures are what one policy sees: 320 x 240 px of a sensor, four by four in one. The others see none.
PICTURES = [
    f"sensors.{side}.model.geometry.{key}"
    for side in ("left", "right")
    for key in ("width=80", "height=60", "pixel_pitch=0.25 mm")
]
POLICIES = ("flow", "depth", "pictures", "blind")


def differences(task: str, policy: str) -> list[str]:
    """What differs between the trainings. A network with maps learns in fewer epochs, as in squeeze-pictures.yaml."""
    touch = {"flow": ("shear",), "depth": HEIGHT[task]}.get(policy, ()) + HAND[task]
    found = [f"features.touch=[{', '.join(touch)}]", f"features.flow={str(policy == 'flow').lower()}"]
    if policy == "pictures":
        seen = ", ".join(["scene.preset=learn", "motion=flowing", *PICTURES])
        found += ["features.maps=[image]", "dagger.epochs=20", f"overrides=[{seen}]"]
    return [*found, "features.sensors=[]"] if policy == "blind" else found


def training(policy: str, task: str = "hold") -> Training:
    """The shipped training of the task with one object, and the features of this policy."""
    drawn = [ONE_BOX] if task == "hold" else []
    return load_model(Training, task, [*drawn, *differences(task, policy), f"dagger.rounds={ROUNDS}"])


def train(folder: Path, policies: list[str], task: str) -> None:
    """Trains those that the folder does not have. Needs the extra `train`."""
    from robot.train.run_folder import RunFolder
    from robot.train.train import POLICY, begin_run
    from robot.train.train import train as continue_training

    for policy in policies:
        run = folder / "runs" / policy
        if (run / POLICY).exists():
            continue
        if not run.exists():
            begin_run(training(policy, task), run)
        typer.echo(policy)
        continue_training(RunFolder(run), report_result=lambda figures: typer.echo(str(figures)))


def play(folder: Path, policies: list[str], task: str, episodes: int, motion: str) -> None:
    """Plays them, and the scripted policy. Needs the extra `policy`."""
    files = [str(folder / "runs" / policy / "policy.onnx") for policy in policies]
    words = [part for file in (*files, "scripted") for part in ("--policy", file)]
    words += ["--episodes", str(episodes), "--every", "1", *set_options([f"motion={motion}"])]
    run_tacsim("transfer", task, *words, "--out", str(folder / f"transfer-{motion}"))


def main(
    folder: Annotated[Path, typer.Argument(help="Folder of all results.")] = Path("runs/transfer-held"),
    task: HeldTask = HeldTask.hold,
    policy: Annotated[list[str] | None, typer.Option(help=f"Of {', '.join(POLICIES)}; none: all.")] = None,
    episodes: int = 32,
    motion: Annotated[str, typer.Option(help="Of the twins: flowing, settled or dynamic.")] = "flowing",
) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    train(folder, policy or list(POLICIES), task.value)
    play(folder, policy or list(POLICIES), task.value, episodes, motion)


if __name__ == "__main__":
    typer.run(main)
