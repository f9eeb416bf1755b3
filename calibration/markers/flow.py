"""Tactile flow from pictures: displacement of each dot printed on the gel, in metres.

Dots are detected on a separate metric grid, whose resolution depends on their size, not on the canonical grid. The
reference gives row and column of each dot (:mod:`calibration.markers.dots`), and its rest position;
:mod:`calibration.markers.tracker` tracks it. A dot that is not visible gets the mean motion of its neighbours: flow is
finite everywhere, and `visible` marks the measured part.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calibration.lens.rectification import (
    Rectification,
    rectification_of_geometry,
    rectification_of_view,
    region_mask,
    visible_box,
)
from calibration.lens.view import GelView
from calibration.markers.dots import (
    DotFinder,
    Lattice,
    NoLattice,
    describe_missing_line,
    fill_from_neighbours,
    find_lattice,
    median_pitch,
)
from calibration.markers.tracker import DotTracker
from calibration.markers.tuning import MAX_EXTRA_SHARE, MAX_MISSING, MIN_PRESENT_SHARE, MIN_VISIBLE_SHARE
from calibration.reference import UnusableReference
from tacsim.interface import Float32, FloatArray, Image, Mask
from tacsim.models.sensor import CanonicalGrid, Markers, PictureRegion, SensorGeometry
from tacsim.optics.grid import PixelGrid, canonical_image
from tacsim.optics.tuning import MIN_RADIUS


class NoMarkers(UnusableReference):
    """The reference does not show the lattice of the sensor."""


class MissingDots(NoLattice):
    """A picture shows a lattice that lacks a whole row or column."""


class TooFewMarkers(RuntimeError):
    """Too few dots are visible for a flow."""


class MarkerFlow:
    """The tactile flow of one sensor.

    Args:
        markers: the lattice.
        rectify: gives the pixels of `grid`, see :func:`marker_grid`.
        distance: from the camera's pinhole to the gel at rest [m]; None: parallel rays.
    """

    def __init__(
        self, markers: Markers, rectify: Rectification, grid: PixelGrid, distance: float | None = None
    ) -> None:
        """Raises ValueError when the image shows the dots too small, or no gel."""
        across = _native_pixels_per_metre(rectify, grid)
        if across * markers.radius < MIN_RADIUS:
            raise ValueError(
                f"markers of radius {markers.radius * 1e3:g} mm are {across * markers.radius:.2g} px in the image, at "
                f"least {MIN_RADIUS:g} px are needed to follow them; take a finer image, or markers: null"
            )
        self._markers, self._distance = markers, distance
        self._native = rectify.image_shape
        box = visible_box(rectify.valid)
        self._whole = _complete_disc_mask(rectify.valid[box], markers.radius / grid.pitch)
        self._shrink = max(1, math.floor(across * grid.pitch + 1e-6))
        self._map = _lookup_map(rectify, self._shrink, box)
        self._pitch = grid.pitch
        self._origin = np.array([grid.x0, grid.y0]) + grid.pitch * np.array([box[1].start, box[0].start])
        self._find = DotFinder(markers.radius / grid.pitch)
        self._tracker: DotTracker | None = None
        self._index = 0
        self._seen: Mask = np.zeros((markers.rows, markers.columns), dtype=np.bool_)

    @property
    def visible(self) -> Mask:
        """(rows, columns) True for dots visible in the last picture; others have the flow of their neighbours."""
        return self._seen

    @property
    def visible_share(self) -> float:
        """Share of the reference's dots that are visible in the last picture."""
        return float(self._seen.sum() / self._present.sum()) if self._tracker is not None else 0.0

    def take_reference(self, image: Image, index: int = 0) -> None:
        """Takes a native image (rows, columns, 3) without contact as rest, and resets the tracking. Raises NoMarkers;
        the previous reference then stays."""
        points = self._find_points(image)
        markers = self._markers
        expected = f"a lattice of {markers.rows} x {markers.columns} dots, {markers.pitch * 1e3:g} mm apart"
        advice = "is the sensor's light on, is nothing touched, and are its markers those of the model or calibration?"
        try:
            lattice = find_lattice(points, (markers.rows, markers.columns), markers.pitch)
        except NoLattice as nothing:
            apart = f" {median_pitch(points) * 1e3:.3g} mm apart" if len(points) > 1 else ""
            raise NoMarkers(f"the reference shows {len(points)} dots{apart}, not {expected}: {advice}") from nothing
        visible = self._is_in_view(lattice.positions)
        shown = int(lattice.present.sum())
        if shown < max(4.0, (1.0 - MAX_MISSING) * visible.sum()):
            raise NoMarkers(f"the reference shows {shown} of {visible.sum()} dots in view of {expected}: {advice}")
        if (missing := describe_missing_line(lattice.present, visible)) is not None:
            raise NoMarkers(f"the reference shows no {expected}: {missing}; {advice}")
        if lattice.extra_points > MAX_EXTRA_SHARE * lattice.present.size:
            raise NoMarkers(
                f"the reference shows {lattice.extra_points} dots more than {expected}: give the true rows and columns"
            )
        try:
            tracker = DotTracker(lattice.positions[lattice.present], lattice.pitch, self._is_in_view)
        except ValueError as error:
            raise NoMarkers(f"the reference shows no {expected}: {error}") from error
        self._tracker, self._index = tracker, index
        self._rest, self._present = lattice.positions, lattice.present
        self._seen = lattice.present.copy()

    def __call__(self, image: Image, index: int, height: tuple[Float32, PixelGrid] | None = None) -> Float32:
        """(rows, columns, 2) displacement against the reference along x, y [m] of the native image of frame `index`.

        height: (h, w) [m] on its grid, for a camera with a known distance.
        Raises TooFewMarkers; ValueError without a reference, or for an image of another shape.
        """
        if self._tracker is None:
            raise ValueError("no reference yet: call take_reference first")
        tracked = self._tracker(self._find_points(image), index - self._index)
        self._index = index
        seen = self._present.copy()
        seen[self._present] = tracked.visible
        self._seen = seen
        if tracked.visible_share < MIN_VISIBLE_SHARE:
            self._tracker.reset()  # too few to determine the motion
            raise TooFewMarkers(
                f"{tracked.visible.sum()} of {len(tracked.visible)} markers are seen, at least {MIN_VISIBLE_SHARE:.0%} "
                "are needed "
                "for a flow: is the light on, and the gel whole? If so, take a fresh reference"
            )
        moved = np.zeros_like(self._rest)
        moved[self._present] = tracked.displacement
        moved = fill_from_neighbours(moved, self._present)
        if self._distance is not None and height is not None:
            moved = self._undo_pinhole(self._rest + moved, *height) - self._rest
        return moved.astype(np.float32)

    def _find_points(self, image: Image) -> FloatArray:
        """(n, 2) x, y of the dots in a native image [m]."""
        import cv2

        if image.dtype != np.uint8 or image.shape != (*self._native, 3):
            raise ValueError(f"image is {image.shape} {image.dtype}, this sensor delivers {(*self._native, 3)} uint8")
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        if self._shrink > 1:
            rows, columns = (length // self._shrink for length in self._native)
            whole = grey[: rows * self._shrink, : columns * self._shrink]
            grey = cv2.resize(whole, (columns, rows), interpolation=cv2.INTER_AREA)
        seen = cv2.remap(grey, *self._map, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        centres = self._find(np.asarray(seen, dtype=np.uint8)).centres
        column, row = np.rint(centres).astype(np.intp).T
        found: FloatArray = centres[self._whole[row, column]] * self._pitch + self._origin
        return found

    def _is_in_view(self, points: FloatArray) -> Mask:
        """(...,) True if whole dots at `points` (..., 2) [m] are in the picture and on the gel."""
        column, row = np.rint(np.moveaxis((points - self._origin) / self._pitch, -1, 0)).astype(np.intp)
        rows, columns = self._whole.shape
        inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
        return np.asarray(inside & self._whole[row.clip(0, rows - 1), column.clip(0, columns - 1)])

    def _undo_pinhole(self, apparent: FloatArray, height: Float32, grid: PixelGrid) -> FloatArray:
        """Positions (..., 2) of dots that the pinhole shows at `apparent`: pressed towards it, the gel looks larger."""
        iterations = 4
        import cv2

        assert self._distance is not None
        nothing, at = np.empty(0, dtype=np.float32), apparent
        for _ in range(iterations):  # the height is that where the dot is, not where it appears
            pixel = ((at - (grid.x0, grid.y0)) / grid.pitch).astype(np.float32)
            deep = cv2.remap(height, pixel, nothing, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            at = apparent * (1.0 - np.asarray(deep, dtype=np.float64) / self._distance)[..., None]
        return at


def marker_grid(markers: Markers, gel_size: tuple[float, float]) -> PixelGrid:
    """A grid of the whole gel (x, y [m]) on which a dot's radius is `dot_radius` pixels."""
    dot_radius = 2.5  # on the grid on which dots are sought [px]
    pitch = markers.radius / dot_radius
    columns, rows = (max(2, math.ceil(length / pitch)) for length in gel_size)
    return PixelGrid(rows, columns, pitch, -(columns - 1) / 2 * pitch, -(rows - 1) / 2 * pitch)


def _complete_disc_mask(valid: Mask, radius: float) -> Mask:
    """True for places in a mask with a whole valid disc of `radius` [px] around them; a cut dot has another centre."""
    import cv2

    reach = math.floor(radius)
    padded = np.pad(valid.astype(np.uint8), 1)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    return np.asarray(cv2.erode(padded, disc)[1:-1, 1:-1], dtype=np.bool_)


def _native_pixels_per_metre(rectify: Rectification, grid: PixelGrid) -> float:
    """Pixels of the native image per metre of the gel at its centre, along the axis with fewer pixels."""
    row, column = (length * rectify.factor // 2 for length in grid.shape)
    beside = rectify.pixels[row, column - 1] - rectify.pixels[row, column]
    below = rectify.pixels[row - 1, column] - rectify.pixels[row, column]
    step = grid.pitch / rectify.factor
    return float(min(np.hypot(*beside), np.hypot(*below))) / step


def _lookup_map(
    rectify: Rectification, shrink: int, box: tuple[slice, slice]
) -> tuple[NDArray[np.int16], NDArray[np.uint16]]:
    """Positions of the pixel centres in `box` in the reduced native image, in OpenCV's fixed point."""
    import cv2

    rows, columns = rectify.valid.shape
    parts = rectify.pixels.reshape(rows, rectify.factor, columns, rectify.factor, 2)
    middle = (parts[box[0], :, box[1]].mean(axis=(1, 3), dtype=np.float64) - (shrink - 1) / 2) / shrink
    whole, fraction = cv2.convertMaps(middle.astype(np.float32), np.empty(0, dtype=np.float32), cv2.CV_16SC2)
    return np.asarray(whole, dtype=np.int16), np.asarray(fraction, dtype=np.uint16)


def find_markers(image: Image) -> tuple[Lattice, float]:
    """The lattice [px from the centre] in an unknown picture (H, W, 3) without contact, and the radius of its dots
    [px]: the radius with which most dots fall into rows and columns. Raises NoLattice."""
    best: tuple[Lattice, float] | None = None
    rows, columns, _ = image.shape
    radius = MIN_RADIUS
    while radius < min(rows, columns) / 12:
        dots = DotFinder(radius)(image)
        try:
            lattice = find_lattice(dots.centres - ((columns - 1) / 2, (rows - 1) / 2))
        except NoLattice:
            pass
        else:
            regular = lattice.present.mean() > MIN_PRESENT_SHARE and min(lattice.present.shape) > 2
            if regular and (best is None or lattice.present.sum() > best[0].present.sum()):
                best = lattice, dots.radius
        radius *= 1.3
    if best is None:
        raise NoLattice("the picture shows no lattice of dark dots, at least 3 x 3")
    if (missing := describe_missing_line(best[0].present)) is not None:
        size = " x ".join(str(count) for count in best[0].present.shape)
        raise MissingDots(f"in a lattice of {size} dots {missing}: clean the gel, or light it evenly")
    return best


def require_no_markers(image: Image) -> None:
    """Raises UnusableReference if a picture (H, W, 3) without contact shows a lattice of dots: without markers in the
    configuration, each dot would be read as a dent."""
    try:
        lattice, _ = find_markers(image)
    except MissingDots as why:
        raise UnusableReference(f"{why}; and the sensor's model or calibration has no markers") from None
    except NoLattice:
        return
    rows, columns = lattice.present.shape
    raise UnusableReference(
        f"the reference shows a lattice of {rows} x {columns} dark dots, {lattice.pitch:.3g} px apart, but the "
        "sensor's model or calibration has no markers: give it markers, or calibrate the sensor with --markers"
    )


def marker_flow(
    markers: Markers | None,
    geometry: SensorGeometry,
    gel_size: tuple[float, float],
    view: GelView | None = None,
    region: PictureRegion | None = None,
) -> MarkerFlow | None:
    """The flow of known dots; None without dots. view: of the gel through lens and perspective; None: the picture is
    metric. region: part of the native picture that shows the gel; None: all of it."""
    if markers is None:
        return None
    fine = marker_grid(markers, gel_size)
    rectify = rectification_of_geometry(geometry, gel_size, fine) if view is None else rectification_of_view(view, fine)
    return MarkerFlow(markers, rectify.within(region), fine, geometry.camera_distance)


def view_of_dots(
    pitch: float, untouched: NDArray[np.uint8], grid: CanonicalGrid, region: PictureRegion | None = None
) -> tuple[Rectification, MarkerFlow]:
    """Rectification of the gel, and its flow, from dots `pitch` [m] apart in a native picture (rows, columns, 3)
    without contact. The camera looks along the gel's normal. Raises NoMarkers without dots."""
    picture = untouched
    if region is not None:
        shown = region_mask(region, untouched.shape[:2])
        level = np.median(untouched[shown], axis=0).astype(np.uint8)
        picture = np.where(shown[..., None], untouched, level)
    try:
        lattice, radius = find_markers(picture)
    except NoLattice as nothing:
        raise NoMarkers(f"{nothing}: marker_pitch needs the dots of the picture without contact") from None
    scale = pitch / lattice.pitch
    (rows, columns), (high, wide) = lattice.present.shape, untouched.shape[:2]
    geometry, size = SensorGeometry(width=wide, height=high, pixel_pitch=scale), (wide * scale, high * scale)
    markers = Markers(rows=rows, columns=columns, pitch=pitch, radius=radius * scale)
    flow = marker_flow(markers, geometry, size, region=region)
    assert flow is not None
    rectify = rectification_of_geometry(geometry, size, canonical_image(grid)).within(region)
    if region is not None:
        down, across = (side.stop - side.start for side in visible_box(shown))
        rectify = replace(rectify, size=(across * scale, down * scale))
    return rectify, flow
