"""Results of kernels that inspect a state on a device (survey_kernels.py), so that its arrays are not copied to the
host."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tacsim.physics.body.moments import Moments
from tacsim.physics.exec.layout import Layout
from tacsim.physics.failure.tuning import MAX_SPEED
from tacsim.physics.gel.tuning import MIN_VOLUME_RATIO

BLOCKS = 256  # of a body's particles, for their sums

# The numbers of one environment: float32
_numbers = Layout()
NOT_FINITE = _numbers.place()  # number of such entries
NODE_SPEED = _numbers.place()  # largest component
MIN_EDGE = _numbers.place(2)  # shortest edge of an element of gel 0, gel 1, minus its length at rest [mm]
CORNER = _numbers.place()  # smallest volume ratio at the elements' corners
TOP = _numbers.place(8)  # surface displacements of gel 0, gel 1: largest |x|, |y|, lowest z, highest z [mm]
SQUARED_VOLUME, LARGEST_SQUARED_VOLUME = _numbers.place(), _numbers.place()  # smallest, largest det b_e of a particle
LOW, HIGH = _numbers.place(3), _numbers.place(3)  # of the particles' reference positions: x, y, z [mm]
# Sums over the particles of d, r, x x^T and r r^T (xx, yy, zz, xy, xz, yz), d r^T (row by row): r reference position
# minus `base`, x position minus `base`, d = x - r
SUMS = _numbers.size
_sums = Layout()
MOVED, REFERENCE = _sums.place(3), _sums.place(3)
SECOND, REFERENCE_SECOND = _sums.place(6), _sums.place(6)
MOVED_REFERENCE = _sums.place(9)
MOMENTS = _sums.size
NUMBERS = SUMS + MOMENTS


@dataclass(frozen=True)
class Survey:
    """Results for one environment's state."""

    finite: bool  # all its numbers are finite
    is_healthy: (
        bool  # in addition, no gel node is too fast and no particle is crushed: see `tacsim.physics.failure.health`
    )
    min_edge_length: tuple[float, ...]  # of each gel, measured along the direction at rest [mm]
    smallest_corner: float  # volume ratio
    surface_bounds: NDArray[
        np.float32
    ]  # (gels, 4) largest |x|, |y|, lowest and highest z of the surfaces' displacements [mm]
    extents: NDArray[np.float32]  # (1, 2, 3) lowest and highest reference positions of the particles [mm]
    moments: Moments | None = None  # of a body
    volumes: tuple[float, float] = (1.0, 1.0)  # smallest and largest elastic volume ratio of its particles


def survey_of(
    numbers: NDArray[np.float32], spacings: Sequence[float], particles: int = 0, base: Any = 0.0
) -> Survey:  # fmt: skip
    """The survey from an environment's numbers (NUMBERS,) of the kernels; spacings: of its gels' nodes [mm]."""
    finite = not numbers[NOT_FINITE]
    is_healthy = bool(
        finite and numbers[NODE_SPEED] <= MAX_SPEED and numbers[SQUARED_VOLUME] > (2.0 * MIN_VOLUME_RATIO) ** 2
    )
    volumes = numbers[[SQUARED_VOLUME, LARGEST_SQUARED_VOLUME]]
    if not (particles and volumes.min() > 0.0):
        volumes = np.ones(2, np.float32)
    least, largest = (float(volume) for volume in np.sqrt(volumes))
    return Survey(
        finite, is_healthy, tuple(h + float(numbers[MIN_EDGE + g]) for g, h in enumerate(spacings)),
        float(numbers[CORNER]), numbers[TOP : TOP + 8].reshape(2, 4), numbers[LOW : LOW + 6].reshape(1, 2, 3),
        _moments(numbers[SUMS:].astype(np.float64), particles, np.asarray(base, np.float64)) if particles else None,
        (least, largest),
    )  # fmt: skip


def _moments(sums: NDArray[np.float64], particles: int, base: NDArray[np.float64]) -> Moments:
    moved, reference = sums[MOVED : MOVED + 3] / particles, sums[REFERENCE : REFERENCE + 3] / particles

    def second(first: int, mean: NDArray[np.float64]) -> NDArray[np.float64]:
        about_base: NDArray[np.float64] = sums[first + np.array([[0, 3, 4], [3, 1, 5], [4, 5, 2]])]
        return about_base - particles * np.outer(mean, mean)

    moved_reference = sums[MOVED_REFERENCE : MOVED_REFERENCE + 9].reshape(3, 3)
    return Moments(
        base + reference + moved, base + reference, second(SECOND, reference + moved),
        second(REFERENCE_SECOND, reference), moved_reference - particles * np.outer(moved, reference),
    )  # fmt: skip
