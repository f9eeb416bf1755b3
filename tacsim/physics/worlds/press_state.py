"""Arrays of one gel under a rigid indenter, of several environments."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from tacsim.compute.runtime import start_taichi
from tacsim.geometry.shapes import MAX_NODES, rotated_bounding_size
from tacsim.geometry.tiles import TILE_NODES, TiledDistance, cached_tiled_distance
from tacsim.models.scene import Box, Cylinder, Indenter, Scene, Shape, Sphere
from tacsim.physics.contact.distance import BOX, CYLINDER, GRID, SPHERE
from tacsim.physics.contact.indenter import (
    POINTS,
)
from tacsim.physics.exec.lanes import MAX_NUMBERS, ON_DEVICE, PARTS, aligned_zeros
from tacsim.physics.exec.layout import (
    COUNTS,
    EDGE_RADIUS,
    KIND,
    NUMBERS,
    PARAMS,
    SHAPE,
    SHAPE_FIRST,
    SHAPE_NODES,
    SHAPE_ORIGIN,
    SHAPE_SPACING,
    STEPS,
)  # fmt: skip
from tacsim.physics.exec.team import (
    run_team,
)
from tacsim.physics.gel.gel import GelParams, GelState, common_lattices, gel_params
from tacsim.physics.units import MM
from tacsim.physics.worlds.fem import FemState, stack_drives
from tacsim.physics.worlds.press_kernels import substeps
from tacsim.physics.worlds.tuning import MESH_GRID_SPACING


class PressState(FemState):
    """Arrays of E environments that one launch of `substeps` advances; each environment is a PressWorld.

    Environments share the gel's lattice; each has its own indenter, materials, friction and settling.
    """

    def __init__(self, scenes: Sequence[Scene]) -> None:
        """Raises ValueError for gels with different lattices, and for an indenter that is too narrow for them."""
        start_taichi()
        self.gel = [gel_params(scene.gel, scene.effective_element_size) for scene in scenes]
        self._gels = GelState(common_lattices([(gel,) for gel in self.gel]), len(scenes))
        nx, ny, _ = self.gel[0].elements
        self._anchor = np.zeros((len(scenes), nx * POINTS, ny * POINTS, 3), np.float32)
        self._pressure = np.zeros(self._anchor.shape[:3], np.float32)  # stored pressure of the contact points [MPa]
        self.params = np.zeros((len(scenes), PARAMS), np.float32)
        self.counts = np.zeros((len(scenes), COUNTS), np.int32)
        self._gels.write_layout(self.counts)
        self.partial = np.zeros((len(scenes), PARTS, NUMBERS), np.float32)
        self._values = np.zeros((len(scenes), 2, 2, 2), np.float32)
        self._covered = 0  # number of changes of the values; a device copies them only after a change
        self.meshes = [self._set_shape(index, scene) for index, scene in enumerate(scenes)]
        self._tiles: dict[int, tuple[np.ndarray, np.ndarray]] = {}  # first and end of the computed tiles
        if ON_DEVICE:
            from tacsim.physics.worlds.device_state import DevicePress

            numbers = self.params, self.counts, self.partial
            self.device = DevicePress(
                self._gels, numbers, self._anchor, self._pressure, lambda: (self._values, self._covered)
            )

    @property
    def anchor(self) -> np.ndarray:
        self._copy_to_host()
        return self._anchor

    @property
    def pressure(self) -> np.ndarray:
        self._copy_to_host()
        return self._pressure

    def place(self, index: int, scene: Scene) -> None:
        """Puts the initial state of another scene into one environment. Raises what the constructor raises; nothing is
        changed then."""
        gel = gel_params(scene.gel, scene.effective_element_size)
        common_lattices([*((each,) for each in self.gel), (gel,)])
        assert scene.indenter is not None
        _require_resolved(scene.indenter, gel)
        _shape_params(scene.indenter.geometry)  # a mesh that cannot be read fails here
        self.gel[index] = gel
        self.params[index], self.counts[index], self.partial[index] = 0.0, 0, 0.0
        self._gels.write_layout(self.counts)
        self._tiles.pop(index, None)
        self.meshes[index] = self._set_shape(index, scene)
        self.gels.clear(index)
        self.gels.common_group.surface_pressure[index] = 0.0
        self.anchor[index], self.pressure[index] = 0.0, 0.0

    def _set_shape(self, index: int, scene: Scene) -> TiledDistance | None:
        """Writes one environment's indenter into params and counts; returns the distances of its mesh."""
        assert scene.indenter is not None
        _require_resolved(scene.indenter, self.gel[index])
        kind, size, mesh = _shape_params(scene.indenter.geometry)
        self.counts[index, KIND], self.params[index, SHAPE : SHAPE + 3] = kind, size
        self.params[index, EDGE_RADIUS] = scene.indenter.effective_edge_radius(scene.effective_element_size) * MM
        self.params[index, SHAPE_SPACING] = MESH_GRID_SPACING * MM
        if mesh is not None:
            self.params[index, SHAPE_ORIGIN : SHAPE_ORIGIN + 3] = mesh.origin * MM
        return mesh

    def cover(self, index: int, low: np.ndarray, high: np.ndarray) -> None:
        """Computes the distances of an environment's mesh between two corners (3,) [mm], axes of the mesh.

        The memory of all environments grows if this one needs more. Raises ValueError for more nodes than the limit,
        MemoryError where there is no memory for them; nothing is changed then.
        """
        mesh = self.meshes[index]
        assert mesh is not None
        first, end = mesh.tile_range(low / MM, high / MM)
        old = self._tiles.get(index)
        if old is not None:
            if (first >= old[0]).all() and (end <= old[1]).all():
                return
            both = np.minimum(first, old[0]), np.maximum(end, old[1])
            if np.prod(TILE_NODES * (both[1] - both[0]).astype(float)) <= min(
                MAX_NODES, MAX_NUMBERS // len(self._values)
            ):
                first, end = both
        values = mesh.values(first, end) * np.float32(MM)
        held = self._values.shape[1:]
        room = tuple(map(max, held, values.shape))
        if room != held:
            grown = aligned_zeros(len(self._values), *room)
            grown[(slice(None), *map(slice, held))] = self._values
            self._values = grown
        nx, ny, nz = values.shape
        self._values[index, :nx, :ny, :nz] = values
        self.counts[index, SHAPE_FIRST : SHAPE_FIRST + 3] = TILE_NODES * first
        self.counts[index, SHAPE_NODES : SHAPE_NODES + 3] = values.shape
        self._tiles[index] = first, end
        self._covered += 1

    def advance(self, drives: Mapping[int, np.ndarray]) -> None:
        drive = stack_drives(drives, self.counts)
        if self.device is not None:
            self.device.run(drive)
            return
        self._gels.copy_surface()
        self._launch(drive, list(drives))

    def _launch(self, drive: np.ndarray, active: Sequence[int]) -> None:
        run_team(
            substeps, drive, self._gels.arguments(), (self._anchor, self._pressure, self._values),
            (self.params, self.counts, self.partial), active=active,
        )  # fmt: skip

    def advance_rows(self, active: Sequence[int], drive: np.ndarray, written: Iterable[int]) -> None:
        """`advance` of environments with as many substeps each: drive (m, n, frames, 6, 3). written: those whose gels
        something else than a launch has changed since their last one; without the copy of all, a launch of few substeps
        takes a twentieth less."""
        if self.device is not None:
            self.advance(dict(zip(active, drive, strict=True)))
            return
        for index in written:
            self._gels.copy_surface(index)
        self.counts[:, STEPS] = drive.shape[1]
        if len(active) < len(self.counts):
            together = np.empty((len(self.counts), *drive.shape[1:]), np.float32)
            together[active] = drive
            drive = together
        self._launch(drive, active)


