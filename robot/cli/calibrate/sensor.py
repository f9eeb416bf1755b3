"""`tacsim calibrate`: the calibration of a sensor from frames."""

from __future__ import annotations

import math
import re
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from robot.cli.calibrate.light import (
    FRAMES,
    UNKNOWN,
    find_lattice,
    fit_light,
    read_presses,
    rectify_frames,
    write_calibration,
)
from robot.cli.calibrate.session import confirm_free_gel, guided_session, image_writer, named_camera
from robot.cli.options import (
    OptionGroup,
    Out,
    Overrides,
    complete_names,
    length_option,
    quantities_parser,
    quantity_parser,
    with_json_option,
    with_option_groups,
)
from robot.cli.output import new_directory, notes, warn
from tacsim.models.text import suggest_word

if TYPE_CHECKING:
    from calibration.frame_set import FrameSet
    from calibration.lens.view import Corners, GelView
    from calibration.profiles import SensorProfile
    from tacsim.models.hardware import CameraSensorConfig
    from tacsim.models.sensor import PictureRegion

calibrate = typer.Typer(no_args_is_help=True, help="Calibrate sensors, cameras and arms of a rig.")


@calibrate.callback()
def _group() -> None:
    """Calibrate sensors, cameras and arms of a rig."""


class Description(OptionGroup):
    """Options that describe ball, pictures and gel."""

    ball_diameter: Annotated[
        Any, length_option('Of the ball, measured with a calliper, for example "5.84 mm".', 1e-4, 0.1)
    ] = None
    ball_radius: Annotated[Any, length_option("Half of the diameter, instead of it.", 5e-5, 0.05)] = None
    kind: Annotated[
        str | None,
        typer.Option(
            "--kind",
            metavar="KIND",
            autocompletion=complete_names(words=("mini", "mini-markers", "r1.5", "digit", "9dtact", "other")),
            help="mini, mini-markers, r1.5, digit, 9dtact or other: gives published properties, such as the part "
            "of the picture that shows the gel, an approximate pixel pitch, dots.",
        ),
    ] = None
    pixel_pitch: Annotated[
        Any,
        length_option("Distance of two pixels on the gel; or give --view, or --kind.", 1e-7, 1e-2),
    ] = None
    view: Annotated[
        Path | None,
        typer.Option(help="view.yaml of `tacsim calibrate lens`: frames are rectified by it.", show_default=False),
    ] = None
    size: Annotated[
        Any,
        typer.Option(
            parser=quantities_parser("length", 2),
            metavar="LENGTH,LENGTH",
            help="Width, height of the gel in the picture, measured with a ruler: they check the pitch.",
        ),
    ] = None
    region: Annotated[
        str | None,
        typer.Option(
            metavar="U,V U,V U,V ...",
            help="Corners of the polygon in the picture that shows the gel \\[px]; pixels outside are ignored.",
        ),
    ] = None
    serial: Annotated[
        str, typer.Option(help="Serial number or name of the sensor; without --out, its folder is sensors/SERIAL.")
    ] = UNKNOWN
    known_depth: Annotated[
        list[str] | None,
        typer.Option(
            "--depth",
            metavar="FRAME=LENGTH",
            help="A press of known depth, which checks pixel pitch and ball; may be repeated.",
        ),
    ] = None
    markers: Annotated[bool, typer.Option("--markers", help="Dots are printed on the gel.")] = False
    marker_pitch: Annotated[
        Any, length_option("Distance of printed dots, measured with a ruler: it checks the pixel pitch.", 1e-4, 1e-2)
    ] = None


