"""`tacsim calibrate`: from frames to the calibration of a sensor."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from robot.cli.calibrate.session import confirm_free_gel, led, named_camera, picture_keeper
from robot.cli.errors import UNTRUSTED
from robot.cli.options import Out, Overrides, length, quantity
from robot.cli.output import busy, new_directory, notes, results, say_files, show_table, warn, writing

if TYPE_CHECKING:
    from calibration.frame_set import FrameSet
    from calibration.lens.view import GelView
    from calibration.light.fit import LightFit
    from calibration.light.verdict import KnownScale
    from calibration.profiles import SensorProfile
    from tacsim.models.hardware import CameraSensorConfig
    from tacsim.models.sensor import CameraNoise, Markers

UNKNOWN = "unknown"  # serial number of a sensor that nobody named
MAX_PRESSES = 200  # 5 to 8 are enough

calibrate = typer.Typer(no_args_is_help=True, help="Calibrate what stands behind a rig.")


@calibrate.callback()
def _group() -> None:
    """Calibrate what stands behind a rig."""


@calibrate.command(
    epilog='Example: [bold]tacsim calibrate sensor frames --ball-diameter "5.84 mm" --pixel-pitch "0.0593 mm"[/]'
)
def sensor(
    frames: Annotated[
        Path | None, typer.Argument(help="Folder of pictures of a ball's presses, 5 to 8 or more; or give --camera.")
    ] = None,
    ball_diameter: Annotated[
        Any, length('Of the ball, as a calliper shows it, for example "5.84 mm".', 1e-4, 0.1)
    ] = None,
    ball_radius: Annotated[Any, length("Half of that, in its place.", 5e-5, 0.05)] = None,
    kind: Annotated[
        str | None,
        typer.Option(
            "--kind",
            metavar="KIND",
            help="mini, mini-markers, r1.5, digit, 9dtact or other: what is known of it beforehand, such as which part "
            "of the picture shows the gel, a first pixel pitch, dots.",
        ),
    ] = None,
    camera: Annotated[
        str | None,
        typer.Option(
            metavar="RIG/SENSOR",
            help="Press now, before this camera of a rig, or one at /dev/... or http://...; no arm is connected.",
        ),
    ] = None,
    presses: Annotated[int, typer.Option(min=1, max=100, help="How many; with --camera.")] = 8,
    pixel_pitch: Annotated[
        Any,
        length("Distance of two pixels on the gel; or give --view, or --kind.", 1e-7, 1e-2),
    ] = None,
    view: Annotated[
        Path | None,
        typer.Option(help="view.yaml of `tacsim calibrate lens`: frames are rectified by it.", show_default=False),
    ] = None,
    reference: Annotated[
        Path | None,
        typer.Option(
            help="The picture without contact; the camera's noise is told by more of them, background_1.png and so on "
            "beside it.",
            show_default="background.png or the like in FRAMES",
        ),
    ] = None,
    serial: Annotated[
        str, typer.Option(help="Serial number or name of the sensor; without --out, its folder is sensors/ and this.")
    ] = UNKNOWN,
    known_depth: Annotated[
        list[str] | None,
        typer.Option(
            "--depth",
            metavar="FRAME=LENGTH",
            help="A press of known depth, which checks pitch and ball; may be repeated.",
        ),
    ] = None,
    markers: Annotated[bool, typer.Option("--markers", help="Dots are printed on the gel.")] = False,
    set_: Overrides = None,
    out: Out = None,
) -> None:
    """Calibrate a sensor's light from presses of a ball: colour of every slope, and slope of every colour.

    Contact circles are found by themselves. Writes calibration.yaml, reference.png and residuals.png, prints how well
    each press is predicted by the others, and ends in a verdict, verdict.html: good, usable or do not trust (then the
    exit code is 3), with the reasons and what to do next.

    With --camera it leads you through it: the gel without contact, then press after press, each judged at once. The
    pictures are kept in frames/ beside the bundle, to calibrate from them again; Ctrl-C keeps what was taken.
    """
    from calibration.profiles import PROFILES

    if (frames is None) == (camera is None):
        raise typer.BadParameter("give either a folder of frames, or --camera to press now")
    if (ball_radius is None) == (ball_diameter is None):
        what = "give the ball's diameter (or its radius, not both): without it no slope is known"
        raise typer.BadParameter(what, param_hint="--ball-diameter")
    if kind is not None and kind not in PROFILES:
        raise typer.BadParameter(f"'{kind}'; known: {', '.join(PROFILES)}", param_hint="--kind")
    profile = PROFILES["other" if kind is None else kind]
    if pixel_pitch is not None and view is not None:
        raise typer.BadParameter("give either --pixel-pitch or --view")
    if pixel_pitch is None and view is None and profile.gel_size is None:
        raise typer.BadParameter("give --pixel-pitch or --view: nothing is known beforehand of this sensor's")
    if out is None and Path(serial).name != serial:
        raise typer.BadParameter(f"'{serial}' cannot be a folder's name; name one by --out", param_hint="--serial")
    from calibration.lens.view import GelView
    from tacsim.config import load

    depths = tuple(_known_depth(text) for text in known_depth or ())
    seen = None if view is None else load(GelView, view)
    ball = ball_radius if ball_diameter is None else ball_diameter / 2
    folder = new_directory(Path("sensors") / serial if out is None and serial != UNKNOWN else out, "calibration")
    with busy("loading"):
        from calibration.frame_set import read_folder, rectified_by_view
        from calibration.light.calibrator import NoDirection, calibrate_light
        from calibration.light.verdict import KnownScale
        from calibration.markers.dots import DotEraser
    markers = markers or profile.markers
    if camera is not None:
        config, sensor_name = named_camera(camera, set_ or [], profile.native)
        seen = _view_of(profile, seen, pixel_pitch, (config.height, config.width))
        pitch = _pitch(profile, seen, pixel_pitch, config.width)
        read = _take_presses(camera, config, sensor_name, folder, ball / pitch, presses, seen, serial, markers=markers)
    else:
        assert frames is not None
        read = read_folder(frames, reference, MAX_PRESSES)
        seen = _view_of(profile, seen, pixel_pitch, read.shape)
        pitch = _pitch(profile, seen, pixel_pitch, read.shape[1])
    if seen is not None:
        read = rectified_by_view(read, seen)
    if read.estimated:
        notes.print("no picture without contact: the median of all presses stands for it")
    found = _markers(read, pitch) if markers else None
    erase = None if found is None else DotEraser(found.radius / pitch)
    try:
        with busy(f"calibrating from {len(read.frames)} presses"):
            named = [(frame.name, frame.image) for frame in read.frames]
            fit = calibrate_light(read.reference, named, ball / pitch, erase)
    except NoDirection as why:
        notes.print(str(why), markup=False)
        results.print("verdict: do not trust; no bundle is written")
        raise typer.Exit(UNTRUSTED) from None
    scale = KnownScale(pitch, ball, profile.gel_size, profile.gel_thickness, depths)
    _write(folder, fit, read, serial, scale, found, profile, view=seen)


def _known_depth(text: str) -> tuple[str, float]:
    name, equals, depth = text.rpartition("=")
    if not equals:
        raise typer.BadParameter(f"'{text}'; give FRAME=LENGTH, such as 'press_3.png=0.5 mm'", param_hint="--depth")
    value = quantity("length", 1e-6, 1e-2)(depth)
    return name, value


def _view_of(
    profile: SensorProfile, view: GelView | None, pitch: float | None, shape: tuple[int, int]
) -> GelView | None:
    """The view that was given, or the profile's crop of its sensor's native pictures of `shape` (rows, columns)."""
    from calibration.lens.view import view_of_corners

    corners = profile.corners(shape)
    if view is not None or pitch is not None or corners is None or profile.gel_size is None:
        return view
    return view_of_corners(corners, profile.gel_size, shape)


def _pitch(profile: SensorProfile, view: GelView | None, pitch: float | None, columns: int) -> float:
    """Distance of two pixels on the gel [m]; that of the profile is only a first one, and said to be."""
    if pitch is not None:
        return pitch
    if view is not None and view.board != "four corners":
        return view.pixel_pitch
    if view is not None:
        found = view.pixel_pitch
    else:
        assert profile.gel_size is not None
        found = profile.gel_size[0] / columns
    warn(f"{found * 1e3:.4g} mm a pixel, as published of a {profile.title} ({profile.source}); measure yours")
    return found


def _take_presses(
    camera: str,
    config: CameraSensorConfig,
    sensor: str,
    folder: Path,
    ball: float,
    presses: int,
    view: GelView | None,
    serial: str,
    *,
    markers: bool,
) -> FrameSet:
    """Frames taken now, native, and kept in `folder`/frames. camera: its name; ball: its radius [px].

    A signal ends the command; what was taken is kept then, too. Raises CannotCalibrate, BadFrames, DeviceError.
    """
    from calibration.errors import BadFrames
    from calibration.frame_set import Frame, FrameSet, metric_picture, require_view_size
    from robot.camera.camera import Camera
    from robot.procedures.presses import BallPressPlan, record_presses

    if view is not None:
        require_view_size((config.height, config.width), view)
    plan = BallPressPlan(ball, presses, rectify=None if view is None else metric_picture(view), markers=markers)
    frames = folder / "frames"
    again = f"tacsim calibrate sensor {shlex.quote(str(frames))} --serial {shlex.quote(serial)} ..."
    with Camera(config, sensor) as source:
        confirm_free_gel()
        note = f"frames kept in {frames}; to calibrate from them again: {again}"
        with led("presses", presses, frames, note) as session:
            session.keep = picture_keeper(frames)
            untouched = record_presses(source, plan, session)
    if not untouched or not session.taken:
        raise BadFrames("the source was over before a press was taken")
    taken = tuple(Frame(name, image) for name, image in session.taken)
    more = tuple(Frame(f"background_{k}.png", image) for k, image in enumerate(untouched[:-1], start=1))
    return FrameSet(camera, untouched[-1], "background.png", taken, more)


def _write(
    folder: Path,
    fit: LightFit,
    read: FrameSet,
    serial: str,
    scale: KnownScale,
    found: Markers | None,
    profile: SensorProfile,
    *,
    view: GelView | None,
) -> None:
    """Shows the calibration, writes its bundle and the page of its verdict; exits with UNTRUSTED where it must."""
    from calibration.bundle import write_bundle
    from calibration.light import page
    from calibration.light.residual_picture import draw
    from calibration.light.verdict import judge

    verdict = judge(fit, scale)
    _show(fit, scale.pixel_pitch, found)
    noise = _noise(read)
    bundle = fit.to_calibration(serial, scale.ball_radius, scale.pixel_pitch, view=view, markers=found, noise=noise)
    warnings = (f"verdict: {verdict}", *bundle.provenance.warnings)
    bundle = bundle.model_copy(update={"provenance": bundle.provenance.model_copy(update={"warnings": warnings})})
    facts = [f"{profile.title}: {profile.source}; {profile.light}"]
    if noise is not None:
        facts.append(f"camera's noise {', '.join(f'{value:.2f}' for value in noise.deviation)} grey levels (R, G, B)")
    with writing(folder):
        written = [write_bundle(folder, bundle, fit.reference)]
        residuals = folder / "residuals.png" if fit.predictions else None
        if residuals is not None:
            draw(fit, residuals)
            written.append(residuals)
        written.append(folder / page.FILE)
        page.write_page(
            written[-1], folder.name if serial == UNKNOWN else serial, fit, scale, verdict, residuals, facts
        )
    for finding in verdict.findings:
        notes.print(f"{finding.word}: {finding.what}. {finding.todo}", markup=False)
    results.print(f"verdict: {verdict.word}")
    say_files(*written)
    if verdict.word == "do not trust":
        raise typer.Exit(UNTRUSTED)


def _markers(read: FrameSet, pitch: float) -> Markers:
    """The lattice of dots in the picture without contact."""
    from calibration.markers.flow import find_markers
    from calibration.markers.lattice import NoLattice
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


def _noise(read: FrameSet) -> CameraNoise | None:
    """The camera's noise, measured and printed."""
    from calibration.light.noise import NoiseUnknown, measure_noise

    try:
        noise = measure_noise(read.untouched_images)
    except NoiseUnknown as why:
        notes.print(f"camera's noise not measured: {why}", markup=False)
        return None
    spread = ", ".join(f"{value:.2f}" for value in noise.deviation)
    notes.print(
        f"camera's noise, from {len(read.untouched_images)} pictures without contact: R, G, B {spread} grey levels; "
        f"correlation of neighbours {noise.neighbours[0]:.2f} along x, {noise.neighbours[1]:.2f} along y"
    )
    return noise


