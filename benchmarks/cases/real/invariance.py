"""Real group: can a policy distinguish simulated from real frames? Simulated presses are compared with the same real
presses, both through a calibration by other presses.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter, process_time
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.cases.real import balls
from benchmarks.cases.real.balls import BallSet, Frames
from benchmarks.cases.real.contact_radius import ball_scene
from benchmarks.cases.real.known_depth import GRID, light_of
from benchmarks.cases.real.labels import BadData, read_labels
from benchmarks.harness.measure import Measurement, Timing
from benchmarks.harness.runner import Case, missing_case
from robot.studies.matched_press import ELEMENT
from tacsim.interface import Image

if TYPE_CHECKING:
    from calibration.bundle import Calibration
    from calibration.compare.compare import Comparison

CASE = "invariance"
FOLDS = 5
MIN_PRESSES = 10
THICKNESS = (2e-3, 8e-3)  # range of a thickness that is estimated from slopes [m]


def invariance(
    folder: Path, of: BallSet, gel_size: tuple[float, float, float] | None, repeat: int
) -> list[Measurement]:
    """Real presses and the same simulated presses, in five folds: distances, a classifier, drift. Seconds: of a press.

    Whole presses are left out, of the calibration and of the classifier. gel_size: None for an unknown gel, which gets
    the size of the picture and the thickness from the slopes around the contacts; its variants begin with the set's
    name.

    *pictures*: our surface is found in our picture, as the real one in its own. *surfaces*: that of the simulation.
    """
    reference, frames = balls.read_balls(folder, of)
    if len(frames) < MIN_PRESSES:
        raise BadData(f"{of.name}: {len(frames)} presses; at least {MIN_PRESSES} are needed")
    named = "" if gel_size is not None else f"{of.name}, "
    gel_size = _estimate_gel(folder, of, reference) if gel_size is None else gel_size
    wall, cpu, pressed, notes = 0.0, 0.0, 0, []
    by_source: dict[str, list[tuple[Comparison, Calibration | None]]] = {"pictures": [], "surfaces": []}
    for fold in range(FOLDS):
        train = tuple(frame for k, frame in enumerate(frames) if k % FOLDS != fold)
        both, calibration, taken, fold_notes = _compare_fold(of, reference, train, frames[fold::FOLDS], gel_size)
        wall, cpu, pressed = wall + taken[0], cpu + taken[1], pressed + len(both["pictures"].pairs)
        notes += fold_notes
        for source, comparison in both.items():
            by_source[source].append((comparison, calibration))
    timing, note = Timing((wall / pressed,), cpu / pressed), "; ".join(notes)
    rows = []
    for source, folds in by_source.items():
        rows += _rows(f"{named}{source}", folds, timing, note)
    return rows


def _estimate_gel(folder: Path, of: BallSet, reference: Image) -> tuple[float, float, float]:
    """Estimated size of a gel from its pictures [m]. Raises BadData."""
    fit, _, _ = balls.calibrated(folder, of)
    thickness = float(np.clip(fit.thickness * of.pixel_pitch, *THICKNESS))
    across, down = (round(length * of.pixel_pitch, 3) for length in (reference.shape[1], reference.shape[0]))
    return across, down, round(thickness / ELEMENT) * ELEMENT


def _rows(
    source: str, folds: list[tuple[Comparison, Calibration | None]], timing: Timing, note: str
) -> list[Measurement]:
    from calibration.compare.invariance import measure_invariance as invariance_of

    report = invariance_of(folds)
    rows = [
        Measurement(
            timing, view.rho, "x", "the distance of two real presses that are neighbours in size; 1 is as far",
            f"{source}: rho, {view.view}", None,
            {
                "rho_low": view.rho_low, "rho_high": view.rho_high, "auc": view.auc, "auc_low": view.auc_low,
                "auc_high": view.auc_high, "distance": view.distance, "neighbour": view.neighbour,
                "presses": float(report.presses),
            },
            note,
        )
        for view in report.views
        if source.endswith("pictures") or view.view in ("gradient", "height")
    ]  # fmt: skip
    rows += [
        Measurement(
            timing, max(0.0, drift.fresh), "deg more", "the same frames before the change, against our gel's gradient",
            f"{source}: drift, {drift.change.name}", None,
            {"extra_deg": drift.fresh, "stale_deg": drift.stale, "usual_deg": report.angle}, note,
        )
        for drift in report.drifts
    ]  # fmt: skip
    overall = [pair for comparison, _ in folds for pair in comparison.pairs]
    kinds = [("gradient_angle", "gradient", "deg", 1.0), ("height_share", "height", "% of depth", 100.0)]
    if source.endswith("pictures"):
        kinds.insert(0, ("contact_mae", "picture", "grey", 1.0))
    for key, name, unit, scale in kinds:
        values, nulls = [pair.numbers[key] for pair in overall], [pair.null[key] for pair in overall]
        figures = {"null": float(np.nanmean(nulls)) * scale, "median": float(np.nanmedian(values)) * scale}
        if key == "contact_mae":
            figures["ncc"] = float(np.nanmean([pair.numbers["contact_ncc"] for pair in overall]))
        rows.append(
            Measurement(
                timing, float(np.nanmean(values)) * scale, unit, "the real frame, by `tacsim compare`",
                f"{source}: {name}", None, figures, note,
            )
        )  # fmt: skip
    return rows


def _compare_fold(
    of: BallSet, reference: Image, train: Frames, test: Frames, gel_size: tuple[float, float, float]
) -> tuple[dict[str, Comparison], Calibration, tuple[float, float], list[str]]:
    """Simulated left-out presses compared with the real ones, by source; the calibration without them; wall and
    processor time of the simulation; notes."""
    from calibration.bundle import read_sensor_model, write_bundle
    from calibration.compare.compare import compare_frames
    from calibration.errors import BadFrames
    from calibration.frame_set import Frame, FrameSet
    from calibration.light.calibrator import calibrate_light
    from calibration.light.noise import NoiseUnknown, measure_press_noise
    from robot.studies.matched_press import match_presses

    try:
        fit = calibrate_light(reference, train, of.ball_radius / of.pixel_pitch)
        noise = measure_press_noise(fit.presses, fit.reference)
    except (BadFrames, NoiseUnknown) as error:
        raise BadData(f"{of.name}: {error}") from None
    calibration = fit.to_calibration("bench", of.ball_radius, of.pixel_pitch, noise=noise)
    real = FrameSet("real", reference, "as labelled", tuple(Frame(name, image) for name, image in test))
    scene = ball_scene(gel_size, of.ball_radius, ELEMENT)
    wall, cpu = perf_counter(), process_time()
    with TemporaryDirectory() as place:
        write_bundle(Path(place), calibration, reference)
        ours, fold_notes = match_presses(real, scene, read_sensor_model(Path(place)), GRID)
    taken = perf_counter() - wall, process_time() - cpu
    both = {
        "pictures": compare_frames(ours, real, calibration, calibration),
        "surfaces": compare_frames(ours, real, None, calibration),
    }
    return both, calibration, taken, fold_notes


def cases(folder: Path) -> tuple[Case, ...]:
    """Cases of the sensor with a known gel, and of every other set with enough presses; missing frames are reported.
    Raises ConfigError."""
    labels, resolution = read_labels(folder), f"{FOLDS} folds, h {ELEMENT * 1e3:g} mm"
    others = tuple(
        Case("real", CASE, "tacsim", f"{other.name}, {resolution}", partial(invariance, folder, other, None), long=True)
        for other in balls.read_sets(folder)
        if other.name != labels.light and not other.dots and balls.has_frames(folder, other)
    )
    try:
        of = light_of(folder, labels)
    except BadData as error:
        return (missing_case(CASE, str(error), resolution), *others)
    size = (*labels.gel_size, labels.gel_thickness[0])
    return (Case("real", CASE, "tacsim", resolution, partial(invariance, folder, of, size), long=True), *others)
