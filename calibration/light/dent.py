"""The dent that a ball presses into a gel: what a photometric calibration takes for the true surface.

Inside the contact circle the gel has the ball's slope; outside it the elastic skirt falls off exponentially:

    s(r) = r / sqrt(R^2 - r^2)                                       r < a
    s(r) = fraction * a / sqrt(R^2 - a^2) * exp(-(r - a) / length)   r >= a

Length and fraction of the skirt belong to the sensor and are found with the circles. Without a skirt, flanks that are
bright outside the contact would be taken for contact, and shallow presses would read a tenth of their depth.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Float64 = NDArray[np.float64]

MAX_RIM_RATIO = 0.98  # contact radius over ball radius; the slope is infinite at 1


@dataclass(frozen=True, slots=True)
class Skirt:
    """The elastic skirt of one sensor's gel."""

    length: float  # [px]
    fraction: float  # of the ball's slope at the contact circle [-]


@dataclass(frozen=True, slots=True)
class ContactCircle:
    """Contact circle in the image [px]; pixel centres are whole numbers, x right, y down."""

    x: float
    y: float
    radius: float


def dent_gradient(
    u: Float64, v: Float64, circle: ContactCircle, skirt: Skirt, ball: float, blur: float = 0.0
) -> Float64:
    """(..., 2) slopes of the height (into the gel) at pixels u, v (...,); `ball`: its radius [px].

    `blur` [px]: standard deviation of the blur through which the step at the contact circle is seen.

    Raises ValueError for a circle as large as the ball.
    """
    from scipy.special import ndtr

    a = circle.radius
    if not 0 < a < ball:
        raise ValueError(f"a ball of {ball:.1f} px has no contact circle of {a:.1f} px")
    dx, dy = u - circle.x, v - circle.y
    r = np.hypot(dx, dy)
    rim = skirt.fraction * a / np.sqrt(ball**2 - a**2)
    inside = 1.0 / np.sqrt(np.maximum(ball**2 - r**2, ball**2 - a**2))  # slope over r
    outside = rim * np.exp(-np.maximum(r - a, 0.0) / skirt.length) / np.maximum(r, 1e-9)
    share = (r < a).astype(np.float64) if blur == 0 else ndtr((a - r) / blur)  # that is inside
    steepness = share * inside + (1.0 - share) * outside
    return np.stack([-steepness * dx, -steepness * dy], axis=-1)


def rim_slope(circle: ContactCircle, ball: float) -> float:
    """The steepest slope of the dent [-]."""
    return circle.radius / float(np.sqrt(ball**2 - circle.radius**2))
