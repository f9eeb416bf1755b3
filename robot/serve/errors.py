"""Error of a request that is not possible now."""

from __future__ import annotations


class Refused(RuntimeError):
    """What the operator asked for is not possible now; the text says why."""


def describe(failure: BaseException) -> str:
    """One line for the page about an error: its text, with its type where it is not one of our own."""
    own = type(failure).__module__.partition(".")[0] in ("tacsim", "calibration", "robot")
    return str(failure) if own and str(failure) else f"{type(failure).__name__}: {failure}"
