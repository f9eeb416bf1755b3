"""Fit of a sensor's light from presses of a ball, its bundle, and the page of its verdict."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import typer

from robot.cli.output import busy, notes, print_files, print_json, results, show_table, warn, writing
from robot.cli.terminal import EXIT_UNTRUSTED, EXIT_UNVERIFIED

if TYPE_CHECKING:
    from calibration.frame_set import FrameSet
    from calibration.lens.view import GelView
    from calibration.light.fit import LightFit
    from calibration.light.verdict import KnownScale
    from calibration.profiles import SensorProfile
    from tacsim.models.sensor import CameraNoise, Markers, PictureRegion

UNKNOWN = "unknown"  # serial number of a sensor without a given name
FRAMES = "frames"  # folder in a bundle with its camera images


def read_presses(frames: Path, reference: Path | None) -> FrameSet:
    max_presses = 200  # 5 to 8 are enough
    with busy("loading"):
        from calibration.frame_set import read_folder
    read = read_folder(frames, reference, max_presses)
    if read.estimated:
        notes.print("no picture without contact: the median of all presses is used")
    return read


def rectify_frames(read: FrameSet, region: PictureRegion | None, view: GelView | None) -> FrameSet:
    """Prepares native images for calibration: uniform outside the region, and metric."""
    from calibration.frame_set import rectified_by_view, restrict_to_region

    if region is not None:
        read = restrict_to_region(read, region)
    return read if view is None else rectified_by_view(read, view)


def fit_light(read: FrameSet, ball: float, dot: float | None) -> LightFit:
    """`ball`, `dot`: radii [px]. Exits with EXIT_UNTRUSTED if slopes do not change the light."""
    with busy("loading"):
        from calibration.light.calibrator import NoDirection, calibrate_light
        from calibration.markers.dots import DotEraser
    named = [(frame.name, frame.image) for frame in read.frames]
    try:
        with busy(f"calibrating from {len(named)} press{'es' * (len(named) > 1)}"):
            erase = None if dot is None else DotEraser(dot)
            more = [frame.image for frame in read.untouched]
            return calibrate_light(read.reference, named, ball, erase, more)
    except NoDirection as why:
        from calibration.light.verdict import GREY, is_grey

        grey = f"; {GREY}: give the camera's own, in colour" if is_grey(read.reference) else ""
        notes.print(f"{why}{grey}")
        results.print("verdict: do not trust; no bundle is written")
        print_json({"verdict": "do not trust", "findings": [{"word": "do not trust", "what": str(why)}]}, [])
        raise typer.Exit(EXIT_UNTRUSTED) from None


def find_lattice(read: FrameSet, pitch: float) -> Markers:
    """The lattice of dots in the reference image."""
    from calibration.markers.dots import NoLattice
    from calibration.markers.flow import find_markers
    from tacsim.models.sensor import Markers

    try:
        lattice, radius = find_markers(read.reference)
    except NoLattice as nothing:
        raise typer.BadParameter(
            f"{nothing}; leave --markers out if none are printed", param_hint="--markers"
        ) from None
    rows, columns = lattice.present.shape
    places = tuple(tuple((float(x), float(y)) for x, y in row) for row in lattice.positions * pitch)
    return Markers(rows=rows, columns=columns, pitch=lattice.pitch * pitch, radius=radius * pitch, places=places)


def write_calibration(
    folder: Path,
    fit: LightFit,
    read: FrameSet,
    serial: str,
    scale: KnownScale,
    found: Markers | None,
    profile: SensorProfile,
    *,
    view: GelView | None,
    region: PictureRegion | None,
) -> None:
    """Prints the calibration, writes its bundle and the page of its verdict. Exits with EXIT_UNTRUSTED or
    EXIT_UNVERIFIED according to the verdict."""
    from calibration.bundle import write_bundle
    from calibration.light.noise import measure_skin
    from calibration.light.verdict import PAGE_FILE, draw_residuals, evaluate_calibration, write_page

    verdict = evaluate_calibration(fit, scale, dots=found is None and _has_dots(fit))
    _print_fit(fit, scale.pixel_pitch, found)
    if profile.directed is not None and profile.directed == (fit.darkness is not None):
        claim = "depends" if profile.directed else "does not depend"
        warn(
            f"the light of a {profile.title} {claim} on the slopes' direction, unlike these pictures: is --kind right?"
        )
    noise = _measure_noise(read, fit)
    # not measured with dots: erased dots leave another grain
    skin = measure_skin(fit.presses, fit.reference, scale.pixel_pitch) if found is None else None
    bundle = fit.to_calibration(
        serial, scale.ball_radius, scale.pixel_pitch, view=view, markers=found, noise=noise, skin=skin
    )
    warnings = (f"verdict: {verdict}", *bundle.provenance.warnings)
    provenance = bundle.provenance.model_copy(update={"warnings": warnings})
    bundle = bundle.model_copy(update={"provenance": provenance, "region": region})
    facts = [f"{profile.title}: {profile.source}; {profile.light}"]
    if found is not None:
        facts.append(_describe_lattice(found))
    if noise is not None:
        facts.append(f"camera's noise {', '.join(f'{value:.2f}' for value in noise.deviation)} grey levels (R, G, B)")
    if skin is not None:
        facts.append(f"skin: {skin:.0%} of the grain of the picture without contact moves with the gel")
        notes.print(facts[-1])
    with writing(folder, new=not (folder / FRAMES).exists()):
        written = [write_bundle(folder, bundle, fit.reference)]
        residuals = folder / "residuals.png" if fit.predictions else None
        if residuals is not None:
            draw_residuals(fit, residuals)
            written.append(residuals)
        written.append(folder / PAGE_FILE)
        title = _title(serial, folder, profile)
        write_page(written[-1], title, fit, scale, verdict, residuals, facts)
    for finding in verdict.findings:
        todo = f" Next: {finding.todo}" if finding.todo else ""
        notes.print(f"{finding.word}: {finding.what}.{todo}")
    results.print(f"verdict: {verdict.word}")
    print_files(*written)
    calibration = bundle.model_dump(mode="json", include={"serial", "gel_size", "provenance", "residuals"})
    print_json({"verdict": verdict.word, "findings": verdict.findings, **calibration}, written)
    if verdict.word == "do not trust":
        raise typer.Exit(EXIT_UNTRUSTED)
    if verdict.word == "unverified scale":
        raise typer.Exit(EXIT_UNVERIFIED)


def _title(serial: str, folder: Path, profile: SensorProfile) -> str:
    """Title of the page: the sensor's name, and its kind if known."""
    name = folder.name if serial == UNKNOWN else serial
    return name if profile.directed is None else f"{name}, {profile.title}"


