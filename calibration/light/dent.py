"""The dent that a ball presses into a gel, the reference surface of a photometric calibration; and the contact circle
of a ball in a tactile image, from its difference to the image without contact.

Inside the contact circle (radius a) the gel has the ball's slope. Outside it has the slope of an elastic layer, bonded
to a rigid base, under Hertz's pressure, scaled to meet the ball's slope at the circle:

    s(r) = r / sqrt(R^2 - r^2)                    r < a
    s(r) = a / sqrt(R^2 - a^2) S(r/a) / S(1)      r >= a

On a thick layer S is Hertz's (Johnson, Contact Mechanics, 1985, eq. 3.42a): it falls to 53 % within a tenth of a
contact radius, without a free parameter. On a thinner layer it falls faster. So the skirt has one parameter, the
layer's thickness, and cannot be confused with a part of the contact. (A skirt with two free parameters, a length and a
step at the circle, can: if light spreads in the gel, the step vanishes and the circles are 15 % too small.)

The contact circle has one definition for real and rendered images: the radius of the elastic dent that explains the
difference best. That dent has a ball inside the circle and Hertz's free surface outside (Johnson, Contact Mechanics,
1985, eq. 3.42a), scaled to meet the ball's slope at the circle. The relation of slope and colour is not assumed: in
each channel it is a quadratic polynomial of both slopes, fitted again to each image by least squares. So no light is
calibrated, and there is no parameter of a sensor.

On a layer 1.7 contact radii thick the surface outside drops faster than Hertz's, and the radius is 4 % too small; on a
thicker one the error is smaller. So compare only radii found by the same method.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.light import tuning
from tacsim.interface import FloatArray


@dataclass(frozen=True, slots=True)
class ContactCircle:
    """Contact circle in the image [px]; pixel centres are whole numbers, x right, y down."""

    x: float
    y: float
    radius: float


def hertz_slope(q: FloatArray) -> FloatArray:
    """Slope of the free surface outside a contact, over that at its circle; q: contact radius over distance, 0 to 1."""
    q = np.maximum(q, 1e-9)
    return np.asarray(2 / np.pi * (np.arcsin(q) / q - np.sqrt(1 - q * q)), dtype=np.float64)


def layer_slope(distance: FloatArray, thinness: float) -> FloatArray:
    """The same on a layer at `distance` (n,) from the axis [contact radii, >= 1]; `thinness`: contact radius over the
    layer's thickness, 0 to 3.

    Hertz's pressure has the transform (sin k - k cos k) / k^3; a half-space answers by 1/k to a wave of number k, a
    bonded layer by less, and least to waves that are long compared with its thickness (Dimitriadis et al., Biophys. J.
    82, 2002).
    Compared with the true pressure of a ball's dent, the error is 1 % of the slope at the circle, up to 1.5.
    """
    from scipy.special import j1

    if thinness < 1e-3:
        return hertz_slope(1 / distance)
    waves, weights = _layer_quadrature()
    waves = waves * thinness  # of one contact radius
    less = weights * (np.sin(waves) - waves * np.cos(waves)) / waves**2 * thinness
    at = np.append(distance, 1.0)
    slope = hertz_slope(1 / at) - 4 / np.pi * j1(np.outer(at, waves)) @ less
    return np.asarray(slope[:-1] / slope[-1], dtype=np.float64)


@functools.cache
def _layer_quadrature() -> tuple[FloatArray, FloatArray]:
    """Numbers of waves over one thickness, and the response of a layer minus that of a half-space, times the weights of
    Gauss quadrature."""
    nu = 0.48  # of silicone; between 0.45 and 0.495 the slope changes by 2 % of that at the circle
    x, weights = np.polynomial.legendre.leggauss(48)
    q, soft = 5.0 * (x + 1), 3 - 4 * nu  # beyond 10 the difference is 1e-7
    answer = (soft * np.sinh(2 * q) - 2 * q) / (soft * np.cosh(2 * q) + 2 * q * q + 5 - 12 * nu + 8 * nu**2)
    return q, 5.0 * weights * (1 - answer)


def dent_slope(distance: FloatArray, contact: float, ball: float, thickness: float = np.inf) -> FloatArray:
    """Slope at `distance` from the axis of a ball in contact up to `contact` on a layer of `thickness`; in one unit.

    Raises ValueError for a circle as large as the ball.
    """
    if not 0 < contact < ball:
        raise ValueError(f"a ball of {ball:.1f} px has no contact circle of {contact:.1f} px")
    slope = distance / np.sqrt(np.maximum(ball**2 - distance**2, ball**2 - contact**2))
    outside = distance >= contact
    rim = contact / np.sqrt(ball**2 - contact**2)
    slope[outside] = rim * layer_slope(distance[outside] / contact, contact / thickness)
    return np.asarray(slope, dtype=np.float64)


def dent_gradient(
    u: FloatArray, v: FloatArray, circle: ContactCircle, thickness: float, ball: float, blur: float = 0.0
) -> FloatArray:
    """(..., 2) slopes of the height (into the gel) at pixels u, v (...,); `ball`: its radius, `thickness` of the layer
    [px].

    blur: [px] standard deviation of the blur of the picture of the dent, along its radius.

    Raises ValueError for a circle as large as the ball.
    """
    radius_step = 0.25  # of the radii at which a blurred slope is found [px]
    dx, dy = u - circle.x, v - circle.y
    r = np.hypot(dx, dy)
    if blur == 0:
        slope = dent_slope(r, circle.radius, ball, thickness)
    else:
        reach = np.arange(0.0, float(r.max(initial=0.0)) + 4 * blur + 2 * radius_step, radius_step)
        profile = dent_slope(reach, circle.radius, ball, thickness)
        side = round(4 * blur / radius_step)
        kernel = np.exp(-((np.arange(-side, side + 1) * radius_step / blur) ** 2) / 2)
        odd = np.concatenate(
            [-profile[side:0:-1], profile]
        )  # on the opposite side of the axis the slope has the opposite sign
        slope = np.interp(r, reach[: len(reach) - side], np.convolve(odd, kernel / kernel.sum(), mode="valid"))
    steepness = slope / np.maximum(r, 1e-9)
    return np.stack([-steepness * dx, -steepness * dy], axis=-1)


def depth_profile(radii: FloatArray, contact: float, ball: float, thickness: float) -> FloatArray:
    """(n,) depth of a dent at `radii`, which rise evenly from 0; 0 at the last; all in one unit."""
    slope = dent_slope(radii, contact, ball, thickness)
    depth = np.concatenate([[0.0], np.cumsum((slope[1:] + slope[:-1]) / 2 * np.diff(radii))])
    return np.asarray(depth[-1] - depth, dtype=np.float64)


@functools.lru_cache(maxsize=64)
def cached_profile(contact: float, ball: float, thickness: float) -> tuple[FloatArray, FloatArray]:
    """Radii up to FAR ball radii and the depth of a dent there [px]; cached, so do not write to them."""
    depth_step = 1.0  # of those at which the depth is found [px]
    radii = np.arange(0.0, tuning.MAX_RADIUS_RATIO * ball, depth_step)
    return radii, depth_profile(radii, contact, ball, thickness)


def dent_height(u: FloatArray, v: FloatArray, circle: ContactCircle, thickness: float, ball: float) -> FloatArray:
    """(...,) height (into the gel) of that dent at pixels u, v (...,) [px]; 0 at FAR ball radii."""
    radii, depth = cached_profile(circle.radius, ball, thickness)
    return np.asarray(np.interp(np.hypot(u - circle.x, v - circle.y), radii, depth), dtype=np.float64)


def contact_depth(contact: float, ball: float, thickness: float) -> float:
    """Depth of a ball in a layer at this contact radius: Hertz's a^2 / R, less on a thin layer; all in one unit."""
    from scipy.special import j1

    waves, weights = _layer_quadrature()
    waves = waves * (contact / thickness)
    less = 4 / np.pi * weights * (np.sin(waves) - waves * np.cos(waves)) / waves**2 * (contact / thickness)
    inside = np.linspace(0.05, 1.0, 20)
    # the slope of the ball is `inside`: the pressure is larger by this factor
    slope = inside - j1(np.outer(inside, waves)) @ less
    pressure = float((inside**3).sum() / (slope * inside**2).sum())
    return contact**2 / ball * pressure * (1 - float((less / waves).sum()))


