"""The state of many grips: rigid objects, each between gel pads."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tacsim.geometry.shapes import bounding_size
from tacsim.models.scene import Gel, GelSurface, Indenter, Preset, Scene
from tacsim.physics.exec.layout import FORCE
from tacsim.physics.gel.gel import GelParams
from tacsim.physics.grip import layout
from tacsim.physics.grip.friction import used_friction
from tacsim.physics.grip.launch import GripLauncher
from tacsim.physics.grip.model import HeldObject, HeldStates, centre_of_mass
from tacsim.physics.grip.poses import checked_numbers, checked_poses, relative_rows
from tacsim.physics.grip.state import GripState
from tacsim.physics.grip.tuning import (
    CLOSING_ZETA,
    EARTH,
    LAYER_SHARE,
    MAX_CLOSING_SPEED,
    MAX_OBJECT_SPEED,
    MIN_POINTS,
    REFERENCE_FORCE,
    SETTLED_TOLERANCE,
    STEP_TIME,
)
from tacsim.physics.pads.gels import PadGels
from tacsim.physics.snapshot import copy_arrays, restore_arrays
from tacsim.physics.units import MM, MPA
from tacsim.physics.worlds.base import NotCopyable
from tacsim.physics.worlds.tuning import PRESS_COURANT

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]


class Grips(NotCopyable):
    """Objects, each between pads with one gel each: a grip. All are at rest; `GripWorld` moves them."""

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
        self.objects, self._preset = tuple(objects), preset
        self._gravity = np.tile(checked_numbers(gravity, (3,), "gravity"), (len(objects), 1))
        scenes = [pad_scene(item, own, preset) for item, own in zip(objects, gels, strict=True) for _ in range(pads)]
        self._state = GripState(scenes, pads)
        self._gels = PadGels(scenes, state=self._state)
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
        self._follow_shares = np.zeros(len(objects))  # of the pads' last motion, that an object on a support has made
        self._closing_speeds = np.zeros(len(objects))
        self._closings, self._steps = np.zeros(len(objects)), np.zeros(len(objects), np.int64)
        self._ran = np.zeros(len(objects), np.int64)
        self._placed, self._was_held, self._touching = (
            np.zeros(len(objects), np.bool_),
            np.zeros(len(objects), np.bool_),
            np.zeros((len(objects), pads), np.bool_),
        )
        self._arms = np.zeros((len(objects), 3))  # to the centres of mass [mm]
        for index in range(len(objects)):
            self._write_constants(index)

    def __len__(self) -> int:
        return len(self.objects)

    def _write_constants(self, index: int) -> None:
        item, gel = self.objects[index], self._state.gels_of(index)[0]
        values = constants_of(item, self._state.gel[gel], self._gels.scenes[gel].gel)
        self._state.constants[index, list(values)] = list(values.values())
        self._state.constants[index, layout.WEIGHT : layout.WEIGHT + 3] = item.mass * self._gravity[index]
        self._arms[index] = MM * centre_of_mass(item)

    def replace(self, index: int, item: HeldObject, gel: Gel | None = None, gravity: ArrayLike | None = None) -> None:
        """Makes one grip a new one with another object, as newly made: call `reset` with its index next. gel, gravity:
        None: as before. The others stay as they are.

        Raises ValueError for a gel of another lattice and for what the constructor refuses; nothing is changed then.
        """
        first = self._state.gels_of(index)[0]
        own = self._gels.scenes[first].gel if gel is None else gel
        down = self._gravity[index] if gravity is None else checked_numbers(gravity, (3,), "gravity")
        for pad in self._state.gels_of(index):
            self._gels.replace(pad, pad_scene(item, own, self._preset))
        self.objects = (*self.objects[:index], item, *self.objects[index + 1 :])
        self._gravity[index], self._placed[index] = down, False
        self._write_constants(index)

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
            for array in (
                self._velocities, self._stretches, self._follow_shares, self._closing_speeds, self._steps,
                self._was_held,
            ):  # fmt: skip
                array[i] = 0
            self._touching[i], self._placed[i] = False, True

    # ---------------------------------------------------------------- results

    @property
    def states(self) -> HeldStates:
        """After the last step, or `reset`."""
        return self._states_of(np.arange(len(self)))

    def state_of(self, index: int) -> HeldStates:
        """`states` of one grip."""
        return self._states_of(np.array([index]))

    def _states_of(self, which: Indices) -> HeldStates:
        """Of some grips (m,)."""
        state, count = self._state, self._state.pads
        gels = self._gels_of(which)
        sums = state.partial[gels, :, FORCE : FORCE + 6].astype(np.float64).sum(axis=1).reshape(-1, count, 6)
        touching = self._touching[which]
        wrenches = np.where(touching[..., None], sums, 0.0)
        frictions = np.array([self.objects[index].friction for index in which.tolist()])
        imbalances = state.objects[which, layout.IMBALANCE].astype(np.float64)
        return HeldStates(
            objects=self._objects[which],
            pads=self._pads[which],
            wrenches=wrenches / [1, 1, 1, MM, MM, MM],
            closings=self._closings[which],
            touching=touching,
            slip_shares=used_friction(state, gels, wrenches, frictions),
            dropped=self._was_held[which] & ~touching.any(axis=1),
            imbalances=imbalances,
            at_rest=imbalances <= SETTLED_TOLERANCE,
            substeps=self._ran[which],
            limited_substeps=state.whole[which, layout.LIMITED].astype(np.int64),
        )

    def surface(self, index: int, pad: int) -> GelSurface:
        """The deformed surface of a pad's gel."""
        return self._gels.surface(self._state.gels_of(index)[pad])

    def gel_size(self, index: int) -> tuple[float, float]:
        """Length and width of the gels of a grip [m]."""
        return self._gels.scenes[self._state.gels_of(index)[0]].gel.size[:2]

    # ------------------------------------------------------ of grips `which` (m,)

    def _gels_of(self, which: Indices) -> Indices:
        """(m k,) numbers of their gels."""
        count = self._state.pads
        return (which[:, None] * count + np.arange(count)).ravel()

    def _require_placed(self, which: Indices) -> None:
        if not self._placed[which].all():
            lacking = which[np.argmin(self._placed[which])]
            raise ValueError(f"grip {int(lacking)} has no object in place yet: call reset() first")

    def _find_supported(self, which: Indices) -> NDArray[np.bool_]:
        """(m,)"""
        return np.asarray(self._state.constants[which, layout.SUPPORT : layout.SUPPORT + 6].any(axis=1))

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
            "follow_share": self._follow_shares,
            "closing_speed": self._closing_speeds, "closing": self._closings, "steps": self._steps,
            "placed": self._placed, "held": self._was_held, "touching": self._touching, "ran": self._ran,
            "kernel": self._state.objects,
        }  # fmt: skip
        return found | {name: array[index : index + 1] for name, array in own.items()}


