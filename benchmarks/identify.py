"""How well `tacsim identify` finds hidden materials: `python -m benchmarks.identify gel` (body, poisson).

Each truth is drawn and simulated in a process of its own, on a mesh that identification does not use, and recorded with
the motions that `tacsim identify … --motions` writes; its numbers come back in a file that is opened when all is done.
Then noise, zeros and places are drawn again many times: how often do the intervals hold the truth, how often is a drift
or a wrong ball noticed, how often something that is not there? No draw needs a simulation: near the estimate the
simulation is the linear system that the fit ended with, and what is drawn is added to the recordings as they were. The
lines are those of the table in docs/identify.md. A gel takes half a minute, a body some minutes.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import time
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from calibration.materials.checks import findings
from calibration.materials.estimate import SETTLED_ERROR, Fit, Point, Priors, Signals, estimate
from calibration.materials.parameters import starts
from calibration.materials.presses import Noise, Press, gathered, signals_of, thinned
from robot.studies.identify.identify import MOMENTS, Identified, Kind, identify, parameters_of
from robot.studies.identify.motions import motions
from robot.studies.identify.recordings import Recordings, find_recordings, read_all
from robot.studies.identify.simulation import Seen, Simulation
from tacsim.config import load_scene
from tacsim.interface import FloatArray, Pose
from tacsim.models.sensor import CanonicalGrid

TRUE_MESH = ("scene.element_size=0.4 mm", "scene.particle_spacing=0.2 mm")  # between those that identification uses
RIGS = {"gel": "press", "body": "sim"}
MOTIONS = {"gel": ("press", "slide"), "body": ("squeeze", "tilt")}
DRIFTS = {"gel": (0.05, 0.1, 0.2), "body": (0.2, 0.5, 1.0)}  # of the normal force during the first recording [N]
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
    shutil.rmtree(folder / "runs", ignore_errors=True)  # of a recording that was cut off
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


def refitted(found: Identified, values: FloatArray, priors: Priors) -> Fit:
    """The fit to `values` (m,), by the simulation as it is near the estimate: linear."""
    fit, zeros = found.fit, found.signals.zeros()
    p, t = len(fit.free), found.signals.presses
    own = fit.predicted - zeros @ fit.nuisances[t : t + zeros.shape[1]]

    def predict(points: Any) -> list[FloatArray]:
        return [
            own
            + fit.system[:, :p] @ (point.free - fit.free)
            + fit.system[:, p : p + t] @ (point.places - fit.nuisances[:t])
            for point in points
        ]

    signals = replace(found.signals, values=values, noise=fit.sigma)
    again = estimate([predict], signals, [replace(each, start=fit.value(each.name)) for each in fit.parameters],
                     priors, 0.0)  # fmt: skip
    return replace(again, mesh_shift=fit.mesh_shift, runs=fit.runs).with_sigma(again.sigma)


def redrawn(found: Identified, values: FloatArray, seed: int, priors: Priors) -> tuple[Fit, Signals]:
    """`values` (m,) with other noise, zeros and places, and the fit to them."""
    random, signals = np.random.default_rng(seed), found.signals
    p, t, zeros = len(found.fit.free), signals.presses, signals.zeros()
    places = found.fit.system[:, p : p + t] @ random.normal(0, priors.place, t)
    values = values + places + zeros @ random.normal(0, priors.zero, zeros.shape[1]) + random.normal(0, signals.noise)
    return refitted(found, values, priors), replace(signals, values=values)


def recordings_of(kind: Kind, number: int, folder: Path) -> tuple[list[Path], dict[str, float]]:
    """Recordings and truth in `folder`; made by another process, unless they are there."""
    if not (folder / "truth.json").exists():
        folder.mkdir(parents=True, exist_ok=True)
        twin = "import sys, pathlib; from benchmarks.identify import record; record(sys.argv[1], int(sys.argv[2]), "
        subprocess.run(
            [sys.executable, "-c", twin + "pathlib.Path(sys.argv[3]))", kind, str(number), str(folder)], check=True
        )
    truth = {}
    for key, value in json.loads((folder / "truth.json").read_text(encoding="utf-8")).items():
        truth[f"friction_{key.rpartition('.')[2]}" if ".friction." in key else key.rpartition(".")[2]] = value
    return find_recordings([folder / "runs"]), truth


def main(
    kind: Annotated[str, typer.Argument(help="gel, body, or poisson: what which presses tell of it.")] = "gel",
    truths: Annotated[int, typer.Option(min=1)] = 3,
    draws: Annotated[int, typer.Option(min=1)] = 50,
    seed: int = 0,
    force_noise: Annotated[float, typer.Option(help="[N]")] = 0.02,
    preset: str = "standard",
    folder: Annotated[Path, typer.Option(help="Of the recordings; those that are there are not made again.")] = Path(
        "runs/identify"
    ),
) -> None:
    """Prints a line of the table for each truth."""
    if kind == "poisson":
        for balls, heights, one in product(((4.0,), (8.0,), (2.0, 8.0), (4.0, 8.0)), (False, True), (0.02, 0.005)):
            felt = "forces and heights" if heights else "forces"
            typer.echo(f"| {' and '.join(f'{each:g}' for each in balls)} mm | {felt} | {one} N | "
                       f"{poisson(one, heights, balls)} |")  # fmt: skip
        return
    what: Kind = "gel" if kind == "gel" else "body"
    noise, priors = Noise(force_noise), Priors(PLACE, ZERO)
    for number in range(seed, seed + truths):
        paths, truth = recordings_of(what, number, folder / f"{kind}-{number}")
        scene = load_scene("press" if kind == "gel" else "squeeze", [f"preset={preset}"])
        recordings, began = Recordings(scene), time.perf_counter()
        presses = read_all(recordings, paths)
        random = np.random.default_rng(number)
        found = identify(what, scene, recordings, [_spoilt(press, force_noise, random) for press in presses], noise,
                         priors)  # fmt: skip
        seconds = time.perf_counter() - began
        clean = signals_of([thinned(gathered(press), MOMENTS) for press in presses], noise).values
        typer.echo(line(found, clean, truth, draws, priors, f"{kind} {number}", f"{seconds:.0f} s"))
        force = found.signals.force[found.signals.channel]
        alone = forces_alone(found)
        alone = replace(alone, fit=refitted(alone, alone.signals.values, priors))
        typer.echo(line(alone, clean[force], truth, draws, priors, "the same by forces alone", ""))


def forces_alone(found: Identified) -> Identified:
    """As if no sensor had seen heights and flow, by the system that the fit ended with."""
    signals = found.signals
    rows = signals.force[signals.channel]
    one = {name: getattr(signals, name)[rows] for name in ("values", "noise", "press", "channel", "time")}
    some = {name: getattr(found.fit, name)[rows] for name in ("predicted", "sigma", "system")}
    by_size = None if found.by_size is None else found.by_size[rows]
    checked = replace(found.checked, sigma=found.checked.sigma[rows])
    return replace(
        found, fit=replace(found.fit, **some), signals=replace(signals, **one), checked=checked, by_size=by_size
    )  # fmt: skip


def _spoilt(press: Press, noise: float, random: np.random.Generator) -> Press:
    """With noise, and with zeros of the force that are off."""
    return replace(
        press,
        readings={
            key: values + random.normal(0, noise, len(values)) + random.normal(0, ZERO) if _is_force(key) else values
            for key, values in press.readings.items()
        },
    )


def _is_force(channel: str) -> bool:
    return channel.rpartition(".")[2] in ("fx", "fy", "fz")


def line(
    found: Identified, clean: FloatArray, truth: dict[str, float], draws: int, priors: Priors, name: str, seconds: str
) -> str:
    """A row of the table; clean: (m,) the signals without noise."""
    fit, names = found.fit, tuple(press.name for press in found.presses)
    cells = []
    again = [redrawn(found, clean, k, priors) for k in range(draws)]
    for each in fit.told:
        low, high = fit.interval(each.name)
        ends = [fit.interval(each.name) for fit, _ in again if each.name in {one.name for one in fit.told}]
        held = sum(low <= truth[each.name] <= high for low, high in ends)
        cells.append(
            f"{each.name} {100 * (fit.value(each.name) / truth[each.name] - 1):+.1f} % "
            f"(-{100 * (1 - low / fit.value(each.name)):.0f}, +{100 * (high / fit.value(each.name) - 1):.0f}; "
            f"{'holds' if low <= truth[each.name] <= high else 'MISSES'}, {held} of {len(ends)})"
        )
    cells += [f"{each.name} not told" for each in fit.untold]

    def noticed_in(drawn: tuple[Fit, Signals]) -> bool:
        return bool(findings(replace(drawn[0], sigma=found.checked.sigma), drawn[1], names, found.by_size))

    false = sum(map(noticed_in, again))
    noticed = [f"nothing wrong {false} of {draws}"]
    for what, change in _faults(found).items():
        seen = (redrawn(found, clean + change, k, priors) for k in range(draws))
        noticed.append(f"{what} {sum(map(noticed_in, seen))} of {draws}")
    against = ", ".join(each.kind for each in found.findings) or "nothing"
    return (f"| {name} | {len(names)} | {fit.runs} | {seconds} | {', '.join(cells)} | {against} | "
            f"{', '.join(noticed)} |")  # fmt: skip


def poisson(force_noise: float, heights: bool, balls: tuple[float, ...]) -> str:
    """The interval of a gel's Poisson's ratio by presses of these balls (radii [mm]) to a quarter of its thickness."""
    scene = load_scene("press", ["preset=draft"])
    parameters = [each for each in parameters_of("gel", scene) if each.name != "friction"]
    depths = np.array([-0.2, -0.1, *np.linspace(0.1, 1.0, 10), 0.7, 0.4, -0.2]) * 1e-3
    names = ("fz", "dent", "width") if heights else ("fz",)
    presses = []
    for radius in balls:
        poses = {"indenter": tuple(Pose(np.array([0.0, 0.0, radius * 1e-3 - depth])) for depth in depths)}
        readings = {f"lower.{name}": np.where(depths > 0.2e-3, 0.0, np.nan if name == "width" else 0.0)
                    for name in names}  # fmt: skip
        presses.append(Press("press", poses, readings, depths * 0, np.ones(len(depths), np.int64), radius * 1e-3))
    seen = {"lower": Seen(CanonicalGrid(), None, np.ones((64, 64), np.bool_))}
    simulation = Simulation(scene, tuple(parameters), tuple(presses), seen)
    [values] = simulation([Point(starts(parameters), np.zeros(len(balls)))])
    signals = replace(signals_of(presses, Noise(force_noise)), values=values)
    fit = estimate([simulation], signals, parameters, Priors(PLACE, 10 * force_noise), SETTLED_ERROR)
    if any(each.name == "poisson_ratio" for each in fit.untold):
        return "not told"
    return "{:.3f} to {:.3f}".format(*fit.interval("poisson_ratio"))


def _faults(found: Identified) -> dict[str, FloatArray]:
    """What is to be noticed, as a change of the signals (m,)."""
    signals = found.signals
    channel = signals.channels.index("lower.fz")
    rows = (signals.press == 0) & (signals.channel == channel)
    along = np.where(rows, signals.time - signals.time[rows].min(), 0.0) / np.ptp(signals.time[rows])
    faults = {f"drift of {size} N": size * along for size in DRIFTS[found.kind]}
    if found.by_size is not None:
        faults |= {
            f"ball {factor} times as large": found.by_size.sum(axis=1) * np.log(factor) for factor in (1.1, 1.25)
        }
    return faults


if __name__ == "__main__":
    typer.run(main)