@calibrate.command(
    epilog='Example: [bold]tacsim calibrate sensor frames --ball-diameter "5.84 mm" --pixel-pitch "0.0593 mm"[/]'
)
@with_json_option
@with_option_groups
def sensor(
    frames: Annotated[
        Path | None, typer.Argument(help="Folder of pictures of a ball's presses, 5 to 8 or more; or give --camera.")
    ] = None,
    *,
    described: Description,
    camera: Annotated[
        str | None,
        typer.Option(
            metavar="RIG/SENSOR",
            help="Press now, in front of this camera of a rig, or one at /dev/... or http://...; no arm is connected.",
        ),
    ] = None,
    presses: Annotated[int, typer.Option(min=1, max=100, help="Number, with --camera.")] = 8,
    reference: Annotated[
        Path | None,
        typer.Option(
            help="The picture without contact; more of them (background_1.png and so on, next to it) give the camera's "
            "noise.",
            show_default="background.png or the like in FRAMES",
        ),
    ] = None,
    set_: Overrides = None,
    out: Out = None,
) -> None:
    """Calibrate a sensor's light from presses of a ball: colour as a function of slope, and slope of colour.

    Contact circles are found automatically. Writes calibration.yaml, reference.png and residuals.png, prints the error
    of each press predicted from the others, and a verdict (verdict.html): good, usable, unverified scale (exit code 4:
    nothing checks ball and pixel pitch) or do not trust (exit code 3), with reasons and the next steps.

    With --camera the command guides you: first the gel without contact, then press after press, each checked at once.
    The pictures are stored in frames/ next to the bundle, to calibrate from them again; Ctrl-C keeps them.
    """
    if (frames is None) == (camera is None):
        raise typer.BadParameter("give either a folder of frames, or --camera to press now")
    if camera is None and set_:
        raise typer.BadParameter("it changes the rig of a camera; a folder has no rig", param_hint="--set")
    if camera is not None and reference is not None:
        raise typer.BadParameter("with --camera it is taken first, of the free gel", param_hint="--reference")
    options = _check_options(described, out)
    _calibrate(options, frames, reference, camera, set_ or [], presses)


def _calibrate(
    options: _SensorOptions,
    frames: Path | None,
    reference: Path | None,
    camera: str | None,
    overrides: list[str],
    presses: int,
) -> None:
    """Calibrates from the images of a folder, or from `presses` in front of a camera; writes bundle and verdict."""
    if camera is not None:
        config, name = named_camera(camera, overrides, options.profile.native)
        seen, pitch = _calibrated_view(options, (config.height, config.width))
        read = _take_presses(camera, config, name, options, presses, seen, pitch)
    else:
        assert frames is not None
        read = read_presses(frames, reference)
        _require_frames(options.depths, [frame.name for frame in read.frames])
        seen, pitch = _calibrated_view(options, read.shape)
    read = rectify_frames(read, options.region, seen)
    found = find_lattice(read, pitch) if options.markers else None
    fit = fit_light(read, options.ball / pitch, None if found is None else found.radius / pitch)
    from calibration.light.verdict import KnownScale

    published = options.pitch is None and options.view is None and options.size is None
    dots = None if found is None or options.marker_pitch is None else (found.pitch, options.marker_pitch)
    scale = KnownScale(
        pitch, options.ball, options.gel_size, options.profile.gel_thickness, options.depths, published, dots
    )
    write_calibration(
        options.folder, fit, read, options.serial, scale, found, options.profile, view=seen, region=options.region
    )


@dataclass(frozen=True, slots=True)
class _SensorOptions:
    """The checked options about sensor and ball."""

    ball: float  # its radius [m]
    profile: SensorProfile
    pitch: float | None  # of pixels on the gel [m]
    view: GelView | None
    size: tuple[float, float] | None  # of the gel that the picture shows [m]
    region: PictureRegion | None
    depths: tuple[tuple[str, float], ...]
    markers: bool
    marker_pitch: float | None  # of printed dots, as given [m]
    serial: str
    folder: Path

    @property
    def gel_size(self) -> tuple[float, float] | None:
        """Size of the gel in the image: as given, of its kind, or of a measured view; None if unknown."""
        measured = self.view is not None and self.view.board != "four corners"  # otherwise only the size is known
        return self.size or self.profile.gel_size or (self.view.size if self.view and measured else None)


