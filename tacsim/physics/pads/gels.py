"""The gels of many pads, and what limits the objects on them."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from tacsim.geometry.shapes import bounding_size, shape_distance
from tacsim.models.scene import GelSurface, Mesh, Scene
from tacsim.models.text import millimetres
from tacsim.physics.exec.layout import LIMIT_RELAXATION_RATE, SMALLEST_VOLUME, STEP
from tacsim.physics.failure.tuning import MAX_COURANT, MAX_SPEED
from tacsim.physics.gel.tuning import MIN_VOLUME_RATIO
from tacsim.physics.pads.tuning import MAX_START_OVERLAP, RIM_POINTS
from tacsim.physics.units import MM
from tacsim.physics.worlds.base import NotCopyable
from tacsim.physics.worlds.press import PressWorld
from tacsim.physics.worlds.press_state import PressState

Floats = NDArray[np.float64]
Rows = slice | NDArray[np.intp]  # of some pads in arrays of all: views where their numbers follow each other


class PadGels(NotCopyable):
    """Pads with one gel each; each touches one rigid object, and several may touch the same.

    Pads do not know of each other. All gels share one lattice and launches, and each pad has the bits that it would
    have alone.
    """

    def __init__(self, scenes: Sequence[Scene], *, state: PressState | None = None) -> None:
        """scenes: of each pad, with the object that it touches as `indenter` (its orientation has no effect). state:
        arrays of these scenes; None: new ones.

        Raises ValueError for scenes without an indenter, gels with different lattices, an object too narrow for a gel's
        mesh, and what :func:`tacsim.geometry.mesh_file.load_mesh` raises.
        """
        lacking = [i for i, scene in enumerate(scenes) if scene.indenter is None]
        if lacking or not scenes:
            which = f"pad {lacking[0]} has none" if lacking else "there is no pad"
            raise ValueError(f"each pad needs a scene with an `indenter`, the object that it touches; {which}")
        self.scenes = tuple(scenes)
        self.state = PressState(self.scenes) if state is None else state
        self.worlds = tuple(PressWorld(scene, self.state, i) for i, scene in enumerate(self.scenes))
        self.names = [f"pad {index}" for index in range(len(self.scenes))]  # in messages
        self._half_sizes = np.array([_half_size(scene) for scene in self.scenes])
        for index in range(len(scenes)):
            self._write_limit_relaxation(index)

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

    def reset(self, index: int | None = None) -> None:
        """Makes the gel of one pad, or of all, as new: undeformed, untouched."""
        for i in range(len(self)) if index is None else [index]:
            self.state.gels.clear(i)
            for array in self.worlds[i].arrays().values():
                array[...] = 0

    def surface(self, index: int) -> GelSurface:
        """The deformed surface of a pad's gel."""
        return self.worlds[index].surface("lower")

    # ----------------------------------------------------------------- limits

    def are_healthy(self, rows: Rows) -> NDArray[np.bool_]:
        """(m,) whether the state of each of some pads is physical without doubt, by the limits of `check_launch`. Of
        all together: single checks would take a quarter of the time of a step. On a device: unknown, False."""
        state = self.state
        partial, steps = state.partial[rows], state.params[rows, STEP]
        if state.device is not None:
            return np.zeros(len(steps), np.bool_)
        moving, spacing = state.gels.common_group.nodes[rows, 0, :2], state.gel[0].spacing
        far, fast = np.abs(moving).max(axis=(0, 2, 3, 4))
        if (
            fast < MAX_SPEED and (spacing - 2 * far) * MAX_COURANT > steps.max()
            and partial[:, :, SMALLEST_VOLUME].min() > MIN_VOLUME_RATIO and math.isfinite(partial.sum())
        ):  # fmt: skip
            return np.ones(len(steps), np.bool_)  # nearly always: no edge is as short as the displacements allow
        nx, ny, _ = state.gel[0].elements
        u, v = moving[:, 0], moving[:, 1]
        u = u[..., : (nx + 1) * (ny + 1)].reshape(*u.shape[:3], nx + 1, ny + 1)
        with np.errstate(invalid="ignore"):  # of a gel that has diverged; a comparison with it is False
            edges = (
                u[:, 0, :, 1:] - u[:, 0, :, :-1], u[:, 1, ..., 1:] - u[:, 1, ..., :-1], u[:, 2, 1:] - u[:, 2, :-1]
            )  # fmt: skip
        shortest = spacing + np.min([edge.reshape(len(steps), -1).min(axis=1) for edge in edges], axis=0)
        slow = np.abs(v).reshape(len(steps), -1).max(axis=1) < MAX_SPEED
        whole = partial[:, :, SMALLEST_VOLUME].min(axis=1) > MIN_VOLUME_RATIO
        finite = np.isfinite(partial).all(axis=(1, 2))
        return np.asarray(slow & whole & finite & (shortest * MAX_COURANT > steps))

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

    def reaches(self, rows: Rows, axes: NDArray[np.float32]) -> Floats:
        """(m, n) half of the extent of some objects along axes of their pads [mm]; axes: (m, n, 3) those, in the axes
        of the objects."""
        return np.asarray((np.abs(axes) @ self._half_sizes[rows][..., None])[..., 0])

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


def rows_of(which: NDArray[np.intp]) -> Rows:
    """Pads with these numbers, which grow."""
    if not len(which):
        return which
    first, last = int(which[0]), int(which[-1])
    return slice(first, last + 1) if last - first + 1 == len(which) else which


def _half_size(scene: Scene) -> Floats:
    """(3,) half of the object's bounding box, along its axes [mm]."""
    assert scene.indenter is not None
    return np.asarray(0.5 * MM * bounding_size(scene.indenter.geometry))
