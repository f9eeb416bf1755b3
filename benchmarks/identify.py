"""How well `tacsim identify` finds hidden materials: `python -m benchmarks.identify gel` (or body).

Each truth is drawn and simulated in a process of its own, on a mesh that identification does not use, and recorded with
the motions that `tacsim identify … --motions` writes; its numbers come back in a file that is opened when all is done.
Then the noise of the force is drawn again many times: how often do the intervals hold the truth? docs/identify.md has
the figures. A gel takes half a minute, a body some minutes.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from calibration.materials.estimate import Fit, Priors, Signals, estimate
from calibration.materials.presses import Noise, gathered, signals_of, thinned
from robot.studies.identify.identify import MOMENTS, Identified, Kind, identify
from robot.studies.identify.motions import motions
from robot.studies.identify.recordings import Recordings, find_recordings, read_all
from tacsim.config import load_scene
from tacsim.interface import FloatArray

TRUE_MESH = ("scene.element_size=0.4 mm", "scene.particle_spacing=0.2 mm")  # between those that identification uses
RIGS = {"gel": "press", "body": "sim"}
MOTIONS = {"gel": ("press", "slide"), "body": ("squeeze", "tilt")}
PLACE, ZERO = 0.02e-3, 0.2  # standard deviations of what the recordings are spoilt with [m, N]


def draw(kind: str, seed: int) -> dict[str, float]:
    """Materials within a factor of 1.5 or so round those of the scenes."""
    random = np.random.default_rng(seed)
    if kind == "gel":
        return {
            "scene.gel.material.youngs_modulus": float(0.145e6 * 1.5 ** random.uniform(-1, 1)),
            "scene.gel.material.poisson_ratio": float(random.uniform(0.45, 0.485)),
            "scene.indenter.friction": float(random.uniform(0.25, 0.7)),
        }
    return {
        "scene.body.material.youngs_modulus": float(0.5e6 * 1.4 ** random.uniform(-1, 1)),
        "scene.body.material.yield_stress": float(30e3 * 1.4 ** random.uniform(-1, 1)),
        "scene.body.material.hardening_modulus": float(random.uniform(30e3, 60e3)),
        "scene.friction.lower": float(random.uniform(0.3, 0.6)),
        "scene.friction.upper": float(random.uniform(0.3, 0.6)),
    }


def record(kind: str, seed: int, folder: Path) -> None:
    """In a process of its own: draws a truth, runs the motions, writes recordings and, apart, the truth."""
    truth = draw(kind, seed)
    scene = load_scene("press" if kind == "gel" else "squeeze")
    sets = [
        word for text in (*TRUE_MESH, *(f"{key}={value!r}" for key, value in truth.items())) for word in ("--set", text)
    ]
    for name in MOTIONS[kind]:
        table = motions(scene)[name]
        script = folder / f"{name}.csv"
        script.write_text(table, encoding="utf-8")
        command = ["run", RIGS[kind], "--policy", str(script), "--steps", str(len(table.splitlines()) - 1)]
        command += ["--out", str(folder / "runs" / name), *sets]
        start = "from robot.cli import main; main()"
        subprocess.run([sys.executable, "-c", start, *command], check=True, capture_output=True)
    (folder / "truth.json").write_text(json.dumps(truth), encoding="utf-8")


def redrawn(found: Identified, clean: Signals, seed: int, priors: Priors) -> Fit:
    """The fit of the same presses with other noise, zeros and places, by the simulation as it is near the estimate."""
    fit, random = found.fit, np.random.default_rng(seed)
    p, t = len(fit.free), clean.presses
    zeros = clean.zeros()
    places = fit.system[:, p : p + t] @ random.normal(0, priors.place, t)
    values = clean.values + places + zeros @ random.normal(0, priors.zero, zeros.shape[1])
    signals = replace(clean, values=values + random.normal(0, clean.noise), noise=fit.sigma)
    own = fit.predicted - zeros @ fit.nuisances[t:]

    def predict(points: Any) -> list[FloatArray]:
        return [
            own
            + fit.system[:, :p] @ (point.free - fit.free)
            + fit.system[:, p : p + t] @ (point.places - fit.nuisances[:t])
            for point in points
        ]

    again = estimate([predict], signals, [replace(each, start=fit.value(each.name)) for each in fit.parameters],
                     priors, 0.0)  # fmt: skip
    return replace(again, mesh_shift=fit.mesh_shift).with_sigma(again.sigma)


def main(
    kind: Annotated[str, typer.Argument(help="gel or body.")] = "gel",
    truths: Annotated[int, typer.Option(min=1)] = 3,
    draws: Annotated[int, typer.Option(min=1)] = 50,
    seed: int = 0,
    force_noise: Annotated[float, typer.Option(help="[N]")] = 0.02,
    preset: str = "standard",
) -> None:
    """Prints a line for each parameter of each truth."""
    what: Kind = "gel" if kind == "gel" else "body"
    noise, priors = Noise(force_noise), Priors(PLACE, ZERO)
    for number in range(seed, seed + truths):
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            twin = "import sys, pathlib; from benchmarks.identify import record; record(sys.argv[1], int(sys.argv[2]), "
            subprocess.run(
                [sys.executable, "-c", twin + "pathlib.Path(sys.argv[3]))", kind, str(number), name], check=True
            )
            scene = load_scene("press" if kind == "gel" else "squeeze", [f"preset={preset}"])
            recordings, began = Recordings(scene), time.perf_counter()
            presses = read_all(recordings, find_recordings([folder / "runs"]))
            random = np.random.default_rng(number)
            noisy = [
                replace(
                    press,
                    readings={
                        key: values + random.normal(0, force_noise, len(values)) + random.normal(0, ZERO)
                        if key.rpartition(".")[2] in ("fx", "fy", "fz") else values
                        for key, values in press.readings.items()
                    },
                )
                for press in presses
            ]  # fmt: skip
            found = identify(what, scene, recordings, noisy, noise, priors)
            seconds = time.perf_counter() - began
            truth = {}
            for key, value in json.loads((folder / "truth.json").read_text(encoding="utf-8")).items():
                truth[f"friction_{key.rpartition('.')[2]}" if ".friction." in key else key.rpartition(".")[2]] = value
        clean = signals_of([thinned(gathered(press), MOMENTS) for press in presses], noise)
        _say(found, clean, truth, draws, priors, seconds)


def _say(
    found: Identified, clean: Signals, truth: dict[str, float], draws: int, priors: Priors, seconds: float
) -> None:
    fit = found.fit
    fits = [redrawn(found, clean, k, priors) for k in range(draws)]
    typer.echo(f"{found.kind}: {len(found.presses)} recordings, {fit.runs} simulated, {seconds:.0f} s; "
               f"against it: {[each.kind for each in found.findings]}")  # fmt: skip
    for each in fit.told:
        low, high = fit.interval(each.name)
        held = sum(a.interval(each.name)[0] <= truth[each.name] <= a.interval(each.name)[1] for a in fits)
        true, value = truth[each.name], fit.value(each.name)
        typer.echo(
            f"  {each.name:18} truth {true:10.4g}  found {value:10.4g}  off {100 * (value / true - 1):+5.1f} %  "
            f"95 %: {low:.4g} to {high:.4g} {'holds' if low <= true <= high else 'MISSES'}; "
            f"{held} of {draws} draws hold"
        )
    for each in fit.untold:
        typer.echo(f"  {each.name:18} not told")


if __name__ == "__main__":
    typer.run(main)
