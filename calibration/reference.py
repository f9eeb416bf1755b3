"""The reference image I0 of a sensor without contact, and the drift of the light since. A recent reference has a larger
effect than any formula.

A picture alone cannot prove that there is no contact: a wide flat contact looks like none, a change of light looks like
a contact. So a new reference is taken only when the motion of the arms makes it certain: without contact at the start
of an episode (`Rig.reset`), lifted off before each touch of a fixed ball (`tacsim calibrate touch`), or when the
operator confirms it. Between these moments the untouched gel in each picture shows the drift of the light
(`DriftFinder`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration import tuning
from tacsim.interface import Float32, Mask

PIXEL_STRIDE = 5  # of the measured pixels


class UnusableReference(ValueError):
    """A reference image cannot be used for measurements."""


class StaleReference(RuntimeError):
    """The light has changed too much since the reference."""


@dataclass(frozen=True, slots=True, eq=False)
class Reference:
    """I0 and its mean, made by :func:`make_reference`."""

    image: Float32  # (H, W, 3) rectified, 0..255
    mean: Float32  # (3,) over the gel
    relative: Float32  # (H, W, 3) I0 / mean(I0) [-]
    valid: Mask  # (H, W)
    scale: Float32  # (H, W, 3) 1 / mean where valid, else 0

    def difference(self, image: Float32) -> Float32:
        """(H, W, 3) relative change (I - I0) / mean(I0) of a rectified image [-]; 0 where not valid.

        Raises ValueError for another shape.
        """
        if image.shape != self.image.shape:
            raise ValueError(f"image is {image.shape}, the reference {self.image.shape}; take a fresh reference")
        change = image - self.image
        change *= self.scale
        return change


def make_reference(
    image: Float32,
    valid: Mask,
    measured: Mask | None = None,
    *,
    colour: bool = True,
) -> Reference:
    """Checks a rectified contact-free image (H, W, 3), 0..255, on the gel (`valid`, (H, W)).

    measured: (H, W) the part of the gel that is checked, and over which the mean is taken; None: all. colour: a surface
    or a contact is identified by changes of its colour, so the gel must not be saturated.

    Raises UnusableReference if the gel is not in the image, too dark or (with `colour`) saturated, or if shapes differ.
    """
    if image.ndim != 3 or image.shape[2] != 3 or image.shape[:2] != valid.shape:
        raise UnusableReference(f"reference is {image.shape}, expected {(*valid.shape, 3)}")
    gel = image[valid if measured is None else measured & valid]
    if len(gel) == 0:
        raise UnusableReference("reference shows no gel: no canonical pixel lies on the gel and in the image")
    if not np.isfinite(gel).all():
        raise UnusableReference("reference is not finite")
    mean = gel.mean(axis=0)
    if (mean < tuning.MIN_MEAN_LEVEL).any():
        levels = ", ".join(f"{level:.1f}" for level in mean)
        raise UnusableReference(
            f"reference is dark: mean R, G, B over the gel {levels}, at least {tuning.MIN_MEAN_LEVEL:g} each; are the "
            "sensor's lights on, and is the exposure right?"
        )
    saturated = float((gel >= tuning.SATURATED_LEVEL).any(axis=1).mean())
    if colour and saturated > tuning.MAX_SATURATED_SHARE:
        raise UnusableReference(
            f"reference is saturated on {saturated:.1%} of the gel, at most {tuning.MAX_SATURATED_SHARE:.0%}: shorten "
            "the exposure or dim the lights"
        )
    mean = mean.astype(np.float32)
    scale = np.where(valid[..., None], 1.0 / mean, 0.0).astype(np.float32)
    return Reference(image.astype(np.float32), mean, image / mean, valid, scale)


def is_channel_order_swapped(image: Float32, known: Float32, valid: Mask) -> bool:
    """True if an image (H, W, 3) is similar to the `known` one of the same gel only with red and blue exchanged.

    The comparison uses the distribution of each colour over the gel, not the gain of the lamps or the white balance.
    False if all colours are equally uniform.
    """
    one, other = (_block_pattern(picture, valid) for picture in (image, known))
    apart = float(np.sqrt(((one - other) ** 2).mean()))
    exchanged_apart = float(np.sqrt(((one[:, ::-1] - other) ** 2).mean()))
    return apart > tuning.MAX_SAME_CHANGE and exchanged_apart < tuning.MAX_EXCHANGED_RATIO * apart


def is_contact_image_swapped(image: Float32, known: Float32, valid: Mask) -> bool:
    """True if most of a picture (H, W, 3), which may show a contact, equals the `known` one of the same gel with red
    and blue swapped, and fits it less well with another gain of each channel (exposure, white balance). False if all
    colours are equally uniform: then a swap looks like a change of the white balance."""
    seen, wanted = _block_levels(image, valid), _block_levels(known, valid)
    if not len(wanted):
        return False
    mean = np.maximum(wanted.mean(axis=0), 1.0)
    gain = np.median(wanted / np.maximum(seen, 1.0), axis=0)
    apart, swapped = (
        float(np.median((np.abs(levels - wanted) / mean).max(axis=1))) for levels in (seen * gain, seen[:, ::-1])
    )
    return apart > tuning.MIN_SWAPPED_CHANGE and swapped < tuning.MAX_EXCHANGED_RATIO * apart


def _block_levels(image: Float32, valid: Mask) -> Float32:
    """(n, 3) mean level of each block on the gel."""
    block_side = 8  # side of the blocks that are compared [px]
    import cv2

    size = (max(valid.shape[1] // block_side, 1), max(valid.shape[0] // block_side, 1))
    whole = cv2.resize(valid.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.999
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.float32)[whole]


def _block_pattern(image: Float32, valid: Mask) -> Float32:
    """(n, 3) brightness of each block of the gel in each colour, relative to the mean."""
    parts = _block_levels(image, valid)
    return np.asarray(parts / parts.mean(axis=0) - 1.0, dtype=np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class Drift:
    """One picture's drift, a quadratic in the place."""

    weights: Float32  # (6, 3) of 1, u, v, uu, uv, vv with u, v in -1..1 across the view
    measured: bool  # with enough untouched gel; otherwise the drift is the median of all pixels

    def scaled(self, factor: Float32) -> Drift:
        """The same in other units: each channel times its `factor` (3,)."""
        return Drift(self.weights * factor, self.measured)


