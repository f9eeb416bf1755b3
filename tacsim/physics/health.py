"""When a simulation leaves what is physical: what kernels watch, how a step is retried, and the error that says so."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

SMALLEST_VOLUME_RATIO = 0.05  # det F of a gel element; below, it counts as inverted
SMALLEST_STEP_VOLUME = 0.1  # det(I + dt C) of a particle in one substep
FASTEST = 0.5  # particle speed / wave speed
RETRIES = 4  # each halves the time step


class SimulationDiverged(RuntimeError):
    """No step size gave a finite, physical state. The world was rolled back to its last good state."""

    def __init__(self, cause: str, where: str, advice: str) -> None:
        super().__init__(f"simulation diverged: {cause}; {where}; {advice}")
        self.cause, self.where, self.advice = cause, where, advice


@dataclass(frozen=True)
class Health:
    """What the kernels saw in one launch, and the array they write it to."""

    smallest_volume_ratio: float  # gel elements
    off_grid: int  # particle substeps outside the grid
    smallest_step_volume: float  # particles
    fastest: float  # particles
    capped: int  # contact overlaps cut to the largest allowed
    overlap: float  # of the last substep [mm]

    @staticmethod
    def array() -> NDArray[np.float32]:
        return np.array([1e9, 0, 1e9, 0, 0, 0], np.float32)

    @classmethod
    def read(cls, a: NDArray[np.float32]) -> Health:
        return cls(float(a[0]), int(a[1]), float(a[2]), float(a[3]), int(a[4]), float(a[5]))

    def complaint(self) -> str | None:
        """What is unphysical, for a person; None when all is well."""
        if not self.smallest_volume_ratio > SMALLEST_VOLUME_RATIO:
            return f"a gel element is inverted or crushed (volume ratio {self.smallest_volume_ratio:.3g})"
        if not self.smallest_step_volume > SMALLEST_STEP_VOLUME:
            return f"a particle lost its volume in one substep (ratio {self.smallest_step_volume:.3g})"
        if not self.fastest < FASTEST:
            return f"a particle moves at {self.fastest:.3g} of the wave speed (limit {FASTEST})"
        if self.off_grid:
            return f"particles left the grid ({self.off_grid} particle substeps)"
        return None


def attempt(
    arrays: Mapping[str, NDArray[np.float32]], launch: Callable[[int], Health], where: Callable[[], str]
) -> Health:
    """Runs `launch(refine)`; if the result is unphysical, restores `arrays` and retries with the step halved.

    Raises SimulationDiverged, with the arrays as they were, when the smallest step fails too.
    """
    complaint = ""
    saved = {name: a.copy() for name, a in arrays.items()}
    for retry in range(RETRIES + 1):
        health = launch(2**retry)
        complaint = health.complaint() or _not_finite(arrays) or ""
        if not complaint:
            return health
        for name, a in arrays.items():
            a[...] = saved[name]
    raise SimulationDiverged(
        complaint, where(), f"even with 1/{2**RETRIES} of the time step; move less far or slower, or use a finer preset"
    )


def require_finite(arrays: Mapping[str, NDArray[np.float32]]) -> None:
    """Raises SimulationDiverged when a state was already broken before a motion begins."""
    complaint = _not_finite(arrays)
    if complaint:
        raise SimulationDiverged(complaint, "before the motion began", "restore a snapshot, or make a new world")


def _not_finite(arrays: Mapping[str, NDArray[np.float32]]) -> str | None:
    for name, a in arrays.items():
        if not np.isfinite(a).all():
            index = np.argwhere(~np.isfinite(a))[0]
            return f"{name}{[int(i) for i in index]} is {a[tuple(index)]}"
    return None


def as_float32(arrays: Sequence[NDArray[np.float32]]) -> None:
    """Kernels read any dtype in silence: refuse what is not contiguous float32."""
    for a in arrays:
        if a.dtype != np.float32 or not a.flags.c_contiguous:
            raise TypeError(f"kernel array must be contiguous float32, got {a.dtype}, shape {a.shape}")
