"""Elastoplastic body: what its particles know, and the grid round them. Its kernels: tacsim/physics/transfers.py.

Elastic state e = b_e - I per particle. Inside: mm, N, MPa; density scaled so that the P-wave speed is 1.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tacsim.physics.gel import MM, MPA
from tacsim.physics.lanes import COPIES, NODES, PARTS, SUMS, aligned_zeros
from tacsim.physics.layout import (
    BODY_BULK,
    BODY_CELL,
    BODY_HARDENING,
    BODY_LIMIT,
    BODY_MASS,
    BODY_MU,
    BODY_VOLUME,
    CAPACITY,
    GRID,
    ORIGIN,
    PARTICLES,
    SLAB,
    STRIDE,
)
from tacsim.physics.material import ELASTIC
from tacsim.scene import BodyMaterial, lame


@dataclass(frozen=True)
class BodyFacts:
    """The body's material and resolution in kernel units."""

    spacing: float  # particle spacing h_p [mm]
    mu: float  # [MPa]
    bulk: float  # [MPa]
    limit: float  # k = sigma_y / (2 mu) [-]
    volume: float  # of one particle [mm^3]; about h_p^3
    hardening: float = 0.0  # growth of the limit by equivalent plastic strain [-]

    @property
    def density(self) -> float:
        return self.bulk + 4.0 / 3.0 * self.mu

    @property
    def cell(self) -> float:
        """Grid spacing dx: 8 particles a cell."""
        return 2 * self.spacing

    @property
    def particle_mass(self) -> float:
        return self.density * self.volume

    def facts(self) -> dict[int, float]:
        """Entries of the array `facts` (tacsim.physics.layout)."""
        return {
            BODY_CELL: self.cell, BODY_MU: self.mu, BODY_BULK: self.bulk, BODY_LIMIT: self.limit,
            BODY_HARDENING: self.hardening, BODY_MASS: self.particle_mass, BODY_VOLUME: self.volume,
        }  # fmt: skip


def body_facts(material: BodyMaterial, spacing: float, volume: float | None = None) -> BodyFacts:
    """`spacing` [m]; `volume` of one particle [m^3], without it spacing^3."""
    mu, lam = lame(material)
    limit = material.elastic_limit
    return BodyFacts(
        spacing * MM, mu * MPA, (lam + 2 * mu / 3) * MPA, limit if math.isfinite(limit) else ELASTIC,
        (spacing**3 if volume is None else volume) * MM**3, material.hardening,
    )  # fmt: skip


