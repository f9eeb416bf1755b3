"""From the pictures of a ball's presses to the fit of a sensor's light, for `tacsim calibrate sensor`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import typer

from robot.cli.errors import UNTRUSTED
from robot.cli.output import busy, notes, results

if TYPE_CHECKING:
    from calibration.frame_set import FrameSet
    from calibration.lens.view import GelView
    from calibration.light.fit import LightFit
    from tacsim.models.geometry import PictureRegion
    from tacsim.models.sensor import Markers

MAX_PRESSES = 200  # 5 to 8 are enough


def read_presses(frames: Path, reference: Path | None) -> FrameSet:
    with busy("loading"):
        from calibration.frame_set import read_folder
    read = read_folder(frames, reference, MAX_PRESSES)
    if read.estimated:
        notes.print("no picture without contact: the median of all presses stands for it")
    return read


def straighten(read: FrameSet, region: PictureRegion | None, view: GelView | None) -> FrameSet:
    """Native pictures as they are calibrated: even beyond the region, and metric."""
    from calibration.frame_set import rectified_by_view, restrict_to_region

    if region is not None:
        read = restrict_to_region(read, region)
    return read if view is None else rectified_by_view(read, view)


def fit_light(read: FrameSet, ball: float, dot: float | None) -> LightFit:
    """`ball`, `dot`: radii [px]. Exits with UNTRUSTED where the light tells nothing."""
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
        from calibration.light.checks.verdict import GREY, is_grey

        grey = f"; {GREY}: give the camera's own, in colour" if is_grey(read.reference) else ""
        notes.print(f"{why}{grey}", markup=False)
        results.print("verdict: do not trust; no bundle is written")
        raise typer.Exit(UNTRUSTED) from None


def find_lattice(read: FrameSet, pitch: float) -> Markers:
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