def _measure_noise(read: FrameSet, fit: LightFit) -> CameraNoise | None:
    """Measures and prints the camera's noise: from more reference images, or else around the contacts."""
    from calibration.light.noise import NoiseUnknown, measure_noise, measure_press_noise

    still = len(read.untouched_images)
    try:
        noise = measure_noise(read.untouched_images) if still > 1 else measure_press_noise(fit.presses, fit.reference)
    except NoiseUnknown as why:
        notes.print(f"camera's noise not measured: {why}")
        return None
    spread = ", ".join(f"{value:.2f}" for value in noise.deviation)
    notes.print(
        f"camera's noise, from {f'{still} pictures without contact' if still > 1 else 'around the contacts'}: R, G, B "
        f"{spread} grey levels; "
        f"correlation of neighbours {noise.neighbours[0]:.2f} along x, {noise.neighbours[1]:.2f} along y"
    )
    return noise


def _has_dots(fit: LightFit) -> bool:
    from calibration.markers.flow import require_no_markers
    from calibration.reference import UnusableReference

    try:
        require_no_markers(fit.reference)
    except UnusableReference:
        return True
    return False


def _print_fit(fit: LightFit, pitch: float, found: Markers | None) -> None:
    if fit.predictions:
        rows = (
            (
                press.name, f"{press.circle.radius * pitch * 1e3:.3f}", f"{press.error:.1f}",
                f"{press.null_error:.1f}", f"{press.correlation:.3f}", f"{press.angle:.1f}",
            )
            for press in fit.predictions
        )  # fmt: skip
        columns = ("frame", "contact radius [mm]", "error", "of [grey levels]", "correlation", "normal [deg]")
        show_table("Each press predicted by all the others", columns, rows, left={0})
    if fit.darkness is not None:
        results.print(
            "this light does not depend on the direction of slopes: darkness gives depth, up to "
            f"{fit.darkness.depths[-1] * pitch * 1e3:.2f} mm beyond {fit.darkness.share:.0%} of the mean "
            "depth around it"
        )
    elif fit.size is not None and fit.forward is not None:
        results.print(
            f"model: degree {fit.size.degree} in the normal, {fit.size.position} in the position; calibrated up to a "
            f"slope of {fit.forward.steepest:.2f}"
        )
    if fit.predictions:
        results.print(
            f"contact radii ± {fit.radius_uncertainty:.1%}; gel {fit.thickness * pitch * 1e3:.1f} mm thick by the "
            "slopes around the contacts"
        )
    if fit.stretch is not None:
        results.print(f"ratio of the axes of contacts: {fit.stretch}")
    for name, why in fit.left_out:
        notes.print(f"left out: {name}: {why}")
    if found is not None:
        notes.print(_describe_lattice(found))


def _describe_lattice(found: Markers) -> str:
    return (
        f"markers: {found.rows} x {found.columns}, {found.pitch * 1e3:.3g} mm apart, radius {found.radius * 1e3:.2g} mm"
    )
