"""`tacsim calibrate`: from frames to the calibration of a sensor."""

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
    straighten,
    write_calibration,
)
from robot.cli.calibrate.session import confirm_free_gel, led, named_camera, picture_keeper
from robot.cli.options import OptionGroup, Out, Overrides, grouped, length, quantities, quantity
from robot.cli.output import new_directory, notes, warn

if TYPE_CHECKING:
    from calibration.frame_set import FrameSet
    from calibration.lens.view import Corners, GelView
    from calibration.profiles import SensorProfile
    from tacsim.models.geometry import PictureRegion
    from tacsim.models.hardware import CameraSensorConfig

calibrate = typer.Typer(no_args_is_help=True, help="Calibrate what stands behind a rig.")


@calibrate.callback()
def _group() -> None:
    """Calibrate what stands behind a rig."""


class Description(OptionGroup):
    """Options that describe ball, pictures and gel."""

    ball_diameter: Annotated[Any, length('Of the ball, as a calliper shows it, for example "5.84 mm".', 1e-4, 0.1)] = (
        None
    )
    ball_radius: Annotated[Any, length("Half of that, in its place.", 5e-5, 0.05)] = None
    kind: Annotated[
        str | None,
        typer.Option(
            "--kind",
            metavar="KIND",
            help="mini, mini-markers, r1.5, digit, 9dtact or other: what is known of it beforehand, such as which part "
            "of the picture shows the gel, a first pixel pitch, dots.",
        ),
    ] = None
    pixel_pitch: Annotated[
        Any,
        length("Distance of two pixels on the gel; or give --view, or --kind.", 1e-7, 1e-2),
    ] = None
    view: Annotated[
        Path | None,
        typer.Option(help="view.yaml of `tacsim calibrate lens`: frames are rectified by it.", show_default=False),
    ] = None
    size: Annotated[
        Any,
        typer.Option(
            parser=quantities("length", 2),
            metavar="LENGTH,LENGTH",
            help="Width, height of the gel that the picture shows, by a ruler: they check the pitch.",
        ),
    ] = None
    region: Annotated[
        str | None,
        typer.Option(
            metavar="U,V U,V U,V ...",
            help="Corners of the polygon of the picture that shows gel \\[px]; beyond it nothing counts.",
        ),
    ] = None
    serial: Annotated[
        str, typer.Option(help="Serial number or name of the sensor; without --out, its folder is sensors/ and this.")
    ] = UNKNOWN
    known_depth: Annotated[
        list[str] | None,
        typer.Option(
            "--depth",
            metavar="FRAME=LENGTH",
            help="A press of known depth, which checks pitch and ball; may be repeated.",
        ),
    ] = None
    markers: Annotated[bool, typer.Option("--markers", help="Dots are printed on the gel.")] = False
    marker_pitch: Annotated[
        Any, length("How far printed dots are apart, by a ruler: it checks the pixel pitch.", 1e-4, 1e-2)
    ] = None


@calibrate.command(
    epilog='Example: [bold]tacsim calibrate sensor frames --ball-diameter "5.84 mm" --pixel-pitch "0.0593 mm"[/]'
)
@grouped
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
            help="Press now, before this camera of a rig, or one at /dev/... or http://...; no arm is connected.",
        ),
    ] = None,
    presses: Annotated[int, typer.Option(min=1, max=100, help="How many; with --camera.")] = 8,
    reference: Annotated[
        Path | None,
        typer.Option(
            help="The picture without contact; the camera's noise is told by more of them, background_1.png and so on "
            "beside it.",
            show_default="background.png or the like in FRAMES",
        ),
    ] = None,
    set_: Overrides = None,
    out: Out = None,
) -> None:
    """Calibrate a sensor's light from presses of a ball: colour of every slope, and slope of every colour.

    Contact circles are found by themselves. Writes calibration.yaml, reference.png and residuals.png, prints how well
    each press is predicted by the others, and ends in a verdict, verdict.html: good, usable, unverified scale (exit
    code 4: nothing checks ball and pixel pitch) or do not trust (exit code 3), with reasons and what to do next.

    With --camera it leads you through it: the gel without contact, then press after press, each judged at once. The
    pictures are kept in frames/ beside the bundle, to calibrate from them again; Ctrl-C keeps what was taken.
    """
    if (frames is None) == (camera is None):
        raise typer.BadParameter("give either a folder of frames, or --camera to press now")
    if camera is None and set_:
        raise typer.BadParameter("it changes a camera's rig; a folder has none", param_hint="--set")
    if camera is not None and reference is not None:
        raise typer.BadParameter("with --camera it is taken first, of the free gel", param_hint="--reference")
    asked = _asked(described, out)
    _calibrate(asked, frames, reference, camera, set_ or [], presses)


