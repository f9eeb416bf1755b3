"""Checks of the state after a launch of kernels, and the error with cause, place and advice."""

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
from tacsim.physics.snapshot import State, copy_arrays, gel_arrays

ADVICE = "move less far or slower"
SEPARATION_ADVICE = (
    "move less far, or press with rounder edges (edge_radius of an indenter); a finer mesh follows a sharp edge closer "
    "and tears at a smaller depth"
)
MEMORY_ADVICE = "restore a snapshot in which its particles are together; in a smaller batch each world has more memory"


@dataclass(frozen=True, slots=True, eq=False)
class LaunchSpan:
    """Text that names the part of a motion, and the poses of the driven frames at its end."""

    words: str
    poses: Mapping[str, Pose] = field(default_factory=dict)

    def __str__(self) -> str:
        at = (f"{name} at {diagnosis.format_millimetres(1e3 * pose.position)} mm" for name, pose in self.poses.items())
        return ", ".join([self.words, *at])


@dataclass(frozen=True)
class Health:
    """Results of the kernels in one launch."""

    smallest_volume_ratio: float  # gel elements
    off_grid: int  # particle substeps outside the grid
    smallest_step_volume: float  # particles
    fastest: float  # particles
    capped: int  # number of contact overlaps that were limited
    overlap: float  # of the last substep [mm]
    courant: float = 0.0  # time step / time of the pressure wave through the most compressed element or grid cell [-]
    is_healthy: bool = False  # all numbers are finite, gel nodes are slow enough and no particle is crushed

    @staticmethod
    def clear(partial: NDArray[np.float32]) -> None:
        """Prepares the parts' numbers (..., PARTS, NUMBERS) for a launch; sums over several launches stay."""
        partial[..., [layout.SMALLEST_VOLUME, layout.SMALLEST_STEP_VOLUME]] = 1e9
        partial[
            ..., [layout.OFF_GRID, layout.PEAK_SPEED, layout.CAPPED, layout.OVERLAP, layout.SQUARED_GREEN_STRAIN]
        ] = 0.0
        partial[..., layout.FORCE_SUM : layout.FORCE_SUM + 6] = 0.0

    @classmethod
    def read(cls, partial: NDArray[np.float32], courant: float = 0.0, *, is_healthy: bool = False) -> Health:
        """Combines all parts of one environment (PARTS, NUMBERS); NaN in one of them gives NaN."""
        least, most, total = partial.min(axis=0), partial.max(axis=0), partial.sum(axis=0, dtype=np.float64)
        counts = [int(total[i]) if math.isfinite(total[i]) else -1 for i in (layout.OFF_GRID, layout.CAPPED)]
        return cls(
            float(least[layout.SMALLEST_VOLUME]), counts[0], float(least[layout.SMALLEST_STEP_VOLUME]),
            float(most[layout.PEAK_SPEED]), counts[1], float(most[layout.OVERLAP]), courant, is_healthy,
        )  # fmt: skip


class SimulationDiverged(RuntimeError):
    """No step size gave a finite, physical state. The world is in its state before the motion."""

    def __init__(
        self, cause: str, where: LaunchSpan, advice: str = ADVICE, *, retry: bool = True,
        quantity: diagnosis.Quantity = "not finite", good: State | None = None, failed: State | None = None,
        health: Health | None = None,
    ) -> None:  # fmt: skip
        """retry: a smaller time step may succeed; quantity: finds the worst particle or node.

        good, failed, health: the world's arrays before and after the launch that failed, and the results of its
        kernels, if there was a launch.
        """
        super().__init__(cause, where, advice)
        self.cause, self.where, self.advice, self.retry, self.quantity = cause, str(where), advice, retry, quantity
        self.poses = where.poses if failed else {}
        self.good, self.failed, self.health = dict(good or {}), copy_arrays(failed or {}), health
        self.possible = ""  # text with the possible length of the motion, if known: printed first
        self.depth: float | None = None  # that an indenter had reached in the untouched gel, of a press that failed [m]
        self.place = ""  # of the worst entry: which particle or node, where [mm]
        self.environment: int | None = None  # which of a batch, where one step advances all
        self.refine = 1  # substeps for one nominal substep at the last attempt
        self.dump: Path | None = None  # the folder that `tacsim debug` reads, if one was written
        self.no_dump = ""  # reason if there is none

    def __str__(self) -> str:
        at = f" at {self.place}" if self.place else ""
        steps = [f"even with 1/{self.refine} of the time step"] if self.refine > 1 else []
        dump = [self.no_dump] if self.no_dump else []
        if self.dump is not None:
            dump = [f"to inspect it: tacsim debug {self.dump}"]
        possible = [self.possible] if self.possible else []
        cause = f"simulation diverged: {self.cause}{at}"
        return "; ".join([*possible, cause, self.where, *steps, self.advice, *dump])


