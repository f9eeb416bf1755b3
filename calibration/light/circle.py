"""The contact circle of a ball in a tactile image, from its difference to the image without contact.

One definition for real and rendered images: the radius of the elastic dent that explains the difference best. The dent
has a ball inside the circle and Hertz's free surface outside (Johnson, Contact Mechanics, 1985, eq. 3.42a), scaled to
meet the ball's slope at the circle. The relation of slope and colour is not assumed: in each channel it is a
quadratic polynomial of both slopes, fitted again to each image by least squares. So no light is calibrated, and there
is no parameter of a sensor.

On a layer 1.7 contact radii thick the surface outside drops faster than Hertz's, and the radius is 4 % too small; on a
thicker one the error is smaller. So compare only radii found by the same method.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.light.dent import dent_slope
from calibration.light.tuning import MAX_CONTACT_RATIO, MAX_RIM_RATIO, MIN_CIRCLE_RADIUS, MIN_EXPLAINED_SHARE
from tacsim.interface import FloatArray


class NoCircle(ValueError):
    """No contact of a ball is visible in an image."""


@dataclass(frozen=True, slots=True)
class Circle:
    """Contact circle [px]; pixel centres are whole numbers, x right, y down."""

    x: float
    y: float
    radius: float
    explained_share: float  # share of the difference that the dent explains, 0 to 1


def find_contact_circle(image: NDArray[np.uint8], reference: NDArray[np.uint8], ball_radius: float) -> Circle:
    """Finds the contact of a ball of known radius [px] in `image` (H, W, 3); `reference` is the same without contact.

    Raises ValueError if the two images differ in size, NoCircle if no ball's contact is visible.
    """
    window_half_side = 2.0  # half side of what the fit looks at [half widths of the bright patch]
    if image.shape != reference.shape:
        raise ValueError(
            f"the image is {image.shape[1]} x {image.shape[0]} px, the one without contact "
            f"{reference.shape[1]} x {reference.shape[0]}; they must be of one camera"
        )
    difference = _blur_image(image.astype(np.float64) - reference)
    difference -= np.median(difference, axis=(0, 1))
    x, y, size = _brightest_patch(difference)
    window = round(window_half_side * size) + 6
    columns = np.arange(max(round(x) - window, 0), min(round(x) + window + 1, image.shape[1]))
    rows = np.arange(max(round(y) - window, 0), min(round(y) + window + 1, image.shape[0]))
    observed = np.ascontiguousarray(difference[np.ix_(rows, columns)].reshape(-1, 3).T)
    circle = _fit_circle(observed, columns, rows, (x, y, size), ball_radius)
    if circle.explained_share >= MIN_EXPLAINED_SHARE and circle.radius >= MIN_CIRCLE_RADIUS:
        return circle
    if circle.radius > MAX_CONTACT_RATIO * MAX_RIM_RATIO * ball_radius:
        larger = _fit_circle(observed, columns, rows, (x, y, size), 2 * ball_radius)
        if larger.explained_share >= MIN_EXPLAINED_SHARE:
            raise NoCircle(
                "the contact is wider than the ball can be: pixel pitch or the ball's radius is wrong (or no ball was "
                "pressed)"
            )
    raise NoCircle(
        f"no ball's contact is seen: a dent explains {max(circle.explained_share, 0.0):.0%} of the difference to the "
        f"image without contact, {MIN_EXPLAINED_SHARE:.0%} are needed"
    )


def _fit_circle(
    observed: FloatArray,
    columns: NDArray[np.intp],
    rows: NDArray[np.intp],
    start: tuple[float, float, float],
    ball: float,
) -> Circle:
    """The circle that explains best what is `observed` (3, n) in a window; `start`: x, y, radius, about [px]."""
    from scipy.optimize import minimize

    power = float((observed**2).sum()), float(((observed - observed.mean(axis=1, keepdims=True)) ** 2).sum())
    largest = MAX_RIM_RATIO * ball

    def residual_share(guess: FloatArray) -> float:
        if not MIN_CIRCLE_RADIUS / 2 < guess[2] < largest:
            return 2.0
        return _residual_share(observed, power, columns - guess[0], rows - guess[1], float(guess[2]), ball)

    x, y, size = start
    first = np.array([x, y, min(size, 0.95 * largest)])
    simplex = first + np.array([[0, 0, 0], [2, 0, 0], [0, 2, 0], [0, 0, -0.15 * first[2]]])
    found = minimize(
        residual_share, first, method="Nelder-Mead",
        options={"xatol": 0.02, "fatol": 1e-7, "maxiter": 400, "initial_simplex": simplex},
    )  # fmt: skip
    return Circle(float(found.x[0]), float(found.x[1]), float(found.x[2]), 1.0 - float(found.fun))


def _blur_image(image: FloatArray) -> FloatArray:
    blur = 1.5  # of images and of the fitted dent, against noise [px]
    import cv2

    side = 2 * round(4 * blur) + 1
    return np.asarray(cv2.GaussianBlur(image, (side, side), blur, borderType=cv2.BORDER_REFLECT), dtype=np.float64)


def _brightest_patch(difference: FloatArray) -> tuple[float, float, float]:
    """Centre and half width of the brightest patch of the difference. Raises NoCircle for images that do not differ."""
    import cv2

    strength = np.sqrt((difference**2).sum(axis=2))
    if not strength.max() > 0:
        raise NoCircle("no ball's contact is seen: the image is the one without contact")
    _, patches = cv2.connectedComponents((strength > 0.5 * strength.max()).astype(np.uint8))
    weight = np.bincount(patches.ravel(), strength.ravel())
    weight[0] = 0.0  # what lies outside all patches
    rows, columns = np.nonzero(patches == int(weight.argmax()))
    width, height = float(np.ptp(columns)), float(np.ptp(rows))
    return float(columns.min()) + width / 2, float(rows.min()) + height / 2, max(width, height) / 2


def _residual_share(
    observed: FloatArray, power: tuple[float, float], dx: FloatArray, dy: FloatArray, contact: float, ball: float
) -> float:
    """Share of the variance of `observed` (3, n) that no polynomial of the dent's slopes explains. power: sums of the
    squares of `observed`, and of its variations."""
    r = np.hypot(dx[None, :], dy[:, None])
    steepness = dent_slope(r, contact, ball) / np.maximum(r, 1e-12)
    x, y = (_blur_image(steepness * part).ravel() for part in (dx[None, :], dy[:, None]))
    features = np.stack([np.ones_like(x), y, y * y, x, x * y, x * x])
    # normal equations: few well-scaled columns, and a hundred solutions an image
    right = features @ observed.T
    weights, *_ = np.linalg.lstsq(features @ features.T, right, rcond=None)
    return (power[0] - float((weights * right).sum())) / power[1]
