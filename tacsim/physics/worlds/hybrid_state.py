"""Arrays of two gels and a plasticine body, of several environments."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from tacsim.compute.runtime import start_taichi
from tacsim.geometry.sampling import body_points
from tacsim.geometry.shapes import bounding_size, enclosed_volume
from tacsim.models.scene import Scene
from tacsim.physics.body.moments import Moments, moments_of
from tacsim.physics.body.plasticine import BodyParams, BodyState, body_params, centre_of
from tacsim.physics.body.surface import tangent_planes
from tacsim.physics.body.tuning import STENCIL_REACH
from tacsim.physics.contact.contact import ContactHistory
from tacsim.physics.exec.lanes import ON_DEVICE, PARTS
from tacsim.physics.exec.layout import COUNTS, NUMBERS, PARAMS, RECORDS
from tacsim.physics.exec.team import run_team
from tacsim.physics.gel.gel import GelParams, GelState, common_lattices, gel_params
from tacsim.physics.units import MM
from tacsim.physics.worlds.fem import FemState, stack_drives
from tacsim.physics.worlds.hybrid_kernels import substeps
from tacsim.physics.worlds.tuning import INITIAL_GAP

if TYPE_CHECKING:
    from tacsim.physics.worlds.device_state import DeviceHybrid


class HybridState(FemState):
    """Arrays of E environments that one launch of `substeps` advances; each environment is a HybridWorld.

    Environments share the gels' lattices; each has its own body, materials, friction and settling.
    """

    device: DeviceHybrid | None = None

    def __init__(self, scenes: Sequence[Scene]) -> None:
        """Raises ValueError for gels with different lattices."""
        start_taichi()
        self.gel = [_gels_of(scene) for scene in scenes]
        self._gels = GelState(common_lattices(self.gel), len(scenes))
        placed = [_body_at_start(scene) for scene in scenes]
        self.body = [body for body, _, _ in placed]
        self.heights = [float(points[:, 2].std()) for _, points, _ in placed]  # of the particles, standard deviation
        self._particles = BodyState([points for _, points, _ in placed], [planes for _, _, planes in placed])
        # memory of the contact law [mm]
        self._contact_history = np.zeros((len(scenes), 2, max(self._particles.counts), ContactHistory.n), np.float32)
        self.params = np.zeros((len(scenes), PARAMS), np.float32)
        self.counts = np.zeros((len(scenes), COUNTS), np.int32)
        self._gels.write_layout(self.counts)
        self.partial = np.zeros((len(scenes), PARTS, NUMBERS), np.float32)
        self.records = np.zeros((len(scenes), RECORDS, PARTS, NUMBERS), np.float32)
        if ON_DEVICE:
            from tacsim.physics.worlds.device_state import DeviceHybrid

            numbers = self.params, self.counts, self.partial
            self.device = DeviceHybrid(
                self._gels, numbers, self.records, self._particles, lambda: self._contact_history
            )

    @property
    def particle_counts(self) -> Sequence[int]:
        """Number of particles of each environment; no download from a device."""
        return self._particles.counts

    @property
    def particles(self) -> BodyState:
        self._copy_to_host()
        return self._particles

    @property
    def contact_history(self) -> np.ndarray:
        self._copy_to_host()
        return self._contact_history

    def extents(self, index: int) -> np.ndarray:
        """See `BodyState.extents`. This and the next methods are for one environment, on the CPU or a device."""
        return self._particles.extents(index) if self.device is None else self.device.survey(index).extents

    def fit_grid(self, index: int, cell: float, extents: np.ndarray) -> None:
        """Fits its grid. Raises MemoryError."""
        # nodes at the border have no mass: all nodes with mass have eight cells (tacsim.physics.body.mass)
        room = len(self._particles.velocities[0])
        self._particles.fit_grid(index, cell, STENCIL_REACH * cell, self.params, self.counts, extents)
        if self.device is not None and len(self._particles.velocities[0]) > room:
            self.device.copy_to_host()  # arrays that have grown are sent again

    def stored_grid_shape(self, index: int) -> tuple[int, int, int]:
        """See `BodyState.stored_grid_shape`."""
        return self._particles.stored_grid_shape(index)

    def moments(self, index: int) -> Moments:
        return moments_of(self._particles, index) if self.device is None else self.device.moments(index)

    def centre(self, index: int) -> np.ndarray:
        """Mean position of the particles (3,) [mm]."""
        return centre_of(self._particles.x(index)) if self.device is None else self.device.moments(index).centre

    def positions_and_planes(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        """Positions [mm] and tangent planes [1/mm] of the particles, (n, 3) both."""
        if self.device is not None:
            return self.device.positions_and_planes(index)
        return self._particles.x(index), self._particles.plane(index)

    @property
    def max_nodes(self) -> int:
        """See `BodyState.max_grid_nodes`."""
        return self._particles.max_grid_nodes

    def place(self, index: int, scene: Scene) -> None:
        """Puts the initial state of another scene into one environment. Raises ValueError for gels with other
        lattices."""
        gels = _gels_of(scene)
        common_lattices([*self.gel, gels])
        body, points, planes = _body_at_start(scene)
        self.gel[index], self.body[index], self.heights[index] = gels, body, float(points[:, 2].std())
        self.gels.clear(index)
        self.particles.place(index, points, planes)
        missing = max(self.particles.counts) - self.contact_history.shape[2]
        if missing > 0:
            self._contact_history = np.pad(self.contact_history, ((0, 0), (0, 0), (0, missing), (0, 0)))
        self.contact_history[index], self.params[index], self.partial[index] = 0.0, 0.0, 0.0
        self.counts[index] = 0
        self._gels.write_layout(self.counts)

    def advance(self, drives: Mapping[int, np.ndarray]) -> None:
        drive = stack_drives(drives, self.counts)
        if self.device is not None:
            self.device.run(drive)
        else:
            self._gels.copy_surface()
            body = self._particles
            run_team(
                substeps, drive, self._gels.arguments(),
                (*body.arguments(), body.changes.reshape(-1), *body.links()), self._contact_history,
                (self.params, self.counts, self.partial), self.records, active=list(drives),
            )  # fmt: skip
        for index in drives:
            self._particles.set_grid_velocities(index, self.counts)


def _gels_of(scene: Scene) -> tuple[GelParams, ...]:
    return tuple(gel_params(scene.gel_of(name), scene.element_size_of(name)) for name in scene.sensors)


def _body_at_start(scene: Scene) -> tuple[BodyParams, np.ndarray, np.ndarray]:
    """A scene's body: parameters, initial particle positions (n, 3) [mm], their tangent planes (n, 3) [1/mm]."""
    assert scene.body is not None
    height = float(bounding_size(scene.body.geometry)[2])
    points = body_points(scene.body, scene.spacing)
    body = body_params(scene.body.material, scene.spacing, volume=enclosed_volume(scene.body.geometry) / len(points))
    planes = tangent_planes(scene.body.geometry, points, scene.spacing) / MM
    return body, (points + [0.0, 0.0, height / 2 + INITIAL_GAP]) * MM, planes