def pad_scene(item: HeldObject, gel: Gel, preset: Preset) -> Scene:
    """What a pad of a grip consists of."""
    touched = Indenter(geometry=item.geometry, friction=item.friction, edge_radius=item.edge_radius)
    return Scene(preset=preset, body=None, gel=gel, indenter=touched)


def constants_of(item: HeldObject, params: GelParams, gel: Gel) -> dict[int, float]:
    """Entries of `constants` that stay the same in all steps, see tacsim.physics.grip.layout."""
    least = MIN_POINTS * LAYER_SHARE * params.density * params.spacing**3 / 18.0
    reach = MM * float(np.linalg.norm(bounding_size(item.geometry))) / 2  # at most
    return {
        layout.MIN_MASS: least,
        layout.MIN_INERTIA: least * (reach / 2) ** 2,
        layout.REACH: reach,
        layout.MAX_SPEED: MAX_OBJECT_SPEED,
        layout.MAX_CLOSING_SPEED: MAX_CLOSING_SPEED,
        layout.CLOSING_RATE: 2 * CLOSING_ZETA / math.sqrt(LAYER_SHARE * params.thickness * params.spacing),
        layout.TOLERANCE: SETTLED_TOLERANCE,
        layout.MIN_FORCE: REFERENCE_FORCE * gel.material.youngs_modulus * MPA * params.thickness**2,
    }
