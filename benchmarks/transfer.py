"""What a policy keeps on a robot that differs from its simulation: `python -m benchmarks.transfer FOLDER`.

One clay and one gel, hidden in a twin. Their motions are recorded on it, `tacsim identify` finds what they are made of,
and for each of {canonical touch, raw pictures} x {materials guessed, identified, drawn} a policy learns to squeeze.
`tacsim transfer` then plays them all, each in its own simulation and over the wire on the twin. Killed anywhere, the
same command goes on; `--only record`, `identify`, `train` or `play` does that part. The table stands in docs/train.md.
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
from tacsim.config import load, load_scene
from tacsim.models.material import BodyMaterial, GelMaterial
from tacsim.models.randomisation import Randomisation
from tacsim.models.training import Training

SIGHTS = {"canonical": "squeeze", "raw": "squeeze-pictures"}  # training files
MATERIALS = ("guessed", "identified", "drawn")
# What the twin is made of. The shipped scene, the guess, has 500 kPa, 30 kPa, 145 kPa and 0.6 on both sides.
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
GOALS, STEPS = ["7 mm", "8.5 mm"], 30  # of an episode on the twin: near enough to be reached in so many steps
ROUNDS = 8  # of the policies' training: 10,240 control steps


def tacsim(*words: str) -> None:
    subprocess.run([sys.executable, "-c", "from robot.cli import main; main()", *words], check=True)


def sets(words: Sequence[str]) -> list[str]:
    return [part for word in words for part in ("--set", word)]


def record(folder: Path, preset: str) -> None:
    """The motions that tell gel and body, on a simulated rig with the twin's materials and mesh."""
    for kind, (rig, *names) in RECORDED.items():
        for name in names:
            out, table = folder / kind / name, motions(load_scene("press" if kind == "gel" else "squeeze"))[name]
            if (out / "report.html").exists():
                continue
            script = folder / f"{kind}-{name}.csv"
            script.write_text(table, encoding="utf-8")
            told = [f"{key}={value}" for key, value in HIDDEN.items() if kind == "body" or ".gel." in key]
            steps = str(len(table.splitlines()) - 1)
            words = sets([f"scene.preset={preset}", *told])
            tacsim("run", rig, "--policy", str(script), "--steps", steps, "--out", str(out), *words)


def identify(folder: Path, preset: str) -> None:
    """By the shipped command, on a coarser mesh than the twin's."""
    for kind in RECORDED:
        out = folder / f"my-{kind}"
        if not out.exists():
            more = sets([f"gel.material={gel(folder)}"]) if kind == "body" else []  # the gel is known by then
            words = ["--preset", preset, "--force-noise", NOISE, "--out", str(out), *more]
            tacsim("identify", kind, str(folder / kind), *words)


def found(folder: Path) -> list[str]:
    """What was identified, as overrides of a rig."""
    friction = load_scene(str(folder / "my-body/scene.yaml")).friction
    return [
        f"scene.gel.material={gel(folder)}",
        f"scene.body.material={typed(load(BodyMaterial, folder / 'my-body/material.yaml'))}",
        *(f"scene.friction.{name}={mu:.9g}" for name, mu in friction.items()),
    ]


def gel(folder: Path) -> str:
    return typed(load(GelMaterial, folder / "my-gel/material.yaml"))


def typed(material: GelMaterial | BodyMaterial) -> str:
    """As a value of --set: its numbers, not the path of a file, which would have to lie below the current folder."""
    return material.model_dump_json(exclude_none=True, exclude={"source"})


def training(sight: str, materials: str, folder: Path) -> Training:
    """The shipped training; where materials are not drawn, with those of the scene or of `folder`."""
    whole = load(Training, SIGHTS[sight], [f"dagger.rounds={ROUNDS}"])
    if materials == "drawn":
        return whole
    assert whole.randomise is not None
    left = {key: each for key, each in whole.randomise.values.items() if not key.startswith(MADE_OF)}
    known = found(folder) if materials == "identified" else []
    return whole.model_copy(
        update={
            "randomise": whole.randomise.model_copy(update={"values": left}),
            "overrides": (*whole.overrides, *known),
        }
    )


def train(folder: Path, cells: Sequence[tuple[str, str]]) -> None:
    """Needs the extra `train`."""
    from robot.train.run_folder import RunFolder
    from robot.train.train import POLICY, begin_run
    from robot.train.train import train as go_on

    for sight, materials in cells:
        run = folder / "runs" / f"{sight}-{materials}"
        if (run / POLICY).exists():
            continue
        if not run.exists():
            begin_run(training(sight, materials, folder), run)
        typer.echo(run.name)
        go_on(RunFolder(run), report_result=lambda figures: typer.echo(str(figures)))


def play(folder: Path, episodes: int, every: int, preset: str, workers: int) -> None:
    """Needs the extra `policy`."""
    twins = load(Randomisation, "squeeze-twin")
    hidden: dict[str, object] = {key: {"choice": [value]} for key, value in HIDDEN.items()}
    hidden |= {"scene.preset": {"choice": [preset]}, "task.goal": {"uniform": GOALS}}
    drawn = {"draws": episodes, "values": {**twins.model_dump(mode="json", exclude_none=True)["values"], **hidden}}
    (folder / "twin.json").write_text(json.dumps(drawn, indent=1), encoding="utf-8")
    policies = [str(path) for sight in SIGHTS for each in MATERIALS if (path := policy(folder, sight, each)).exists()]
    words = [part for path in policies for part in ("--policy", path)]
    words += ["--twin", str(folder / "twin.json"), "--episodes", str(episodes), "--every", str(every)]
    words += ["--workers", str(workers)]
    tacsim("transfer", "squeeze", *words, "--steps", str(STEPS), "--out", str(folder / f"transfer-{preset}"))


def policy(folder: Path, sight: str, materials: str) -> Path:
    return folder / "runs" / f"{sight}-{materials}" / "policy.onnx"


def main(
    folder: Annotated[Path, typer.Argument(help="What is found is kept here.")] = Path("runs/transfer"),
    only: Annotated[str, typer.Option(help="record, identify, train or play; empty: all.")] = "",
    cell: Annotated[list[str] | None, typer.Option(help="To be trained, SIGHT-MATERIALS; none: all.")] = None,
    episodes: int = 12,
    every: int = 3,
    workers: int = 1,
    preset: Annotated[str, typer.Option(help="Mesh of the twin.")] = "standard",
    known: Annotated[str, typer.Option(help="Mesh on which it is identified.")] = "draft",
) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    cells = [(sight, materials) for sight in SIGHTS for materials in MATERIALS]
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
