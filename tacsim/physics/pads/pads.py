"""Gel pads that follow an engine of rigid bodies: several pads on one object, many objects, advanced by poses.

No ramp and no hold: in each step of time the objects move evenly to their poses at its end, and the gels with them.
Gels keep the inertia of quasi-static motions, scaled so that a step has few substeps: forces at rest are exact, while
waves in a gel are slower than in silicone (docs/mujoco.md).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tacsim.compute.runtime import launching
from tacsim.models.scene import Scene
from tacsim.models.text import millimetres
from tacsim.physics.exec.layout import FORCE_SUM
from tacsim.physics.motion.even import EvenMotion, check_poses
from tacsim.physics.pads.gels import PadGels, rows_of
from tacsim.physics.pads.launch import PadLauncher, PadStep, StepError
from tacsim.physics.pads.patch import Patches, PatchResponses, step_moduli
from tacsim.physics.pads.tuning import MAX_PAD_TRAVEL, PAD_SECOND
from tacsim.physics.snapshot import copy_arrays, restore_arrays, snapshot_of
from tacsim.physics.units import MM
from tacsim.physics.worlds.press_state import PressState
from tacsim.physics.worlds.tuning import PRESS_COURANT

Floats = NDArray[np.float64]
Indices = NDArray[np.intp]

_TO_MILLIMETRES = np.array([1.0, 1.0, 1.0, MM, MM, MM])  # of wrenches [N, N m]


class GelPads(PadGels):
    """Pads that an engine moves: it gives the pose of its object in the frame of each pad, and gets the wrench on each
    pad back. Pads of many environments are one list."""

    _instead = "GelPads(scenes, step) and restore(pads.snapshot())"

    def __init__(
        self, scenes: Sequence[Scene], step: float, substeps: int | None = None, *, state: PressState | None = None
    ) -> None:  # fmt: skip
        """step: time of a step [s]. substeps: of the gels in a step; None: as many as PAD_SECOND asks for. The rest:
        see `PadGels`.

        Raises ValueError for a step that is not positive, and for what `PadGels` refuses.
        """
        if not (math.isfinite(step) and step > 0.0):
            raise ValueError(f"step is {step:g} s: give the positive time of the engine's step")
        super().__init__(scenes, state=state)
        self.step_time = step
        self._substep = PRESS_COURANT * self.state.gel[0].spacing  # [mm]
        wanted = math.ceil(step * PAD_SECOND / self._substep - 1e-6)
        self.substeps = max(1, wanted) if substeps is None else substeps
        if self.substeps < 1:
            raise ValueError(f"substeps is {substeps}; give at least 1, or None for {wanted}")
        self._launcher = PadLauncher(self, self._substep, step)
        count = len(scenes)
        self._frictions, self._moduli = np.zeros(count), np.zeros((count, 4))
        self._reaches = np.zeros(count)  # from the objects' centres to their farthest points, at most [mm]
        for index in range(count):
            self._write_constants(index)
        self._poses, self._placed = np.zeros((count, 7)), np.zeros(count, np.bool_)  # of objects in their pads' frames
        self._wrenches, self._steps = np.zeros((count, 6)), np.zeros(count, np.int64)
        self._motions = np.zeros((count, 6))  # of the objects in the last step, at the pads' origins [mm, rad]

    def _write_constants(self, index: int) -> None:
        indenter = self.scenes[index].indenter
        assert indenter is not None
        self._frictions[index] = indenter.friction
        self._moduli[index] = step_moduli(self.state.gel[index], self._time)
        self._reaches[index] = np.linalg.norm(self._half_sizes[index])

    def replace(self, index: int, scene: Scene) -> None:
        """See `PadGels.replace`."""
        super().replace(index, scene)
        self._write_constants(index)

    @property
    def wrenches(self) -> Floats:
        """(n, 6) of the last step, see `step`; zeros before."""
        return self._wrenches.copy()

    def wrenches_of(self, pads: range) -> Floats:
        """(k, 6) of some pads."""
        return self._wrenches[pads.start : pads.stop].copy()

    @launching()
    def step(self, poses: ArrayLike) -> Floats:
        """One step of time: each object moves evenly to its pose at the end.

        Args:
            poses: (n, 7) of the object in each pad's frame: position [m] of its frame (tacsim.geometry.shapes: the
                centre of its bounding box), and unit quaternion x, y, z, w. The first after `reset` is where it is.

        Returns:
            (n, 6) force and moment of the object on each pad, about the pad's origin, in its axes [N, N m]: the mean
            over the substeps.

        Raises:
            ValueError: for poses of another shape, that are not finite, or that differ from the last by more than the
                gels can follow; for a first pose inside a gel; for an object that would rest on the housing of a gel.
            SimulationDiverged: where a gel's state becomes unphysical.

        After an error all pads are as they were before.
        """
        every = np.arange(len(self))
        for failure in self._advance_pads(every, np.zeros_like(every), check_poses(poses, len(self))).values():
            raise failure
        return self.wrenches

    @launching()
    def step_scenes(self, scenes: Sequence[Sequence[int]], poses: ArrayLike) -> list[StepError | None]:
        """One step of some pads, in one launch; the others stay as they are.

        Args:
            scenes: numbers of the pads of each scene, which move together; in increasing order.
            poses: (m, 7) of all of them, in this order, see `step`.

        Returns:
            Of each scene, the error that `step` would raise: all its pads are then as they were before, and the others
            are not affected. None: it has moved, see `wrenches`.

        Raises ValueError for poses of another shape, or that are not finite, and numbers that do not grow.
        """
        pads = np.array([pad for scene in scenes for pad in scene], np.intp)
        if not len(pads) or (np.diff(pads) <= 0).any():
            raise ValueError(
                f"pads {pads.tolist()}: give the numbers of one pad or more, each larger than the one before"
            )
        numbers = np.repeat(np.arange(len(scenes)), [len(scene) for scene in scenes])
        failures = self._advance_pads(pads, numbers, check_poses(poses, len(pads)))
        return [failures.get(number) for number in range(len(scenes))]

    def _advance_pads(self, pads: Indices, scenes: Indices, ends: Floats) -> dict[int, StepError]:
        """One step of pads (m,) of scenes (m,). Returns the failures by scene."""
        rows = rows_of(pads)
        placed = self._placed[rows]
        starts = self._poses[rows] if placed.all() else np.where(placed[:, None], self._poses[rows], ends)
        motion = EvenMotion.between(starts, ends)
        drive = motion.drive(self.substeps, self._time)
        refused = self._find_refused(pads, scenes, motion, drive, placed)
        if refused:
            able = ~np.isin(scenes, list(refused))
            return {**refused, **(self._advance_pads(pads[able], scenes[able], ends[able]) if able.any() else {})}
        failures, substeps = self._launcher.advance(PadStep(pads, scenes, motion, drive, self._steps[rows]))
        sums = self.state.partial[rows, :, FORCE_SUM : FORCE_SUM + 6].astype(np.float64).sum(axis=1)
        wrenches, motions = sums / (_TO_MILLIMETRES * substeps[:, None]), motion.at_origin(self.substeps)
        if failures:
            done = ~np.isin(scenes, list(failures))
            rows, ends, wrenches, motions = pads[done], ends[done], wrenches[done], motions[done]
        self._poses[rows], self._placed[rows], self._wrenches[rows], self._motions[rows] = ends, True, wrenches, motions
        self._steps[rows] += 1
        return failures

    def _find_refused(
        self, pads: Indices, scenes: Indices, motion: EvenMotion, drive: NDArray[np.float32], placed: NDArray[np.bool_]
    ) -> dict[int, StepError]:
        """Errors by scene: of objects that move by more than the gels can follow, and of first poses inside a gel."""
        found: dict[int, StepError] = {}
        shifts = motion.shifts
        travels = np.sqrt((shifts * shifts).sum(axis=1)) + self._reaches[pads] * motion.angles
        most = self.max_travel * MM
        if travels.max() > most:
            for row in np.flatnonzero(travels > most).tolist():
                words = (
                    f"the object of {self.names[pads[row]]} moves by {travels[row]:.3g} mm in a step of "
                    f"{self.step_time:g} s; the gels follow {millimetres(self.max_travel)}: call reset() after the "
                    f"engine was reset, or take shorter steps"
                )
                found.setdefault(int(scenes[row]), ValueError(words))
        for row in np.flatnonzero(~placed).tolist():
            try:
                self.require_clear(int(pads[row]), drive[row, -1, 0])
            except ValueError as failure:
                found.setdefault(int(scenes[row]), failure)
        return found

    # ---------------------------------------------------------------- results

    def stiffness(self) -> Floats:
        """(n, 6, 6) change of each wrench by a motion of its object in the pad's frame within a step [N/m, N, N m/rad]:
        three displacements of what is at the pad's origin, then three turns about it; zeros where nothing touches. An
        estimate by the contact patch, for engines that integrate implicitly; see `PatchResponses.linear`, and
        `responses` for friction with a limit."""
        found = np.zeros((len(self), 6, 6))
        pads, responses = self.responses()
        if len(pads):
            found[pads] = responses.linear()
        return found

    def responses(self, pads: ArrayLike | None = None) -> tuple[Indices, PatchResponses]:
        """How wrenches follow motions of the objects within a step, with the limit of friction [m, rad, N, N m].

        pads: numbers of some; None: all. Returns the numbers (k,) of those that touch something, and the responses of
        these.
        """
        which = np.arange(len(self)) if pads is None else np.asarray(pads, np.intp)
        touching = which[self._wrenches[which].any(axis=1)]
        patches = self._patches(touching)
        if not (patches.areas > 0.0).all():  # a push of dashpots alone
            touching = touching[patches.areas > 0.0]
            patches = self._patches(touching)
        given = self._moduli[touching], self._wrenches[touching] * _TO_MILLIMETRES, self._frictions[touching]
        return touching, patches.responses(*given, self._motions[touching]).in_metres()

    def _patches(self, which: Indices) -> Patches:
        """The contact patches on some pads."""
        group, rows = self.state.gels.common_group, rows_of(which)
        nodes, tops = group.surface_pressure[rows, 0], group.u[rows, 0, :, :, -1, 2]
        return Patches.measure(self.state.gel[0].spacing, self.state.pressure[rows], nodes, tops)

    def slip_share(self, index: int) -> float:
        """Share of the limit of friction that a pad uses: 0 without drag, about 1 while its object slides [-]. 1 too
        where nothing touches."""
        one = np.array([index])
        return float(self._patches(one).used_friction(self._wrenches[one] * _TO_MILLIMETRES, self._frictions[one])[0])

    # ------------------------------------------------------------------ state

    def reset(self, index: int | None = None) -> None:
        """Makes the gel of one pad, or of all, as new: undeformed, untouched. The next pose is where its object is."""
        super().reset(index)
        rows = slice(None) if index is None else slice(index, index + 1)
        self._placed[rows], self._steps[rows] = False, 0
        self._poses[rows] = self._wrenches[rows] = self._motions[rows] = 0.0
        self._launcher.written.update(range(len(self))[rows])

    def snapshot(self, index: int) -> dict[str, NDArray[Any]]:
        """A copy of the whole state of one pad, as named arrays."""
        state = snapshot_of(self.worlds[index].arrays(), {})
        state["poses"] = self._poses[[index]]
        numbers = {"wrench": self._wrenches[index], "motion": self._motions[index], "steps": self._steps[[index]]}
        return state | copy_arrays(numbers)

    def restore(self, index: int, state: Mapping[str, NDArray[Any]]) -> None:
        """Raises ValueError if `state` is no snapshot of such a pad; the pad is then unchanged."""
        wrench, motion, steps = np.zeros(6), np.zeros(6), np.zeros(1, np.int64)
        arrays = {**self.worlds[index].arrays(), "wrench": wrench, "motion": motion, "steps": steps}
        placed = "steps" in state and bool(np.any(state["steps"]))
        known = dict(state) if placed else {**state, "poses": np.array([[0.0, 0, 0, 0, 0, 0, 1]])}
        restore_arrays(arrays, ["object"], known, finite=["wrench", "motion"])
        self._poses[index] = np.asarray(state["poses"], np.float64)[0] if placed else 0.0
        self._placed[index] = placed
        self._wrenches[index], self._motions[index], self._steps[index] = wrench, motion, steps[0]
        self._launcher.written.add(index)

    @property
    def max_travel(self) -> float:
        """How far a point of an object may move in a step, relative to a pad [m]."""
        return MAX_PAD_TRAVEL * self.state.gel[0].spacing * self.substeps / MM

    @property
    def _time(self) -> float:
        """Of a step, in the kernel [mm]."""
        return self.substeps * self._substep
