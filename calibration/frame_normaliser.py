"""Converts a native frame to a canonical observation, in the same way for simulated, mock, real and recorded sensors.

calibration/normaliser.py makes the normaliser of a sensor; calibration/height computes a height from a picture.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration import tuning
from calibration.height.surface_finder import SurfaceFinder, canonical_part
from calibration.lens.rectification import (
    Rectification,
    visible_box,
)
from calibration.markers.flow import MarkerFlow, require_no_markers
from calibration.reference import (
    DriftFinder,
    Reference,
    StaleReference,
    UnusableReference,
    contact_area,
    is_channel_order_swapped,
    is_contact_image_swapped,
    make_reference,
    max_mean_change,
)
from tacsim.control import MIN_CONTACT_DIFFERENCE, MIN_CONTACT_HEIGHT
from tacsim.interface import SurfaceMap, TactileFrame, TactileObservation
from tacsim.models.sensor import CanonicalGrid
from tacsim.optics.grid import canonical_cells


class NoReference(RuntimeError):
    """A frame was given before a reference was taken."""


class FrameNormaliser:
    """Rectifies a frame, compares it with the reference, and finds contact.

    A simulation gives height, gradient and flow. For other sources they are found in the picture: height and gradient
    by `find`, flow by `markers`; quantities that cannot be found are None.
    """

    def __init__(
        self,
        rectify: Rectification,
        grid: CanonicalGrid,
        find: SurfaceFinder | None = None,
        markers: MarkerFlow | None = None,
        *,
        drifts: bool = False,
        untouched: NDArray[np.float32] | None = None,
        dots: Callable[[NDArray[np.uint8]], tuple[Rectification, MarkerFlow]] | None = None,
    ) -> None:
        """Args:
        rectify: gives the canonical image, or for a `find` its wider view.
        drifts: the light is real and may drift from its reference; a `find` measures that itself.
        untouched: the rectified picture without contact of the calibration.
        dots: returns replacements of `rectify` and `markers` for the native picture (rows, columns, 3) of the first
            reference, whose dots give the size of the gel; raises UnusableReference without dots.
        """
        self._grid, self._find, self._dots = grid, find, dots
        self._set_view(rectify, markers)
        self._find_drift = DriftFinder(self._on_image.shape) if drifts and find is None else None
        self._untouched = untouched
        # reason why the reference may show a contact; None: it shows none, or there is no picture to compare it with
        self.reference_doubt: str | None = None
        self._sought = False  # the last observation was found in a picture
        self.reference: Reference | None = None  # the present reference; None before the first
        # height and gradient, or flow, are found in pictures of sources that do not give their surface
        self.finds_height, self.finds_flow = find is not None, markers is not None or dots is not None
        # share of the pixels of the last picture whose colour is beyond the calibrated slopes: they get the nearest
        # calibrated slope. 0 if no height had to be found
        self.out_of_range_share = 0.0
        # relative change of the untouched gel's colour since the reference [-], in the last picture with enough of it;
        # and the mean slope [degrees] that corresponds to this drift. None before such a picture, or without height
        self.drift: float | None = None
        self.drift_slope: float | None = None

    def _set_view(self, rectify: Rectification, markers: MarkerFlow | None) -> None:
        grid = self._grid
        shape = (grid.rows * grid.image_scale, grid.columns * grid.image_scale)
        spare = [given - wanted for given, wanted in zip(rectify.valid.shape, shape, strict=True)]
        odd = any(extra % (2 * grid.image_scale) for extra in spare)
        if min(spare) < 0 or odd or (self._find is None and any(spare)):
            raise ValueError(f"rectification gives {rectify.valid.shape} px, the canonical image has {shape}")
        self._rectify, self._markers = rectify, markers
        self._on_image: NDArray[np.bool_] = canonical_part(rectify.valid, grid)
        self._off_image = np.nonzero(~self._on_image)
        self._valid: NDArray[np.bool_] = np.asarray(_cell_view(self._on_image, grid).all(axis=(1, 3)), dtype=np.bool_)
        self._valid.flags.writeable = False

    @property
    def visible_size(self) -> tuple[float, float]:
        """x, y size of the gel in the native picture, within its region [m]; the maps may show only the centre."""
        valid, pitch = self._rectify.valid, self._grid.pitch / self._grid.image_scale
        down, across = (side.stop - side.start for side in visible_box(valid))
        x, y = (
            # a gel that reaches the border of the view continues beyond it; one that ends before is limited by a region
            size if (visible + 2) * pitch >= min(size, whole * pitch) else visible * pitch
            for size, visible, whole in zip(self._rectify.size, (across, down), valid.shape[::-1], strict=True)
        )
        return x, y

    @property
    def stale(self) -> bool:
        """True if the reference is outdated: take a new one as soon as there is no contact."""
        return (self.drift or 0.0) > tuning.STALE_COLOUR or (self.drift_slope or 0.0) > tuning.STALE_SLOPE

    @property
    def visible_markers(self) -> NDArray[np.bool_] | None:
        """(rows, columns) True for markers that were visible in the last picture with flow; the flow of the others is
        the mean of their neighbours. None for a sensor whose flow is not found in pictures."""
        return None if self._markers is None else self._markers.visible

    @property
    def visible_marker_share(self) -> float:
        """Share of the reference's markers that are visible in that picture; 1 if none had to be found."""
        return 1.0 if self._markers is None else self._markers.visible_share

    def take_reference(self, frame: TactileFrame) -> None:
        """Makes `frame`, taken without contact, the reference I0, and the places of its markers their rest positions.
        Raises UnusableReference (the old reference then stays), or ValueError for a frame of another shape."""
        if self._dots is not None and self._markers is None:
            self._set_view(*self._dots(frame.image))
        rectified = self._rectify(frame.image)
        # The mean is that of the canonical image's pixels, so that what a policy sees does not depend on whether height
        # is found.
        measured = np.zeros_like(self._rectify.valid)
        canonical_part(measured, self._grid)[...] = self._on_image
        # In a recording, dots are found also next to glare; a live arm stops by the colour of contacts, too.
        colour = self._find is not None or self._markers is None or self._dots is not None
        reference = make_reference(rectified, self._rectify.valid, measured, colour=colour)
        if self._untouched is not None and is_channel_order_swapped(rectified, self._untouched, self._rectify.valid):
            raise UnusableReference(
                "red and blue are exchanged: the gel looks as in its calibration only with the channels in the other "
                "order; give pictures in the order in which they were calibrated (this program's is RGB)"
            )
        self._warn_of_contact(reference)
        if self._markers is not None:
            self._markers.take_reference(frame.image, frame.index)
        elif self._find is not None:
            require_no_markers(frame.image)
        self.reference = reference
        self.drift_slope = self.drift = None

    def _warn_of_contact(self, reference: Reference) -> None:
        """Compares a new reference with the bundle's picture, and warns if it shows a contact."""
        self.reference_doubt = None
        if self._untouched is None:
            return
        valid = reference.valid
        known = self._untouched / np.maximum(self._untouched[valid].mean(axis=0), 1.0)
        dark = np.zeros_like(valid)
        if self._markers is not None:  # printed dots may have moved
            dark = _dot_mask(reference.relative) | _dot_mask(known)
        area = contact_area(reference.relative - known, ~valid | dark, self._grid.pitch / self._grid.image_scale)
        if area > tuning.MIN_CONTACT_AREA:
            self.reference_doubt = (
                f"the reference shows a contact of {area * 1e6:.1f} mm^2: it differs there from the picture without "
                "contact that belongs to the calibration; take a reference of the free gel"
            )
            warnings.warn(self.reference_doubt, stacklevel=3)

    def diagnostics(self) -> dict[str, float]:
        """Known quality of the last observation, if it was found in a picture: `beyond` (`out_of_range_share`),
        `drift`, `background` (`drift_slope`), `visible_share`, `stale` (0 or 1); and `touched_reference` (1) if the
        reference shows a contact."""
        if not self._sought:
            return {}
        known = {
            "stale": float(self.stale),
            "beyond": self.out_of_range_share if self.finds_height else None,
            "drift": self.drift,
            "background": self.drift_slope,
            "kept": self.visible_marker_share if self.finds_flow else None,
            "touched_reference": None if self.reference_doubt is None else 1.0,
        }
        return {name: value for name, value in known.items() if value is not None}

    def __call__(self, frame: TactileFrame, now: float) -> TactileObservation:
        """The observation of `frame` at time `now` [s].

        The drift of a real light (`drifts`) since the reference, one quadratic over the gel, is removed from image,
        gradient and height, if enough of the gel is untouched to measure it.

        Raises NoReference; StaleReference if the light has changed; MarkersLost if too few markers are visible;
        ValueError for a frame of another shape.
        """
        if self.reference is None:
            raise NoReference("no reference yet: call take_reference with a frame without contact (Rig.reset does)")
        self.out_of_range_share, self._sought = 0.0, False
        difference = partial(_relative_change, self.reference, self._rectify, frame)
        if frame.surface is None:
            return self._observation_from_image(frame, difference(), now)
        surface = frame.surface
        self._require_shape("height", surface.height, ())
        return TactileObservation(
            image=lambda: _encode_image(canonical_part(difference(), self._grid)),
            gradient=partial(self._gradient_of, surface),
            height=surface.height,
            contact=(surface.height > MIN_CONTACT_HEIGHT) & self._valid,
            valid=self._valid,
            flow=surface.flow,
            time=frame.time,
            age=now - frame.time,
            picture=lambda: frame.image,
        )

    def _observation_from_image(
        self, frame: TactileFrame, difference: NDArray[np.float32], now: float
    ) -> TactileObservation:
        """The observation from the picture; seen: its difference from the reference."""
        change: NDArray[np.float32] = canonical_part(difference, self._grid)
        height, gradient, flow, drift = self._find_surface(frame, difference)
        if drift is not None:
            change = np.subtract(change, drift, out=drift)
            change[self._off_image] = 0.0
        return TactileObservation(
            image=_encode_image(change),
            gradient=gradient,
            height=height,
            contact=self._contact_mask(change) if height is None else (height > MIN_CONTACT_HEIGHT) & self._valid,
            valid=self._valid,
            flow=flow,
            time=frame.time,
            age=now - frame.time,
            picture=frame.image,
        )

    def _find_surface(self, frame: TactileFrame, change: NDArray[np.float32]) -> tuple[NDArray[np.float32] | None, ...]:
        """Height, gradient and flow, and the drift to subtract from the canonical image."""
        height = gradient = flow = removed = None
        self._sought = any(part is not None for part in (self._find, self._markers, self._find_drift))
        if self._find_drift is not None:
            drift = self._find_drift(np.ascontiguousarray(np.moveaxis(change, -1, 0)), ~self._on_image)
            if drift.measured:
                self.drift = max_mean_change(self._find_drift.drift_at_stride(drift))
                removed = self._find_drift.drift_on_part(drift, (0, 0), self._on_image.shape)
        if self._find is not None:
            assert self.reference is not None
            found = self._find(change, self.reference.relative)
            self.out_of_range_share = found.out_of_range_share
            if found.drift is not None:
                self.drift, self.drift_slope = found.drift, found.drift_slope
            height, gradient, removed = found.height, found.gradient, found.removed_drift
        if self.stale:
            self._require_channel_order(change)
        self._require_stable_light()
        if self._markers is not None:
            deep = None if height is None else (height, canonical_cells(self._grid))
            flow = self._markers(frame.image, frame.index, deep)
        return height, gradient, flow, removed

    def _require_channel_order(self, change: NDArray[np.float32]) -> None:
        """Raises StaleReference for a picture with red and blue swapped, by its change (H, W, 3) from the reference."""
        assert self.reference is not None
        image = self.reference.image + change * self.reference.mean
        if is_contact_image_swapped(image, self.reference.image, self.reference.valid):
            raise StaleReference(
                "red and blue are swapped: the untouched gel looks as in its reference only with the channels in the "
                "other order; give frames and reference in one order (this program's is RGB)"
            )

    def _require_stable_light(self) -> None:
        """Raises StaleReference."""
        for measured, limit, words in (
            (self.drift_slope, tuning.MAX_SLOPE_CHANGE, "slopes of {:.0f} degrees"),
            (self.drift, tuning.MAX_COLOUR_CHANGE, "{:.0%} of its colour"),
        ):
            if measured is not None and measured > limit:
                raise StaleReference(
                    f"the untouched gel differs from its reference by {words.format(measured)}, too much to measure by "
                    "it. Is a lamp out, or the exposure another? If not, take a fresh reference (Rig.reset does)"
                )

    def _contact_mask(self, change: NDArray[np.float32]) -> NDArray[np.bool_]:
        """(h, w) where the colour, averaged over a cell and its neighbours, differs from the reference: not in the
        flat middle of a contact, which has the colour of the untouched gel."""
        import cv2

        cell = _cell_view(change, self._grid).mean(axis=(1, 3), dtype=np.float32)
        calm = cv2.blur(cell, (3, 3))
        return np.asarray(np.abs(calm).max(axis=2) > MIN_CONTACT_DIFFERENCE, dtype=np.bool_) & self._valid

    def _gradient_of(self, surface: SurfaceMap) -> NDArray[np.float32]:
        self._require_shape("gradient", surface.gradient, (2,))
        return surface.gradient

    def _require_shape(self, name: str, values: NDArray[np.float32], components: tuple[int, ...]) -> None:
        shape = (self._grid.rows, self._grid.columns, *components)
        if values.shape != shape:
            raise ValueError(
                f"frame.surface has {name} {values.shape}, the canonical grid is {shape}; sample it on the grid of the "
                "rig"
            )


