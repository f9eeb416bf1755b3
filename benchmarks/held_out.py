"""Errors of calibrations on left-out presses, for each sensor: `python -m benchmarks.held_out DIR`.

DIR holds the public frames that `references/balls.yaml` names. Prints the first table of
docs/measurements/calibration.md, a minute a set; `--only NAME` measures one set. `--spread 50` prints the second: how
far contact radii differ between calibrations by random subsets of the presses, a quarter of an hour a set. `--clicked`
prints the table of both masks in docs/measurements/comparison.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from time import process_time
from typing import Annotated

import numpy as np
import typer

from benchmarks.cases.real import balls
from benchmarks.cases.real.balls import BallSet
from benchmarks.cases.real.clicked import clicked_errors, has_circles
from benchmarks.cases.real.labels import BadData, read_picture
from calibration.errors import BadFrames
from calibration.height.slopes import DarknessSlopes
from calibration.light.calibrator import calibrate_light
from calibration.light.dent import dent_height
from calibration.light.fit import LightFit
from calibration.normaliser import normaliser_for_calibration
from tacsim.interface import Image, TactileFrame
from tacsim.models.sensor import CanonicalGrid

# Contact MAE, correlation, normals before the model had shadows and slopes of a surface (decision 10)
BEFORE = {
    "THUsight": (6.24, 0.988, 3.0),
    "Taxim GelSight": (5.00, 0.983, 8.0),
    "FOTS GelSight": (2.90, 0.991, 7.6),
    "DIGIT": (8.68, 0.965, 10.8),
}
KINDS = (("contact MAE [grey levels]", "error", 2), ("correlation", "correlation", 3), ("normals [deg]", "angle", 1))
TIMES = 9  # repetitions to measure the time of a picture
# Sets of one press, of which none can be left out. Their folders; ball radius [m]; row, column, and pixel pitch [mm]
DARK, DARK_BALL, DARK_SCALE = "9dtact_sensor_*", 4e-3, "camera_calibration_position_scale.npy"
DARK_BEFORE = "-1.4 to 2.2 mm"  # heights found for a dent of 2.2 mm
SUBSETS = (5, 8, 15)  # presses
MAX_RADIUS_ERROR = 0.05  # relative error of a radius; a larger one means another solution of the fit


def rows_of(folder: Path, of: BallSet) -> list[str]:
    """Rows of one set, one for each figure. Raises BadData."""
    fit, _, cpu = balls.calibrated(folder, of)
    reference, frames = balls.read_balls(folder, of)
    picture = picture_time(fit, of, reference, frames[0][1])
    presses = fit.predictions
    return [
        table_row(
            f"{of.name}, {len(presses)} presses",
            what,
            f"{BEFORE[of.name][k]:.{digits}f}" if of.name in BEFORE else "",
            f"{np.mean([getattr(press, name) for press in presses]):.{digits}f}",
            f"{cpu:.1f} s, {1e3 * picture:.1f} ms",
        )
        for k, (what, name, digits) in enumerate(KINDS)
    ]


def picture_time(fit: LightFit, of: BallSet, reference: Image, image: Image) -> float:
    """Processor time of a picture from camera to observation [s], median."""
    calibration = fit.to_calibration("bench", of.ball_radius, of.pixel_pitch)
    normalise = normaliser_for_calibration(calibration, CanonicalGrid(), reference)
    normalise.take_reference(TactileFrame(image=reference, time=0.0, index=0, surface=None))
    taken = []
    for number in range(TIMES):
        begun = process_time()
        normalise(TactileFrame(image=image, time=0.0, index=1 + number, surface=None), 0.0)
        taken.append(process_time() - begun)
    return float(np.median(taken))


def dark_row(home: Path) -> str:
    """The row of the one press of a sensor whose light shows depth as darkness. Raises BadFrames, BadData."""
    reference = read_picture(home / "depth_calibration_ref.png")
    begun = process_time()
    pitch = 1e-3 * float(np.ravel(np.load(home / DARK_SCALE, allow_pickle=False))[2])
    fit = calibrate_light(
        reference, [("press", read_picture(home / "depth_calibration_sample.png"))], DARK_BALL / pitch
    )
    cpu = process_time() - begun
    if fit.darkness is None:
        return table_row("9DTact", "height [mm]", DARK_BEFORE, "its light was classified as one with direction", "")
    (press,) = fit.presses
    depth, _ = DarknessSlopes(fit.darkness, press.shape, 1.0).depth(press.change.astype(np.float32))
    v, u = np.mgrid[: press.shape[0], : press.shape[1]].astype(np.float64)
    off = depth - dent_height(u, v, press.circle, fit.thickness, DARK_BALL / pitch)
    off = off[press.distance() < press.circle.radius]
    found = f"{1e3 * pitch * np.sqrt(np.mean(off**2)):.3f} mm rms (on the press itself: the set has one)"
    return table_row(
        f"9DTact {home.name.removeprefix('9dtact_')}, 1 press", "height in contact", DARK_BEFORE, found, f"{cpu:.1f} s"
    )


@dataclass(frozen=True, slots=True)
class Subset:
    """A calibration by some of the presses of a set."""

    scale: float  # of its contact radii, relative to those by all presses: mean logarithm of their ratio
    estimated_deviation: float  # standard deviation of that scale, estimated by the calibration
    shadows: bool  # True if it found shadows


def subsets_of(folder: Path, of: BallSet, presses: int, count: int) -> list[Subset]:
    """Calibrations by random subsets, without refused ones. Raises BadData."""
    fit, _, _ = balls.calibrated(folder, of)
    radii = {press.name: press.circle.radius for press in fit.presses}
    reference, frames = balls.read_balls(folder, of)
    rng = np.random.default_rng(presses)
    found = []
    for _ in range(count):
        chosen = sorted(rng.choice(len(frames), presses, replace=False))
        try:
            part = calibrate_light(reference, [frames[i] for i in chosen], of.ball_radius / of.pixel_pitch)
        except BadFrames:
            continue
        scale = [np.log(press.circle.radius / radii[press.name]) for press in part.presses if press.name in radii]
        if scale:
            shadows = part.forward is not None and part.forward.shadows is not None
            found.append(Subset(float(np.mean(scale)), part.radius_uncertainty, shadows))
    return found


def spread_row(folder: Path, of: BallSet, presses: int, count: int) -> str:
    """The row of one set and size of subsets. Raises BadData."""
    subsets = subsets_of(folder, of, presses, count)
    fit, _, _ = balls.calibrated(folder, of)
    name, cells = f"{of.name}, {len(fit.presses)} presses", [str(presses), f"{len(subsets)} of {count}"]
    if len(subsets) < 2:
        return table_row(name, *cells, *["-"] * 6)
    scales = np.array([subset.scale for subset in subsets])
    return table_row(
        name,
        *cells,
        f"{scales.mean():+.1%}",
        f"{scales.std(ddof=1):.1%}",
        f"{scales[np.argmax(np.abs(scales))]:+.1%}",
        f"{np.mean(np.abs(scales) > MAX_RADIUS_ERROR):.0%}",
        f"{np.median([subset.estimated_deviation for subset in subsets]):.1%}",
        f"{np.mean([subset.shadows for subset in subsets]):.0%}",
    )


def clicked_row(folder: Path, of: BallSet) -> str:
    """The row of one set: contact MAE [grey levels] in both masks. Raises BadData."""
    fit, _, _ = balls.calibrated(folder, of)
    errors = clicked_errors(folder, of)
    refined = float(np.mean([press.error for press in fit.predictions]))
    return table_row(
        f"{of.name}, {len(fit.predictions)} presses", f"{refined:.2f}", f"{np.mean(errors):.2f} ({len(errors)})"
    )


def table_row(*cells: str) -> str:
    return f"| {' | '.join(cells)} |"


def main(
    folder: Path,
    only: Annotated[str, typer.Option(help="Measure this set alone.")] = "",
    spread: Annotated[
        int, typer.Option(min=0, help="Number of random subsets of each set to calibrate by instead.")
    ] = 0,
    presses: Annotated[list[int], typer.Option(min=1, help="Presses in a subset.")] = list(SUBSETS),  # noqa: B006
    clicked: Annotated[bool, typer.Option(help="Also contact MAE in circles clicked by hand.")] = False,
) -> None:
    """Prints the table of errors on left-out presses, or of the spread of contact radii between subsets."""
    available = [of for of in balls.read_sets(folder) if only in of.name and balls.has_frames(folder, of)]
    if spread:
        heads = (
            "sensor",
            "in a subset",
            "subsets",
            "radii, mean",
            "sd",
            "worst",
            f"beyond {MAX_RADIUS_ERROR:.0%}",
            "said ±",
        )
        typer.echo(table_row(*heads, "with shadows"))
        typer.echo(table_row(*["---"] * 9))
        for of in available:
            for size in presses:
                if size < len(balls.read_balls(folder, of)[1]):
                    typer.echo(spread_row(folder, of, size, spread))
        return
    if clicked:
        typer.echo(table_row("set", "within 1.5 refined radii", "inside the clicked circle (presses)"))
        typer.echo(table_row(*["---"] * 3))
        for of in available:
            if has_circles(of):
                typer.echo(clicked_row(folder, of))
        return
    typer.echo(table_row("sensor", "held-out figure", "before", "now", "CPU: calibration, a picture"))
    typer.echo(table_row(*["---"] * 5))
    for of in available:
        typer.echo("\n".join(rows_of(folder, of)))
    for home in sorted(folder.rglob(DARK)):
        if only in "9DTact":
            typer.echo(dark_row(home))


if __name__ == "__main__":
    try:
        typer.run(main)
    except (BadData, BadFrames) as error:
        raise SystemExit(str(error)) from None
