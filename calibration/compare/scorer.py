"""Scores one pair of pictures in the pixels of B: height, gradient and flow of both on the canonical grid, from any
source, and the pictures themselves."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from calibration.bundle import Calibration
from calibration.compare import metrics
from calibration.compare.metrics import Alignment
from calibration.compare.tuning import MIN_SWAPPED_GAIN
from calibration.errors import BadFrames
from calibration.frame_set import Frame, FrameSet, frame_warnings
from calibration.markers.flow import TooFewMarkers
from calibration.normaliser import normaliser_for_calibration
from calibration.reference import StaleReference, UnusableReference, subtract_drift
from tacsim.control import MIN_CONTACT_HEIGHT
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


Numbers = dict[str, float]


@dataclass(frozen=True, slots=True, eq=False)
class Pair:
    """One frame of A against one of B."""

    a: Frame
    b: Frame
    numbers: Numbers
    null: Numbers  # the same of A's reference
    flags: tuple[str, ...]
    region: Mask  # (H, W) contact in either, in the pixels of B
    contact_b: metrics.Patch | None  # contact of B alone, in its pixels


class Scorer:
    """Scores pairs in the pixels of B."""

    def __init__(self, a: FrameSet, b: FrameSet, alignment: Alignment, names: tuple[str, str]) -> None:
        self._b, self._alignment, self.names = b, alignment, names
        self._covered = alignment.covered_mask
        self._whole = None if self._covered.all() else self._covered
        self._reference_a = alignment(a.reference)
        self._plain: list[float] = []  # correlations of the pairs without and with red and blue exchanged
        self._swapped: list[float] = []

    def score_pair(
        self, a: Frame, b: Frame, surface_a: SurfaceEstimate | None, surface_b: SurfaceEstimate | None
    ) -> Pair:
        seen_a, seen_b = self._alignment(a.image), b.image.astype(np.float32)
        change_a, change_b = seen_a - self._reference_a, seen_b - self._b.reference
        contact_a, contact_b = (
            metrics.contact_region(subtract_drift(change, self._b.reference.mean(axis=(0, 1)))) & self._covered
            for change in (change_a, change_b)
        )
        region = contact_a | contact_b
        numbers = self.score_images(seen_a, seen_b, region) | _contact_regions(contact_a, contact_b)
        numbers["contact_ncc"] = metrics.image_correlation(change_a, change_b, region)
        grain_b = self._grain_deviations(change_b, region)
        numbers |= {key: abs(value - grain_b[key]) for key, value in self._grain_deviations(change_a, region).items()}
        null = self.score_images(self._reference_a, seen_b, region) | _contact_regions(
            np.zeros_like(contact_b), contact_b
        )
        null["contact_ncc"] = metrics.image_correlation(np.zeros_like(change_b), change_b, region)
        null |= grain_b  # the reference against itself has none
        if surface_a is not None and surface_b is not None:
            numbers |= self._score_surfaces(surface_a, surface_b, surface_a)
            null |= self._score_surfaces(undeformed_surface(surface_b), surface_b, surface_a)
        if region.any():
            self._plain.append(numbers["contact_ncc"])
            self._swapped.append(metrics.image_correlation(change_a[..., ::-1], change_b, region))
        reference_b = self._b.reference.astype(np.float32)
        flags = [
            *(f"{self.names[0]}: {words}" for words in frame_warnings(seen_a, self._reference_a, contact_a)),
            *(f"{self.names[1]}: {words}" for words in frame_warnings(seen_b, reference_b, contact_b)),
        ]
        return Pair(a, b, numbers, null, tuple(flags), region, metrics.circle_of_region(contact_b))

    def score_images(self, one: metrics.Picture, other: metrics.Picture, region: Mask) -> Numbers:
        """Metrics of two pictures with contact in `region`."""
        similarity = metrics.similarity_map(one, other)
        rim = metrics.WINDOW // 2
        inner = np.zeros_like(self._covered)
        inner[rim:-rim, rim:-rim] = True
        inner &= self._covered
        return {
            "mae": metrics.mean_absolute_error(one, other, self._whole),
            "psnr": metrics.peak_signal_to_noise(one, other, self._whole),
            "ssim": float(similarity[inner].mean()) if inner.any() else math.nan,
            "contact_mae": metrics.mean_absolute_error(one, other, region),
            "contact_psnr": metrics.peak_signal_to_noise(one, other, region),
            "contact_ssim": float(similarity[region].mean()) if region.any() else math.nan,
        }

    def _grain_deviations(self, change: metrics.Picture, region: Mask) -> Numbers:
        """Grain of a change of colour outside and inside a contact `region`, without its border [grey levels]."""
        grain_margin = 5  # of a contact's border, whose edge would pass for grain [px]
        from scipy.ndimage import binary_dilation, binary_erosion

        beside = self._covered & ~binary_dilation(region, iterations=grain_margin)
        inside = binary_erosion(region, iterations=grain_margin)
        return {
            "grain": metrics.grain_deviation(change, beside),
            "contact_grain": metrics.grain_deviation(change, inside),
        }

    def _score_surfaces(self, a: SurfaceEstimate, b: SurfaceEstimate, other_surface: SurfaceEstimate) -> Numbers:
        """Metrics of A's surface against B's, in the pressed region of B or `other_surface`."""
        pressed_a, pressed_b, of_shown = (
            metrics.pressed_region(t.height, MIN_CONTACT_HEIGHT) for t in (a, b, other_surface)
        )
        pressed = _contact_regions(pressed_a, pressed_b)
        no_flow = a.flow is None or b.flow is None or a.flow.shape != b.flow.shape
        return surface_errors(a, b, (of_shown | pressed_b) & b.valid, b) | {
            "surface_iou": pressed["contact_iou"],
            "surface_radius": pressed["contact_radius"] * GRID.pitch,
            "surface_centroid": pressed["contact_centroid"] * GRID.pitch,
            "marker_error": math.nan if no_flow else metrics.end_point_error(np.asarray(a.flow), np.asarray(b.flow)),
        }

    def swap_warning(self) -> list[str]:
        """A warning if the pairs agree better with red and blue exchanged."""
        plain, swapped = (float(np.mean(values)) if values else 0.0 for values in (self._plain, self._swapped))
        if swapped > 0.5 and swapped > plain + MIN_SWAPPED_GAIN:
            return [
                f"red and blue look swapped in {' or '.join(self.names)}: exchanged they correlate by {swapped:.2f}, "
                f"as they are by {plain:.2f}; OpenCV's pictures are BGR"
            ]
        return []


def surface_errors(a: SurfaceEstimate, b: SurfaceEstimate, where: Mask, pressed: SurfaceEstimate) -> Numbers:
    """Errors of gradient and height in a region (h, w); the share is of the depth of `pressed`."""
    error = metrics.height_error(a.height, b.height, where)
    deepest = float(pressed.height.max(initial=0.0))
    return {
        "gradient_angle": metrics.mean_normal_angle(a.gradient, b.gradient, where),
        "height_rmse": error,
        "height_share": error / deepest if deepest > MIN_CONTACT_HEIGHT else math.nan,
    }


def _contact_regions(a: Mask, b: Mask) -> Numbers:
    patch_a, patch_b = metrics.circle_of_region(a), metrics.circle_of_region(b)
    radius = abs((patch_a.radius if patch_a else 0.0) - (patch_b.radius if patch_b else 0.0))
    return {
        "contact_iou": metrics.intersection_over_union(a, b),
        "contact_radius": radius if patch_a or patch_b else math.nan,
        "contact_centroid": math.hypot(patch_a.x - patch_b.x, patch_a.y - patch_b.y)
        if patch_a and patch_b
        else math.nan,
    }
