"""One press of a ball: its approximate contact circle, and its change of the gel's colour."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.errors import BadFrames
from calibration.light import tuning
from calibration.light.dent import ContactCircle, find_contact_circle
from calibration.reference import UnusableReference, make_reference
from calibration.tuning import SATURATED_LEVEL
from tacsim.interface import FloatArray, Image, Mask
from tacsim.models.photometric import image_axes


@dataclass(frozen=True, slots=True, eq=False)
class BallPress:
    """One frame of a calibration."""

    name: str
    circle: ContactCircle
    change: FloatArray  # (H, W, 3) relative change of colour, without drift
    drift: FloatArray  # (H, W, 3) drift of the light since the reference [grey levels]
    lit: Mask  # (H, W, 3) not saturated

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return (self.lit.shape[0], self.lit.shape[1])

    def distance(self) -> FloatArray:
        """(H, W) distance from the centre of the contact [px]."""
        v, u = np.mgrid[: self.shape[0], : self.shape[1]]
        return np.asarray(np.hypot(u - self.circle.x, v - self.circle.y), dtype=np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class Window:
    """The n used pixels of one press."""

    u: FloatArray  # (n,) columns [px]
    v: FloatArray  # (n,) rows [px]
    change: FloatArray  # (n, 3) relative change of colour


def mean_reference_colour(reference: Image) -> FloatArray:
    """(3,) mean colour of a picture without contact. Raises BadFrames for one that is dark or saturated."""
    try:
        base = make_reference(reference.astype(np.float32), np.ones(reference.shape[:2], dtype=np.bool_))
    except UnusableReference as error:
        raise BadFrames(str(error)) from None
    return base.mean.astype(np.float64)


def find_press(name: str, image: Image, reference: Image, mean: FloatArray, ball: float) -> BallPress:
    """Approximate contact circle of one frame, and its change of colour without drift.

    Args:
        image, reference: (H, W, 3) uint8 RGB with and without contact; `mean` (3,) of the reference.
        ball: radius of the ball [px].

    Raises NoCircle, BadFrames.
    """
    half = find_contact_circle(_halve_image(image), _halve_image(reference), ball / 2)
    circle = ContactCircle(2 * half.x + 0.5, 2 * half.y + 0.5, min(2 * half.radius, 0.95 * tuning.MAX_RIM_RATIO * ball))
    return make_press(name, image, reference, mean, circle)


def make_press(
    name: str,
    image: Image,
    reference: Image,
    mean: FloatArray,
    circle: ContactCircle,
    reach: float = tuning.SKIRT_RADIUS,
) -> BallPress:
    """The same with an approximately known contact. reach: radius of its effect on the gel [contact radii]. Raises
    BadFrames."""
    raw = image.astype(np.float64) - reference
    height, width = reference.shape[:2]
    if not (0 <= circle.x < width and 0 <= circle.y < height):
        raise BadFrames("the middle of the contact lies outside the picture")
    v, u = np.mgrid[:height, :width].astype(np.float64)
    distance = np.hypot(u - circle.x, v - circle.y)
    lit = (image < SATURATED_LEVEL) & (reference < SATURATED_LEVEL)
    drift = _fit_drift(raw, (distance > reach * circle.radius) & lit.all(axis=2))
    contact = distance < circle.radius
    saturated = 1.0 - float(lit[contact].all(axis=1).mean()) if contact.any() else 1.0
    if saturated > tuning.MAX_SATURATED_CONTACT:
        raise BadFrames(f"{saturated:.0%} of the contact is saturated: shorten the exposure or press less")
    change = (raw - drift) / mean
    strength = np.abs(gaussian_blur(change, 3.0)).max(axis=2)
    near, far = (
        np.where(part, strength, 0.0)
        for part in (distance < 1.5 * circle.radius, distance > tuning.UNTOUCHED_RADIUS * circle.radius)
    )
    strong = tuning.MIN_SECOND_CONTACT * float(near.max())
    if _patch_area(far, strong) > tuning.MIN_SECOND_AREA * _patch_area(near, strong):
        raise BadFrames(
            "there is a second contact in the picture, or one in the picture without contact; press one ball at a time"
        )
    return BallPress(name, circle, change, drift, lit)


def _patch_area(strength: FloatArray, strong: float) -> int:
    """Pixels of the largest patch that exceeds `strong` somewhere, and half of it everywhere."""
    import cv2

    count, patches = cv2.connectedComponents((strength > strong / 2).astype(np.uint8))
    numbers = np.asarray(patches, np.intp)
    peaks = np.unique(numbers[strength > strong])
    return int(np.bincount(numbers.ravel(), minlength=count)[peaks].max(initial=0))


def _fit_drift(difference: FloatArray, untouched: Mask) -> FloatArray:
    """(H, W, 3) change between reference and frame outside the contact: a quadratic in the place, or the median if too
    little is untouched."""
    if untouched.mean() < tuning.MIN_UNTOUCHED_SHARE:
        level = np.median(difference[untouched], axis=0) if untouched.any() else np.zeros(3)
        return np.broadcast_to(level, difference.shape).copy()
    u, v = np.meshgrid(*image_axes(difference.shape[1], difference.shape[0]))
    terms = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=-1)
    seen = terms[untouched]
    weights = np.linalg.solve(seen.T @ seen, seen.T @ difference[untouched])
    quadratic: FloatArray = terms @ weights
    return quadratic


def gaussian_blur(image: FloatArray, deviation: float) -> FloatArray:
    """Blurred by a Gaussian of this standard deviation [px]."""
    import cv2

    return np.asarray(cv2.GaussianBlur(image, (0, 0), deviation), dtype=np.float64)


def _halve_image(image: Image) -> Image:
    import cv2

    size = (image.shape[1] // 2, image.shape[0] // 2)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