def _relative_change(reference: Reference, rectify: Rectification, frame: TactileFrame) -> NDArray[np.float32]:
    """(H, W, 3) relative change of the rectified picture."""
    return reference.difference(rectify(frame.image))


def _encode_image(change: NDArray[np.float32]) -> NDArray[np.uint8]:
    """(H, W, 3) clip(128 + 128 change), rounded; no change is exactly 128."""
    import cv2

    # cv2 takes the absolute value before it saturates: what is below -1 would be folded up
    return np.asarray(cv2.convertScaleAbs(np.maximum(change, np.float32(-1.0)), alpha=128.0, beta=128.0))


def _dot_mask(relative: NDArray[np.float32]) -> NDArray[np.bool_]:
    """(H, W) True for pixels of an image (H, W, 3), relative to its mean, in or next to printed dots."""
    import cv2

    dark = (relative.max(axis=2) < tuning.MAX_DOT_LEVEL).astype(np.uint8)
    return np.asarray(cv2.dilate(dark, np.ones((5, 5), dtype=np.uint8)), dtype=np.bool_)


def _cell_view(pixels: NDArray[Any], grid: CanonicalGrid) -> NDArray[Any]:
    """(h, scale, w, scale, ...) view of canonical pixels (H, W, ...), cell by cell."""
    scale = grid.image_scale
    return pixels.reshape(grid.rows, scale, grid.columns, scale, *pixels.shape[2:])
