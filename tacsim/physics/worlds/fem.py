"""Base of worlds with finite-element gels (two gels around a body, an indenter on one gel): motions and inertia."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Generator, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from tacsim.compute.runtime import launching
from tacsim.interface import Pose
from tacsim.models.scene import GelSurface
from tacsim.physics.exec.layout import FORCE, GEL_DAMPING, GEL_DENSITY, MEMORY_SHARE, STEP, STEPS
from tacsim.physics.failure.diagnosis import element_lengths
from tacsim.physics.failure.tuning import MAX_COURANT
from tacsim.physics.gel.gel import GelParams, GelState, gel_surface
from tacsim.physics.motion.controller import (
    ForceReading,
    Launch,
    Motion,
    PreparedLaunch,
    come_to_rest,
    move_and_settle,
    move_flowing,
    move_real_time,
)
from tacsim.physics.motion.inertia import Inertia, plan_real_time
from tacsim.physics.motion.load import move_at_constant_load, require_loads
from tacsim.physics.motion.path import (
    Path,
    plan_flow,
    resolve_targets,
)
from tacsim.physics.move import MoveCommand, MoveStats
from tacsim.physics.snapshot import LazyState, State, copy_arrays, gel_arrays, restore_arrays, snapshot_of
from tacsim.physics.units import MM
from tacsim.physics.worlds.base import BaseWorld
from tacsim.physics.worlds.tuning import REST_TOLERANCE

if TYPE_CHECKING:  # a device's kernels
    from tacsim.physics.worlds.device_state import DeviceState
    from tacsim.physics.worlds.survey import Survey


class FemState(ABC):
    """Arrays of several environments (HybridState, PressState). Arrays of a device are downloaded when requested."""

    device: DeviceState | None = None  # the device that computes, if it is not the CPU
    params: NDArray[np.float32]
    partial: NDArray[np.float32]
    _gels: GelState

    @abstractmethod
    def advance(self, drives: Mapping[int, NDArray[np.float32]]) -> None:
        """One launch; drives: (n, frames, 6, 3) of the environments that move, each with its own n."""

    def _copy_to_host(self) -> None:
        if self.device is not None:
            self.device.copy_to_host()

    @property
    def gels(self) -> GelState:
        self._copy_to_host()
        return self._gels

    def surface_displacements(self, index: int) -> list[NDArray[np.float32]]:
        """See `GelState.surface_displacements`."""
        return (
            self._gels.surface_displacements(index) if self.device is None else self.device.surface_displacements(index)
        )


def stack_drives(drives: Mapping[int, NDArray[np.float32]], counts: NDArray[np.int32]) -> NDArray[np.float32]:
    """Drives (n, frames, 6, 3) of some environments in one array (E, longest, ...); writes each n into `counts`."""
    counts[:, STEPS] = 0
    first = next(iter(drives.values()))
    longest = max(len(drive) for drive in drives.values())
    together = np.zeros((len(counts), longest, *first.shape[1:]), np.float32)
    for index, drive in drives.items():
        together[index, : len(drive)] = drive
        counts[index, STEPS] = len(drive)
    return together


class FemWorld(BaseWorld):
    """One environment of a FemState. Its gels are layers of finite elements in their sensors' frames."""

    balanced: ClassVar[bool]  # contact forces on all gels add up to the weight of a free body
    yields: bool  # the pressed body yields, so a fast motion changes its final state
    max_force_loss = math.inf  # of `Path`
    unsettled_reason = ""  # why the last motion has not settled, independent of its residual, and advice

    state: FemState
    _index: int
    _gels: tuple[GelParams, ...]  # by index
    _rates: NDArray[np.float64]  # (frames, 6) velocities at the end of a flowing motion [-, rad/mm]
    _scaled: Inertia  # of quasi-static motions
    _true: Inertia  # of motions in real time
    _inertia: Inertia  # of the last motion

    # ---------------------------------------------------- for subclasses

    def _scalars(self) -> dict[str, NDArray[Any]]:
        """Additional entries of a snapshot: velocities and inertia after the last motion."""
        return {"rates": self._rates, "true_inertia": np.array(float(self._inertia.real_time))}

    @abstractmethod
    def _stop(self) -> None:
        """Sets the speed of everything to zero."""

    @property
    def _readings(self) -> int:
        """Largest number of readings in a launch."""
        return 1

    @abstractmethod
    def prepare(self, launch: Launch) -> PreparedLaunch:
        """Sets this environment's parameters for a launch. Raises SimulationDiverged if that cannot be done."""

    @abstractmethod
    def outcome(self, prepared: PreparedLaunch) -> list[ForceReading]:
        """The forces that the launch has read. Raises SimulationDiverged if its state is unphysical."""

    # ------------------------------------------------------------------ state

    def snapshot(self) -> dict[str, NDArray[Any]]:
        return snapshot_of({**self.arrays(), **self._grid(self._stored_grid_shape()), **self._scalars()}, self._poses)

    def _stored_grid_shape(self) -> tuple[int, int, int]:
        """Shape of the grid in a snapshot, see `BodyState.stored_grid_shape`."""
        return 0, 0, 0

    def _grid(self, shape: tuple[int, int, int]) -> dict[str, NDArray[Any]]:
        """Entries of a snapshot for that grid."""
        return {}

    def _allocate_grid(self, state: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
        """Arrays for the same entries of a state that is to be restored."""
        return {}

    def _restore_grid(self, grid: Mapping[str, NDArray[Any]]) -> None:
        """Fits the grid of a restored state and sets its velocities."""

    def restore(self, state: Mapping[str, NDArray[Any]]) -> None:
        """See World."""
        numbers, grid = self._scalars(), self._allocate_grid(state)
        arrays = {**self.arrays(), **grid, **numbers}
        self._poses = restore_arrays(arrays, list(self._poses), state, finite=list(numbers))
        self._restore_grid(grid)
        self._use_inertia(self._true if numbers["true_inertia"] else self._scaled)

    def place(self, poses: Mapping[str, Pose]) -> None:
        """See World. The gels move with their sensors' frames."""
        self._poses = resolve_targets(self._poses, poses)
        self._rates[...] = 0.0

    def wrench(self, name: str) -> NDArray[np.float64]:
        first = FORCE + 6 * self._sensor(name)
        wrench: NDArray[np.float64] = (
            self.state.partial[self._index, :, first : first + 6].astype(np.float64).sum(axis=0)
        )
        wrench[3:] /= MM
        return wrench

    def surface(self, name: str) -> GelSurface:
        index = self._sensor(name)
        return gel_surface(self._gels[index], self.state.surface_displacements(self._index)[index])

    def _survey(self) -> Survey | None:
        device = self.state.device
        return None if device is None else device.survey(self._index)

    def _snapshot_before_motion(self) -> State:
        device = self.state.device
        if device is None:
            return self.snapshot()
        device.store_state(self._index)
        sums = {"sums": self.state.partial[self._index]}
        return self._state_before(device, "motion", snapshot_of({**sums, **self._scalars()}, self._poses))

    def _before_launch(self) -> State:
        device = self.state.device
        if device is None:
            return copy_arrays(self.arrays())
        return self._state_before(device, "launch", copy_arrays({"sums": self.state.partial[self._index]}))

    def _state_before(self, device: DeviceState, moment: str, extra: State) -> State:
        """This world's arrays as the device has stored them before the last "motion" or "launch", and `extra`."""

        shape = self._stored_grid_shape()

        def fetch() -> State:
            with device.with_state_before(moment):
                return {**copy_arrays({**self.arrays(), **self._grid(shape)}), **extra}

        return LazyState(fetch)

    # ---------------------------------------------------------------- inertia

    def _use_inertia(self, inertia: Inertia) -> None:
        self._inertia = inertia
        self._write_inertia()

    def _write_inertia(self, launch: Launch | None = None) -> None:
        """Writes the entries for `launch` into `params`."""
        entries = self._inertia.entries(launch)
        self.state.params[self._index, list(entries)] = list(entries.values())

    def _switch_inertia(self, inertia: Inertia) -> None:
        """Changes the inertia and sets all velocities to zero, since another inertia has another time scale."""
        if inertia is not self._inertia:
            self._stop()
            self._use_inertia(inertia)

    def _courant(self) -> float:
        """The time step over the time of the pressure wave through the most compressed gel element [-].

        Edges along their directions at rest are computed first, which is fast; elements only if such an edge is too
        short.
        """
        step = float(self.state.params[self._index, STEP])
        with np.errstate(all="ignore"):  # check_launch reports what is not finite
            survey, waves = self._survey(), self._waves
            lengths = list(survey.min_edge_length) if survey else self.state.gels.min_edge_length(self._index)
            if len(lengths) < len(waves):  # gels with equal lattices were measured together
                waves = (max(waves),)
            if any(length * MAX_COURANT < step * wave for length, wave in zip(lengths, waves, strict=True)):
                lengths, waves = self._measured_lengths(), self._waves
        finest = 1e-6 * min(gel.spacing for gel in self._gels)
        return max(step * wave / max(length, finest) for length, wave in zip(lengths, waves, strict=True))

    def _measured_lengths(self) -> list[float]:
        """Length of the most compressed element of each gel [mm]."""
        arrays = gel_arrays(self.arrays(), "gel_displacement").items()
        return [float(gel.min()) for g, u in arrays for gel in element_lengths(u, self._gels[g].thickness)]

    def _damping(self) -> float:
        """Damping of the gels in the last launch: rate times the wave's time through the gel [-]."""
        return float(self.state.params[self._index, GEL_DAMPING]) * self._gels[0].thickness

    @property
    def _waves(self) -> tuple[float, ...]:
        """Speeds of the gels' pressure waves, in kernel units."""
        entries = self._inertia.params
        return tuple(
            math.sqrt(gel.density / entries.get(GEL_DENSITY + g, gel.density)) for g, gel in enumerate(self._gels)
        )

    @property
    def _thickness(self) -> float:
        """Thickness of the thickest gel, which has the longest wave time: motions are planned for it [mm]."""
        return max(gel.thickness for gel in self._gels)

    @property
    def _lever(self) -> float:
        """Distance from a sensor's origin to the rim of the widest gel [mm]."""
        return max(max(gel.half) for gel in self._gels)

    # ----------------------------------------------------------------- motion

    def _run_command(self, command: MoveCommand) -> Motion:
        end = resolve_targets(self._poses, command.targets)
        require_loads(command.loads, self.sensors)
        begin, goals, settling = dict(self._poses), dict(end), self.scene.settling
        balanced, max_readings, self.unsettled_reason = self.balanced, self._readings, ""
        a, b = list(begin.values()), list(end.values())
        path = planned = None  # of a dynamic motion, of a quasi-static one
        if command.duration is not None:
            path = plan_real_time(a, b, command.duration, self._true, self._lever)
        elif not command.flow:
            planned = self.plan(a, b)  # raises ValueError for a path that is far too long, before a stop
        flowing = self._plan_flow(a, b if command.flow else a)  # or to the present poses: a stop

        def from_rest(refine: int) -> Motion:
            nonlocal planned
            if path is not None:
                rest = Path(a, a, 0, self._scaled.step, refine, flowing.interval, is_creeping=self.yields)
                held = yield from self._hold_at_rest(rest)
                self._switch_inertia(self._true)
                stats = yield from move_real_time(replace(path, refine=refine), settling, balanced=balanced)
                return replace(stats, substeps=held + stats.substeps, hold=held)
            self._switch_inertia(self._scaled)
            if command.loads:
                end.update(goals)
                return (
                    yield from move_at_constant_load(
                        self, begin, end, command.loads, refine, balanced=balanced, max_readings=max_readings
                    )
                )
            if planned is None or self._rates.any():  # contact forces have changed in the stop
                planned = self.plan(a, b)
            quasi_static = replace(planned, refine=refine)
            return (yield from move_and_settle(quasi_static, settling, balanced=balanced, max_readings=max_readings))

        def attempt(refine: int) -> Motion:
            flow = replace(flowing, refine=refine)
            if command.flow:
                self._switch_inertia(self._scaled)
                return move_flowing(flow, settling, balanced=balanced, max_readings=max_readings)
            return come_to_rest(flow, from_rest(refine)) if self._rates.any() else from_rest(refine)

        stats = yield from self._retry_smaller_steps(command, attempt)
        if stats.force_loss > self.max_force_loss:
            slower = "settling.tolerance" if settling.mach is None else "settling.mach"
            self.unsettled_reason = (
                f"the speed of the motion made the body yield: the force fell by {stats.force_loss:.1%} in the hold "
                f"(limit {self.max_force_loss:.1%}); restore the state before and move with a smaller {slower}"
            )
        self._poses = end
        self._rates[...] = flowing.rates[1] if command.flow and flowing.rates is not None else 0.0
        return self._complete_stats(stats)

    def _complete_stats(self, stats: MoveStats) -> MoveStats:
        """Adds results of the final state to `stats`."""
        return stats

    def _hold_at_rest(self, path: Path) -> Generator[Launch, Sequence[ForceReading], int]:
        """Hold before a first motion in real time; returns its substeps, 0 if nothing touches a gel.

        In real time there is no damping of the velocities that the last hold has left, and contact is a spring without
        memory. Therefore the scene first comes to rest on these springs.
        """
        forces = self.state.partial[self._index, :, FORCE : FORCE + 6 * len(self.sensors)]
        if self._inertia is not self._scaled or not forces.any():
            return 0
        settling = self.scene.settling
        tight = settling.model_copy(update={"tolerance": min(settling.tolerance, REST_TOLERANCE)})
        self._use_inertia(replace(self._scaled, params={**self._scaled.params, MEMORY_SHARE: 0.0}))
        stats = yield from move_and_settle(path, tight, balanced=self.balanced, max_readings=self._readings)
        return stats.substeps

    @abstractmethod
    def plan(self, start: Sequence[Pose], end: Sequence[Pose]) -> Path:
        """The path between two poses of all driven frames, at the scene's speed."""

    def _plan_flow(self, start: Sequence[Pose], end: Sequence[Pose]) -> Path:
        mach, step = self.scene.flow_mach, self._scaled.step
        path = plan_flow(start, end, self._rates.copy(), mach, step, self._lever, self._thickness)
        return replace(path, is_creeping=self.yields)

    @launching()  # for the whole call: worlds of a batch share arrays, also the numbers of substeps
    def _advance(self, launch: Launch) -> list[ForceReading]:
        prepared = self.prepare(launch)
        self.state.advance({self._index: prepared.drive})
        return self.outcome(prepared)
