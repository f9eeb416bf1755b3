"""Threads of one environment: how the work of a launch is distributed.

A launch runs many substeps, since the start of a launch takes as long as a substep at preset draft. A substep has a few
stages; each stage has PARTS pieces of work, one for each part. The threads of a team claim pieces, first those of their
own parts, whose arrays are in the core's cache. A stage begins when the previous one is done. Threads wait for a thread
that the operating system has suspended only if it has claimed a piece. A thread that has waited for long leaves the
rest of the launch to the others (docs/decisions/0007). The results do not depend on which thread does a piece.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from tacsim.compute.runtime import launching, ti
from tacsim.compute.taichi_patches.repeated_launch import launch_kernel
from tacsim.compute.threads import has_one_thread, thread_count
from tacsim.physics.exec.lanes import PARTS

CHUNK = 512  # iterations of a loop that Taichi runs on one thread: each thread gets a chunk and executes its first one
MAX_POLLS = 8_000  # of a stage that is not done; then a thread leaves, after about 0.5 ms

# Columns of `sync`; it has a row (one cache line) for each environment with substeps in the launch
ENVIRONMENT, DONE, CLAIMED = range(3)  # index; pieces done; stages claimed of part 0, 1, ...

# Whether short kernels run on the thread that launches them. Taichi's own thread may be on another core, to which all
# arrays must go and back: on a machine in use a timestep of gel pads took 1.4 times the CPU time.
SERIAL = has_one_thread()

Sync = ti.types.ndarray(dtype=ti.i32, ndim=2)


@ti.func
def claim_work(sync: ti.template(), turn, own, stages):
    """Number of the next piece of work, stage * PARTS + part, which the caller must do and report by
    `report_work_done`; stages * PARTS if there is none left for this thread.

    turn: row of `sync`; own: first of the thread's own parts; stages: their number. A thread that leaves has no claimed
    piece: another thread has claimed the piece that it waited for, and does the rest.
    """
    piece, polls = -1, 0
    while piece < 0:
        stage = ti.atomic_add(sync[turn, DONE], 0) // PARTS
        if stage >= stages:
            piece = stages * PARTS
        for n in range(PARTS):
            part = (own + n) % PARTS
            if piece < 0 and ti.atomic_add(sync[turn, CLAIMED + part], 0) == stage:
                before = ti.atomic_max(sync[turn, CLAIMED + part], stage + 1)
                if before == stage:  # no other thread has claimed it
                    piece = stage * PARTS + part
        polls += 1
        if piece < 0 and polls > MAX_POLLS:
            piece = stages * PARTS
    return piece


@ti.func
def report_work_done(sync: ti.template(), turn):
    ti.atomic_add(sync[turn, DONE], 1)


# Loops with one iteration or none replace branches: inside a branch the compiler does not merge lanes.


@ti.func
def first_in_chunk(task):
    """1 for the first task of each chunk, else 0."""
    return 1 - ti.min(task % CHUNK, 1)


@ti.func
def one_if(condition):
    return ti.select(condition, 1, 0)


@ti.func
def first_own_part(task, team):
    """First of a thread's own parts, which it claims before others."""
    return task // CHUNK % team * PARTS // team % PARTS


def team_size(environments: int) -> int:
    """Threads for each environment of a launch: all threads (TACSIM_THREADS limits them) over the environments."""
    return max(1, min(thread_count() // environments, PARTS))


@launching()
def run_team(kernel: Any, drive: np.ndarray, *arguments: Any, active: Sequence[int] = (0,)) -> None:
    """Launches `kernel(team, drive, *arguments, sync)`; a tuple of arrays is the argument for an argument pack.

    drive: (environments, substeps, ...); active: environments with substeps. The loop runs over these only: Taichi
    divides a longer loop into equal pieces for all threads, also where a piece has no work.
    """
    sync = np.zeros((len(active), 16), np.int32)
    sync[:, ENVIRONMENT] = active
    launch_kernel(kernel, team_size(len(active)), drive, *arguments, sync)
