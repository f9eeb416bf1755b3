"""What counts as unphysical after a launch of kernels, and the error that says what, where and what to do."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from tacsim.interface import Pose
from tacsim.physics.exec import layout
from tacsim.physics.failure import diagnosis
from tacsim.physics.snapshot import State, copies

SMALLEST_VOLUME_RATIO = 0.05  # det F of a gel element, elastic volume ratio of a particle; below, it counts as inverted
SMALLEST_STEP_VOLUME = 0.1  # det(I + dt C) of a particle in one substep
FASTEST = 0.5  # speed of a particle or gel node / wave speed
LARGEST_COURANT = 1.0  # time step / time of the pressure wave through the smallest cell or most squeezed element
LARGEST_GRID = 20_000_000  # nodes of one environment; 80 bytes each on a CPU, in four copies

ADVICE = "move less far or slower, or use a finer preset"
NO_ROOM = "restore a snapshot in which its particles are together; worlds of a smaller batch have more room each"


@dataclass(frozen=True, slots=True, eq=False)
class Place:
    """Where in a motion a launch is, in words, and the poses of the driven frames at its end."""

    words: str
    poses: Mapping[str, Pose]

    def __str__(self) -> str:
        at = (f"{name} at {diagnosis.millimetres(1e3 * pose.position)} mm" for name, pose in self.poses.items())
        return ", ".join([self.words, *at])


class SimulationDiverged(RuntimeError):
    """No step size gave a finite, physical state. The world is as it was before the motion.

    good, failed: arrays at the start and at the end of the launch that went wrong, where they are known; health: what
    its kernels saw. `dump`: the folder that `tacsim debug` reads, if one was written.
    """

    def __init__(self, cause: str, where: str, advice: str = ADVICE, *, retry: bool = True) -> None:
        """retry: a smaller time step might do better."""
        super().__init__(cause, where, advice)
        self.retry = retry
        self.cause, self.where, self.advice = cause, where, advice
        self.place = ""  # of the worst entry: which particle or node, where [mm]
        self.quantity: diagnosis.Quantity = "not finite"  # by which the worst entry is found
        self.good: State = {}
        self.failed: State = {}
        self.poses: Mapping[str, Pose] = {}  # of the driven frames at the end of that launch
        self.health: Health | None = None
        self.refine = 1  # the step was cut into so many at the last attempt
        self.dump: Path | None = None
        self.no_dump = ""  # why there is none

    def of_launch(self, good: State, failed: State, where: Place) -> Self:
        """Keeps what a dump wants of the launch that went wrong: the arrays before and after it, and the poses then."""
        self.good, self.failed, self.poses = good, copies(failed), where.poses
        return self

    def __str__(self) -> str:
        steps = f"even with 1/{self.refine} of the time step; " if self.refine > 1 else ""
        place = f" at {self.place}" if self.place else ""
        text = f"simulation diverged: {self.cause}{place}; {self.where}; {steps}{self.advice}"
        if self.dump is not None:
            return f"{text}; to look into it: tacsim debug {self.dump}"
        return f"{text}; {self.no_dump}" if self.no_dump else text


@dataclass(frozen=True)
class Health:
    """What the kernels saw in one launch."""

    smallest_volume_ratio: float  # gel elements
    off_grid: int  # particle substeps outside the grid
    smallest_step_volume: float  # particles
    fastest: float  # particles
    capped: int  # contact overlaps cut to the largest allowed
    overlap: float  # of the last substep [mm]
    courant: float = 0.0  # time step / time of the pressure wave through the most squeezed element or grid cell [-]

    @staticmethod
    def clear(partial: NDArray[np.float32]) -> None:
        """Prepares the parts' numbers (..., PARTS, NUMBERS) for a launch; sums that outlive it stay."""
        partial[..., [layout.SMALLEST_VOLUME, layout.SMALLEST_STEP_VOLUME]] = 1e9
        partial[..., [layout.OFF_GRID, layout.FASTEST, layout.CAPPED, layout.OVERLAP]] = 0.0

    @classmethod
    def read(cls, partial: NDArray[np.float32], courant: float = 0.0) -> Health:
        """Of all parts of one environment (PARTS, NUMBERS); NaN in any of them stays NaN."""
        least, most, total = partial.min(axis=0), partial.max(axis=0), partial.sum(axis=0)
        counts = [int(total[i]) if math.isfinite(total[i]) else -1 for i in (layout.OFF_GRID, layout.CAPPED)]
        return cls(
            float(least[layout.SMALLEST_VOLUME]), counts[0], float(least[layout.SMALLEST_STEP_VOLUME]),
            float(most[layout.FASTEST]), counts[1], float(most[layout.OVERLAP]), courant,
        )  # fmt: skip

    def complaint(self) -> tuple[str, diagnosis.Quantity] | None:
        """What is unphysical, and the quantity that shows where; None when all is well."""
        if not self.smallest_volume_ratio > SMALLEST_VOLUME_RATIO:
            return f"a gel element is inverted or crushed (volume ratio {self.smallest_volume_ratio:.3g})", "node speed"
        if not self.smallest_step_volume > SMALLEST_STEP_VOLUME:
            return f"a particle lost its volume in one substep (ratio {self.smallest_step_volume:.3g})", "speed"
        if not self.fastest < FASTEST:
            return f"a particle moves at {self.fastest:.3g} of the wave speed (limit {FASTEST})", "speed"
        if self.off_grid:
            return f"particles left the grid ({self.off_grid} particle substeps)", "speed"
        if self.courant > LARGEST_COURANT:
            words = f"the time step is {self.courant:.3g} of what the pressure wave takes through the most squeezed"
            return f"{words} element or grid cell (limit {LARGEST_COURANT:g})", "element length"
        return None