def _calibrate(
    asked: _Asked, frames: Path | None, reference: Path | None, camera: str | None, overrides: list[str], presses: int
) -> None:
    """From the pictures of a folder, or of so many presses before a camera, to the bundle and its verdict."""
    if camera is not None:
        config, name = named_camera(camera, overrides, asked.profile.native)
        seen, pitch = _calibrated(asked, (config.height, config.width))
        read = _take_presses(camera, config, name, asked, presses, seen, pitch)
    else:
        assert frames is not None
        read = read_presses(frames, reference)
        _require_frames(asked.depths, [frame.name for frame in read.frames])
        seen, pitch = _calibrated(asked, read.shape)
    read = straighten(read, asked.region, seen)
    found = find_lattice(read, pitch) if asked.markers else None
    fit = fit_light(read, asked.ball / pitch, None if found is None else found.radius / pitch)
    from calibration.light.checks.verdict import KnownScale

    published = asked.pitch is None and asked.view is None and asked.size is None
    dots = None if found is None or asked.marker_pitch is None else (found.pitch, asked.marker_pitch)
    scale = KnownScale(pitch, asked.ball, asked.gel_size, asked.profile.gel_thickness, asked.depths, published, dots)
    write_calibration(
        asked.folder, fit, read, asked.serial, scale, found, asked.profile, view=seen, region=asked.region
    )


@dataclass(frozen=True, slots=True)
class _Asked:
    """What the command line says of sensor and ball."""

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
        """What is known of the gel that the picture shows: as told, of its kind, or of the view that was measured."""
        measured = self.view is not None and self.view.board != "four corners"  # else the size is all that is known
        return self.size or self.profile.gel_size or (self.view.size if self.view and measured else None)


def _asked(given: Description, out: Path | None) -> _Asked:
    """Checked, before anything slow is loaded; the folder is made."""
    from calibration.bundle import SERIAL
    from calibration.profiles import PROFILES

    if (given.ball_radius is None) == (given.ball_diameter is None):
        what = "give the ball's diameter (or its radius, not both): without it no slope is known"
        raise typer.BadParameter(what, param_hint="--ball-diameter")
    if given.kind is not None and given.kind not in PROFILES:
        raise typer.BadParameter(f"'{given.kind}'; known: {', '.join(PROFILES)}", param_hint="--kind")
    profile = PROFILES["other" if given.kind is None else given.kind]
    if given.pixel_pitch is not None and given.view is not None:
        raise typer.BadParameter("give either --pixel-pitch or --view")
    if given.pixel_pitch is None and given.view is None and profile.gel_size is None:
        raise typer.BadParameter("give --pixel-pitch or --view, or --kind with a pitch that is known beforehand")
    if given.marker_pitch is not None and not (given.markers or profile.markers):
        what = "it says how far printed dots are apart: give --markers, too"
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

    return _Asked(
        ball=(given.ball_radius or 0.0) + (given.ball_diameter or 0.0) / 2,  # one of them is None
        profile=profile,
        pitch=given.pixel_pitch,
        view=None if given.view is None else load_model(GelView, given.view),
        size=given.size,
        region=None if given.region is None else _region(given.region),
        depths=tuple(_known_depth(text) for text in given.known_depth or ()),
        markers=given.markers or profile.markers,
        marker_pitch=given.marker_pitch,
        serial=serial,
        folder=folder,
    )


def _region(text: str) -> PictureRegion:
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


def _known_depth(text: str) -> tuple[str, float]:
    name, equals, depth = text.rpartition("=")
    if not equals:
        raise typer.BadParameter(f"'{text}'; give FRAME=LENGTH, such as 'press_3.png=0.5 mm'", param_hint="--depth")
    value = quantity("length", 1e-6, 1e-2)(depth)
    return name, value


