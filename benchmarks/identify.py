"""How well `tacsim identify` finds hidden materials: `python -m benchmarks.identify gel` (body, poisson, friction,
docs).

A separate process draws each truth, simulates it on a mesh that identification does not use, and records the motions
that `tacsim identify … --motions` writes. It stores the truth in a file that is read after the fit. Then noise, zeros
and places are drawn again many times, to count how often the intervals contain the truth, how often a drift or a wrong
ball is detected, and how often there are false detections. No draw needs a simulation: near the estimate the simulation
equals the linear system at the end of the fit, and the errors are added to the recordings. A gel takes a minute, a body
a quarter of an hour. `friction` compares motions for the identification of friction. `docs` writes the table of
docs/identify.md from the results in `--folder`, and measures missing ones.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import time
from dataclasses import asdict, dataclass, replace
from itertools import product
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from calibration.materials.checks import find_contradictions
from calibration.materials.estimate import SETTLING_ERROR, estimate_materials
from calibration.materials.fit import (
    Fit,
    Noise,
    Point,
    Press,
    Priors,
    Signals,
    covariance_of,
    downsample_press,
    merge_repeated_readings,
    signals_of,
    start_values,
)
from calibration.materials.tuning import MAX_IDENTIFIED_HALF_INTERVAL
from robot.studies.identify.identify import MOMENTS, Identified, Kind, identify, parameters_of
from robot.studies.identify.motions import motions
from robot.studies.identify.recordings import Recordings, find_recordings, read_all
from robot.studies.identify.simulation import SensorView, Simulation
from tacsim import pose as se3
from tacsim.config import load_scene
from tacsim.interface import FloatArray, Pose
from tacsim.models.scene import Scene
from tacsim.models.sensor import CanonicalGrid

# between the meshes that identification uses
TRUE_MESH = ("scene.element_size=0.4 mm", "scene.particle_spacing=0.2 mm")
RIGS = {"gel": "press", "body": "sim"}
MOTIONS = {"gel": ("press", "slide"), "body": ("squeeze", "tilt")}
DRIFTS = {"gel": (0.05, 0.1, 0.2), "body": (0.2, 0.5, 1.0)}  # of the normal force during the first recording [N]
PAGE, ROWS = (
    Path("docs/measurements/identification.md"),
    "found.json",
)  # the page of all truths; the file of one truth, in its folder
BEGIN, END = "<!-- made by python -m benchmarks.identify docs -->", "<!-- end of the table -->"
HEAD = (
    "| Truth | Recordings | Simulated | Time | Error (95 %; draws with the truth inside) | Contradictions | Detected |",
    "|---|---|---|---|---|---|---|",
)
WORDS = {
    "youngs_modulus": "stiffness", "poisson_ratio": "Poisson's ratio", "yield_stress": "yield",
    "hardening_modulus": "hardening", "friction_lower": "friction below", "friction_upper": "friction above",
}  # fmt: skip
FRICTIONS = ((0.15, 0.15), (0.3, 0.3), (0.6, 0.6), (1.0, 1.0), (0.3, 0.6), (0.6, 0.3), (0.2, 0.6))  # below, above
PLACE, ZERO = 0.02e-3, 0.2  # standard deviations of the errors that are added to the recordings [m, N]


@dataclass(frozen=True)
class Row:
    """One line of the table."""

    name: str
    recordings: int
    simulated: int
    seconds: float | None
    # by name: relative errors of the estimate and of the ends of its interval; number of draws whose interval contains
    # the truth, and number of draws. None: not identified
    parameters: dict[str, tuple[float, ...] | None]
    against: list[str]
    detected: dict[str, int]  # number of draws with a detection, by error
    draws: int


def draw_truth(kind: str, seed: int) -> dict[str, float]:
    """Random materials within a factor of about 1.5 of those of the scenes."""
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
    """Draws a truth, runs the motions, and writes recordings and truth, in a separate process."""
    truth = draw_truth(kind, seed)
    shutil.rmtree(folder / "runs", ignore_errors=True)  # of an incomplete recording
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
    """The fit to `values` (m,), with the simulation linearised near the estimate."""
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
    parameters = [replace(each, start=fit.value(each.name)) for each in fit.parameters]
    again = estimate_materials([predict], signals, parameters, priors, 0.0)
    refit = replace(again, mesh_shift=fit.mesh_shift, settled_shift=fit.settled_shift, runs=fit.runs)
    return refit.with_sigma(again.sigma).widen_intervals(values - again.predicted, signals.series)


def redrawn(found: Identified, values: FloatArray, seed: int, priors: Priors) -> tuple[Fit, Signals]:
    """`values` (m,) with other noise, zeros and places, and the fit to them."""
    random, signals = np.random.default_rng(seed), found.signals
    p, t, zeros = len(found.fit.free), signals.presses, signals.zeros()
    places = found.fit.system[:, p : p + t] @ random.normal(0, priors.place, t)
    values = values + places + zeros @ random.normal(0, priors.zero, zeros.shape[1]) + random.normal(0, signals.noise)
    return refitted(found, values, priors), replace(signals, values=values)


def recordings_of(kind: Kind, number: int, folder: Path) -> tuple[list[Path], dict[str, float]]:
    """Recordings and truth in `folder`; another process makes them if they are missing."""
    if not (folder / "truth.json").exists():
        folder.mkdir(parents=True, exist_ok=True)
        script = "import sys, pathlib; from benchmarks.identify import record; record(sys.argv[1], int(sys.argv[2]), "
        subprocess.run(
            [sys.executable, "-c", script + "pathlib.Path(sys.argv[3]))", kind, str(number), str(folder)], check=True
        )
    truth = {}
    for key, value in json.loads((folder / "truth.json").read_text(encoding="utf-8")).items():
        truth[f"friction_{key.rpartition('.')[2]}" if ".friction." in key else key.rpartition(".")[2]] = value
    return find_recordings([folder / "runs"]), truth


def measured(kind: Kind, number: int, folder: Path, draws: int, force_noise: float, preset: str) -> list[Row]:
    """The rows of one truth: from all recorded data, and from forces alone. Writes them into `folder`."""
    noise, priors = Noise(force_noise), Priors(PLACE, ZERO)
    paths, truth = recordings_of(kind, number, folder)
    scene = load_scene("press" if kind == "gel" else "squeeze", [f"preset={preset}"])
    recordings, began = Recordings(scene), time.perf_counter()
    presses = read_all(recordings, paths)
    random = np.random.default_rng(number)
    disturbed = [_add_errors(press, force_noise, random) for press in presses]
    found = identify(kind, scene, recordings, disturbed, noise, priors)
    seconds = time.perf_counter() - began
    clean = signals_of([downsample_press(merge_repeated_readings(press), MOMENTS) for press in presses], noise).values
    force = found.signals.force[found.signals.channel]
    alone = forces_alone(found)
    alone = replace(alone, fit=refitted(alone, alone.signals.values, priors))
    rows = [
        make_row(found, clean, truth, draws, priors, f"{kind} {number}", seconds),
        make_row(alone, clean[force], truth, draws, priors, "the same by forces alone", None),
    ]
    (folder / ROWS).write_text(json.dumps([asdict(each) for each in rows], indent=1), encoding="utf-8")
    return rows


def main(
    kind: Annotated[str, typer.Argument(help="gel, body, docs; poisson, friction: which motions identify it.")] = "gel",
    truths: Annotated[int, typer.Option(min=1)] = 3,
    draws: Annotated[int, typer.Option(min=1)] = 50,
    seed: int = 0,
    force_noise: Annotated[float, typer.Option(help="[N]")] = 0.02,
    preset: str = "standard",
    folder: Annotated[Path, typer.Option(help="Of the recordings; existing ones are used again.")] = Path(
        "runs/identify"
    ),
) -> None:
    """Prints a line of the table for each truth; `docs` writes the table."""
    if kind == "poisson":
        for balls, heights, one in product(((4.0,), (8.0,), (2.0, 8.0), (4.0, 8.0)), (False, True), (0.02, 0.005)):
            channels = "forces and heights" if heights else "forces"
            typer.echo(f"| {' and '.join(f'{each:g}' for each in balls)} mm | {channels} | {one} N | "
                       f"{poisson(one, heights, balls)} |")  # fmt: skip
        return
    if kind == "friction":
        for motion in ("squeeze", "slide", "tilt"):
            typer.echo("\n".join(friction(motion)))
        return
    rows = []
    kinds: tuple[Kind, ...] = ("gel", "body") if kind == "docs" else ("gel" if kind == "gel" else "body",)
    for what, number in product(kinds, range(seed, seed + truths)):
        own = folder / f"{what}-{number}"
        if kind == "docs" and (own / ROWS).exists():
            found = [Row(**each) for each in json.loads((own / ROWS).read_text(encoding="utf-8"))]
        else:
            found = measured(what, number, own, draws, force_noise, preset)
        typer.echo("\n".join(map(table_line, found)))
        rows += found
    if kind == "docs":
        text = PAGE.read_text(encoding="utf-8")
        before, after = text.partition(BEGIN)[0], text.partition(END)[2]
        table = "\n".join([*HEAD, *map(table_line, rows)])
        PAGE.write_text(f"{before}{BEGIN}\n{table}\n{END}{after}", encoding="utf-8")


def forces_alone(found: Identified) -> Identified:
    """The result without heights and flow, from the linear system at the end of the fit."""
    signals = found.signals
    rows = signals.force[signals.channel]
    one = {name: getattr(signals, name)[rows] for name in ("values", "noise", "press", "channel", "time")}
    some = {name: getattr(found.fit, name)[rows] for name in ("predicted", "sigma", "system")}
    by_size = None if found.by_size is None else found.by_size[rows]
    checked = replace(found.checked, sigma=found.checked.sigma[rows])
    return replace(
        found, fit=replace(found.fit, **some), signals=replace(signals, **one), checked=checked, by_size=by_size
    )  # fmt: skip


def _add_errors(press: Press, noise: float, random: np.random.Generator) -> Press:
    """The press with noise, and with errors of the force zeros."""
    return replace(
        press,
        readings={
            key: values + random.normal(0, noise, len(values)) + random.normal(0, ZERO) if _is_force(key) else values
            for key, values in press.readings.items()
        },
    )


def _is_force(channel: str) -> bool:
    return channel.rpartition(".")[2] in ("fx", "fy", "fz")


def make_row(
    found: Identified, clean: FloatArray, truth: dict[str, float], draws: int, priors: Priors, name: str,
    seconds: float | None,
) -> Row:  # fmt: skip
    """The result compared with the truth. clean: (m,) the signals without noise."""
    fit, names = found.fit, tuple(press.name for press in found.presses)
    parameters: dict[str, tuple[float, ...] | None] = {each.name: None for each in fit.parameters}
    again = [redrawn(found, clean, k, priors) for k in range(draws)]
    for each in fit.identified:
        one, value, true = each.name, fit.value(each.name), truth[each.name]
        ends = [fit.interval(one) for fit, _ in again if one in {parameter.name for parameter in fit.identified}]
        contained = sum(low <= true <= high for low, high in ends)
        parameters[one] = (value / true - 1, *(end / true - 1 for end in fit.interval(one)), contained, len(ends))

    def is_detected(drawn: tuple[Fit, Signals]) -> bool:
        return bool(find_contradictions(replace(drawn[0], sigma=found.checked.sigma), drawn[1], names, found.by_size))

    detections = {"nothing wrong": sum(map(is_detected, again))}
    for what, change in _faults(found).items():
        detections[what] = sum(is_detected(redrawn(found, clean + change, k, priors)) for k in range(draws))
    return Row(
        name, len(names), fit.runs, seconds, parameters, [each.kind for each in found.findings], detections, draws
    )  # fmt: skip


def table_line(row: Row) -> str:
    cells = []
    for name, found in row.parameters.items():
        words = WORDS.get(name, name)
        if found is None:
            cells.append(f"{words} not identified")
            continue
        error, low, high, contained, draws = found
        miss = "" if low <= 0 <= high else ", MISSES"
        cells.append(
            f"{words} {100 * error:+.1f} % ({100 * low:+.0f} to {100 * high:+.0f}{miss}; {contained:g} of {draws:g})"
        )
    detections = ", ".join(f"{what} {count}" for what, count in row.detected.items())
    seconds = "" if row.seconds is None else f"{row.seconds:.0f} s"
    return (f"| {row.name} | {row.recordings} | {row.simulated} | {seconds} | {'; '.join(cells)} | "
            f"{', '.join(row.against) or 'nothing'} | {detections} of {row.draws} |")  # fmt: skip


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
    views = {"lower": SensorView(CanonicalGrid(), None, np.ones((64, 64), np.bool_))}
    simulation = Simulation(scene, tuple(parameters), tuple(presses), views)
    [values] = simulation([Point(start_values(parameters), np.zeros(len(balls)))])
    signals = replace(signals_of(presses, Noise(force_noise)), values=values)
    fit = estimate_materials([simulation], signals, parameters, Priors(PLACE, 10 * force_noise), SETTLING_ERROR)
    if any(each.name == "poisson_ratio" for each in fit.unidentified):
        return "not identified"
    return "{:.3f} to {:.3f}".format(*fit.interval("poisson_ratio"))


def planned(scene: Scene, motion: str, moments: int) -> Press:
    """One of the motions of a body from first contact, at a number of moments, with zero readings."""
    touch = Pose(np.array([0.0, 0.0, 10e-3]), se3.HALF_TURN_X.quaternion)
    rows = np.loadtxt(motions(scene)[motion].splitlines(), delimiter=",", skiprows=1)
    upper = [touch, *(se3.compose(touch, se3.from_rotation_vector([x, 0, z], [0, turn, 0])) for x, z, turn in rows)]
    count = len(upper)
    readings = {f"{gel}.{force}": np.zeros(count) for gel in ("lower", "upper") for force in ("fx", "fz")}
    poses = {"lower": (Pose(),) * count, "upper": tuple(upper)}
    return downsample_press(Press(motion, poses, readings, np.arange(float(count)), np.ones(count, np.int64)), moments)


def friction(motion: str, sensors: tuple[float, ...] = (0.02, 0.2, 1.0)) -> list[str]:
    """Lines of a table: half the 95 % intervals of both frictions of a body by one motion, its material known, for
    these force sensors [N]."""
    scene = load_scene("squeeze", ["preset=learn"])
    press = planned(scene, motion, MOMENTS)
    parameters = [each for each in parameters_of("body", scene) if each.name.startswith("friction")]
    simulation, signals = Simulation(scene, tuple(parameters), (press,), {}), signals_of([press], Noise(1.0))
    points = [
        Point(np.log(pair) + change, np.array([place]))
        for pair in FRICTIONS
        for change, place in ((0, 0), (np.array([0.08, 0]), 0), (np.array([0, 0.08]), 0), (0, PLACE))
    ]
    values, lines = np.array(simulation(points)).reshape(len(FRICTIONS), 4, -1), []
    for (lower, upper_one), (base, *changed) in zip(FRICTIONS, values, strict=True):
        columns = [(one - base) / step for one, step in zip(changed, (0.08, 0.08, PLACE), strict=True)]
        system, cells = np.column_stack([*columns, signals.zeros()]), []
        for noise in sensors:
            priors = np.array([PLACE, *[10 * noise] * 4])
            known = covariance_of(system, np.hypot(noise, SETTLING_ERROR * base), priors, np.zeros(2, np.bool_))
            halves = 1.96 * np.sqrt(np.diag(known))[:2]
            cells.append(
                " / ".join("no" if half > MAX_IDENTIFIED_HALF_INTERVAL else f"{100 * half:.0f} %" for half in halves)
            )
        angle = np.degrees(abs(np.arctan(lower) - np.arctan(upper_one)))
        lines.append(f"| {motion} | {lower:g} / {upper_one:g} | {angle:.0f} | {' | '.join(cells)} |")
    return lines


def _faults(found: Identified) -> dict[str, FloatArray]:
    """The errors to detect, as changes of the signals (m,)."""
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
