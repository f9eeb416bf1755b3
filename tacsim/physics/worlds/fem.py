"""What worlds of two kinds share, two gels round a body and an indenter on one: frames that are driven, and motions."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from tacsim.compute.runtime import launching
from tacsim.interface import Pose
from tacsim.models.scene import GelSurface, Scene
from tacsim.physics.exec.layout import FORCE, GEL_DAMPING, STEP, STEPS
from tacsim.physics.failure.diagnosis import element_lengths
from tacsim.physics.failure.health import LARGEST_COURANT
from tacsim.physics.gel.gel import MM, GelParams, GelState, gel_surface
from tacsim.physics.motion.controller import (
    ForceReading,
    Launch,
    Motion,
    PreparedLaunch,
    come_to_rest,
    move_and_settle,
    move_flowing,
    move_real_time,
    run,
)
from tacsim.physics.motion.inertia import Inertia, plan_real_time
from tacsim.physics.motion.load import keep_loads, require_loads
from tacsim.physics.motion.path import Path, plan, plan_flow, resolve_targets
from tacsim.physics.motion.retry import retried
from tacsim.physics.move import MoveCommand, MoveStats
from tacsim.physics.snapshot import restore_arrays, snapshot_of
from tacsim.physics.worlds.base import BaseWorld

ZETA_GEL_HELD = 1.0  # zeta in alpha = zeta c / thickness, the damping of a gel while nothing is driven


class FemState(Protocol):
    """Arrays of some environments (HybridState, PressState)."""

    gels: GelState
    params: NDArray[np.float32]
    partial: NDArray[np.float32]

    def advance(self, drives: Mapping[int, NDArray[np.float32]]) -> None: ...


def stack_drives(drives: Mapping[int, NDArray[np.float32]], counts: NDArray[np.int32]) -> NDArray[np.float32]:
    """Drives (n, frames, 6, 3) of some environments in one array (E, longest, ...); writes all n into `counts`."""
    counts[:, STEPS] = 0
    first = next(iter(drives.values()))
    longest = max(len(drive) for drive in drives.values())
    together = np.zeros((len(counts), longest, *first.shape[1:]), np.float32)
    for index, drive in drives.items():
        together[index, : len(drive)] = drive
        counts[index, STEPS] = len(drive)
    return together


class FemWorld(BaseWorld):
    """One environment of a state whose gels are layers of finite elements in their sensors' frames."""

    balanced: ClassVar[bool]  # contact forces on all gels add up to the weight of a free body
    yields: bool  # what is pressed keeps what a hurried motion does to it

    scene: Scene
    _state: FemState
    _index: int
    _gel: GelParams
    _rates: NDArray[np.float64]  # (frames, 6) at which a motion that flows has left them [-, rad/mm]
    _scaled: Inertia  # for the way to rest
    _true: Inertia
    _inertia: Inertia  # of the last motion

    # ---------------------------------------------------- what a world adds

    @abstractmethod
    def arrays(self) -> dict[str, NDArray[Any]]:
        """Views of all that changes in a motion, by name."""

    def _scalars(self) -> dict[str, NDArray[Any]]:
        """What a snapshot holds besides: of how the last motion has left this world."""
        return {"rates": self._rates, "true_inertia": np.array(float(self._inertia.real_time))}

    @abstractmethod
    def _stop(self) -> None:
        """Sets the speed of everything to zero."""

    @abstractmethod
    def prepare(self, launch: Launch) -> PreparedLaunch:
        """Sets this environment's numbers for a launch. Raises SimulationDiverged if that cannot be done."""

    @abstractmethod
    def outcome(self, prepared: PreparedLaunch) -> ForceReading:
        """What the launch came to. Raises SimulationDiverged if that is unphysical."""

    # ------------------------------------------------------------------ state

    def snapshot(self) -> dict[str, NDArray[Any]]:
        return snapshot_of({**self.arrays(), **self._scalars()}, self._poses)

    def restore(self, state: Mapping[str, NDArray[Any]]) -> None:
        """See World."""
        numbers = self._scalars()
        self._poses = restore_arrays({**self.arrays(), **numbers}, list(self._poses), state, finite=list(numbers))
        self._use_inertia(self._true if numbers["true_inertia"] else self._scaled)

    def wrench(self, name: str) -> NDArray[np.float64]:
        first = FORCE + 6 * self._sensor(name)
        wrench: NDArray[np.float64] = (
            self._state.partial[self._index, :, first : first + 6].astype(np.float64).sum(axis=0)
        )
        wrench[3:] /= MM
        return wrench

    def surface(self, name: str) -> GelSurface:
        return gel_surface(self._gel, self._state.gels, self._index, self._sensor(name))

    # ---------------------------------------------------------------- inertia

    def _use_inertia(self, inertia: Inertia) -> None:
        """Answers to forces by `inertia` from now on."""
        self._inertia = inertia
        self._write_inertia(None)

    def _write_inertia(self, launch: Launch | None) -> None:
        entries = self._inertia.entries(launch)
        self._state.params[self._index, list(entries)] = list(entries.values())

    def _switch_inertia(self, inertia: Inertia) -> None:
        """Another inertia has another time: what moves is stopped, its speed has no meaning there."""
        if inertia is not self._inertia:
            self._stop()
            self._use_inertia(inertia)

    def _courant(self) -> float:
        """The time step over the time of the pressure wave through the most squeezed gel element [-].

        Edges along their directions at rest are quickly looked at; only should they be too short, elements are.
        """
        step = float(self._state.params[self._index, STEP])
        with np.errstate(all="ignore"):  # what is not finite is told by others
            shortest = self._state.gels.shortest(self._index, self._gel.spacing)
            if shortest * LARGEST_COURANT < step:
                shortest = float(element_lengths(self.arrays(), self._gel.thickness).min())
        return step / max(shortest, 1e-6 * self._gel.spacing)

    def _damping(self) -> float:
        """Of the gel in the last launch: its rate times the wave's time through it [-]."""
        return float(self._state.params[self._index, GEL_DAMPING]) * self._gel.thickness

    # ----------------------------------------------------------------- motion

    def move(
        self, targets: Mapping[str, Pose], loads: Mapping[str, float] | None = None, duration: float | None = None,
        *, flow: bool = False,
    ) -> MoveStats:  # fmt: skip
        return run(self.motion(MoveCommand(targets, loads or {}, duration, flow)), self._advance)

    def _run_command(self, order: MoveCommand) -> Motion:
        end = resolve_targets(self._poses, order.targets)
        require_loads(order.loads, self.sensors)
        begin, goals, rest = dict(self._poses), dict(end), np.zeros_like(self._rates)
        a, b = list(begin.values()), list(end.values())
        timed = None
        if order.duration is not None:
            timed = plan_real_time(a, b, order.duration, self._true, max(self._gel.half))
        onward = self._plan_flow(a, b if order.flow else a)  # or to where they are: a stop
        if timed is None and not order.flow:
            self.plan(a, b)  # raises ValueError for a way that is far too long, before a stop

        def after_stop(refine: int) -> Motion:
            self._switch_inertia(self._scaled if timed is None else self._true)
            settling, balanced = self.scene.settling, self.balanced
            if timed is not None:
                return (yield from move_real_time(replace(timed, refine=refine), settling, balanced=balanced))
            if order.loads:
                end.update(goals)
                return (yield from keep_loads(self, begin, end, order.loads, refine, balanced=balanced))
            return (yield from move_and_settle(replace(self.plan(a, b), refine=refine), settling, balanced=balanced))

        def tried(refine: int) -> Motion:
            if order.flow:
                self._switch_inertia(self._scaled)
                return move_flowing(replace(onward, refine=refine), self.scene.settling, balanced=self.balanced)
            if self._rates.any():
                return come_to_rest(replace(onward, refine=refine), after_stop(refine))
            return after_stop(refine)

        stats = yield from retried(self, order, tried)
        self._poses = end
        self._rates[...] = onward.rates[1] if order.flow and onward.rates is not None else rest
        return stats

    def plan(self, start: Sequence[Pose], end: Sequence[Pose]) -> Path:
        """The path between two poses of all driven frames, at the scene's speed."""
        mach, gel = self.scene.peak_mach, self._gel
        return plan(start, end, mach, self._scaled.step, max(gel.half), gel.thickness, yields=self.yields)

    def _plan_flow(self, start: Sequence[Pose], end: Sequence[Pose]) -> Path:
        mach, gel = self.scene.settling.flow_mach, self._gel
        return plan_flow(start, end, self._rates.copy(), mach, self._scaled.step, max(gel.half), gel.thickness)

    @launching()  # whole: worlds of a batch share arrays, among them those that say who takes part
    def _advance(self, path: Path, first: int, last: int) -> ForceReading:
        prepared = self.prepare(Launch(path, first, last))
        self._state.advance({self._index: prepared.drive})
        return self.outcome(prepared)
