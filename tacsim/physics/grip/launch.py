"""Launches of grips: checks of the state after each, and new attempts with smaller steps of time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tacsim.interface import Pose
from tacsim.physics.exec.layout import FORCE, OVERLAP, STEP
from tacsim.physics.failure.health import Health, LaunchSpan, SimulationDiverged, check_launch
from tacsim.physics.grip import layout
from tacsim.physics.grip.frames import PadMotions
from tacsim.physics.grip.poses import matrices_of
from tacsim.physics.grip.state import GripState
from tacsim.physics.grip.tuning import MESH_MARGIN, QUIET_TIME
from tacsim.physics.snapshot import State, copy_arrays
from tacsim.physics.worlds.pads import GelPads
from tacsim.physics.worlds.press import MESH_ADVICE
from tacsim.physics.worlds.tuning import CHECKED_STEPS, MAX_RETRIES

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class GripStep:
    """One step of all grips."""

    motions: PadMotions
    moving: NDArray[np.int64]  # (n,) substeps in which the pads move
    resting: NDArray[np.int64]  # (n,) further ones, at most
    settles: bool  # ends when forces balance
    starts: NDArray[np.float32]  # (n, OBJECT) of the objects
    objects: Floats  # (n, 7) their poses before, world [m]
    numbers: NDArray[np.int64]  # (n,) of the step, for errors and for checks that are not made in each


class GripLauncher:
    """Advances the gels and objects of all grips, or leaves them as they were."""

    def __init__(self, state: GripState, gels: GelPads, substep: float) -> None:
        """gels: of all pads; substep: nominal step of time [mm]."""
        self._state, self._gels, self._substep = state, gels, substep

    def advance(self, step: GripStep) -> NDArray[np.int64]:
        """Advances all grips; those whose state becomes unphysical again from the state before, with half the time
        step, as often as MAX_RETRIES. Returns their substeps (n,).

        Raises SimulationDiverged, and ValueError for an object that rests on the housing of a gel.
        """
        before = [copy_arrays(world.arrays()) for world in self._gels.worlds]
        kept, waiting = self._state.objects.copy(), list(range(len(step.objects)))
        try:
            for retry in range(MAX_RETRIES + 1):
                failures = self._launch(waiting, step, 2**retry, before)
                if not failures:
                    break
                if retry == MAX_RETRIES or any(not failure.retry for failure in failures.values()):
                    index, failure = next(iter(failures.items()))
                    failure.environment, failure.refine = index, 2**retry
                    raise failure
                waiting = list(failures)
                self._restore(waiting, before)
            for gel in np.flatnonzero(self.find_touching()):
                self._gels.require_off_housing(int(gel), self._state.drive[gel, 0, 0])
        except BaseException:
            self._restore(range(len(step.objects)), before)
            self._state.objects[...] = kept
            raise
        finally:
            self._state.params[:, STEP] = self._substep
        return self._state.whole[:, layout.LAST].astype(np.int64) + 1

    def find_touching(self) -> NDArray[np.bool_]:
        """(gels,) whether its object touches it."""
        return np.asarray(self._state.partial[:, :, FORCE : FORCE + 3].any(axis=(1, 2)))

    def _restore(self, grips: Sequence[int], before: Sequence[State]) -> None:
        for index in grips:
            for gel in self._state.gels_of(index):
                for name, array in self._gels.worlds[gel].arrays().items():
                    array[...] = before[gel][name]

    def _launch(
        self, grips: Sequence[int], step: GripStep, finer: int, before: Sequence[State]
    ) -> dict[int, SimulationDiverged]:
        """One launch of some grips, with 1 / finer of the time step. Returns the failures."""
        state, failures, time_step = self._state, dict[int, SimulationDiverged](), self._substep / finer
        frames = step.motions.frames(step.moving * finer, time_step)
        quiet = math.ceil(QUIET_TIME * state.gel[0].thickness / time_step) if step.settles else 0
        for index in grips:
            state.objects[index] = step.starts[index]
            moving, total = int(step.moving[index]) * finer, int(step.moving[index] + step.resting[index]) * finer
            values = {
                layout.SUBSTEPS: total, layout.MOVING: moving, layout.LAST: total - 1,
                layout.QUIET_SUBSTEPS: quiet, layout.QUIET: 0, layout.LIMITED: 0,
            }  # fmt: skip
            state.whole[index, list(values)] = list(values.values())
            for g, gel in enumerate(state.gels_of(index)):
                state.params[gel, STEP] = time_step
                Health.clear(state.partial[gel])
                try:
                    self._cover(index, g, frames[index], step)
                except (ValueError, MemoryError) as error:
                    failures[index] = SimulationDiverged(str(error), _where(index, step), MESH_ADVICE, retry=False)
        ready = [index for index in grips if index not in failures]
        if ready:
            state.advance_grips({index: frames[index] for index in ready})
        healthy = self._gels.are_healthy()
        for index in ready:
            try:
                for gel in state.gels_of(index):
                    self._check(index, gel, step, before[gel], healthy=bool(healthy[gel]))
            except SimulationDiverged as failure:
                failures[index] = failure
        return failures

    def _cover(self, index: int, g: int, frames: NDArray[np.float32], step: GripStep) -> None:
        """Computes the distances of a mesh where a pad may touch it in this launch."""
        if self._state.meshes[self._state.gels_of(index)[g]] is None:
            return
        turn, rows = matrices_of(step.objects[index]), np.zeros((2, 1, 6, 3))
        for row, frame in zip(rows, frames[[0, -1], g].astype(np.float64), strict=True):
            place = frame[3] + step.starts[index, layout.CLOSING] * frame[:3, 2]
            row[0, :3], row[0, 3] = frame[:3].T @ turn, -frame[:3].T @ place
        self._gels.worlds[self._state.gels_of(index)[g]].cover(rows, MESH_MARGIN)

    def _check(self, index: int, gel: int, step: GripStep, before: State, *, healthy: bool) -> None:
        """Raises SimulationDiverged for an unphysical state, or a tip that the gel does not resolve."""
        world, state = self._gels.worlds[gel], self._state
        if not healthy:
            check_launch(world.arrays, before, world.read_health(), lambda: _where(index, step))
        overlap = float(state.partial[gel, :, OVERLAP].max())
        if overlap <= 0.0 or step.numbers[index] % CHECKED_STEPS == 0:
            world.require_contact_resolution(state.drive[gel, 0, 0], overlap, lambda: _where(index, step), before)


def _where(index: int, step: GripStep) -> LaunchSpan:
    pose = step.objects[index]
    return LaunchSpan(f"grip {index} in step {step.numbers[index]}", {"object": Pose(pose[:3], pose[3:])})