def _check_options(given: Description, out: Path | None) -> _SensorOptions:
    """Checks the options before slow imports; the results' folder is checked, too."""
    from calibration.bundle import SERIAL
    from calibration.profiles import PROFILES

    if (given.ball_radius is None) == (given.ball_diameter is None):
        what = "give the ball's diameter (or its radius, not both): without it no slope is known"
        raise typer.BadParameter(what, param_hint="--ball-diameter")
    if given.kind is not None and given.kind not in PROFILES:
        words = f"'{given.kind}'; known: {', '.join(PROFILES)}{suggest_word(given.kind, PROFILES)}"
        raise typer.BadParameter(words, param_hint="--kind")
    profile = PROFILES["other" if given.kind is None else given.kind]
    if given.pixel_pitch is not None and given.view is not None:
        raise typer.BadParameter("give either --pixel-pitch or --view")
    if given.pixel_pitch is None and given.view is None and profile.gel_size is None:
        raise typer.BadParameter("give --pixel-pitch or --view, or --kind with a pitch that is known beforehand")
    if given.marker_pitch is not None and not (given.markers or profile.markers):
        what = "it is the distance of printed dots: give --markers, too"
        raise typer.BadParameter(what, param_hint="--marker-pitch")
    if given.size is not None and min(given.size) <= 0:
        raise typer.BadParameter("both lengths must be above 0", param_hint="--size")
    serial = given.serial
    if not re.fullmatch(SERIAL, serial):
        raise typer.BadParameter(
            f"'{serial}' is no serial number: up to 64 letters, digits, '.', '_' and '-'", param_hint="--serial"
        )
    if serial == UNKNOWN and out is not None and re.fullmatch(SERIAL, out.name):
        serial = out.name
    folder = new_directory(Path("sensors") / serial if out is None and serial != UNKNOWN else out, "calibration")
    from calibration.lens.view import GelView
    from tacsim.config import load_model

    return _SensorOptions(
        ball=(given.ball_radius or 0.0) + (given.ball_diameter or 0.0) / 2,  # one of them is None
        profile=profile,
        pitch=given.pixel_pitch,
        view=None if given.view is None else load_model(GelView, given.view),
        size=given.size,
        region=None if given.region is None else _parse_region(given.region),
        depths=tuple(_parse_known_depth(text) for text in given.known_depth or ()),
        markers=given.markers or profile.markers,
        marker_pitch=given.marker_pitch,
        serial=serial,
        folder=folder,
    )


def _parse_region(text: str) -> PictureRegion:
    try:
        points = [tuple(float(number) for number in point.split(",")) for point in text.split()]
    except ValueError:
        points = []
    if len(points) < 3 or any(len(point) != 2 or not all(map(math.isfinite, point)) for point in points):
        raise typer.BadParameter(
            f"'{text}' is no polygon of three points or more; for example \"67,68 465,113 475,383 73,437\"",
            param_hint="--region",
        )
    return tuple((u, v) for u, v in points)


def _parse_known_depth(text: str) -> tuple[str, float]:
    name, equals, depth = text.rpartition("=")
    if not equals:
        raise typer.BadParameter(f"'{text}'; give FRAME=LENGTH, such as 'press_3.png=0.5 mm'", param_hint="--depth")
    value = quantity_parser("length", 1e-6, 1e-2)(depth)
    return name, value


def _require_frames(depths: tuple[tuple[str, float], ...], names: list[str]) -> None:
    """Raises BadParameter for the depth of a press that does not exist."""
    for name, _ in depths:
        if name not in names:
            raise typer.BadParameter(f"no frame '{name}'; there are {', '.join(names)}", param_hint="--depth")