def judged(arrays: State, good: State, health: Health, where: Place) -> Health:
    """`health` of a launch that changed `arrays` from `good` to what they are.

    Raises SimulationDiverged if that is unphysical; tacsim.physics.motion.retry rolls back and tries again.
    """
    complaint = health.complaint() or _complaint(arrays)
    if complaint is None:
        return health
    words, quantity = complaint
    failure = SimulationDiverged(words, str(where)).of_launch(good, arrays, where)
    failure.quantity, failure.health = quantity, health
    raise failure


def _complaint(arrays: State) -> tuple[str, diagnosis.Quantity] | None:
    """What the kernels don't watch: numbers that are not finite, gel nodes too fast, crushed particles."""
    found = diagnosis.not_finite(arrays)
    if found is not None:
        return found, "not finite"
    speed = diagnosis.fastest_node(arrays)
    if speed > FASTEST:
        return f"a gel node moves at {speed:.3g} of the wave speed (limit {FASTEST})", "node speed"
    volumes = diagnosis.particle_volumes(arrays)
    if volumes is not None and not volumes.min() > SMALLEST_VOLUME_RATIO:
        return f"a particle is crushed (elastic volume ratio {volumes.min():.3g})", "particle volume"
    return None


def require_room(low: NDArray[Any], high: NDArray[Any], cell: float, where: Place, most: int = LARGEST_GRID) -> None:
    """Raises SimulationDiverged for a grid from `low` to `high` (3,) [mm] with more nodes than `most`, what there is
    memory for, or LARGEST_GRID."""
    most = min(most, LARGEST_GRID)
    counts = (np.asarray(high, np.float64) - np.asarray(low, np.float64)) / cell + 1
    if not float(np.prod(counts)) <= most:
        size = " x ".join(f"{length:.4g}" for length in (counts - 1) * cell)
        raise SimulationDiverged(
            f"particles spread over {size} mm, which needs a grid of {np.prod(counts):.3g} nodes (limit {most:.3g})",
            str(where),
            NO_ROOM,
        )
