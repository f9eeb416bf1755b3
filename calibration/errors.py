"""The errors of calibration. Each message says what cannot be used, the reason, and what to do."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


class CalibrationError(ValueError):
    """A calibration, or its data, cannot be used."""


class BadFrames(CalibrationError):
    """Frames cannot be used for a calibration or a comparison."""


@contextmanager
def error_context(part: str) -> Iterator[None]:
    """Puts the name of a part of a rig before the message of a `CalibrationError`."""
    try:
        yield
    except CalibrationError as error:
        raise type(error)(f"{part}: {error}") from error