def _require_resolved(indenter: Indenter, gel: GelParams) -> None:
    """Raises ValueError for an indenter that fits between the contact points of the gel's surface."""
    geometry = indenter.geometry
    size = rotated_bounding_size(geometry, indenter.model_copy(update={"yaw": 0.0}).turn)  # no width depends on the yaw
    narrow, spacing = float(size[:2].min()) * MM, gel.spacing / POINTS
    if narrow < math.sqrt(2.0) * spacing:
        layers = math.ceil(gel.thickness / (narrow * POINTS / math.sqrt(2.0)))
        raise ValueError(
            f"the indenter ({geometry.shape}) is {narrow:.4g} mm wide and fits between the gel's contact points, which "
            f"lie {spacing:.4g} mm apart (element_size / {POINTS}): choose element_size at most "
            f"{math.floor(1e4 * gel.thickness / layers) / 1e4:g} mm"
        )


def _shape_params(geometry: Shape) -> tuple[int, tuple[float, ...], TiledDistance | None]:
    """Kind and size [mm] for the kernels (`signed_distance`), and the distances of a mesh."""
    match geometry:
        case Sphere():
            return SPHERE, (geometry.radius * MM, 0.0, 0.0), None
        case Cylinder():
            return CYLINDER, (geometry.radius * MM, 0.0, geometry.height / 2 * MM), None
        case Box():
            return BOX, tuple(side / 2 * MM for side in geometry.size), None
    mesh = cached_tiled_distance(geometry, MESH_GRID_SPACING)
    return GRID, tuple(float(side) * MM for side in mesh.half), mesh
