"""How much of the grain in the untouched picture is on the gel's skin, and moves with it.

Fine detail of that picture is seen again in a press, in the same place, as far as it stands still there: so do the
camera's own pattern and dust on its lens. Of the skin far from the contact does, too; near it the skin has been pulled
along, by a few pixels, and does not. What is seen again far off and no longer nearby is the skin's share. The rest is
the noise of that one picture.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from calibration.light.press import BallPress
from tacsim.optics.skin import high_pass

NEAR_RADII = (1.25, 2.2)  # where the skin has moved, and the light changes little [contact radii]
FAR_RADII = (4.0, 8.0)  # where it has hardly, in about the same light
MIN_PIXELS = 1000  # of either part of a press
MIN_PRESSES = 4
MIN_SHARE = 0.2  # a smaller one is not told from none; 0.07 at most is found on three real sensors without any
MIN_STANDARD_ERRORS = 3.0  # standard errors over presses that the share must be from none


def measure_skin(presses: Sequence[BallPress], reference: NDArray[np.uint8], pixel_pitch: float) -> float | None:
    """Share of the fine part of `reference` (H, W, 3) that moves with the gel, 0 to 1; None where the presses do not
    tell that there is any. `pixel_pitch` [m].

    It is low rather than high: skin that has moved by less than its grain counts as what stands still.
    """
    mean = reference.mean(axis=(0, 1))
    grain = high_pass(reference.astype(np.float32), pixel_pitch)
    shares = []
    for press in presses:
        change = high_pass((press.change * mean).astype(np.float32), pixel_pitch)
        lit, distance = press.lit.all(axis=2), press.distance() / press.circle.radius
        parts = [lit & (distance > least) & (distance < most) for least, most in (FAR_RADII, NEAR_RADII)]
        if min(int(part.sum()) for part in parts) >= MIN_PIXELS:
            far, near = (1.0 + float((change[part] * grain[part]).sum() / (grain[part] ** 2).sum()) for part in parts)
            shares.append(far - max(near, 0.0))
    if len(shares) < MIN_PRESSES:
        return None
    share, error = float(np.median(shares)), float(np.std(shares, ddof=1)) / len(shares) ** 0.5
    return min(share, 1.0) if share > max(MIN_SHARE, MIN_STANDARD_ERRORS * error) else None
