"""What all errors of calibrating have in common: somebody must give something else."""

from __future__ import annotations


class Unusable(ValueError):
    """A calibration, or what one is to be made from, cannot be used: which, why, and what to do."""
