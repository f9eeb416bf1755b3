"""Native frame -> canonical observation: the same function for simulated, mock, real and recorded sensors."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from calibration.lens import Rectification, from_corners, from_geometry
from calibration.reference import Reference, make_reference
from tacsim.interface import SurfaceMap, TactileFrame, TactileObservation
from tacsim.optics.geometry import CanonicalGrid, SensorModel
from tacsim.optics.grid import canonical_image
from tacsim.rigfile import ReplaySensorFacts
from tacsim.touch import CONTACT_DIFFERENCE, CONTACT_HEIGHT


class NoReference(RuntimeError):
    """A frame cannot be normalised before a contact-free one was taken."""


class FrameNormaliser:
    """Rectifies a frame, compares it with the reference, and finds where there is contact.

    Height, gradient and flow are those of the source where it knows them (simulation), otherwise None.
    """

    def __init__(self, rectify: Rectification, grid: CanonicalGrid) -> None:
        shape = (grid.rows * grid.image_scale, grid.columns * grid.image_scale)
        if rectify.valid.shape != shape:
            raise ValueError(f"rectification gives {rectify.valid.shape} px, the canonical image has {shape}")
        self._rectify, self._grid = rectify, grid
        self._valid: NDArray[np.bool_] = np.asarray(_cells(rectify.valid, grid).all(axis=(1, 3)), dtype=np.bool_)
        self._valid.flags.writeable = False
        self._reference: Reference | None = None

    @property
    def reference(self) -> Reference | None:
        """The present reference; None before the first."""
        return self._reference

    def take_reference(self, frame: TactileFrame) -> None:
        """Makes `frame`, taken without contact, the reference I0. Raises UnusableReference (the old one then stays), or
        ValueError for a frame of another shape."""
        self._reference = make_reference(self._rectify(frame.image), self._rectify.valid)

    def __call__(self, frame: TactileFrame, now: float) -> TactileObservation:
        """The observation of `frame` at time `now` [s]. Raises NoReference; ValueError for a frame of another shape."""
        if self._reference is None:
            raise NoReference("no reference yet: call take_reference with a frame without contact (Rig.reset does)")
        change = self._reference.difference(self._rectify(frame.image))
        surface = frame.surface
        if surface is not None:
            self._check(surface)
        height = None if surface is None else surface.height
        return TactileObservation(
            image=_byte_image(change),
            gradient=None if surface is None else surface.gradient,
            height=height,
            contact=self._contact(change) if height is None else (height > CONTACT_HEIGHT) & self._valid,
            valid=self._valid,
            flow=None if surface is None else surface.flow,
            time=frame.time,
            age=now - frame.time,
        )

    def _contact(self, change: NDArray[np.float32]) -> NDArray[np.bool_]:
        """(h, w) where the colour, averaged over a cell and its neighbours, differs from the reference. It misses the
        flat middle of a contact, whose slope and colour are those of the untouched gel: only height knows it."""
        import cv2

        cell = _cells(change, self._grid).mean(axis=(1, 3), dtype=np.float32)
        calm = cv2.blur(cell, (3, 3))
        return np.asarray(np.abs(calm).max(axis=2) > CONTACT_DIFFERENCE, dtype=np.bool_) & self._valid

    def _check(self, surface: SurfaceMap) -> None:
        shape = (self._grid.rows, self._grid.columns)
        if surface.height.shape != shape or surface.gradient.shape != (*shape, 2):
            raise ValueError(
                f"frame.surface has height {surface.height.shape} and gradient {surface.gradient.shape}, the canonical "
                f"grid is {shape}; sample it on the grid of the rig"
            )


def for_simulated(model: SensorModel, gel_size: tuple[float, float], grid: CanonicalGrid) -> FrameNormaliser:
    """The normaliser of a simulated sensor; `gel_size`: x, y [m]."""
    return FrameNormaliser(from_geometry(model.geometry, gel_size, canonical_image(grid)), grid)


def for_recorded(facts: ReplaySensorFacts, image_shape: tuple[int, int], grid: CanonicalGrid) -> FrameNormaliser:
    """The normaliser of recorded frames of `image_shape` (rows, columns), through the four corners of the gel.

    Raises calibration.lens.BadCorners.
    """
    return FrameNormaliser(from_corners(facts.corners, facts.size, image_shape, canonical_image(grid)), grid)


def _byte_image(change: NDArray[np.float32]) -> NDArray[np.uint8]:
    """(H, W, 3) clip(128 + 128 change), rounded; no change is exactly 128."""
    image: NDArray[np.uint8] = np.rint(np.clip(128.0 + 128.0 * change, 0.0, 255.0)).astype(np.uint8)
    return image


def _cells(pixels: NDArray[Any], grid: CanonicalGrid) -> NDArray[Any]:
    """(h, scale, w, scale, ...) view of canonical pixels (H, W, ...), cell by cell."""
    scale = grid.image_scale
    return pixels.reshape(grid.rows, scale, grid.columns, scale, *pixels.shape[2:])
