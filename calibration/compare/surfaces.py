"""Height, gradient and flow of a side's frames on the canonical grid, from any source."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from calibration.bundle import Calibration
from calibration.errors import BadFrames
from calibration.frame_set import Frame, FrameSet
from calibration.markers.flow import TooFewMarkers
from calibration.normaliser import normaliser_for_calibration
from calibration.reference import StaleReference, UnusableReference
from tacsim.interface import Float32, FloatArray, Mask, TactileFrame
from tacsim.models.sensor import CanonicalGrid

GRID = CanonicalGrid()  # on which surfaces are compared


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceEstimate:
    """The gel surface in one frame."""

    height: Float32  # (h, w) into the gel [m]
    gradient: Float32  # (h, w, 2) [-]
    flow: Float32 | None  # (m, n, 2) at the markers [m]
    valid: Mask  # (h, w)

    def moved(self, shift: FloatArray) -> SurfaceEstimate:
        """The surface moved by `shift` (x, y) [cells]. Its flow stays that of the same markers."""
        import cv2

        if not shift.any():
            return self
        matrix = np.array([[1.0, 0.0, shift[0]], [0.0, 1.0, shift[1]]])

        def at(field: Float32) -> Any:
            size = (field.shape[1], field.shape[0])
            flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
            return cv2.warpAffine(field, matrix, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)

        return replace(self, height=np.asarray(at(self.height)), gradient=np.asarray(at(self.gradient)))


def estimate_surfaces(
    side: FrameSet,
    frames: Sequence[Frame],
    calibration: Calibration | None,
) -> tuple[tuple[SurfaceEstimate | None, ...] | None, str]:
    """The surfaces of some of the frames and notes on frames without one, whose entry is None; or None and the reason.

    With a calibration they are found in the pictures, also for a simulation with known surfaces, so that both sources
    are treated equally. Raises BadFrames for a reference that cannot be used.
    """
    if calibration is None:
        return _recorded_surfaces(frames)
    normaliser = normaliser_for_calibration(calibration, GRID)
    try:
        normaliser.take_reference(TactileFrame(side.reference, time=0.0, index=0))
        found: list[SurfaceEstimate | None] = []
        lost = []
        for frame in frames:
            try:
                seen = normaliser(TactileFrame(frame.image, time=0.0, index=0), 0.0)
            except (StaleReference, TooFewMarkers) as why:
                found.append(None)
                lost.append(f"{frame.name}: {why}")
                continue
            assert seen.height is not None and seen.gradient is not None
            found.append(SurfaceEstimate(seen.height, seen.gradient, seen.flow, seen.valid))
    except UnusableReference as error:
        raise BadFrames(f"{side.name}: {side.reference_from}: {error}") from None
    except ValueError as error:
        raise BadFrames(f"{side.name}: {error}") from None
    return tuple(found), "; ".join(lost)


def undeformed_surface(like: SurfaceEstimate) -> SurfaceEstimate:
    """The surface of a gel without contact."""
    flow = None if like.flow is None else np.zeros_like(like.flow)
    return SurfaceEstimate(np.zeros_like(like.height), np.zeros_like(like.gradient), flow, like.valid)


def _recorded_surfaces(frames: Sequence[Frame]) -> tuple[tuple[SurfaceEstimate | None, ...] | None, str]:
    shape = (GRID.rows, GRID.columns)
    found: list[SurfaceEstimate | None] = []
    for frame in frames:
        if frame.surface is None:
            return None, "pictures alone have no height; give the sensor's calibration"
        if frame.surface.height.shape != shape:
            cells = " x ".join(map(str, frame.surface.height.shape))
            return None, f"the recorded surface has {cells} cells, not {shape[0]} x {shape[1]}; give a calibration"
        everywhere = np.ones(shape, dtype=np.bool_)
        found.append(SurfaceEstimate(frame.surface.height, frame.surface.gradient, frame.surface.flow, everywhere))
    return tuple(found), ""
