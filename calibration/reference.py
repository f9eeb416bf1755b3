"""The reference image I0 of a sensor without contact. A recent one has a larger effect than any formula.

A picture alone cannot prove that there is no contact: a wide flat contact looks like none, a change of light looks like
a contact. So a new reference is taken only when the motion of the arms makes it certain: without contact at the start
of an episode (`Rig.reset`), lifted off before each touch of a fixed ball (`tacsim calibrate touch`), or when the
operator confirms it. Between these moments the untouched gel in each picture shows the drift of the light
(:mod:`calibration.drift`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.tuning import (
    MAX_EXCHANGED_RATIO,
    MAX_SAME_CHANGE,
    MAX_SATURATED_SHARE,
    MIN_MEAN_LEVEL,
    MIN_SWAPPED_CHANGE,
    SATURATED_LEVEL,
)
from tacsim.interface import Float32, Mask


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
    if (mean < MIN_MEAN_LEVEL).any():
        levels = ", ".join(f"{level:.1f}" for level in mean)
        raise UnusableReference(
            f"reference is dark: mean R, G, B over the gel {levels}, at least {MIN_MEAN_LEVEL:g} each; are the "
            "sensor's lights on, and is the exposure right?"
        )
    saturated = float((gel >= SATURATED_LEVEL).any(axis=1).mean())
    if colour and saturated > MAX_SATURATED_SHARE:
        raise UnusableReference(
            f"reference is saturated on {saturated:.1%} of the gel, at most {MAX_SATURATED_SHARE:.0%}: shorten the "
            "exposure or dim the lights"
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
    return apart > MAX_SAME_CHANGE and exchanged_apart < MAX_EXCHANGED_RATIO * apart


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
    return apart > MIN_SWAPPED_CHANGE and swapped < MAX_EXCHANGED_RATIO * apart


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
