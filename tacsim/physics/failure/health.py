"""What counts as unphysical after a launch of kernels, and the error that says what, where and what to do."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tacsim.interface import Pose
from tacsim.physics.exec import layout
from tacsim.physics.failure import diagnosis
from tacsim.physics.failure.tuning import MAX_COURANT, MAX_GRID_NODES, MAX_SPEED, MIN_STEP_VOLUME
from tacsim.physics.gel.tuning import MIN_VOLUME_RATIO
from tacsim.physics.snapshot import State, copies, gel_arrays

ADVICE = "move less far or slower"
TORN = (
    "move less far, or press with rounder edges (edge_radius of an indenter); a finer mesh follows a sharp edge closer "
    "and tears sooner"
)
NO_ROOM = "restore a snapshot in which its particles are together; worlds of a smaller batch have more room each"


@dataclass(frozen=True, slots=True, eq=False)
class LaunchSpan:
    """Which part of a motion a launch is, in words, and the poses of the driven frames at its end."""

    words: str
    poses: Mapping[str, Pose] = field(default_factory=dict)

    def __str__(self) -> str:
        at = (f"{name} at {diagnosis.millimetres(1e3 * pose.position)} mm" for name, pose in self.poses.items())
        return ", ".join([self.words, *at])


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
    sound: bool = False  # all numbers known to be finite, gel nodes slow and particles uncrushed

    @staticmethod
    def clear(partial: NDArray[np.float32]) -> None:
        """Prepares the parts' numbers (..., PARTS, NUMBERS) for a launch; sums that outlive it stay."""
        partial[..., [layout.SMALLEST_VOLUME, layout.SMALLEST_STEP_VOLUME]] = 1e9
        partial[..., [layout.OFF_GRID, layout.FASTEST, layout.CAPPED, layout.OVERLAP, layout.GREEN]] = 0.0

    @classmethod
    def read(cls, partial: NDArray[np.float32], courant: float = 0.0, *, sound: bool = False) -> Health:
        """Of all parts of one environment (PARTS, NUMBERS); NaN in any of them stays NaN."""
        least, most, total = partial.min(axis=0), partial.max(axis=0), partial.sum(axis=0, dtype=np.float64)
        counts = [int(total[i]) if math.isfinite(total[i]) else -1 for i in (layout.OFF_GRID, layout.CAPPED)]
        return cls(
            float(least[layout.SMALLEST_VOLUME]), counts[0], float(least[layout.SMALLEST_STEP_VOLUME]),
            float(most[layout.FASTEST]), counts[1], float(most[layout.OVERLAP]), courant, sound,
        )  # fmt: skip


class SimulationDiverged(RuntimeError):
    """No step size gave a finite, physical state. The world is as it was before the motion."""

    def __init__(
        self, cause: str, where: LaunchSpan, advice: str = ADVICE, *, retry: bool = True,
        quantity: diagnosis.Quantity = "not finite", good: State | None = None, failed: State | None = None,
        health: Health | None = None,
    ) -> None:  # fmt: skip
        """retry: a smaller time step might do better; quantity: that by which the worst particle or node is found.

        good, failed: the world's arrays before and after the launch that went wrong, and what its kernels saw, where
        there was a launch.
        """
        super().__init__(cause, where, advice)
        self.cause, self.where, self.advice, self.retry, self.quantity = cause, str(where), advice, retry, quantity
        self.poses = where.poses if failed else {}
        self.good, self.failed, self.health = dict(good or {}), copies(failed or {}), health
        self.possible = ""  # how far the motion can go, in words, where that is known: said first
        self.depth: float | None = None  # that an indenter had reached in the untouched gel, of a press that failed [m]
        self.place = ""  # of the worst entry: which particle or node, where [mm]
        self.refine = 1  # the step was cut into so many at the last attempt
        self.dump: Path | None = None  # the folder that `tacsim debug` reads, if one was written
        self.no_dump = ""  # why there is none

    def __str__(self) -> str:
        at = f" at {self.place}" if self.place else ""
        steps = [f"even with 1/{self.refine} of the time step"] if self.refine > 1 else []
        dump = [self.no_dump] if self.no_dump else []
        if self.dump is not None:
            dump = [f"to look into it: tacsim debug {self.dump}"]
        possible = [self.possible] if self.possible else []
        cause = f"simulation diverged: {self.cause}{at}"
        return "; ".join([*possible, cause, self.where, *steps, self.advice, *dump])


