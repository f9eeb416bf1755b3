"""Rigid objects held by gel pads at rest: objects and gels are solved together, one launch a control step."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tacsim.compute.runtime import launching
from tacsim.geometry.shapes import bounding_size
from tacsim.models.scene import Gel, GelSurface, Indenter, Mesh, Preset, Scene, Shape
from tacsim.physics.exec.layout import FORCE
from tacsim.physics.grip import layout
from tacsim.physics.grip.frames import PadMotions
from tacsim.physics.grip.friction import used_friction
from tacsim.physics.grip.launch import GripLauncher, GripStep
from tacsim.physics.grip.model import HeldObject, HeldStates, Support, centre_of_mass
from tacsim.physics.grip.poses import (
    checked_forces,
    checked_numbers,
    checked_poses,
    half_widths,
    in_mm,
    matrices_of,
    max_closings,
    relative_rows,
    z_axes,
)
from tacsim.physics.grip.state import GripState
from tacsim.physics.grip.tuning import (
    CLEAR_MARGIN,
    CLOSING_ZETA,
    EARTH,
    GRASP_SPRINGS,
    LAYER_SHARE,
    MAX_CLOSING_SPEED,
    MAX_GRASP_STEPS,
    MAX_HOLD,
    MAX_OBJECT_SPEED,
    MAX_SUBSTEPS,
    MESH_TRAVEL,
    MIN_POINTS,
    MOVING_SHARE,
    PAD_MACH,
    REFERENCE_FORCE,
    SETTLED_TOLERANCE,
    SHORT_MOTION,
    STEP_TIME,
)
from tacsim.physics.snapshot import copy_arrays, restore_arrays
from tacsim.physics.units import MM, MPA
from tacsim.physics.worlds.base import NotCopyable
from tacsim.physics.worlds.pads import GelPads
from tacsim.physics.worlds.tuning import PRESS_COURANT

Floats = NDArray[np.float64]


class GripWorld(NotCopyable):
    """Objects, each between pads with one gel each: a grip. All grips advance in one launch, and each has the bits that
    it would have alone.

    In a step the pads move evenly to their new poses; objects and gels come to rest together. What cannot be held
    slides or falls, as slowly as the gels' scaled inertia lets it.
    """

    _instead = "GripWorld(objects) and restore(world.snapshot())"

    def __init__(
        self, objects: Sequence[HeldObject], gel: Gel | Sequence[Gel] | None = None, *, pads: int = 2,
        preset: Preset = "learn", substeps: int | None = None, gravity: ArrayLike = EARTH,
    ) -> None:  # fmt: skip
        """objects: one for each grip. gel: of all pads, or one for each grip. pads: of a grip. preset: mesh of the
        gels. substeps: of a step, at least; None: as many as STEP_TIME asks for. gravity: (3,) world axes [m/s^2].

        Raises ValueError for no object, no pad, numbers of gels and objects that differ, gels of different lattices, an
        object too narrow for the mesh, gravity that is not finite; RuntimeError on a GPU.
        """
        gels = [gel or Gel()] * len(objects) if gel is None or isinstance(gel, Gel) else list(gel)
        if not objects or pads < 1 or len(gels) != len(objects):
            raise ValueError(
                f"give at least one object and one pad, and a gel for each object or one for all; got {len(objects)} "
                f"objects, {pads} pads, {len(gels)} gels"
            )
        self.objects, self._gravity = tuple(objects), checked_numbers(gravity, (3,), "gravity")
        scenes = [
            Scene(preset=preset, body=None, gel=own, indenter=_indenter(item))
            for item, own in zip(objects, gels, strict=True)
            for _ in range(pads)
        ]
        self._state = GripState(scenes, pads)
        self._gels = GelPads(scenes, 1.0, 1, state=self._state)  # its steps are not used
        self._gels.names = [f"pad {g} of grip {index}" for index in range(len(objects)) for g in range(pads)]
        lattice = self._state.gel[0]
        self._substep = PRESS_COURANT * lattice.spacing  # [mm]
        self._launcher = GripLauncher(self._state, self._gels, self._substep)
        wanted = math.ceil(STEP_TIME * lattice.thickness / self._substep)
        self.substeps = wanted if substeps is None else substeps
        if self.substeps < 2:
            raise ValueError(f"substeps is {substeps}; give at least 2, or None for {wanted}")
        self._objects, self._pads = np.zeros((len(objects), 7)), np.zeros((len(objects), pads, 7))
        self._velocities = np.zeros((len(objects), 2, 3))  # of objects relative to the pads' mean, and spins
        self._stretches = np.zeros((len(objects), 6))  # of supports [mm, rad]
        self._closing_speeds = np.zeros(len(objects))
        self._closings, self._steps = np.zeros(len(objects)), np.zeros(len(objects), np.int64)
        self._ran = np.zeros(len(objects), np.int64)
        self._placed, self._was_held, self._touching = (
            np.zeros(len(objects), np.bool_),
            np.zeros(len(objects), np.bool_),
            np.zeros((len(objects), pads), np.bool_),
        )
        self._write_constants()

    def __len__(self) -> int:
        return len(self.objects)

    def _write_constants(self) -> None:
        constants = self._state.constants
        for index, item in enumerate(self.objects):
            gel, reach = self._state.gel[index * self._state.pads], MM * _reach(item.geometry)
            least = MIN_POINTS * LAYER_SHARE * gel.density * gel.spacing**3 / 18.0
            scene = self._gels.scenes[index * self._state.pads]
            values = {
                layout.MIN_MASS: least,
                layout.MIN_INERTIA: least * (reach / 2) ** 2,
                layout.REACH: reach,
                layout.MAX_SPEED: MAX_OBJECT_SPEED,
                layout.MAX_CLOSING_SPEED: MAX_CLOSING_SPEED,
                layout.CLOSING_RATE: 2 * CLOSING_ZETA / math.sqrt(LAYER_SHARE * gel.thickness * gel.spacing),
                layout.TOLERANCE: SETTLED_TOLERANCE,
                layout.MIN_FORCE: REFERENCE_FORCE * scene.gel.material.youngs_modulus * MPA * gel.thickness**2,
            }
            constants[index, list(values)] = list(values.values())
        weights = np.array([item.mass for item in self.objects])[:, None] * self._gravity
        constants[:, layout.WEIGHT : layout.WEIGHT + 3] = weights
        self._arms = MM * np.array([centre_of_mass(item) for item in self.objects])

    # ------------------------------------------------------------------- step

    def reset(self, objects: ArrayLike, pads: ArrayLike, index: int | None = None) -> None:
        """Puts new gels and the object of one grip, or of all, in place, at rest and clear of each other.

        Args:
            objects: (n, 7) position of the centre of each object's bounding box [m] and quaternion x, y, z, w, world;
                (7,) of one grip.
            pads: (n, k, 7) of the pads, or (k, 7): the origin is the middle of the gel's surface, z points out of it.

        Raises ValueError for poses of another shape, that are not finite, or with an object inside a gel.
        """
        which = list(range(len(self))) if index is None else [index]
        count = self._state.pads
        placed = checked_poses(objects, (len(self), 7) if index is None else (7,), "objects").reshape(-1, 7)
        around = checked_poses(pads, (len(self), count, 7) if index is None else (count, 7), "pads").reshape(
            -1, count, 7
        )
        for i, item, own in zip(which, placed, around, strict=True):
            for g, gel in enumerate(self._state.gels_of(i)):
                self._gels.require_clear(gel, relative_rows(item, own[g]))
        for i, item, own in zip(which, placed, around, strict=True):
            for gel in self._state.gels_of(i):
                self._gels.reset(gel)
            self._objects[i], self._pads[i] = item, own
            for array in (self._velocities, self._stretches, self._closing_speeds, self._steps, self._was_held):
                array[i] = 0
            self._touching[i], self._placed[i] = False, True

    @launching()
    def step(
        self, pads: ArrayLike, *, forces: ArrayLike | None = None, loads: ArrayLike | None = None,
        support: Support | None = None, settle: bool = False,
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
        if not self._placed.all():
            raise ValueError(f"grip {int(np.argmin(self._placed))} has no object in place yet: call reset() first")
        ends = checked_poses(pads, self._pads.shape, "pads")
        grip_forces = np.full(len(self), np.nan) if forces is None else checked_forces(forces, len(self))
        closings = self._begin_closing(ends, grip_forces)
        self._write_loads(loads, support)
        starts = self._pads.copy()
        outward = z_axes(starts)
        starts[..., :3] -= closings[:, None, None] * outward
        motions = PadMotions.between(MM * self._objects[:, :3], in_mm(starts), in_mm(ends), self._find_carrying())
        moving = self._plan(motions)
        self._write_objects(grip_forces, closings, max_closings(ends))
        self._ran = self._launcher.advance(self._describe_step(motions, moving, settle=settle))
        self._finish(motions, ends, grip_forces)
        return self.states

    def grasp(self, pads: ArrayLike, forces: ArrayLike) -> HeldStates:
        """Closes the pads from poses (n, k, 7), clear of the objects, with grip forces (n,) [N], until all is at rest;
        then lets the weight of the objects act. Objects are carried at the same time, by weak springs."""
        weights = self._state.constants[:, layout.WEIGHT : layout.WEIGHT + 3]
        carried = np.concatenate([-weights, np.zeros_like(weights)], axis=1)
        springs = Support([GRASP_SPRINGS[0]] * 3 + [GRASP_SPRINGS[1]] * 3)
        for _ in range(MAX_GRASP_STEPS):
            if self.step(pads, forces=forces, loads=carried, support=springs, settle=True).at_rest.all():
                break
        return self.step(pads, forces=forces, settle=True)

    @property
    def states(self) -> HeldStates:
        """After the last step, or `reset`."""
        count = self._state.pads
        sums = self._state.partial[:, :, FORCE : FORCE + 6].astype(np.float64).sum(axis=1).reshape(-1, count, 6)
        touching = self._touching
        wrenches = np.where(touching[..., None], sums, 0.0)
        shares = used_friction(self._state, wrenches, np.array([item.friction for item in self.objects]))
        imbalances = self._state.objects[:, layout.IMBALANCE].astype(np.float64)
        return HeldStates(
            objects=self._objects.copy(),
            pads=self._pads.copy(),
            wrenches=wrenches / [1, 1, 1, MM, MM, MM],
            closings=self._closings.copy(),
            touching=touching.copy(),
            slip_shares=shares,
            dropped=self._was_held & ~touching.any(axis=1),
            imbalances=imbalances,
            at_rest=imbalances <= SETTLED_TOLERANCE,
            substeps=self._ran.copy(),
            limited_substeps=self._state.whole[:, layout.LIMITED].astype(np.int64),
        )

    def surface(self, index: int, pad: int) -> GelSurface:
        """The deformed surface of a pad's gel."""
        return self._gels.surface(self._state.gels_of(index)[pad])

    def gel_size(self, index: int) -> tuple[float, float]:
        """Length and width of the gels of a grip [m]."""
        return self._gels.scenes[self._state.gels_of(index)[0]].gel.size[:2]

    def _begin_closing(self, ends: Floats, forces: Floats) -> Floats:
        """(n,) how far the pads are closed already, from the poses at the end of the step [m]; 0 without a force."""
        closed = self._closings if self._state.pads == 1 else half_widths(ends) - half_widths(self._pads)
        return np.where(np.isnan(forces), 0.0, closed)

    def _write_loads(self, loads: ArrayLike | None, support: Support | None) -> None:
        count, constants = len(self), self._state.constants
        given = np.zeros((count, 6)) if loads is None else checked_numbers(loads, (count, 6), "loads")
        stiffness, limits = (np.zeros((count, 6)), np.zeros((count, 2))) if support is None else support.rows(count)
        weights = constants[:, layout.WEIGHT : layout.WEIGHT + 3]
        constants[:, layout.LOAD : layout.LOAD + 3] = weights + given[:, :3]
        constants[:, layout.TORQUE : layout.TORQUE + 3] = given[:, 3:] * MM
        constants[:, layout.SUPPORT : layout.SUPPORT + 6] = stiffness * [*[1 / MM] * 3, *[MM] * 3]
        constants[:, layout.SUPPORT_LIMIT : layout.SUPPORT_LIMIT + 2] = np.minimum(
            limits * [1.0, MM], np.finfo(np.float32).max
        )

    def _plan(self, motions: PadMotions) -> NDArray[np.int64]:
        """(n,) substeps in which the pads move. Raises ValueError for pads that move too far."""
        lengths = motions.lengths(max(self._state.gel[0].half))
        for index in np.flatnonzero(~self._touching.any(axis=1)):
            if self._is_clear(int(index), lengths[index]):
                lengths[index] = 0.0
        least = math.ceil(MOVING_SHARE * self.substeps)
        braked = np.sqrt(lengths * np.maximum(lengths, SHORT_MOTION * self._state.gel[0].thickness))
        moving = np.maximum(np.ceil(braked / (PAD_MACH * self._substep) - 1e-6), least)
        worst = int(np.argmax(moving))
        if not moving[worst] <= MAX_SUBSTEPS:
            raise ValueError(
                f"a pad of grip {worst} moves by {lengths[worst]:.3g} mm in a step, relative to the others; the limit "
                f"is {MAX_SUBSTEPS * PAD_MACH * self._substep:.3g} mm: are the poses in metres? if so, take more steps"
            )
        return moving.astype(np.int64)

    def _find_carrying(self) -> NDArray[np.bool_]:
        """(n, k) whether a pad touches an object that nothing else holds."""
        return self._touching & ~self._find_supported()[:, None]

    def _find_supported(self) -> NDArray[np.bool_]:
        """(n,)"""
        return np.asarray(self._state.constants[:, layout.SUPPORT : layout.SUPPORT + 6].any(axis=1))

    def _is_clear(self, index: int, length: float) -> bool:
        """Whether no pad of a grip can touch its object after a motion of this length [mm]."""
        margin = length + CLEAR_MARGIN * self._state.gel[0].thickness
        return all(
            self._gels.clearance(gel, relative_rows(self._objects[index], self._pads[index, g])) > margin
            for g, gel in enumerate(self._state.gels_of(index))
        )

    def _write_objects(self, forces: Floats, closings: Floats, max_closed: Floats) -> None:
        """Puts the state before the step into the arrays of the kernel."""
        state, closes = self._state, np.isfinite(forces)
        state.constants[:, layout.TURN : layout.TURN + 9] = matrices_of(self._objects).reshape(-1, 9)
        state.constants[:, layout.WEIGHT_ARM : layout.WEIGHT_ARM + 3] = (
            matrices_of(self._objects) @ self._arms[..., None]
        )[..., 0]
        state.constants[:, layout.CLOSING_RANGE] = -np.finfo(np.float32).max
        state.constants[:, layout.CLOSING_RANGE + 1] = MM * max_closed
        state.constants[:, layout.CLOSING_FORCE] = np.where(closes, forces, 0.0)
        state.whole[:, layout.IS_CLOSING] = closes
        self._starts = np.zeros((len(self), layout.OBJECT), np.float32)
        self._starts[:, layout.TURNED + 3] = 1.0
        self._starts[:, layout.VELOCITY : layout.VELOCITY + 6] = self._velocities.reshape(-1, 6)
        self._starts[:, layout.CLOSING] = MM * closings
        self._starts[:, layout.CLOSING_SPEED] = np.where(closes, self._closing_speeds, 0.0)
        self._starts[:, layout.STRETCH : layout.STRETCH + 6] = self._stretches

    def _describe_step(self, motions: PadMotions, moving: NDArray[np.int64], *, settle: bool) -> GripStep:
        resting = np.full(len(self), MAX_HOLD if settle else self.substeps - math.ceil(MOVING_SHARE * self.substeps))
        for index, item in enumerate(self.objects):
            if isinstance(item.geometry, Mesh) and self._state.whole[index, layout.IS_CLOSING]:
                # the distances of a mesh are known in some depth only
                most = MESH_TRAVEL * self._state.gel[0].spacing / (MAX_CLOSING_SPEED * self._substep)
                resting[index] = min(resting[index], math.ceil(most))
        return GripStep(motions, moving, resting, settle, self._starts, self._objects.copy(), self._steps.copy())

    def _finish(self, motions: PadMotions, ends: Floats, forces: Floats) -> None:
        """Takes the state after the step from the arrays of the kernel."""
        from scipy.spatial.transform import Rotation

        found = self._state.objects.astype(np.float64)
        moving = found[:, layout.VELOCITY : layout.VELOCITY + 6].reshape(-1, 2, 3)
        at, self._velocities, turned = motions.to_world(found[:, :3], moving)
        self._objects[:, :3] = at / MM
        before, own = Rotation.from_quat(self._objects[:, 3:]), found[:, layout.TURNED : layout.TURNED + 4]
        self._objects[:, 3:] = (Rotation.from_matrix(turned) * Rotation.from_quat(own) * before).as_quat()
        self._closings = np.where(np.isnan(forces), 0.0, found[:, layout.CLOSING] / MM)
        self._closing_speeds = found[:, layout.CLOSING_SPEED].copy()
        self._stretches = np.where(self._find_supported()[:, None], found[:, layout.STRETCH : layout.STRETCH + 6], 0.0)
        self._pads = ends.copy()
        self._pads[..., :3] += self._closings[:, None, None] * z_axes(ends)
        self._steps += 1
        self._touching = self._launcher.find_touching().reshape(self._touching.shape)
        self._was_held |= self._touching.any(axis=1)

    # ------------------------------------------------------------------ state

    def snapshot(self, index: int) -> dict[str, NDArray[Any]]:
        """A copy of the whole state of one grip, as named arrays."""
        return copy_arrays(self._arrays(index))

    def restore(self, index: int, state: Mapping[str, NDArray[Any]]) -> None:
        """Raises ValueError if `state` is no snapshot of such a grip; the grip is then unchanged."""
        arrays = self._arrays(index)
        restore_arrays(arrays, [], {**state, "poses": np.empty((0, 7))}, finite=["object", "pads", "velocity"])

    def _arrays(self, index: int) -> dict[str, NDArray[Any]]:
        """Views of the whole state of one grip."""
        gels = self._state.gels_of(index)
        found = {
            f"{name}_{g}": array
            for g, gel in enumerate(gels)
            for name, array in self._gels.worlds[gel].arrays().items()
        }
        own = {
            "object": self._objects, "pads": self._pads, "velocity": self._velocities, "stretch": self._stretches,
            "closing_speed": self._closing_speeds, "closing": self._closings, "steps": self._steps,
            "placed": self._placed, "held": self._was_held, "touching": self._touching, "ran": self._ran,
            "kernel": self._state.objects,
        }  # fmt: skip
        return found | {name: array[index : index + 1] for name, array in own.items()}


def _reach(geometry: Shape) -> float:
    """Largest distance of a point of the object from its own origin [m], at most."""
    return float(np.linalg.norm(bounding_size(geometry))) / 2


def _indenter(item: HeldObject) -> Indenter:
    return Indenter(geometry=item.geometry, friction=item.friction, edge_radius=item.edge_radius)
