"""What a linear system of least squares leaves open of its unknowns."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tacsim.interface import FloatArray

HELD_DEVIATION = (
    0.5  # standard deviation of a free number that is held where it was, as far as the others' intervals go
)
UNKNOWN_DEVIATION = 100.0  # standard deviation of a free number of which nothing is known


def covariance_of(
    system: FloatArray, sigma: FloatArray, priors: FloatArray, held: NDArray[np.bool_], spread: float = HELD_DEVIATION
) -> FloatArray:
    """(n, n) of all unknowns, from the system (m, n), whose last columns have `priors`. Parameters that are held have
    no variance themselves; `spread` is what they may be off, as far as the others go."""
    p, n = len(held), system.shape[1]
    free = np.concatenate([~held, np.ones(n - p, np.bool_)])
    known = np.concatenate([np.full(p, UNKNOWN_DEVIATION), priors])[free]
    rows = system / sigma[:, None]
    scaled = rows[:, free] * known  # by what is known beforehand: then the information is never singular
    found = np.zeros((n, n))
    found[np.ix_(free, free)] = np.linalg.inv(scaled.T @ scaled + np.eye(len(known))) * np.outer(known, known)
    for index in np.flatnonzero(held):
        moved = found @ (rows.T @ rows[:, index])
        found = found + spread**2 * np.outer(moved, moved)
    return found
