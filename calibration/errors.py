"""The errors of calibration: each says what cannot be used, why, and what to do."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


class CalibrationError(ValueError):
    """A calibration, or what one is to be made from, cannot be used."""


class BadFrames(CalibrationError):
    """Frames that cannot be calibrated from, or compared."""


@contextmanager
def error_context(part: str) -> Iterator[None]:
    """Puts the name of a part of a rig before the message of a `CalibrationError`."""
    try:
        yield
    except CalibrationError as error:
        raise type(error)(f"{part}: {error}") from error