def _calibrated_view(options: _SensorOptions, shape: tuple[int, int]) -> tuple[GelView | None, float]:
    """The view and the pixel pitch [m] of the calibrated images, for native images of `shape` (rows, columns)."""
    from calibration.lens.view import calibrated_view

    seen, pitch = _pixel_geometry(options, shape)
    view, coarse = calibrated_view(seen, pitch, shape)
    if coarse != pitch:
        notes.print(f"calibrated at {coarse * 1e3:.3g} mm a pixel: the pictures have {pitch * 1e3:.3g} mm")
    return view, coarse


def _pixel_geometry(options: _SensorOptions, shape: tuple[int, int]) -> tuple[GelView | None, float]:
    """The given view, or that of the region, or of the profile's crop of native images of `shape` (rows, columns); and
    the distance of two pixels on the gel [m]. Warns if the distance is the published one of the profile."""
    from calibration.lens.view import view_of_corners

    if options.view is not None:
        return options.view, options.view.pixel_pitch
    corners = options.profile.corners(shape) if options.pitch is None else None
    if options.region is not None:
        corners = _bounding_corners(options.region, shape)
    size, columns = options.profile.gel_size, shape[1]
    if corners is not None:
        wide, high = corners[2][0] - corners[0][0], corners[2][1] - corners[0][1]
        size = (wide * options.pitch, high * options.pitch) if options.pitch is not None else size
    if options.pitch is None:
        assert size is not None
        view = None if corners is None else view_of_corners(corners, size, shape)
        found = size[0] / columns if view is None else view.pixel_pitch
        profile = options.profile
        warn(f"{found * 1e3:.4g} mm a pixel, as published of a {profile.title} ({profile.source}); measure yours")
        return view, found
    if corners is None:
        return None, options.pitch
    assert size is not None
    view = view_of_corners(corners, size, shape)
    return view, view.pixel_pitch


def _bounding_corners(region: PictureRegion, shape: tuple[int, int]) -> Corners:
    """Corners of the bounding box of a polygon, in an image of `shape` (rows, columns)."""
    u, v = zip(*region, strict=True)
    left, right = max(min(u), 0.0) - 0.5, min(max(u), shape[1] - 1.0) + 0.5
    top, bottom = max(min(v), 0.0) - 0.5, min(max(v), shape[0] - 1.0) + 0.5
    return ((left, top), (right, top), (right, bottom), (left, bottom))


def _take_presses(
    camera: str,
    config: CameraSensorConfig,
    sensor: str,
    options: _SensorOptions,
    presses: int,
    view: GelView | None,
    pitch: float,
) -> FrameSet:
    """Takes native frames now, and stores them in frames/ of the folder. camera: its name.

    A signal ends the command; frames that were taken stay. Raises CannotCalibrate, BadFrames, DeviceError.
    """
    from calibration.errors import BadFrames
    from calibration.frame_set import Frame, FrameSet, metric_image_map, require_view_size
    from robot.camera.camera import Camera
    from robot.procedures.presses import BallPressPlan, record_presses

    if view is not None:
        require_view_size((config.height, config.width), view)
    rectify = None if view is None else metric_image_map(view)
    plan = BallPressPlan(options.ball / pitch, presses, rectify=rectify, markers=options.markers)
    frames = options.folder / FRAMES
    again = f"tacsim calibrate sensor {shlex.quote(str(frames))} --serial {shlex.quote(options.serial)} ..."
    with Camera(config, sensor) as source:
        confirm_free_gel()
        note = f"frames stored in {frames}; to calibrate from them again: {again}"
        with guided_session("presses", presses, frames, note) as session:
            session.store = image_writer(frames)
            untouched = record_presses(source, plan, session)
    if not untouched or not session.measurements:
        raise BadFrames("the source ended before a press was taken")
    taken = tuple(Frame(name, image) for name, image in session.measurements)
    more = tuple(Frame(f"background_{k}.png", image) for k, image in enumerate(untouched[:-1], start=1))
    return FrameSet(camera, untouched[-1], "background.png", taken, more)
