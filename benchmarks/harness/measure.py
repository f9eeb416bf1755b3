"""Time and memory of one case, inside the process that runs it."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

import numpy as np

T = TypeVar("T")
BUDGET = 1.0  # [s] total time of the repetitions, after which there is no other ...
MIN_REPETITIONS = 3  # ... except that a spread needs this number, ...
LONG_REPETITION = 5.0  # [s] ... unless one repetition takes this time


@dataclass(frozen=True, slots=True)
class Timing:
    """Timed repetitions of one thing [s]."""

    samples: tuple[float, ...]  # wall
    processor: float  # median time of all threads together

    @property
    def median(self) -> float:
        return float(np.median(self.samples))

    @property
    def spread(self) -> float | None:
        """Interquartile range; None with fewer than three repetitions."""
        if len(self.samples) < 3:
            return None
        low, high = np.percentile(self.samples, [25, 75])
        return float(high - low)


@dataclass(frozen=True, slots=True)
class Measurement:
    """Result of a case: a row of the report without the names of the case."""

    timing: Timing
    error: float
    error_unit: str
    against: str
    variant: str = ""
    substeps: int | None = None
    figures: dict[str, float] = field(default_factory=dict)
    note: str = ""


def timed(run: Callable[[], T], repeat: int, warm: Callable[[], object] | None = None) -> tuple[Timing, T]:
    """Times `run` up to `repeat` times, and at least once; returns the times and the result of the last run.

    warm: runs first, without timing, to compile kernels or load them from their cache; default: `run` itself.
    """
    (run if warm is None else warm)()
    samples: list[float] = []
    processor: list[float] = []
    while not samples or (len(samples) < repeat and _worth_another(samples)):
        cpu, wall = time.process_time(), time.perf_counter()
        result = run()
        samples.append(time.perf_counter() - wall)
        processor.append(time.process_time() - cpu)
    return Timing(tuple(samples), float(np.median(processor))), result


def once(run: Callable[[], T]) -> tuple[Timing, T]:
    """The time of a single `run`, which may include loading kernels, and its result."""
    wall, cpu = time.perf_counter(), time.process_time()
    result = run()
    return Timing((time.perf_counter() - wall,), time.process_time() - cpu), result


def _worth_another(samples: Sequence[float]) -> bool:
    return sum(samples) < BUDGET or (len(samples) < MIN_REPETITIONS and max(samples) < LONG_REPETITION)


def step_cost(timing: Timing, substeps: int, count: int, what: str) -> dict[str, float]:
    """Time of a substep [ns] divided by the number of particles or elements; it includes all parts of a substep."""
    each = 1e9 / (substeps * count)
    return {f"wall_per_{what}_substep_ns": timing.median * each, f"cpu_per_{what}_substep_ns": timing.processor * each}


def reset_peak_memory() -> None:
    """Resets `peak_memory` to the present memory of this process. Has no effect on systems other than Linux."""
    references = Path("/proc/self/clear_refs")
    if references.exists():
        references.write_text("5", encoding="ascii")  # proc_pid_clear_refs(5): resets the peak resident set size


def peak_memory() -> float:
    """The largest memory of this process so far [MB].

    On Linux from /proc, because getrusage includes the memory of the parent process at the start of this one.
    """
    status = Path("/proc/self/status")
    if status.exists():
        for line in status.read_text(encoding="ascii", errors="replace").splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024 / 1e6
    import resource

    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6