def check_launch(
    arrays: Callable[[], State], good: State, health: Health, where: Callable[[], LaunchSpan]
) -> Health:  # fmt: skip
    """`health` of a launch that changed the world's `arrays` from `good` to what they are; where: which part of the
    motion it was, asked only for a failure.

    Raises SimulationDiverged if that is unphysical; the world rolls back and tries again.
    """
    fault = _fault(arrays, health)
    if fault is not None:
        words, quantity = fault
        advice = TORN if quantity in ("node speed", "element length") else ADVICE
        raise SimulationDiverged(words, where(), advice, quantity=quantity, good=good, failed=arrays(), health=health)
    return health


def _fault(look: Callable[[], State], health: Health) -> tuple[str, diagnosis.Quantity] | None:
    """What is unphysical, and the quantity that shows where; None when all is well."""
    if not health.smallest_volume_ratio > MIN_VOLUME_RATIO:
        ratio = health.smallest_volume_ratio
        told = f"volume ratio {ratio:.3g}" if ratio > -1e3 else "torn without bound"
        return f"a gel element is inverted or crushed ({told})", "node speed"
    if not health.smallest_step_volume > MIN_STEP_VOLUME:
        ratio = health.smallest_step_volume
        return f"a particle lost its volume in one substep (ratio {ratio:.3g})", "particle speed"
    if not health.fastest < MAX_SPEED:
        return f"a particle moves at {health.fastest:.3g} of the wave speed (limit {MAX_SPEED})", "particle speed"
    if health.off_grid:
        return f"particles left the grid ({health.off_grid} particle substeps)", "particle speed"
    if health.courant > MAX_COURANT:
        words = f"the time step is {health.courant:.3g} of what the pressure wave takes through the most squeezed"
        return f"{words} element or grid cell (limit {MAX_COURANT:g})", "element length"
    if health.sound:
        return None
    arrays = look()
    entry = diagnosis.not_finite(arrays)
    if entry is not None:
        return entry, "not finite"
    node = max((float(np.abs(v).max()) for v in gel_arrays(arrays, "gel_velocity").values()), default=0.0)
    if node > MAX_SPEED:
        return f"a gel node moves at {node:.3g} of the wave speed (limit {MAX_SPEED})", "node speed"
    if diagnosis.clearly_uncrushed(arrays, MIN_VOLUME_RATIO):
        return None
    volumes = diagnosis.particle_volumes(arrays)
    if volumes is not None and not volumes.min() > MIN_VOLUME_RATIO:
        return f"a particle is crushed (elastic volume ratio {volumes.min():.3g})", "particle volume"
    return None


def require_room(
    low: NDArray[Any], high: NDArray[Any], cell: float, where: Callable[[], LaunchSpan], most: int = MAX_GRID_NODES
) -> None:
    """Raises SimulationDiverged for a grid from `low` to `high` (3,) [mm] with more nodes than `most`, what there is
    memory for, or MAX_GRID_NODES."""
    most = min(most, MAX_GRID_NODES)
    counts = (np.asarray(high, np.float64) - np.asarray(low, np.float64)) / cell + 1
    if not float(np.prod(counts)) <= most:
        size = " x ".join(f"{length:.4g}" for length in (counts - 1) * cell)
        needed = f"a grid of {np.prod(counts):.3g} nodes (limit {most:.3g})"
        raise SimulationDiverged(f"particles spread over {size} mm, which needs {needed}", where(), NO_ROOM)
