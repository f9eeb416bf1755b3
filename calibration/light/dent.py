"""The dent that a ball presses into a gel: the reference surface of a photometric calibration.

Inside the contact circle (radius a) the gel has the ball's slope. Outside it has the slope of an elastic layer, bonded
to a rigid base, under Hertz's pressure, scaled to meet the ball's slope at the circle:

    s(r) = r / sqrt(R^2 - r^2)                    r < a
    s(r) = a / sqrt(R^2 - a^2) S(r/a) / S(1)      r >= a

On a thick layer S is Hertz's (Johnson, Contact Mechanics, 1985, eq. 3.42a): it falls to 53 % within a tenth of a
contact radius, without a free parameter. On a thinner layer it falls faster. So the skirt has one parameter, the
layer's thickness, and cannot be confused with a part of the contact. (A skirt with two free parameters, a length and a
step at the circle, can: if light spreads in the gel, the step vanishes and the circles are 15 % too small.)
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from calibration.light.tuning import MAX_RADIUS_RATIO
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
    radii = np.arange(0.0, MAX_RADIUS_RATIO * ball, depth_step)
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
