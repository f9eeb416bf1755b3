"""Contact: thresholds of its mask, one number for its amount, and the approach until touch. NumPy only."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from tacsim.interface import Mask, TactileObservation


def contact_signal(observation: TactileObservation) -> float:
    """Mean of |I - I0| / mean(I0) over valid pixels and channels [-]: 0 without contact, grows with the press.

    Reads the 8-bit canonical image, so changes beyond a full mean(I0) saturate at 1. Raises ValueError when no pixel is
    valid or when the image is no whole multiple of the `valid` mask.
    """
    valid = pixel_mask(observation.valid, observation.image.shape[:2])
    if not valid.any():
        raise ValueError("contact_signal: no valid pixel; does the canonical grid overlap the gel?")
    return float(np.abs(observation.image[valid].astype(np.int16) - 128).mean() / 128.0)


def pixel_mask(cells: Mask, shape: tuple[int, int]) -> Mask:
    """A mask over grid cells (h, w), spread to the pixels (H, W) of the canonical image. Raises ValueError if H, W are
    no whole multiple of h, w."""
    scale = shape[0] // cells.shape[0]
    if scale < 1 or shape != (cells.shape[0] * scale, cells.shape[1] * scale):
        raise ValueError(f"image of {shape} pixels is no whole multiple of the canonical grid of {cells.shape} cells")
    return np.repeat(np.repeat(cells, scale, axis=0), scale, axis=1)


class NoTouch(RuntimeError):
    """An approach met nothing, or found no gentle contact."""


def approach(
    touches: Callable[[], bool], advance: Callable[[float], None], step: float, longest: float, advice: str
) -> float:
    """Moves ahead in equal steps until something is touched. Returns the distance travelled [m].

    For rigs that cannot undo a motion; a simulated world can (tacsim.sim.reset.approach_force).

    Args:
        touches: whether the gels touch by now; asked before every step.
        advance: goes this far [m] from where the approach began, and returns once the gels were observed there.
        step: between two contact checks [m].
        longest: the approach ends here [m].
        advice: what a person may do about it when nothing was touched.

    Raises NoTouch at the end of the approach, and what `touches` and `advance` raise.
    """
    distance = 0.0
    while not touches():
        distance += step
        if distance > longest:
            raise NoTouch(f"no touch after an approach of {1e3 * longest:.3g} mm; {advice}")
        advance(distance)
    return distance
