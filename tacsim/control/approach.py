"""Approaches until touch, on any rig."""

from __future__ import annotations

from collections.abc import Callable


class NoTouch(RuntimeError):
    """An approach met nothing, or found no gentle contact."""


def approach(
    touches: Callable[[], bool], advance: Callable[[float], None], step: float, max_distance: float, advice: str
) -> float:
    """Moves ahead in equal steps until something is touched. Returns the distance travelled [m].

    For rigs that cannot undo a motion; a simulated world can (tacsim.sim.reset.approach_force).

    Args:
        touches: whether the gels touch by now; asked before every step.
        advance: goes this far [m] from where the approach began, and returns once the gels were observed there.
        step: between two contact checks [m].
        max_distance: the approach ends here [m].
        advice: what a person may do about it when nothing was touched.

    Raises NoTouch at the end of the approach, and what `touches` and `advance` raise.
    """
    distance = 0.0
    while not touches():
        distance += step
        if distance > max_distance:
            raise NoTouch(f"no touch after an approach of {1e3 * max_distance:.3g} mm; {advice}")
        advance(distance)
    return distance
