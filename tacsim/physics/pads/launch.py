"""Launches of gel pads: checks of their state after each, and new attempts with smaller steps of time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tacsim.interface import Pose
from tacsim.physics.exec.layout import FORCE_SUM, OVERLAP, SMALLEST_VOLUME, STEP
from tacsim.physics.failure.health import LaunchSpan, SimulationDiverged, check_launch
from tacsim.physics.motion.even import EvenMotion
from tacsim.physics.pads.gels import PadGels, Rows, rows_of
from tacsim.physics.pads.tuning import CHECKED_STEPS
from tacsim.physics.snapshot import LazyState, State, copy_arrays
from tacsim.physics.units import MM
from tacsim.physics.worlds.press import MESH_ADVICE
from tacsim.physics.worlds.tuning import MAX_RETRIES

Drive = NDArray[np.float32]  # (m, substeps, 1, 6, 3)
StepError = ValueError | SimulationDiverged

# Of the parts' numbers SMALLEST_VOLUME to OVERLAP before a launch, see `Health.clear`
_INITIAL_RESULTS = np.array([1e9, 0.0, 1e9, 0.0, 0.0, 0.0], np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class PadStep:
    """One step of m pads; rows of all arrays are these."""

    pads: NDArray[np.intp]  # (m,) their numbers, which grow
    scenes: NDArray[np.intp]  # (m,) numbers of the scenes that they belong to
    motion: EvenMotion
    drive: Drive  # of the motion
    numbers: NDArray[np.int64]  # (m,) of the step, for errors and for checks that are not made in each


class PadLauncher:
    """Advances the gels of pads, or leaves them as they were."""

    def __init__(self, gels: PadGels, substep: float, step_time: float) -> None:
        """substep: nominal step of time [mm]; step_time: time of a step, in messages [s]."""
        self._gels, self._state, self._substep, self._step_time = gels, gels.state, substep, step_time
        self.written = set(range(len(gels)))  # pads that something else than a launch has changed since their last one

    def advance(self, step: PadStep) -> tuple[dict[int, StepError], NDArray[np.int64]]:
        """Advances pads; those whose state becomes unphysical again from the state before, with half the time step, as
        often as MAX_RETRIES.

        Returns the failures by scene, SimulationDiverged, and ValueError for an object that rests on the housing of a
        gel, and the substeps of each row. All pads of a scene that fails are as they were before.
        """
        rows, substeps = rows_of(step.pads), step.drive.shape[1]
        stored, ran = _StoredGels.copy(self._gels, rows), np.full(len(step.pads), substeps)
        failed: dict[int, StepError] = {}
        waiting, drive = np.arange(len(step.pads)), step.drive
        for retry in range(MAX_RETRIES + 1):
            failures = self._launch(step, waiting, drive, retry, stored)
            again = []
            for row, failure in failures.items():
                if retry == MAX_RETRIES or not failure.retry:
                    failure.refine = 2**retry
                    failed.setdefault(int(step.scenes[row]), failure)
                self._restore(step, [row], stored)
                again.append(row)
            again = [row for row in again if int(step.scenes[row]) not in failed]
            if not again:
                break
            waiting = np.array(again)
            ran[waiting] = substeps * 2 ** (retry + 1)
            drive = step.motion.of(again).drive(int(ran[again[0]]), substeps * self._substep)
        self._state.params[rows, STEP] = self._substep
        self._find_on_housing(step, rows, failed)
        if failed:
            self._restore(step, np.flatnonzero(np.isin(step.scenes, list(failed))).tolist(), stored)
        return failed, ran

    def _find_on_housing(self, step: PadStep, rows: Rows, failed: dict[int, StepError]) -> None:
        """Adds the errors of objects that rest on the housing of a gel."""
        ends = step.drive[:, -1, 0]
        beside = np.abs(ends[:, 3, :2]) + self._gels.reaches(rows, ends[:, :2]) > self._state.gel[0].half
        for row in np.flatnonzero(beside.any(axis=1)).tolist():
            pad, scene = int(step.pads[row]), int(step.scenes[row])
            if scene not in failed and self._state.partial[pad, :, FORCE_SUM : FORCE_SUM + 6].any():
                try:
                    self._gels.require_off_housing(pad, ends[row])
                except ValueError as failure:
                    failed[scene] = failure

    def _restore(self, step: PadStep, rows: Sequence[int], stored: _StoredGels) -> None:
        for row in rows:
            stored.put_back(self._gels, row, int(step.pads[row]))
            self.written.add(int(step.pads[row]))

    def _launch(
        self, step: PadStep, waiting: NDArray[np.intp], drive: Drive, retry: int, stored: _StoredGels
    ) -> dict[int, SimulationDiverged]:
        """One launch of some rows. Returns the failures by row."""
        failures, state, pads = dict[int, SimulationDiverged](), self._state, step.pads[waiting]
        rows = rows_of(pads)
        state.params[rows, STEP] = self._substep / 2**retry
        state.partial[rows, :, SMALLEST_VOLUME : OVERLAP + 1] = _INITIAL_RESULTS
        state.partial[rows, :, FORCE_SUM : FORCE_SUM + 6] = 0.0
        for at, (row, pad) in enumerate(zip(waiting.tolist(), pads.tolist(), strict=True)):
            if state.meshes[pad] is not None:
                try:
                    self._gels.worlds[pad].cover(drive[at])
                except (ValueError, MemoryError) as error:
                    failures[row] = SimulationDiverged(str(error), self._where(step, row), MESH_ADVICE, retry=False)
        if failures:
            able = np.array([row not in failures for row in waiting.tolist()])
            waiting, drive, pads = waiting[able], drive[able], pads[able]
            if not len(pads):
                return failures
            rows = rows_of(pads)
        active = pads.tolist()
        state.advance_rows(active, drive, self.written.intersection(active))
        self.written.difference_update(active)
        healthy, overlap = self._gels.are_healthy(rows), state.partial[rows, :, OVERLAP].max(axis=1)
        suspected = ~healthy | self._select_checks(rows, step.numbers[waiting], drive[:, -1, 0], overlap)
        for at in np.flatnonzero(suspected).tolist():
            row = int(waiting[at])
            try:
                self._check(step, row, drive[at], float(overlap[at]), stored, healthy=bool(healthy[at]))
            except SimulationDiverged as failure:
                failures[row] = failure
        return failures

    def _select_checks(
        self, rows: Rows, numbers: NDArray[np.int64], ends: NDArray[np.float32], overlap: NDArray[np.float32]
    ) -> NDArray[np.bool_]:
        """(m,) whether a gel may not resolve a tip of its object, which is to be checked: in some steps where they
        touch, and where they do not, although the object reaches below the surface. ends: (m, 6, 3)."""
        in_turn = numbers % CHECKED_STEPS == 0
        if overlap.min() > 0.0:
            return np.asarray(in_turn)
        lowest = ends[:, 3, 2] - self._gels.reaches(rows, ends[:, 2:3])[:, 0]
        tops = self._state.gels.common_group.u[rows, 0, :, :, -1, 2].reshape(len(numbers), -1).max(axis=1)
        return np.asarray(np.where(overlap > 0.0, in_turn, ~(lowest > tops)))

    def _check(
        self, step: PadStep, row: int, drive: Drive, overlap: float, stored: _StoredGels, *, healthy: bool
    ) -> None:
        """Raises SimulationDiverged for an unphysical state, or a tip that the gel does not resolve."""
        pad = int(step.pads[row])
        world, where = self._gels.worlds[pad], partial(self._where, step, row)
        before = LazyState(partial(stored.named, self._gels, row, pad))
        if not healthy:
            check_launch(world.arrays, before, world.read_health(), where)
        world.require_contact_resolution(drive[-1, 0], overlap, where, before)

    def _where(self, step: PadStep, row: int) -> LaunchSpan:
        return LaunchSpan(
            f"{self._gels.names[step.pads[row]]} in step {step.numbers[row]} of {self._step_time:g} s",
            {"object": Pose(step.drive[row, -1, 0, 3].astype(np.float64) / MM)},
        )


@dataclass(frozen=True, slots=True, eq=False)
class _StoredGels:
    """Copies of what a launch changes of m pads, in few arrays; as named arrays only after a failure."""

    nodes: NDArray[np.float32]
    anchor: NDArray[np.float32]
    pressure: NDArray[np.float32]
    node_pressure: NDArray[np.float32]
    sums: NDArray[np.float32]

    @classmethod
    def copy(cls, gels: PadGels, rows: Rows) -> _StoredGels:
        return cls(*(np.array(each) for each in _changed_by_launch(gels, rows)))

    def put_back(self, gels: PadGels, row: int, pad: int) -> None:
        views = _changed_by_launch(gels, slice(pad, pad + 1))
        for view, own in zip(
            views, (self.nodes, self.anchor, self.pressure, self.node_pressure, self.sums), strict=True
        ):
            view[...] = own[row]

    def named(self, gels: PadGels, row: int, pad: int) -> State:
        """The arrays of a pad's world as they were."""
        now = _StoredGels.copy(gels, slice(pad, pad + 1))
        self.put_back(gels, row, pad)
        found: Mapping[str, NDArray[Any]] = copy_arrays(gels.worlds[pad].arrays())
        now.put_back(gels, 0, pad)
        return found


def _changed_by_launch(gels: PadGels, rows: Rows) -> tuple[NDArray[np.float32], ...]:
    state = gels.state
    group = state.gels.common_group
    return (
        group.nodes[rows, 0, :2], state.anchor[rows], state.pressure[rows], group.surface_pressure[rows, 0],
        state.partial[rows],
    )  # fmt: skip
