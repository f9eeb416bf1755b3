"""Gel pads that follow an engine of rigid bodies: several pads on one object, many objects, advanced by poses.

No ramp and no hold: in each step of time the objects move evenly to their poses at its end, and the gels with them.
Gels keep the inertia of quasi-static motions, scaled so that a step has few substeps: forces at rest are exact, while
waves in a gel are slower than in silicone (docs/mujoco.md).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tacsim.compute.runtime import launching
from tacsim.geometry.shapes import shape_distance
from tacsim.interface import Pose
from tacsim.models.scene import GelSurface, Mesh, Scene
from tacsim.models.text import millimetres
from tacsim.physics.exec.layout import FORCE_SUM, LIMIT_RELAXATION_RATE, OVERLAP, SMALLEST_VOLUME, STEP
from tacsim.physics.failure.health import Health, LaunchSpan, SimulationDiverged, check_launch
from tacsim.physics.failure.tuning import MAX_COURANT, MAX_SPEED
from tacsim.physics.gel.tuning import MIN_VOLUME_RATIO
from tacsim.physics.motion.even import EvenMotion, check_poses
from tacsim.physics.snapshot import State, copy_arrays, restore_arrays, snapshot_of
from tacsim.physics.units import MM
from tacsim.physics.worlds.base import NotCopyable
from tacsim.physics.worlds.patch import Patch, PatchResponse
from tacsim.physics.worlds.press import MESH_ADVICE, PressWorld
from tacsim.physics.worlds.press_state import PressState
from tacsim.physics.worlds.tuning import (
    CHECKED_STEPS,
    MAX_PAD_TRAVEL,
    MAX_RETRIES,
    MAX_START_OVERLAP,
    PAD_SECOND,
    PRESS_COURANT,
    RIM_POINTS,
)

Floats = NDArray[np.float64]

STEP_ADVICE = "take shorter steps, or press less deep and slower"


class GelPads(NotCopyable):
    """Pads with one gel each; each touches one rigid object, and several may touch the same.

    Pads do not know of each other: an engine gives the pose of its object in the frame of each pad, and gets the wrench
    on each pad back. Pads of many environments are one list; all gels share one lattice, and each pad has the bits that
    it would have alone.
    """

    _instead = "GelPads(scenes, step) and restore(pads.snapshot())"

    def __init__(
        self, scenes: Sequence[Scene], step: float, substeps: int | None = None, *, state: PressState | None = None
    ) -> None:  # fmt: skip
        """scenes: of each pad, with the object that it touches as `indenter` (its orientation has no effect). step:
        time of a step [s]. substeps: of the gels in a step; None: as many as PAD_SECOND asks for.
        state: arrays of these scenes; None: new ones.

        Raises ValueError for a step that is not positive, scenes without an indenter, gels with different lattices, an
        object too narrow for a gel's mesh, and what :func:`tacsim.geometry.mesh_file.load_mesh` raises.
        """
        if not (math.isfinite(step) and step > 0.0):
            raise ValueError(f"step is {step:g} s: give the positive time of the engine's step")
        lacking = [i for i, scene in enumerate(scenes) if scene.indenter is None]
        if lacking or not scenes:
            which = f"pad {lacking[0]} has none" if lacking else "there is no pad"
            raise ValueError(f"each pad needs a scene with an `indenter`, the object that it touches; {which}")
        self.scenes, self.step_time = tuple(scenes), step
        self.state = PressState(self.scenes) if state is None else state
        self.worlds = tuple(PressWorld(scene, self.state, i) for i, scene in enumerate(self.scenes))
        self.names = [f"pad {index}" for index in range(len(self.scenes))]  # in messages
        gel = self.state.gel[0]
        self._substep = PRESS_COURANT * gel.spacing  # [mm]
        wanted = math.ceil(step * PAD_SECOND / self._substep - 1e-6)
        self.substeps = max(1, wanted) if substeps is None else substeps
        if self.substeps < 1:
            raise ValueError(f"substeps is {substeps}; give at least 1, or None for {wanted}")
        for index in range(len(scenes)):
            self._write_limit_relaxation(index)
        self._half_sizes = [_half_size(scene) for scene in self.scenes]
        self._poses: list[Floats | None] = [None] * len(scenes)  # (7,) of the object in each pad's frame
        self._wrenches, self._steps = np.zeros((len(scenes), 6)), np.zeros(len(scenes), np.int64)
        self._motions = np.zeros((len(scenes), 6))  # of the objects in the last step, at the pads' origins [mm, rad]

    def __len__(self) -> int:
        return len(self.worlds)

    def _write_limit_relaxation(self, index: int) -> None:
        rate = self.worlds[index].steady_limit_relaxation / self.state.gel[index].thickness
        self.state.params[index, LIMIT_RELAXATION_RATE] = rate

    def replace(self, index: int, scene: Scene) -> None:
        """Makes one pad a new one, of another scene on the same lattice. Raises ValueError; nothing is changed then."""
        self.state.place(index, scene)
        world = PressWorld(scene, self.state, index)
        self.worlds = (*self.worlds[:index], world, *self.worlds[index + 1 :])
        self.scenes = (*self.scenes[:index], scene, *self.scenes[index + 1 :])
        self._half_sizes[index] = _half_size(scene)
        self._write_limit_relaxation(index)
        self.reset(index)

    @property
    def wrenches(self) -> Floats:
        """(n, 6) of the last step, see `step`; zeros before."""
        return self._wrenches.copy()

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
            SimulationDiverged: where a gel's state becomes unphysical; all pads are then as they were before.
        """
        ends = check_poses(poses, len(self))
        starts = np.array([end if pose is None else pose for pose, end in zip(self._poses, ends, strict=True)])
        motion = EvenMotion.between(starts, ends)
        self._require_travel(motion)
        drive = motion.drive(self.substeps, self._time)
        for index in [i for i, pose in enumerate(self._poses) if pose is None]:
            self.require_clear(index, drive[index, -1, 0])
        self._advance(motion, drive)
        sums = self.state.partial[:, :, FORCE_SUM : FORCE_SUM + 6].astype(np.float64).sum(axis=1)
        sums[:, 3:] /= MM
        self._wrenches = sums / self._last_substeps[:, None]
        self._poses, self._steps = list(ends), self._steps + 1
        self._motions = motion.at_origin(self.substeps)
        for index in range(len(self)):
            if self._wrenches[index].any():
                self.require_off_housing(index, drive[index, -1, 0])
        return self._wrenches.copy()

    def stiffness(self) -> Floats:
        """(n, 6, 6) change of each wrench by a motion of its object in the pad's frame within a step [N/m, N, N m/rad]:
        three displacements of what is at the pad's origin, then three turns about it. An estimate by the contact patch,
        for engines that integrate implicitly; see `PatchResponse.linear`, and `responses` for friction with a limit."""
        return np.array([np.zeros((6, 6)) if each is None else each.linear() for each in self.responses()])

    def responses(self) -> list[PatchResponse | None]:
        """How the wrench of each pad follows a motion of its object within a step, with the limit of friction [m, rad,
        N, N m]; None where nothing touches."""
        touching = np.flatnonzero(self._wrenches.any(axis=1))
        found: list[PatchResponse | None] = [None] * len(self)
        wrenches = self._wrenches * [1, 1, 1, MM, MM, MM]
        for index, patch in zip(touching.tolist(), self._patches(touching), strict=True):
            friction = self._friction(index)
            if patch.area > 0.0:
                gel, motion = self.state.gel[index], self._motions[index]
                found[index] = patch.response(gel, self._time, wrenches[index], friction, motion).in_metres()
        return found

    def _friction(self, index: int) -> float:
        indenter = self.scenes[index].indenter
        assert indenter is not None
        return indenter.friction

    def _patches(self, which: NDArray[np.intp]) -> list[Patch]:
        """The contact patches on some pads."""
        group = self.state.gels.common_group
        tops = group.u[which, 0, :, :, -1, 2]
        return Patch.measure(self.state.gel[0], self.state.pressure[which], group.surface_pressure[which, 0], tops)

    def patch(self, index: int) -> Patch:
        """The contact patch on a pad."""
        (found,) = self._patches(np.array([index]))
        return found

    def slip_share(self, index: int) -> float:
        """Share of the limit of friction that a pad uses: 0 without drag, about 1 while its object slides [-]. 1 too
        where nothing touches."""
        wrench = self._wrenches[index] * [1, 1, 1, MM, MM, MM]
        return self.patch(index).used_friction(wrench, self._friction(index))

    def surface(self, index: int) -> GelSurface:
        """The deformed surface of a pad's gel."""
        return self.worlds[index].surface("lower")

    # ------------------------------------------------------------------ state

    def reset(self, index: int | None = None) -> None:
        """Makes the gel of one pad, or of all, as new: undeformed, untouched. The next pose is where its object is."""
        for i in range(len(self)) if index is None else [index]:
            self.state.gels.clear(i)
            for array in self.worlds[i].arrays().values():
                array[...] = 0
            self._poses[i], self._steps[i] = None, 0
            self._wrenches[i] = self._motions[i] = 0.0

    def snapshot(self, index: int) -> dict[str, NDArray[Any]]:
        """A copy of the whole state of one pad, as named arrays."""
        pose = self._poses[index]
        state = snapshot_of(self.worlds[index].arrays(), {})
        state["poses"] = np.zeros((1, 7)) if pose is None else pose[None].copy()
        numbers = {"wrench": self._wrenches[index], "motion": self._motions[index], "steps": self._steps[[index]]}
        return state | copy_arrays(numbers)

    def restore(self, index: int, state: Mapping[str, NDArray[Any]]) -> None:
        """Raises ValueError if `state` is no snapshot of such a pad; the pad is then unchanged."""
        wrench, motion, steps = np.zeros(6), np.zeros(6), np.zeros(1, np.int64)
        arrays = {**self.worlds[index].arrays(), "wrench": wrench, "motion": motion, "steps": steps}
        placed = "steps" in state and bool(np.any(state["steps"]))
        known = dict(state) if placed else {**state, "poses": np.array([[0.0, 0, 0, 0, 0, 0, 1]])}
        restore_arrays(arrays, ["object"], known, finite=["wrench", "motion"])
        self._poses[index] = np.array(state["poses"], np.float64)[0] if placed else None
        self._wrenches[index], self._motions[index], self._steps[index] = wrench, motion, steps[0]

    # ------------------------------------------------------------------- step

    @property
    def max_travel(self) -> float:
        """How far a point of an object may move in a step, relative to a pad [m]."""
        return MAX_PAD_TRAVEL * self.state.gel[0].spacing * self.substeps / MM

    @property
    def _time(self) -> float:
        """Of a step, in the kernel [mm]."""
        return self.substeps * self._substep

    def _require_travel(self, motion: EvenMotion) -> None:
        turned, shifted = np.linalg.norm([motion.turns, motion.shifts], axis=2)
        travel = shifted + np.linalg.norm(self._half_sizes, axis=1) * turned
        worst = int(np.argmax(travel))
        if travel[worst] > self.max_travel * MM:
            raise ValueError(
                f"the object of pad {worst} moves by {travel[worst]:.3g} mm in a step of {self.step_time:g} s; the gels"
                f" follow {millimetres(self.max_travel)}: call reset() after the engine was reset, or take shorter "
                f"steps"
            )

    def _advance(self, motion: EvenMotion, drive: NDArray[np.float32]) -> None:
        """Advances all pads; those whose state becomes unphysical again from the state before, with half the time step,
        as often as MAX_RETRIES."""
        self._last_substeps = np.full(len(self), self.substeps)
        before = [copy_arrays(world.arrays()) for world in self.worlds]
        waiting = {i: drive[i] for i in range(len(self))}
        for retry in range(MAX_RETRIES + 1):
            failures = self._launch(waiting, before)
            if not failures:
                break
            for index in failures:
                self._restore_arrays(index, before[index])
            if retry == MAX_RETRIES or any(not failure.retry for failure in failures.values()):
                for index, state in enumerate(before):
                    self._restore_arrays(index, state)
                index, failure = next(iter(failures.items()))
                failure.refine = 2**retry
                raise failure
            again = list(failures)
            self._last_substeps[again] *= 2
            finer = motion.of(again).drive(self.substeps * 2 ** (retry + 1), self._time)
            waiting = dict(zip(again, finer, strict=True))
        self.state.params[:, STEP] = self._substep

    def _restore_arrays(self, index: int, state: State) -> None:
        for name, array in self.worlds[index].arrays().items():
            array[...] = state[name]
        self.state.params[index, STEP] = self._substep

    def _launch(
        self, drives: Mapping[int, NDArray[np.float32]], before: Sequence[State]
    ) -> dict[int, SimulationDiverged]:
        """One launch of some pads. Returns the failures."""
        failures: dict[int, SimulationDiverged] = {}
        own = list(drives)
        self.state.params[own, STEP] = [self._time / len(drive) for drive in drives.values()]
        cleared = self.state.partial[own]
        Health.clear(cleared)
        self.state.partial[own] = cleared
        for index, drive in drives.items():
            try:
                self.worlds[index].cover(drive)
            except (ValueError, MemoryError) as error:
                failures[index] = SimulationDiverged(str(error), self._where(index, drive), MESH_ADVICE, retry=False)
        ready = {index: drive for index, drive in drives.items() if index not in failures}
        if ready:
            self.state.advance(ready)
        healthy = self.are_healthy()
        for index, drive in ready.items():
            try:
                self._check(index, drive, before[index], healthy=bool(healthy[index]))
            except SimulationDiverged as failure:
                failures[index] = failure
        return failures

    def are_healthy(self) -> NDArray[np.bool_]:
        """(n,) whether a pad's state is physical without doubt, by the limits of `check_launch`, of all pads together:
        a quarter of the time of a step would go into single checks. On a device: unknown, False."""
        state = self.state
        if state.device is not None:
            return np.zeros(len(self), np.bool_)
        nx, ny, _ = state.gel[0].elements
        nodes = state.gels.common_group.nodes[:, 0, :2, :, :, : (nx + 1) * (ny + 1)]
        u, v = nodes[:, 0].reshape(len(self), *nodes.shape[2:4], nx + 1, ny + 1), nodes[:, 1]
        edges = (
            u[:, 0, :, 1:] - u[:, 0, :, :-1], u[:, 1, ..., 1:] - u[:, 1, ..., :-1], u[:, 2, 1:] - u[:, 2, :-1]
        )  # fmt: skip
        least = state.gel[0].spacing + min(edge.min() for edge in edges)
        if (
            max(v.max(), -v.min()) < MAX_SPEED and least * MAX_COURANT > state.params[:, STEP].max()
            and state.partial[:, :, SMALLEST_VOLUME].min() > MIN_VOLUME_RATIO and math.isfinite(state.partial.sum())
        ):  # fmt: skip
            return np.ones(len(self), np.bool_)  # nearly always
        shortest = state.gel[0].spacing + np.min([edge.reshape(len(self), -1).min(axis=1) for edge in edges], axis=0)
        slow = np.abs(v).reshape(len(self), -1).max(axis=1) < MAX_SPEED
        whole = state.partial[:, :, SMALLEST_VOLUME].min(axis=1) > MIN_VOLUME_RATIO
        finite = np.isfinite(state.partial).all(axis=(1, 2))
        return np.asarray(slow & whole & finite & (shortest * MAX_COURANT > state.params[:, STEP]))

    def _check(self, index: int, drive: NDArray[np.float32], before: State, *, healthy: bool) -> None:
        """Raises SimulationDiverged for an unphysical state, or a tip that the gel does not resolve."""
        world, where = self.worlds[index], partial(self._where, index, drive)
        if not healthy:
            check_launch(world.arrays, before, world.read_health(), where)
        overlap = float(self.state.partial[index, :, OVERLAP].max())
        if overlap <= 0.0 or self._steps[index] % CHECKED_STEPS == 0:
            world.require_contact_resolution(drive[-1, 0], overlap, where, before)

    def _where(self, index: int, drive: NDArray[np.float32]) -> LaunchSpan:
        return LaunchSpan(
            f"pad {index} in step {self._steps[index]} of {self.step_time:g} s",
            {"object": Pose(drive[-1, 0, 3].astype(np.float64) / MM)},
        )

    # ----------------------------------------------------------------- limits

    def _distances(self, index: int, points: Floats, rows: NDArray[np.float32]) -> Floats:
        """Distance (k,) [mm] of points (k, 3) [mm] in a pad's frame from its object; rows: its motion (6, 3)."""
        indenter, mesh = self.scenes[index].indenter, self.state.meshes[index]
        assert indenter is not None
        motion = rows.astype(np.float64)
        at = (points - motion[3]) @ motion[:3] / MM
        if mesh is not None:
            near = (np.abs(at) <= mesh.half).all(axis=1)
            found = np.full(len(at), np.inf)
            if near.any():
                found[near] = mesh.sample_distance(at[near])[0]
            return found * MM
        assert not isinstance(indenter.geometry, Mesh)
        edge = indenter.effective_edge_radius(self.scenes[index].effective_element_size)
        return shape_distance(indenter.geometry, at, edge) * MM

    def clearance(self, index: int, rows: NDArray[np.float32]) -> float:
        """Distance of an object from the undeformed surface of a pad's gel [mm], negative inside; rows: see
        `_distances`."""
        gel = self.state.gel[index]
        x, y = (gel.spacing * (np.arange(3 * n + 1) / 3 - n / 2) for n in gel.elements[:2])
        points = np.stack([*np.meshgrid(x, y, indexing="ij"), np.zeros((len(x), len(y)))], axis=-1).reshape(-1, 3)
        return float(self._distances(index, points, rows).min())

    def require_clear(self, index: int, rows: NDArray[np.float32]) -> None:
        """Raises ValueError for a first pose in which the object is inside the gel."""
        limit, deepest = MAX_START_OVERLAP * self.state.gel[index].thickness, -self.clearance(index, rows)
        if deepest > limit:
            raise ValueError(
                f"the first pose of the object of {self.names[index]} is {deepest:.3g} mm inside its gel (limit "
                f"{limit:.3g} mm): begin with the object clear of the gels and close them, or restore a snapshot"
            )

    def require_off_housing(self, index: int, rows: NDArray[np.float32]) -> None:
        """Raises ValueError for an object that reaches the rigid housing around the gel, which is not simulated."""
        scene, half = self.scenes[index], np.array(self.state.gel[index].half)
        housing = scene.gel.housing
        reach = np.abs(rows[:2]) @ self._half_sizes[index]  # along x and y of the pad
        if housing is None or (np.abs(rows[3, :2]) + reach <= half).all():
            return
        rim = self.state.gel[index].rim_points(-housing * MM, RIM_POINTS)
        depth = float(-self._distances(index, rim, rows).min())
        if depth > 0.0:
            raise ValueError(
                f"the object of {self.names[index]} is wider than the gel and reaches {depth:.3g} mm into the housing "
                f"around it, which is {millimetres(housing)} below the gel's surface and is not simulated: press with "
                f"less force, give the pad a larger gel, or `housing: null` if there is none"
            )


def _half_size(scene: Scene) -> Floats:
    """(3,) half of the object's bounding box, along its axes [mm]."""
    from tacsim.geometry.shapes import bounding_size

    assert scene.indenter is not None
    return np.asarray(0.5 * MM * bounding_size(scene.indenter.geometry))
