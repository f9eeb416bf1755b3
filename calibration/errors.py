"""What all errors of calibrating have in common: somebody must give something else."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


class Unusable(ValueError):
    """A calibration, or what one is to be made from, cannot be used: which, why, and what to do."""


@contextmanager
def naming(part: str) -> Iterator[None]:
    """Makes an `Unusable` say which part of a rig it speaks of."""
    try:
        yield
    except Unusable as error:
        raise type(error)(f"{part}: {error}") from error