def _require_frames(depths: tuple[tuple[str, float], ...], names: list[str]) -> None:
    """Raises BadParameter for the depth of a press that is not there: it would check nothing."""
    for name, _ in depths:
        if name not in names:
            raise typer.BadParameter(f"no frame '{name}'; there are {', '.join(names)}", param_hint="--depth")


def _calibrated(asked: _Asked, shape: tuple[int, int]) -> tuple[GelView | None, float]:
    """The view and the pixel pitch [m] of the pictures that are calibrated, from native ones of `shape` (rows,
    columns)."""
    from calibration.lens.view import calibrated_view

    seen, pitch = _geometry(asked, shape)
    view, coarse = calibrated_view(seen, pitch, shape)
    if coarse != pitch:
        notes.print(f"calibrated at {coarse * 1e3:.3g} mm a pixel: the pictures have {pitch * 1e3:.3g} mm")
    return view, coarse


def _geometry(asked: _Asked, shape: tuple[int, int]) -> tuple[GelView | None, float]:
    """The view that was given, or that of the region, or the profile's crop of its sensor's native pictures of `shape`
    (rows, columns); and the distance of two pixels on the gel [m]. That of the profile is said to be a first one."""
    from calibration.lens.view import view_of_corners

    if asked.view is not None:
        return asked.view, asked.view.pixel_pitch
    corners = asked.profile.corners(shape) if asked.pitch is None else None
    if asked.region is not None:
        corners = _box(asked.region, shape)
    size, columns = asked.profile.gel_size, shape[1]
    if corners is not None:
        wide, high = corners[2][0] - corners[0][0], corners[2][1] - corners[0][1]
        size = (wide * asked.pitch, high * asked.pitch) if asked.pitch is not None else size
    if asked.pitch is None:
        assert size is not None
        view = None if corners is None else view_of_corners(corners, size, shape)
        found = size[0] / columns if view is None else view.pixel_pitch
        profile = asked.profile
        warn(f"{found * 1e3:.4g} mm a pixel, as published of a {profile.title} ({profile.source}); measure yours")
        return view, found
    if corners is None:
        return None, asked.pitch
    assert size is not None
    view = view_of_corners(corners, size, shape)
    return view, view.pixel_pitch


def _box(region: PictureRegion, shape: tuple[int, int]) -> Corners:
    """Corners of the pixels round a polygon, in a picture of `shape` (rows, columns)."""
    u, v = zip(*region, strict=True)
    left, right = max(min(u), 0.0) - 0.5, min(max(u), shape[1] - 1.0) + 0.5
    top, bottom = max(min(v), 0.0) - 0.5, min(max(v), shape[0] - 1.0) + 0.5
    return ((left, top), (right, top), (right, bottom), (left, bottom))


def _take_presses(
    camera: str,
    config: CameraSensorConfig,
    sensor: str,
    asked: _Asked,
    presses: int,
    view: GelView | None,
    pitch: float,
) -> FrameSet:
    """Frames taken now, native, and kept in frames/ of the folder. camera: its name.

    A signal ends the command; what was taken is kept then, too. Raises CannotCalibrate, BadFrames, DeviceError.
    """
    from calibration.errors import BadFrames
    from calibration.frame_set import Frame, FrameSet, metric_image_map, require_view_size
    from robot.camera.camera import Camera
    from robot.procedures.presses import BallPressPlan, record_presses

    if view is not None:
        require_view_size((config.height, config.width), view)
    rectify = None if view is None else metric_image_map(view)
    plan = BallPressPlan(asked.ball / pitch, presses, rectify=rectify, markers=asked.markers)
    frames = asked.folder / FRAMES
    again = f"tacsim calibrate sensor {shlex.quote(str(frames))} --serial {shlex.quote(asked.serial)} ..."
    with Camera(config, sensor) as source:
        confirm_free_gel()
        note = f"frames kept in {frames}; to calibrate from them again: {again}"
        with led("presses", presses, frames, note) as session:
            session.store = picture_keeper(frames)
            untouched = record_presses(source, plan, session)
    if not untouched or not session.measurements:
        raise BadFrames("the source was over before a press was taken")
    taken = tuple(Frame(name, image) for name, image in session.measurements)
    more = tuple(Frame(f"background_{k}.png", image) for k, image in enumerate(untouched[:-1], start=1))
    return FrameSet(camera, untouched[-1], "background.png", taken, more)