def max_mean_change(change: Float32) -> float:
    """Mean change of colour over the gel, of (n, 3), in the channel with the largest change [-]."""
    return float(np.abs(change).mean(axis=0).max())


def subtract_drift(change: NDArray[np.floating], level: NDArray[np.floating]) -> Float32:
    """A change of colour (H, W, 3) [grey levels] since a picture with mean colour `level` (3,), without its drift;
    unchanged if too little of the gel is untouched to measure a drift."""
    scale = np.maximum(np.asarray(level, dtype=np.float32), 1.0)
    planes = np.ascontiguousarray(np.moveaxis(change / scale, -1, 0), dtype=np.float32)
    find = DriftFinder((change.shape[0], change.shape[1]))
    drift = find(planes, np.zeros(change.shape[:2], dtype=np.bool_))
    if drift.measured:
        find.remove(planes, drift)
    return np.asarray(np.moveaxis(planes, 0, -1) * scale, dtype=np.float32)


class DriftFinder:
    """Finds the drift in a view of `shape` (H, W): a quadratic in the place, fitted twice to the untouched pixels, the
    second time only to those near the first fit; or the median if too few pixels are untouched."""

    def __init__(self, shape: tuple[int, int]) -> None:
        self._u, self._v = (np.linspace(-1, 1, count, dtype=np.float32) for count in reversed(shape))
        u, v = np.meshgrid(self._u[::PIXEL_STRIDE], self._v[::PIXEL_STRIDE])
        self._few = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=-1).reshape(-1, 6)

    def __call__(self, planes: Float32, hidden: Mask) -> Drift:
        """The drift in relative changes (3, H, W), without those `hidden` (H, W)."""
        seen = planes[:, ::PIXEL_STRIDE, ::PIXEL_STRIDE].reshape(3, -1)
        on_gel = ~hidden[::PIXEL_STRIDE, ::PIXEL_STRIDE].ravel()
        weights = np.zeros((6, 3), dtype=np.float32)
        if on_gel.any():
            weights[0] = np.median(seen[:, on_gel], axis=1)
        measured = False
        for _ in range(2):
            rest = np.abs(seen - np.einsum("ni,ic->cn", self._few, weights))
            untouched = on_gel & (np.maximum(np.maximum(rest[0], rest[1]), rest[2]) < tuning.MAX_UNTOUCHED_CHANGE)
            measured = bool(untouched.mean() >= tuning.MIN_UNTOUCHED_SHARE)
            if not measured:
                break
            terms = self._few[untouched].astype(np.float64)
            # einsum: such small products are slower with the threads of BLAS
            square = np.einsum("ni,nj->ij", terms, terms) + 1e-6 * len(terms) * np.eye(6)
            weights = np.linalg.solve(square, np.einsum("ni,cn->ic", terms, seen[:, untouched])).astype(np.float32)
        return Drift(weights, measured)

    def remove(self, planes: Float32, drift: Drift) -> None:
        """Subtracts the drift from relative changes (3, H, W)."""
        for plane, (one, u, v, uu, uv, vv) in zip(planes, drift.weights.T, strict=True):
            plane -= (one + v * self._v + vv * self._v * self._v)[:, None] + (u * self._u + uu * self._u * self._u)
            plane -= (uv * self._v)[:, None] * self._u

    def drift_on_part(self, drift: Drift, corner: tuple[int, int], shape: tuple[int, int]) -> Float32:
        """(h, w, 3) the drift on pixels of `shape` (h, w) [-]. The first pixel is at row and column `corner` of the
        view; pixels may be outside the view."""
        v, u = (
            (2.0 * (first + np.arange(count)) / (whole.size - 1) - 1.0).astype(np.float32)
            for first, count, whole in zip(corner, shape, (self._v, self._u), strict=True)
        )
        one, by_u, by_v, by_uu, by_uv, by_vv = drift.weights
        # row by row (w * 3 numbers), not pixel by pixel: several times as fast
        along = (one + u[:, None] * by_u + (u * u)[:, None] * by_uu).ravel()
        change: Float32 = v[:, None] * (by_v + u[:, None] * by_uv).ravel()
        change += along
        change += (v * v)[:, None] * np.tile(by_vv, shape[1])
        return change.reshape(*shape, 3)

    def drift_at_stride(self, drift: Drift) -> Float32:
        """(n, 3) the drift at every STRIDE-th row and column [-]."""
        return np.asarray(np.einsum("ni,ic->nc", self._few, drift.weights), dtype=np.float32)


def contact_area(change: Float32, ignored: NDArray[np.bool_], pitch: float) -> float:
    """Area [m^2] of the largest patch in which two pictures without contact differ as by a contact, from their relative
    change (H, W, 3) on pixels of `pitch` [m], without drift of the light and without the pixels `ignored` (H, W)."""
    import cv2

    planes = np.ascontiguousarray(np.moveaxis(change, -1, 0), dtype=np.float32)
    find = DriftFinder(ignored.shape)
    find.remove(planes, find(planes, ignored))
    planes[:, ignored] = 0.0
    smooth = [cv2.GaussianBlur(plane, (0, 0), tuning.CONTACT_BLUR) for plane in planes]
    strong = (np.abs(smooth).max(axis=0) > tuning.MIN_CONTACT_CHANGE) & ~ignored
    _, _, stats, _ = cv2.connectedComponentsWithStats(strong.astype(np.uint8))
    return float(stats[1:, cv2.CC_STAT_AREA].max(initial=0)) * pitch**2