def max_dent_slope(circle: ContactCircle, ball: float) -> float:
    """The steepest slope of the dent [-]."""
    return circle.radius / float(np.sqrt(ball**2 - circle.radius**2))


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
    if circle.explained_share >= tuning.MIN_EXPLAINED_SHARE and circle.radius >= tuning.MIN_CIRCLE_RADIUS:
        return circle
    if circle.radius > tuning.MAX_CONTACT_RATIO * tuning.MAX_RIM_RATIO * ball_radius:
        larger = _fit_circle(observed, columns, rows, (x, y, size), 2 * ball_radius)
        if larger.explained_share >= tuning.MIN_EXPLAINED_SHARE:
            raise NoCircle(
                "the contact is wider than the ball can be: pixel pitch or the ball's radius is wrong (or no ball was "
                "pressed)"
            )
    raise NoCircle(
        f"no ball's contact is seen: a dent explains {max(circle.explained_share, 0.0):.0%} of the difference to the "
        f"image without contact, {tuning.MIN_EXPLAINED_SHARE:.0%} are needed"
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
    largest = tuning.MAX_RIM_RATIO * ball

    def residual_share(guess: FloatArray) -> float:
        if not tuning.MIN_CIRCLE_RADIUS / 2 < guess[2] < largest:
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
