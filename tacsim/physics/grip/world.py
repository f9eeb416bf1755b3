"""Rigid objects held by gel pads at rest: objects and gels are solved together, one launch a control step."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tacsim.compute.runtime import launching
from tacsim.models.scene import Mesh
from tacsim.physics.failure.health import SimulationDiverged
from tacsim.physics.grip import layout
from tacsim.physics.grip.frames import PadMotions
from tacsim.physics.grip.grips import Grips
from tacsim.physics.grip.launch import GripStep
from tacsim.physics.grip.model import GripCommand, GuideSupport, HeldStates, Support, support_rows
from tacsim.physics.grip.poses import (
    checked_forces,
    checked_numbers,
    checked_poses,
    half_widths,
    in_mm,
    max_closings,
    relative_rows,
    z_axes,
)
from tacsim.physics.grip.tuning import (
    CLEAR_MARGIN,
    GRASP_SPRINGS,
    MAX_CLOSING_SPEED,
    MAX_GRASP_STEPS,
    MAX_HOLD,
    MAX_SUBSTEPS,
    MESH_TRAVEL,
    MOVING_SHARE,
    PAD_MACH,
    SETTLED_TOLERANCE,
    SHORT_MOTION,
)
from tacsim.physics.motion.even import matrices_of
from tacsim.physics.units import MM

Floats = NDArray[np.float64]
Float32 = NDArray[np.float32]
Indices = NDArray[np.int64]
Failures = dict[int, ValueError | SimulationDiverged]  # by grip


class GripWorld(Grips):
    """Objects, each between pads with one gel each: a grip. All grips advance in one launch, and each has the bits that
    it would have alone.

    In a step the pads move evenly to their new poses; objects and gels come to rest together. What cannot be held
    slides or falls, as slowly as the gels' scaled inertia lets it.
    """

    @launching()
    def step(
        self, pads: ArrayLike, *, forces: ArrayLike | None = None, loads: ArrayLike | None = None,
        support: Support | GuideSupport | None = None, settle: bool = False,
    ) -> HeldStates:  # fmt: skip
        """One control step: the pads move evenly to their poses, and objects and gels come to rest as far as the step
        allows.

        Args:
            pads: (n, k, 7) poses of the pads at the end, world, see `reset`.
            forces: (n,) grip force [N] of grips whose pads close from these poses along their z axes, all equally far,
                until each is pressed with this force on average; NaN, or None for all: they stay at these poses, and
                the force follows.
            loads: (n, 6) force and moment on each object about its centre, without its weight, world axes [N, N m].
            support: of all objects; it begins without load where an object is when it is first given.
            settle: until forces balance, in place of a fixed number of substeps.

        Returns:
            Where all is at the end. An object without equilibrium is no error: see `slip_shares` and `dropped`.

        Raises:
            ValueError: before `reset`; for arguments of another shape or that are not finite; for pads that move too
                far in a step; for an object that rests on the housing of a gel.
            SimulationDiverged: where a gel's state becomes unphysical; `environment` is the index of the grip, and all
                are then as they were before: reset that one.
        """
        every = np.arange(len(self))
        self._require_placed(every)
        ends = checked_poses(pads, self._pads.shape, "pads")
        grip_forces = np.full(len(self), np.nan) if forces is None else checked_forces(forces, len(self))
        given = np.zeros((len(self), 6)) if loads is None else checked_numbers(loads, (len(self), 6), "loads")
        springs = support_rows(support, len(self))
        failures = self._advance(every, ends, grip_forces, given, springs, settle=settle, undo_all=True)
        for failure in failures.values():
            raise failure
        return self.states

    @launching()
    def step_each(
        self, commands: Mapping[int, GripCommand], *, settle: bool = False
    ) -> dict[int, HeldStates | ValueError | SimulationDiverged]:
        """One control step of some grips, by index, in one launch; the others stay as they are. A grip that fails is as
        it was before, and has no effect on the others.

        Returns the state of each (of one grip), or the error that `step` would raise. Raises ValueError before `reset`,
        and for commands of another shape or that are not finite.
        """
        which = np.array(sorted(commands), np.int64)
        own = [commands[index] for index in which.tolist()]
        self._require_placed(which)
        ends = checked_poses([each.pads for each in own], (len(own), *self._pads.shape[1:]), "pads")
        forces = checked_forces([np.nan if each.force is None else each.force for each in own], len(own))
        springs = np.concatenate([support_rows(each.support, 1) for each in own])
        failures = self._advance(which, ends, forces, np.zeros((len(own), 6)), springs, settle=settle)
        states = self._states_of(which)
        found = {index: states.row(row) for row, index in enumerate(which.tolist())}
        return {**found, **failures}

    @launching()
    def grasp(
        self, pads: ArrayLike, forces: ArrayLike, index: int | None = None, *, guide: GuideSupport | None = None
    ) -> HeldStates:
        """Closes the pads from poses (n, k, 7), clear of the objects, with grip forces (n,) [N], until all is at rest;
        then lets the weight of the objects act. Objects are carried at the same time, by weak springs, or by the guide
        on which they are.

        index: of one grip, with pads (1, k, 7) and forces (1,), the others stay as they are; None: all. Returns the
        states of these. Raises what `step` raises.
        """
        which = np.arange(len(self)) if index is None else np.array([index])
        self._require_placed(which)
        ends = checked_poses(pads, (len(which), *self._pads.shape[1:]), "pads")
        grip_forces, free = checked_forces(forces, len(which)), np.zeros((len(which), 6))
        carried = free.copy()
        if guide is None:
            carried[:, :3] = -self._state.constants[which, layout.WEIGHT : layout.WEIGHT + 3]
        weak = Support([GRASP_SPRINGS[0]] * 3 + [GRASP_SPRINGS[1]] * 3)
        springs, rests = support_rows(guide or weak, len(which)), support_rows(guide, len(which))
        for _ in range(MAX_GRASP_STEPS):
            self._advance_all(which, ends, grip_forces, carried, springs)
            if (self._state.objects[which, layout.IMBALANCE] <= SETTLED_TOLERANCE).all():
                break
        self._advance_all(which, ends, grip_forces, free, rests)
        return self._states_of(which)

    # ------------------------------------------ parts of a step of grips `which` (m,)

    def _advance_all(self, which: Indices, *given: Any) -> None:
        """A step that settles. Raises the first failure; all are then as they were."""
        for failure in self._advance(which, *given, settle=True, undo_all=True).values():
            raise failure

    def _advance(
        self, which: Indices, ends: Floats, forces: Floats, loads: Floats, springs: Floats, *,
        settle: bool, undo_all: bool = False,
    ) -> Failures:  # fmt: skip
        """One step; returns the failures by grip. undo_all: a failure of one leaves all as they were."""
        closings = self._begin_closing(which, ends, forces)
        self._write_loads(which, loads, springs)
        starts = self._pads[which]
        outward = z_axes(starts)
        starts[..., :3] -= closings[:, None, None] * outward
        motions = PadMotions.between(
            MM * self._objects[which, :3], in_mm(starts), in_mm(ends), self._find_carrying(which)
        )
        moving, too_far = self._plan(which, motions)
        if too_far:
            able = np.array([index not in too_far for index in which.tolist()])
            if undo_all or not able.any():
                return dict(too_far)
            given = ends[able], forces[able], loads[able], springs[able]
            return {**too_far, **self._advance(which[able], *given, settle=settle)}
        starting = self._write_objects(which, forces, closings, max_closings(ends))
        paths = self._find_support_paths(which, motions)
        follows = self._follow_shares[which][:, None] * paths
        self._state.constants[which, layout.SUPPORT_LIMIT] += springs[:, -1] / MM * np.linalg.norm(follows, axis=1)
        follows /= moving[:, None]  # in the first substep
        for first, part in ((layout.PLACE, 1.0), (layout.STRETCH, 1.0), (layout.VELOCITY, 1.0 / self._substep)):
            starting[:, first : first + 3] += part * follows
        step = self._describe_step(which, motions, moving, starting, settle=settle)
        failures = self._launcher.advance(step, undo_all=undo_all)
        if not (failures and undo_all):
            done = np.array([index not in failures for index in which.tolist()])
            self._finish(which, motions, ends, forces, done)
            self._update_follow_shares(which[done], paths[done])
        return failures

    def _begin_closing(self, which: Indices, ends: Floats, forces: Floats) -> Floats:
        """(m,) how far the pads are closed already, from the poses at the end of the step [m]; 0 without a force."""
        alone = self._state.pads == 1
        closed = self._closings[which] if alone else half_widths(ends) - half_widths(self._pads[which])
        return np.where(np.isnan(forces), 0.0, closed)

    def _write_loads(self, which: Indices, loads: Floats, springs: Floats) -> None:
        constants = self._state.constants
        weights = constants[which, layout.WEIGHT : layout.WEIGHT + 3]
        constants[which, layout.LOAD : layout.LOAD + 3] = weights + loads[:, :3]
        constants[which, layout.TORQUE : layout.TORQUE + 3] = loads[:, 3:] * MM
        units, most = [*[1 / MM] * 3, *[MM] * 3, 1.0, MM, *[1.0] * 3, MM, MM], np.finfo(np.float32).max
        numbers = np.clip(springs[:, :-1] * units, -most, most)
        constants[which, layout.SUPPORT : layout.SUPPORT + layout.SUPPORT_NUMBERS] = numbers

    def _plan(self, which: Indices, motions: PadMotions) -> tuple[NDArray[np.int64], dict[int, ValueError]]:
        """(m,) substeps in which the pads move, and errors of grips whose pads move too far, the worst first."""
        lengths = motions.lengths(max(self._state.gel[0].half))
        for row in np.flatnonzero(~self._touching[which].any(axis=1)):
            if self._is_clear(int(which[row]), lengths[row]):
                lengths[row] = 0.0
        least = math.ceil(MOVING_SHARE * self.substeps)
        braked = np.sqrt(lengths * np.maximum(lengths, SHORT_MOTION * self._state.gel[0].thickness))
        moving = np.maximum(np.ceil(braked / (PAD_MACH * self._substep) - 1e-6), least)
        too_far = {
            int(which[row]): ValueError(
                f"a pad of grip {which[row]} moves by {lengths[row]:.3g} mm in a step, relative to the others; the "
                f"limit is {MAX_SUBSTEPS * PAD_MACH * self._substep:.3g} mm: are the poses in metres? if so, take more "
                "steps"
            )
            for row in np.argsort(-moving, kind="stable")
            if not moving[row] <= MAX_SUBSTEPS
        }
        return np.minimum(moving, MAX_SUBSTEPS).astype(np.int64), too_far

    def _find_carrying(self, which: Indices) -> NDArray[np.bool_]:
        """(m, k) whether a pad touches an object that nothing else holds."""
        return self._touching[which] & ~self._find_supported(which)[:, None]

    def _find_support_paths(self, which: Indices, motions: PadMotions) -> Floats:
        """(m, 3) mean motion of the pads, as far as an object on a support can follow it by sliding, world [mm]."""
        sliding = self._state.constants[which, layout.SUPPORT_AXES : layout.SUPPORT_AXES + 3].astype(np.float64)
        return np.asarray(self._find_supported(which)[:, None] * sliding * motions.shifts.mean(axis=1))

    def _update_follow_shares(self, which: Indices, paths: Floats) -> None:
        """An object that pads pull along its support begins the next step as fast as they do: each step has its own
        start and stop, and the object no momentum that could make it lag and overshoot."""
        found = self._state.objects[which, layout.PLACE : layout.PLACE + 3].astype(np.float64)
        squares = (paths**2).sum(axis=1)
        shares = (found * paths).sum(axis=1) / np.where(squares > 0.0, squares, 1.0)
        self._follow_shares[which] = np.clip(shares, 0.0, 1.0)

    def _is_clear(self, index: int, length: float) -> bool:
        """Whether no pad of a grip can touch its object after a motion of this length [mm]."""
        margin = length + CLEAR_MARGIN * self._state.gel[0].thickness
        return all(
            self._gels.clearance(gel, relative_rows(self._objects[index], self._pads[index, g])) > margin
            for g, gel in enumerate(self._state.gels_of(index))
        )

    def _write_objects(self, which: Indices, forces: Floats, closings: Floats, max_closed: Floats) -> Float32:
        """Puts the state before the step into the arrays of the kernel. Returns (m, OBJECT) where objects begin."""
        state, closes = self._state, np.isfinite(forces)
        turns = matrices_of(self._objects[which])
        state.constants[which, layout.TURN : layout.TURN + 9] = turns.reshape(-1, 9)
        state.constants[which, layout.WEIGHT_ARM : layout.WEIGHT_ARM + 3] = (turns @ self._arms[which][..., None])[
            ..., 0
        ]
        state.constants[which, layout.CLOSING_RANGE] = -np.finfo(np.float32).max
        state.constants[which, layout.CLOSING_RANGE + 1] = MM * max_closed
        state.constants[which, layout.CLOSING_FORCE] = np.where(closes, forces, 0.0)
        state.whole[which, layout.IS_CLOSING] = closes
        starts = np.zeros((len(which), layout.OBJECT), np.float32)
        starts[:, layout.TURNED + 3] = 1.0
        starts[:, layout.VELOCITY : layout.VELOCITY + 6] = self._velocities[which].reshape(-1, 6)
        starts[:, layout.CLOSING] = MM * closings
        starts[:, layout.CLOSING_SPEED] = np.where(closes, self._closing_speeds[which], 0.0)
        starts[:, layout.STRETCH : layout.STRETCH + 6] = self._stretches[which]
        return starts

    def _describe_step(
        self, which: Indices, motions: PadMotions, moving: Indices, starting: Float32, *, settle: bool
    ) -> GripStep:
        resting = np.full(len(which), MAX_HOLD if settle else self.substeps - math.ceil(MOVING_SHARE * self.substeps))
        for row, index in enumerate(which.tolist()):
            if isinstance(self.objects[index].geometry, Mesh) and self._state.whole[index, layout.IS_CLOSING]:
                # the distances of a mesh are known in some depth only
                most = MESH_TRAVEL * self._state.gel[0].spacing / (MAX_CLOSING_SPEED * self._substep)
                resting[row] = min(resting[row], math.ceil(most))
        return GripStep(which, motions, moving, resting, settle, starting, self._objects[which], self._steps[which])

    def _finish(
        self, which: Indices, motions: PadMotions, ends: Floats, forces: Floats, done: NDArray[np.bool_]
    ) -> None:
        """Takes the state after the step from the arrays of the kernel, of those that are `done` (m,)."""
        from scipy.spatial.transform import Rotation

        own, found = which[done], self._state.objects[which].astype(np.float64)
        moving = found[:, layout.VELOCITY : layout.VELOCITY + 6].reshape(-1, 2, 3)
        at, velocities, turned = motions.to_world(found[:, :3], moving)
        found, ends, forces = found[done], ends[done], forces[done]
        self._velocities[own], self._objects[own, :3] = velocities[done], at[done] / MM
        before = Rotation.from_quat(self._objects[own, 3:])
        in_step = Rotation.from_quat(found[:, layout.TURNED : layout.TURNED + 4])
        self._objects[own, 3:] = (Rotation.from_matrix(turned[done]) * in_step * before).as_quat()
        closings = np.where(np.isnan(forces), 0.0, found[:, layout.CLOSING] / MM)
        self._closings[own], self._closing_speeds[own] = closings, found[:, layout.CLOSING_SPEED]
        stretches = found[:, layout.STRETCH : layout.STRETCH + 6]
        self._stretches[own] = np.where(self._find_supported(own)[:, None], stretches, 0.0)
        pads = ends.copy()
        pads[..., :3] += closings[:, None, None] * z_axes(ends)
        self._pads[own] = pads
        self._steps[own] += 1
        self._ran[own] = self._state.whole[own, layout.LAST] + 1
        touching = self._launcher.find_touching(self._gels_of(own)).reshape(-1, self._state.pads)
        self._touching[own] = touching
        self._was_held[own] |= touching.any(axis=1)