class BodyState:
    """Particles of all environments, in the order that kernels like; views for everybody else.

    points: (E, N, 4) position [mm]; planes: (E, N, 4) tangent planes of the body's surface [1/mm], body_surface.py.
    rates: (E, N, 4, 4) velocity; and the columns of the affine velocity, its derivatives by x, y, z.
    strains: (E, N, 8) e = b_e - I (xx, yy, zz, xy, xz, yz), equivalent plastic strain, nothing.
    masses: (E, COPIES, strips, 4 NODES) momentum and mass of NODES neighbours along z, one copy a part; velocities:
    (E, strips, 4 NODES). Lines of the grid have an even number of nodes where NODES is 2.
    """

    def __init__(self, points: Sequence[np.ndarray], planes: Sequence[np.ndarray] | None = None) -> None:
        """points, planes: of each environment, (n, 3) [mm], [1/mm]; without planes no particle knows a surface."""
        self.counts = [len(p) for p in points]
        n, e = max(self.counts), len(points)
        self.points = aligned_zeros(e, n, 4)
        self.planes = aligned_zeros(e, n, 4)
        for index, p in enumerate(points):
            self.points[index, : len(p), :3] = p
            if planes is not None:
                self.planes[index, : len(p), :3] = planes[index]
        self.rates = aligned_zeros(e, n, 4, 4)
        self.strains = aligned_zeros(e, n, 8)
        self.masses = aligned_zeros(e, COPIES, 1, 4 * NODES)
        self.velocities = aligned_zeros(e, 1, 4 * NODES)
        self._sums = aligned_zeros(e * PARTS * SUMS, 4 * NODES)

    def x(self, environment: int = 0) -> np.ndarray:
        """Positions [mm], (n, 3), a view."""
        return self.points[environment, : self.counts[environment], :3]

    def plane(self, environment: int = 0) -> np.ndarray:
        """Tangent planes [1/mm], (n, 3), a view."""
        return self.planes[environment, : self.counts[environment], :3]

    def v(self, environment: int = 0) -> np.ndarray:
        """Velocities, (n, 3), a view."""
        return self.rates[environment, : self.counts[environment], 0, :3]

    def c(self, environment: int = 0) -> np.ndarray:
        """Affine velocities, (n, 3, 3), a view."""
        return self.rates[environment, : self.counts[environment], 1:, :3].transpose(0, 2, 1)

    def e(self, environment: int = 0) -> np.ndarray:
        """Elastic strains b_e - I, (n, 6), a view."""
        return self.strains[environment, : self.counts[environment], :6]

    def flow(self, environment: int = 0) -> np.ndarray:
        """Equivalent plastic strains, (n,), a view."""
        return self.strains[environment, : self.counts[environment], 6]

    def refresh(self) -> None:
        """Zeros in the fourth numbers, which take part in sums: after somebody has written the others."""
        for array in (self.points, self.planes, self.rates):
            array[..., 3] = 0.0

    def fit(self, environment: int, cell: float, margin: float, facts: np.ndarray, counts: np.ndarray) -> None:
        """Lays the grid of one environment round its particles: it follows the body, so no index is ever clamped.

        margin [mm]: what they may move during the launch. Writes origin, node counts and the parts' slabs of node
        planes into `facts` and `counts` (tacsim.physics.layout).
        """
        x = self.x(environment)
        origin, shape = fit_grid(x, cell, margin)
        facts[environment, ORIGIN : ORIGIN + 3] = origin
        counts[environment, GRID : GRID + 3] = shape
        counts[environment, PARTICLES] = len(x)
        for part in range(COPIES):
            own = x[len(x) * part // COPIES : len(x) * (part + 1) // COPIES, 0]
            low, high = 0, 0
            if own.size:
                low = max(math.floor((float(own.min()) - margin - float(origin[0])) / cell) - 1, 0)
                high = min(math.ceil((float(own.max()) + margin - float(origin[0])) / cell) + 3, shape[0])
            counts[environment, SLAB + 2 * part : SLAB + 2 * part + 2] = low, high
        # three planes for what particles off the grid would add
        strips = (shape[0] + 3) * shape[1] * shape[2] // NODES
        if self.masses.shape[2] < strips:
            strips = strips * 5 // 4  # a body that spreads asks for more again and again
            self.masses = aligned_zeros(*self.masses.shape[:2], strips, 4 * NODES)
            self.velocities = aligned_zeros(len(self.masses), strips, 4 * NODES)
        counts[:, STRIDE], counts[:, CAPACITY] = self.points.shape[1], self.masses.shape[2]

    def arguments(self) -> tuple[np.ndarray, ...]:
        """What every kernel with a body takes, in this order."""
        return (
            self.points.reshape(-1, 4), self.planes.reshape(-1, 4), self.rates.reshape(-1, 4, 4),
            self.strains.reshape(-1, 4), self.masses.reshape(-1, 4 * NODES), self.velocities.reshape(-1, 4 * NODES),
            self._sums,
        )  # fmt: skip


def bounds(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest coordinates (3,) of points (n, 3). By columns: NumPy is ten times slower along such a row."""
    columns = [x[:, d] for d in range(x.shape[1])]
    return np.array([c.min() for c in columns]), np.array([c.max() for c in columns])


def fit_grid(x: np.ndarray, cell: float, margin: float) -> tuple[np.ndarray, tuple[int, int, int]]:
    """Origin and node counts of a grid round the particles (n, 3) [mm]; whole strips along z."""
    least, most = bounds(x)
    low = np.floor((least - margin) / cell) * cell
    counts = np.ceil((most + margin - low) / cell).astype(int) + 3
    return low.astype(np.float32), (int(counts[0]), int(counts[1]), -(-int(counts[2]) // NODES) * NODES)
