"""Launches of grips: checks of the state after each, and new attempts with smaller steps of time."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tacsim.interface import Pose
from tacsim.physics.exec.layout import FORCE, OVERLAP, STEP
from tacsim.physics.failure.health import Health, LaunchSpan, SimulationDiverged, check_launch
from tacsim.physics.grip import layout
from tacsim.physics.grip.frames import PadMotions
from tacsim.physics.grip.state import GripState
from tacsim.physics.grip.tuning import MESH_MARGIN, QUIET_TIME
from tacsim.physics.motion.even import matrices_of
from tacsim.physics.pads.gels import PadGels
from tacsim.physics.pads.tuning import CHECKED_STEPS
from tacsim.physics.snapshot import State, copy_arrays
from tacsim.physics.worlds.press import MESH_ADVICE
from tacsim.physics.worlds.tuning import MAX_RETRIES

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class GripStep:
    """One step of some grips; rows of all arrays are these."""

    grips: NDArray[np.int64]  # (n,) their numbers
    motions: PadMotions
    moving: NDArray[np.int64]  # (n,) substeps in which the pads move
    resting: NDArray[np.int64]  # (n,) further ones, at most
    settles: bool  # ends when forces balance
    starts: NDArray[np.float32]  # (n, OBJECT) of the objects
    objects: Floats  # (n, 7) their poses before, world [m]
    numbers: NDArray[np.int64]  # (n,) of the step, for errors and for checks that are not made in each


class GripLauncher:
    """Advances the gels and objects of all grips, or leaves them as they were."""

    def __init__(self, state: GripState, gels: PadGels, substep: float) -> None:
        """gels: of all pads; substep: nominal step of time [mm]."""
        self._state, self._gels, self._substep = state, gels, substep

    def advance(self, step: GripStep, *, undo_all: bool) -> dict[int, ValueError | SimulationDiverged]:
        """Advances grips; those whose state becomes unphysical again from the state before, with half the time step, as
        often as MAX_RETRIES.

        Returns the failures by grip: SimulationDiverged, and ValueError for an object that rests on the housing of a
        gel. Those grips are as they were, with undo_all all.
        """
        grips = step.grips.tolist()
        before = {
            gel: copy_arrays(self._gels.worlds[gel].arrays()) for grip in grips for gel in self._state.gels_of(grip)
        }
        kept = self._state.objects.copy()
        failed: dict[int, ValueError | SimulationDiverged] = {}
        try:
            failed |= self._try_until_healthy(step, before)
            failed |= self._find_on_housing([grip for grip in grips if grip not in failed])
            wrong = grips if failed and undo_all else list(failed)
        except BaseException:
            wrong = grips
            raise
        finally:
            self._restore(wrong, before)
            self._state.objects[wrong] = kept[wrong]
            self._state.params[:, STEP] = self._substep
        return failed

    def _try_until_healthy(self, step: GripStep, before: Mapping[int, State]) -> dict[int, SimulationDiverged]:
        """Launches, and again with smaller steps. Returns the failures that remain."""
        waiting, failed = list(range(len(step.grips))), dict[int, SimulationDiverged]()
        for retry in range(MAX_RETRIES + 1):
            failures = self._launch(waiting, step, 2**retry, before)
            waiting = []
            for row, failure in failures.items():
                grip = int(step.grips[row])
                if retry == MAX_RETRIES or not failure.retry:
                    failure.environment, failure.refine = grip, 2**retry
                    failed[grip] = failure
                else:
                    waiting.append(row)
                    self._restore([grip], before)
            if not waiting:
                break
        return failed

    def _find_on_housing(self, grips: Sequence[int]) -> dict[int, ValueError]:
        found = {}
        for grip in grips:
            gels = np.array(self._state.gels_of(grip))
            try:
                for gel in gels[self.find_touching(gels)].tolist():
                    self._gels.require_off_housing(gel, self._state.drive[gel, 0, 0])
            except ValueError as failure:
                found[grip] = failure
        return found

    def find_touching(self, gels: NDArray[np.int64]) -> NDArray[np.bool_]:
        """(m,) whether its object touches each of these gels (m,)."""
        return np.asarray(self._state.partial[gels, :, FORCE : FORCE + 3].any(axis=(1, 2)))

    def _restore(self, grips: Sequence[int], before: Mapping[int, State]) -> None:
        for index in grips:
            for gel in self._state.gels_of(index):
                for name, array in self._gels.worlds[gel].arrays().items():
                    array[...] = before[gel][name]

    def _launch(
        self, rows: Sequence[int], step: GripStep, finer: int, before: Mapping[int, State]
    ) -> dict[int, SimulationDiverged]:
        """One launch of some rows of a step, with 1 / finer of the time step. Returns the failures by row."""
        state, failures, time_step = self._state, dict[int, SimulationDiverged](), self._substep / finer
        frames = step.motions.frames(step.moving * finer, time_step)
        quiet = math.ceil(QUIET_TIME * state.gel[0].thickness / time_step) if step.settles else 0
        for row in rows:
            index = int(step.grips[row])
            state.objects[index] = step.starts[row]
            moving, total = int(step.moving[row]) * finer, int(step.moving[row] + step.resting[row]) * finer
            values = {
                layout.SUBSTEPS: total, layout.MOVING: moving, layout.LAST: total - 1,
                layout.QUIET_SUBSTEPS: quiet, layout.QUIET: 0, layout.LIMITED: 0,
            }  # fmt: skip
            state.whole[index, list(values)] = list(values.values())
            for g, gel in enumerate(state.gels_of(index)):
                state.params[gel, STEP] = time_step
                Health.clear(state.partial[gel])
                try:
                    self._cover(row, g, frames[row], step)
                except (ValueError, MemoryError) as error:
                    failures[row] = SimulationDiverged(str(error), _where(row, step), MESH_ADVICE, retry=False)
        ready = [row for row in rows if row not in failures]
        if ready:
            state.advance_grips({int(step.grips[row]): frames[row] for row in ready})
        healthy = self._gels.are_healthy(slice(None))
        for row in ready:
            try:
                for gel in state.gels_of(int(step.grips[row])):
                    self._check(row, gel, step, before[gel], healthy=bool(healthy[gel]))
            except SimulationDiverged as failure:
                failures[row] = failure
        return failures

    def _cover(self, row: int, g: int, frames: NDArray[np.float32], step: GripStep) -> None:
        """Computes the distances of a mesh where a pad may touch it in this launch."""
        gel = self._state.gels_of(int(step.grips[row]))[g]
        if self._state.meshes[gel] is None:
            return
        turn, rows = matrices_of(step.objects[row]), np.zeros((2, 1, 6, 3))
        for each, frame in zip(rows, frames[[0, -1], g].astype(np.float64), strict=True):
            place = frame[3] + step.starts[row, layout.CLOSING] * frame[:3, 2]
            each[0, :3], each[0, 3] = frame[:3].T @ turn, -frame[:3].T @ place
        self._gels.worlds[gel].cover(rows, MESH_MARGIN)

    def _check(self, row: int, gel: int, step: GripStep, before: State, *, healthy: bool) -> None:
        """Raises SimulationDiverged for an unphysical state, or a tip that the gel does not resolve."""
        world, state = self._gels.worlds[gel], self._state
        if not healthy:
            check_launch(world.arrays, before, world.read_health(), lambda: _where(row, step))
        overlap = float(state.partial[gel, :, OVERLAP].max())
        if overlap <= 0.0 or step.numbers[row] % CHECKED_STEPS == 0:
            world.require_contact_resolution(state.drive[gel, 0, 0], overlap, lambda: _where(row, step), before)


def _where(row: int, step: GripStep) -> LaunchSpan:
    pose = step.objects[row]
    return LaunchSpan(f"grip {step.grips[row]} in step {step.numbers[row]}", {"object": Pose(pose[:3], pose[3:])})
