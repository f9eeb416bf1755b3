"""Performance of policies on a robot that differs from its simulation: `python -m benchmarks.transfer FOLDER`.

A hidden rig has one clay and one gel. Their motions are recorded on it, `tacsim identify` finds their materials, and
for each of {canonical touch, raw pictures} x {materials guessed, identified, drawn} a policy learns to squeeze.
`tacsim transfer` then plays all policies, in their own simulation and over the wire on the hidden rig. After an
interruption the same command continues; `--only record`, `identify`, `train` or `play` does that part. docs/train.md
has the table.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated

import typer

from robot.studies.identify.motions import motions
from tacsim.config import load_model, load_scene
from tacsim.models.material import BodyMaterial, GelMaterial
from tacsim.models.policy import Training
from tacsim.models.randomisation import Randomisation

VIEWS = {"canonical": "squeeze", "raw": "squeeze-pictures"}  # training files
MATERIALS = ("guessed", "identified", "drawn")
# Materials of the hidden rig. The shipped scene, the guess, has 500 kPa, 30 kPa, 145 kPa and 0.6 on both sides.
HIDDEN = {
    "scene.body.material.youngs_modulus": "0.26 MPa",
    "scene.body.material.yield_stress": "14 kPa",
    "scene.gel.material.youngs_modulus": "0.172 MPa",
    "scene.friction.lower": "0.48",
    "scene.friction.upper": "0.71",
}
MADE_OF = (
    "scene.body.material.",
    "scene.gel.material.",
    "scene.friction.",
    "sensors.lower.model",
    "sensors.upper.model",
)
RECORDED = {"gel": ("press", "press", "slide"), "body": ("sim", "squeeze", "tilt")}  # rig, motions
NOISE = "20 mN"  # of an external force sensor
# of an episode on the hidden rig; the goals can be reached in that number of steps
GOALS, STEPS = ["7 mm", "8.5 mm"], 30
ROUNDS = 8  # of the policies' training: 10,240 control steps


def run_tacsim(*words: str) -> None:
    subprocess.run([sys.executable, "-c", "from robot.cli import main; main()", *words], check=True)


def set_options(words: Sequence[str]) -> list[str]:
    return [part for word in words for part in ("--set", word)]


def record(folder: Path, preset: str) -> None:
    """Records the motions that identify gel and body, on a simulated rig with the hidden materials and mesh."""
    for kind, (rig, *names) in RECORDED.items():
        for name in names:
            out, table = folder / kind / name, motions(load_scene("press" if kind == "gel" else "squeeze"))[name]
            if (out / "report.html").exists():
                continue
            script = folder / f"{kind}-{name}.csv"
            script.write_text(table, encoding="utf-8")
            overrides = [f"{key}={value}" for key, value in HIDDEN.items() if kind == "body" or ".gel." in key]
            steps = str(len(table.splitlines()) - 1)
            words = set_options([f"scene.preset={preset}", *overrides])
            run_tacsim("run", rig, "--policy", str(script), "--steps", steps, "--out", str(out), *words)


def identify(folder: Path, preset: str) -> None:
    """Identifies the materials by the shipped command, on a coarser mesh than that of the hidden rig."""
    for kind in RECORDED:
        out = folder / f"my-{kind}"
        if not out.exists():
            # the gel is identified before the body
            more = set_options([f"gel.material={gel(folder)}"]) if kind == "body" else []
            words = ["--preset", preset, "--force-noise", NOISE, "--out", str(out), *more]
            run_tacsim("identify", kind, str(folder / kind), *words)


def identified_overrides(folder: Path) -> list[str]:
    """The identified materials, as overrides of a rig."""
    friction = load_scene(str(folder / "my-body/scene.yaml")).friction
    return [
        f"scene.gel.material={gel(folder)}",
        f"scene.body.material={format_material(load_model(BodyMaterial, folder / 'my-body/material.yaml'))}",
        *(f"scene.friction.{name}={mu:.9g}" for name, mu in friction.items()),
    ]


def gel(folder: Path) -> str:
    return format_material(load_model(GelMaterial, folder / "my-gel/material.yaml"))


def format_material(material: GelMaterial | BodyMaterial) -> str:
    """The material as a value of --set: its numbers, because a file would have to be below the current folder."""
    return material.model_dump_json(exclude_none=True, exclude={"source"})


def training(view: str, materials: str, folder: Path) -> Training:
    """The shipped training; without drawn materials, with those of the scene or of `folder`."""
    whole = load_model(Training, VIEWS[view], [f"dagger.rounds={ROUNDS}"])
    if materials == "drawn":
        return whole
    assert whole.randomise is not None
    others = {key: each for key, each in whole.randomise.values.items() if not key.startswith(MADE_OF)}
    known = identified_overrides(folder) if materials == "identified" else []
    return whole.model_copy(
        update={
            "randomise": whole.randomise.model_copy(update={"values": others}),
            "overrides": (*whole.overrides, *known),
        }
    )


def train(folder: Path, cells: Sequence[tuple[str, str]]) -> None:
    """Trains the policies. Needs the extra `train`."""
    from robot.train.run_folder import RunFolder
    from robot.train.train import POLICY, begin_run
    from robot.train.train import train as continue_training

    for view, materials in cells:
        run = folder / "runs" / f"{view}-{materials}"
        if (run / POLICY).exists():
            continue
        if not run.exists():
            begin_run(training(view, materials, folder), run)
        typer.echo(run.name)
        continue_training(RunFolder(run), report_result=lambda figures: typer.echo(str(figures)))


def play(folder: Path, episodes: int, every: int, preset: str, workers: int) -> None:
    """Plays all policies. Needs the extra `policy`."""
    shipped = load_model(Randomisation, "squeeze-twin")
    hidden: dict[str, object] = {key: {"choice": [value]} for key, value in HIDDEN.items()}
    hidden |= {"scene.preset": {"choice": [preset]}, "task.goal": {"uniform": GOALS}}
    drawn = {"draws": episodes, "values": {**shipped.model_dump(mode="json", exclude_none=True)["values"], **hidden}}
    (folder / "twin.json").write_text(json.dumps(drawn, indent=1), encoding="utf-8")
    policies = [str(path) for view in VIEWS for each in MATERIALS if (path := policy(folder, view, each)).exists()]
    words = [part for path in policies for part in ("--policy", path)]
    words += ["--twin", str(folder / "twin.json"), "--episodes", str(episodes), "--every", str(every)]
    words += ["--workers", str(workers)]
    run_tacsim("transfer", "squeeze", *words, "--steps", str(STEPS), "--out", str(folder / f"transfer-{preset}"))


def policy(folder: Path, view: str, materials: str) -> Path:
    return folder / "runs" / f"{view}-{materials}" / "policy.onnx"


def main(
    folder: Annotated[Path, typer.Argument(help="Folder of all results.")] = Path("runs/transfer"),
    only: Annotated[str, typer.Option(help="record, identify, train or play; empty: all.")] = "",
    cell: Annotated[list[str] | None, typer.Option(help="To be trained, VIEW-MATERIALS; none: all.")] = None,
    episodes: int = 12,
    every: int = 3,
    workers: int = 1,
    preset: Annotated[str, typer.Option(help="Mesh of the hidden rig.")] = "standard",
    known: Annotated[str, typer.Option(help="Mesh of the identification.")] = "draft",
) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    cells = [(view, materials) for view in VIEWS for materials in MATERIALS]
    parts: dict[str, Callable[[], None]] = {
        "record": lambda: record(folder, preset),
        "identify": lambda: identify(folder, known),
        "train": lambda: train(folder, [each for each in cells if not cell or "-".join(each) in cell]),
        "play": lambda: play(folder, episodes, every, preset, workers),
    }
    for name, part in parts.items():
        if only in ("", name):
            part()


if __name__ == "__main__":
    typer.run(main)