def check_launch(
    arrays: Callable[[], State], good: State, health: Health, where: Callable[[], LaunchSpan]
) -> Health:  # fmt: skip
    """Returns `health`. arrays: returns the world's arrays after the launch; good: the arrays before it; where: returns
    the part of the motion, called only after a failure.

    Raises SimulationDiverged if the state is unphysical; the world then restores its state and tries again.
    """
    fault = _find_fault(arrays, health)
    if fault is not None:
        words, quantity = fault
        advice = SEPARATION_ADVICE if quantity in ("node speed", "element length") else ADVICE
        raise SimulationDiverged(words, where(), advice, quantity=quantity, good=good, failed=arrays(), health=health)
    return health


def _find_fault(read_arrays: Callable[[], State], health: Health) -> tuple[str, diagnosis.Quantity] | None:
    """Text with the fault, and the quantity that shows its place; None for a physical state."""
    if not health.smallest_volume_ratio > MIN_VOLUME_RATIO:
        ratio = health.smallest_volume_ratio
        description = f"volume ratio {ratio:.3g}" if ratio > -1e3 else "torn without bound"
        return f"a gel element is inverted or crushed ({description})", "node speed"
    if not health.smallest_step_volume > MIN_STEP_VOLUME:
        ratio = health.smallest_step_volume
        return f"a particle lost its volume in one substep (ratio {ratio:.3g})", "particle speed"
    if not health.fastest < MAX_SPEED:
        return f"a particle moves at {health.fastest:.3g} of the wave speed (limit {MAX_SPEED})", "particle speed"
    if health.off_grid:
        return f"particles left the grid ({health.off_grid} particle substeps)", "particle speed"
    if health.courant > MAX_COURANT:
        words = f"the time step is {health.courant:.3g} of the pressure wave's time through the most compressed"
        return f"{words} element or grid cell (limit {MAX_COURANT:g})", "element length"
    if health.is_healthy:
        return None
    arrays = read_arrays()
    entry = diagnosis.describe_non_finite(arrays)
    if entry is not None:
        return entry, "not finite"
    node = max((float(np.abs(v).max()) for v in gel_arrays(arrays, "gel_velocity").values()), default=0.0)
    if node > MAX_SPEED:
        return f"a gel node moves at {node:.3g} of the wave speed (limit {MAX_SPEED})", "node speed"
    if diagnosis.volumes_exceed_twice(arrays, MIN_VOLUME_RATIO):
        return None
    volumes = diagnosis.particle_volumes(arrays)
    if volumes is not None and not volumes.min() > MIN_VOLUME_RATIO:
        return f"a particle is crushed (elastic volume ratio {volumes.min():.3g})", "particle volume"
    return None


def require_grid_memory(
    low: NDArray[Any], high: NDArray[Any], cell: float, where: Callable[[], LaunchSpan], max_nodes: int = MAX_GRID_NODES
) -> None:
    """Raises SimulationDiverged for a grid from `low` to `high` (3,) [mm] with more nodes than `max_nodes`, the limit
    of the memory, or MAX_GRID_NODES."""
    max_nodes = min(max_nodes, MAX_GRID_NODES)
    counts = (np.asarray(high, np.float64) - np.asarray(low, np.float64)) / cell + 1
    if not float(np.prod(counts)) <= max_nodes:
        size = " x ".join(f"{length:.4g}" for length in (counts - 1) * cell)
        needed = f"a grid of {np.prod(counts):.3g} nodes (limit {max_nodes:.3g})"
        raise SimulationDiverged(f"particles spread over {size} mm, which needs {needed}", where(), MEMORY_ADVICE)
