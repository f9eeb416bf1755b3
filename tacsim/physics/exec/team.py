"""Threads of one environment: how a launch is spread over them.

A launch runs many substeps, since starting one costs as much as a draft substep. A substep is a few stages, and each
stage PARTS pieces of work, one of each part. The threads of a team take them one after the other, each first those of
its own parts, whose arrays are in its core's cache. A stage begins when the one before is done. Nobody waits for a
thread that another program keeps from running, unless it has a piece in hand; and who has waited for long leaves the
rest of the launch to the others (docs/decisions/0007). Whoever does a piece, its bits are the same.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from tacsim.compute.runtime import launching, ti
from tacsim.compute.taichi_patches.repeated_launch import launch
from tacsim.compute.threads import threads
from tacsim.physics.exec.lanes import PARTS

CHUNK = 512  # Taichi runs loops of up to 512 iterations on one thread: every member gets a chunk, and does its first
PATIENCE = 8_000  # polls of a stage that is not done, after which a member leaves: some 0.5 ms

# Columns of `sync`, a row (one cache line) for each environment that has substeps to do
ENVIRONMENT, DONE, CLAIMED = range(3)  # its index; pieces of work so far; stages taken of part 0, 1, ...

Sync = ti.types.ndarray(dtype=ti.i32, ndim=2)


@ti.func
def next_piece(sync: ti.template(), turn, own, stages):
    """Number of the next piece of work, stage PARTS + part, which the caller must do and report by `piece_done`; stages
    PARTS if there is none left for this member.

    turn: row of `sync`; own: the first of the member's own parts; stages: how many there are. A member that leaves has
    nothing in hand, so somebody else has what it waited for, and does the rest.
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
                if before == stage:  # nobody was faster
                    piece = stage * PARTS + part
        polls += 1
        if piece < 0 and polls > PATIENCE:
            piece = stages * PARTS
    return piece


@ti.func
def piece_done(sync: ti.template(), turn):
    ti.atomic_add(sync[turn, DONE], 1)


# Loops that run once or not at all, in place of branches: inside a branch the compiler does not merge lanes.


@ti.func
def first_in_chunk(task):
    """How often the work of `task` is done: once for the first of each chunk, else never."""
    return 1 - ti.min(task % CHUNK, 1)


@ti.func
def one_if(condition):
    return ti.select(condition, 1, 0)


@ti.func
def own_part(task, team):
    """The first of the parts that a member does before others."""
    return task // CHUNK % team * PARTS // team % PARTS


def team_size(environments: int) -> int:
    """Threads for each environment of a launch: those that there are (TACSIM_THREADS bounds them), shared out."""
    return max(1, min(threads() // environments, PARTS))


@launching()
def run_team(kernel: Any, drive: np.ndarray, *arguments: Any, active: Sequence[int] = (0,)) -> None:
    """Launches `kernel(team, drive, *arguments, sync)`; a tuple of arrays is the argument for an argument pack.

    drive: (environments, substeps, ...); active: those that have substeps to do. Only they take turns: Taichi cuts a
    longer loop into as many equal pieces as there are threads, whether there is work in a piece or not.
    """
    sync = np.zeros((len(active), 16), np.int32)
    sync[:, ENVIRONMENT] = active
    launch(kernel, team_size(len(active)), drive, *arguments, sync)