def _look_for_dots(fit: LightFit) -> None:
    """Warns of dots on the gel where --markers is not given."""
    from calibration.markers.flow import require_no_markers
    from calibration.reference import UnusableReference

    try:
        require_no_markers(fit.reference)
    except UnusableReference:
        warn("dots seem to be printed on the gel; give --markers, or each will pass for a dent")


def _show(fit: LightFit, pitch: float, found: Markers | None) -> None:
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
            f"this light tells no direction: darkness tells depth, up to {fit.darkness.depths[-1] * pitch * 1e3:.2f} "
            f"mm beyond {fit.darkness.share:.0%} of the mean depth round it"
        )
    elif fit.size is not None and fit.forward is not None:
        results.print(
            f"model: degree {fit.size.degree} in the normal, {fit.size.position} in the place; calibrated up to a "
            f"slope of {fit.forward.steepest:.2f}"
        )
    if fit.predictions:
        results.print(
            f"contact radii ± {fit.radius_uncertainty:.1%}; gel {fit.thickness * pitch * 1e3:.1f} mm thick by the "
            "slopes round the contacts"
        )
    for name, why in fit.left_out:
        notes.print(f"left out: {name}: {why}", markup=False)
    if found is None:
        _look_for_dots(fit)
    else:
        notes.print(
            f"markers: {found.rows} x {found.columns}, {found.pitch * 1e3:.3g} mm apart, radius "
            f"{found.radius * 1e3:.2g} mm"
        )
