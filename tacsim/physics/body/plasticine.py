"""Elastoplastic body: what its particles know, and the grid round them. Its kernels: tacsim/physics/body/transfers.py.

Elastic state e = b_e - I per particle. Inside: mm, N, MPa; density scaled so that the P-wave speed is 1.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tacsim.models.material import BodyMaterial, elastic_constants
from tacsim.physics.body.followers import Links, links, node_masses
from tacsim.physics.body.material import UNREACHABLE_LIMIT
from tacsim.physics.body.tuning import STENCIL_REACH
from tacsim.physics.exec import layout
from tacsim.physics.exec.lanes import CACHE_LINE, COPIES, LANES, MAX_NUMBERS, NODES, PARTS, aligned_zeros, padded
from tacsim.physics.units import MM, MPA


@dataclass(frozen=True)
class BodyParams:
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

    def params(self) -> dict[int, float]:
        """Entries of the array `params` (tacsim.physics.exec.layout)."""
        return {
            layout.BODY_CELL: self.cell, layout.BODY_MU: self.mu, layout.BODY_BULK: self.bulk,
            layout.BODY_LIMIT: self.limit, layout.BODY_HARDENING: self.hardening,
            layout.BODY_MASS: self.particle_mass, layout.BODY_VOLUME: self.volume,
        }  # fmt: skip


def body_params(material: BodyMaterial, spacing: float, volume: float | None = None) -> BodyParams:
    """`spacing` [m]; `volume` of one particle [m^3], without it spacing^3."""
    mu, lam = elastic_constants(material)
    limit = material.elastic_limit
    return BodyParams(
        spacing * MM, mu * MPA, (lam + 2 * mu / 3) * MPA, limit if math.isfinite(limit) else UNREACHABLE_LIMIT,
        (spacing**3 if volume is None else volume) * MM**3, material.hardening,
    )  # fmt: skip


@dataclass(frozen=True)
class Laid:
    """Where a body's particles lie on their grid, which they do for many launches, and what follows from it."""

    rows: np.ndarray  # (3, n) [mm]
    extents: np.ndarray  # of `BodyState.extents`
    centre: np.ndarray  # (3,) [mm]
    arms: np.ndarray  # (3, n) from the centre, in float64 [mm]
    second: np.ndarray  # (3, 3) sum of arm arm^T [mm^2]


class BodyState:
    """Particles of all environments and the grid they move on, laid out for the kernels: whole lanes and cache lines.

    rows: (E, PARTICLE_ROWS, W) one number of all particles a row (tacsim.physics.exec.layout), zeros behind the last
    particle; masses: (E, COPIES, strips, 4 NODES) momentum and mass of NODES neighbours along z, one copy a part;
    velocities: (E, strips, 4 NODES); changes: (E, 3, strips, 4 NODES), of tacsim.physics.body.mass; ends: (E, 2, 2, n)
    and shares (E, 2, n) of light nodes, see tacsim.physics.body.followers.
    Lines of the grid have an even number of nodes where NODES is 2.
    """

    def __init__(self, points: Sequence[np.ndarray], planes: Sequence[np.ndarray] | None = None) -> None:
        """points, planes: of each environment, (n, 3) [mm], [1/mm]; without planes no particle knows a surface."""
        self.counts = [len(p) for p in points]
        self.rows = aligned_zeros(len(points), layout.PARTICLE_ROWS, row_length(max(self.counts)))
        for index, p in enumerate(points):
            self.x(index)[...] = self.reference(index)[...] = p
            if planes is not None:
                self.plane(index)[...] = planes[index]
        self.masses = aligned_zeros(len(points), COPIES, 1, 4 * NODES)
        self.velocities = aligned_zeros(len(points), 1, 4 * NODES)
        self.changes = aligned_zeros(len(points), 3, 1, 4 * NODES)
        self.ends = np.zeros((len(points), 2, 2, 1), np.int32)
        self.shares = np.zeros((len(points), 2, 1), np.float32)
        self._laid: dict[int, Laid] = {}
        self._linked: dict[int, tuple[Laid, tuple[int, int, int], Links]] = {}  # and how the grid was laid then
        self._grid: dict[int, tuple[int, int, int]] = {}  # nodes of the grids whose velocities outlive a launch

    def place(self, environment: int, points: np.ndarray, planes: np.ndarray) -> None:
        """Another body in one environment, at rest, see __init__. Rows of all grow if this one has more particles."""
        count, room = len(points), self.rows.shape[2]
        if row_length(count) > room:
            rows = aligned_zeros(*self.rows.shape[:2], row_length(count))
            rows[..., :room] = self.rows
            self.rows = rows
        self.counts[environment] = count
        self.forget_grid(environment)
        self.rows[environment] = 0.0
        self.x(environment)[...], self.plane(environment)[...] = points, planes
        self.reference(environment)[...] = points

    def _rows(self, environment: int, first: int, count: int) -> np.ndarray:
        return self.rows[environment, first : first + count, : self.counts[environment]]

    def whole(self, environment: int) -> np.ndarray:
        """All that its particles know (PARTICLE_ROWS, n), a view."""
        return self._rows(environment, 0, layout.PARTICLE_ROWS)

    def x(self, environment: int = 0) -> np.ndarray:
        """Positions [mm], (n, 3), a view."""
        return self._rows(environment, layout.POSITION, 3).T

    def plane(self, environment: int = 0) -> np.ndarray:
        """Tangent planes [1/mm], (n, 3), a view."""
        return self._rows(environment, layout.PLANE, 3).T

    def v(self, environment: int = 0) -> np.ndarray:
        """Velocities, (n, 3), a view."""
        return self._rows(environment, layout.VELOCITY, 3).T

    def c(self, environment: int = 0) -> np.ndarray:
        """Affine velocities over the places on the grid, (n, 3, 3), a view."""
        columns: np.ndarray = self.rows[environment, layout.AFFINE : layout.AFFINE + 9].reshape(3, 3, -1)
        return columns[..., : self.counts[environment]].T

    def reference(self, environment: int = 0) -> np.ndarray:
        """Places on the grid [mm], (n, 3), a view."""
        return self._rows(environment, layout.REFERENCE, 3).T

    def gradient(self, environment: int = 0) -> np.ndarray:
        """Displacement gradients H since they were there, (n, 3, 3), a view."""
        columns: np.ndarray = self.rows[environment, layout.GRADIENT : layout.GRADIENT + 9].reshape(3, 3, -1)
        return columns[..., : self.counts[environment]].T

    def deformation(self, environment: int = 0) -> np.ndarray:
        """F = I + H, (n, 3, 3)."""
        f: np.ndarray = np.eye(3, dtype=np.float32) + self.gradient(environment)
        return f

    def e(self, environment: int = 0) -> np.ndarray:
        """Elastic strains b_e - I, (n, 6), a view."""
        return self._rows(environment, layout.STRAIN, 6).T

    def plastic_strain(self, environment: int = 0) -> np.ndarray:
        """Equivalent plastic strains, (n,), a view."""
        return self._rows(environment, layout.PLASTIC_STRAIN, 1).reshape(-1)

    @property
    def most(self) -> int:
        """Grid nodes that each environment may have: its share of what kernels can count, in all copies."""
        return MAX_NUMBERS // (4 * COPIES * len(self.rows))

    def spin(self, environment: int = 0) -> np.ndarray:
        """C F^T, (n, 3, 3): its skew part is that of the angular momentum, over mass dx^2/4."""
        spin: np.ndarray = self.c(environment) @ self.deformation(environment).swapaxes(1, 2)
        return spin

    def move_reference(self, environment: int) -> None:
        """Moves the grid's reference to where the particles are now: there they are on the grid, undeformed.

        What strains of the affine velocity is C F^-1; what spins keeps the angular momentum, mass dx^2/4 skew(C F^T).
        """
        c, f = self.c(environment), self.deformation(environment)
        in_space = c @ np.linalg.inv(f)
        more = (self.spin(environment) - in_space) / 2
        c[...] = in_space + more - more.swapaxes(1, 2)
        self.reference(environment)[...] = self.x(environment)
        self.gradient(environment)[...] = 0.0
        self.forget_grid(environment)

    def grid_velocity(self, environment: int, shape: tuple[int, int, int] | None = None) -> np.ndarray:
        """Of the nodes of its grid, (nx, ny, nz, 3), a view; of no nodes where particles alone know how they move, as
        before the first launch and where the grid is laid anew. shape: as from `grid_kept`, if not the present one."""
        nx, ny, nz = self.grid_kept(environment) if shape is None else shape
        strips: np.ndarray = self.velocities[environment, : nx * ny * nz // NODES]
        return strips.reshape(nx, ny, nz, 4)[:, :, : max(nz - NODES + 1, 0), :3]

    def keep_grid(self, environment: int, counts: np.ndarray, velocities: np.ndarray | None = None) -> None:
        """From now on the nodes of its grid, as it is laid, have the velocities that stand there, or these."""
        nx, ny, nz = counts[environment, layout.GRID : layout.GRID + 3].tolist()
        self._grid[environment] = (nx, ny, nz)
        if velocities is not None:
            self.velocities[environment] = 0.0
            self.grid_velocity(environment)[...] = velocities

    def forget_grid(self, environment: int) -> None:
        """From now on its particles alone know how they move."""
        self._grid.pop(environment, None)

    def grid_kept(self, environment: int) -> tuple[int, int, int]:
        """How many nodes, with padding, the grid has whose nodes have velocities; zeros if there is none."""
        return self._grid.get(environment, (0, 0, 0))

    def laid(self, environment: int) -> Laid:
        """How its particles lie on the grid; worked out anew only if a place is another one than at the last call."""
        rows, known = self._rows(environment, layout.REFERENCE, 3), self._laid.get(environment)
        if known is None or not np.array_equal(known.rows, rows):
            x = self.reference(environment)
            centre = centre_of(x)
            arms = (x - centre).T
            known = Laid(rows.copy(), extents_of(x), centre, arms, arms @ arms.T)
            self._laid[environment] = known
        return known

    def extents(self, environment: int) -> np.ndarray:
        """Lowest and highest places on the grid of each part's particles [mm], (COPIES, 2, 3); of a part without any,
        infinity and minus infinity."""
        return self.laid(environment).extents

    def fit(
        self, environment: int, cell: float, margin: float, params: np.ndarray, counts: np.ndarray,
        extents: np.ndarray | None = None,
    ) -> None:  # fmt: skip
        """Lays the grid of one environment round its particles' places on it, so no index is ever clamped.

        margin [mm]: how far from them a node at its border is, at least; extents: those of `extents`, if they are
        known. Writes origin, node counts and the parts' slabs of node planes into `params` and `counts`
        (tacsim.physics.exec.layout).

        The memory of all environments grows if this one needs more; of what stands in it only velocities outlive a
        substep. Raises MemoryError, with that memory as it was, where there is none.
        """
        extents = self.extents(environment) if extents is None else extents
        origin, shape = fit_grid(*bounds_of(extents), cell, margin)
        params[environment, layout.ORIGIN : layout.ORIGIN + 3] = origin
        counts[environment, layout.GRID : layout.GRID + 3] = shape
        counts[environment, layout.PARTICLES] = self.counts[environment]
        for part, (lowest, highest) in enumerate(extents[:, :, 0].tolist()):
            low, high = 0, 0
            if lowest <= highest:
                low = max(math.ceil((lowest - float(origin[0])) / cell - STENCIL_REACH), 0)
                high = min(math.floor((highest - float(origin[0])) / cell + STENCIL_REACH) + 1, shape[0])
            counts[environment, layout.SLAB + 2 * part : layout.SLAB + 2 * part + 2] = low, high
        # three planes for what particles off the grid would add
        strips = (shape[0] + 3) * shape[1] * shape[2] // NODES
        if self.masses.shape[2] < strips:
            # a body that spreads asks for more again and again
            room = max(strips, min(strips * 5 // 4, self.most // NODES))
            masses = aligned_zeros(*self.masses.shape[:2], room, 4 * NODES)
            velocities = aligned_zeros(len(masses), room, 4 * NODES)
            changes = aligned_zeros(len(masses), 3, room, 4 * NODES)
            velocities[:, : self.velocities.shape[1]] = self.velocities
            self.masses, self.velocities, self.changes = masses, velocities, changes
        counts[environment, layout.GRID_MOVES] = self._grid.get(environment) == shape
        self._link(environment, origin, cell, shape, counts)
        counts[:, layout.STRIDE], counts[:, layout.CAPACITY] = self.rows.shape[2], self.masses.shape[2]

    def _link(
        self, environment: int, origin: np.ndarray, cell: float, shape: tuple[int, int, int], counts: np.ndarray
    ) -> None:  # fmt: skip
        """Finds light nodes and their leaders, which stay for as long as the particles' places on the grid do."""
        laid, known = self.laid(environment), self._linked.get(environment)
        if known is None or known[0] is not laid or known[1] != shape:
            found = links(node_masses(self.reference(environment), origin, cell, shape))
            known = self._linked[environment] = laid, shape, found
            number = found.shares.shape[1]
            if number > self.shares.shape[2]:
                more = (0, number * 5 // 4 - self.shares.shape[2])
                self.ends = np.pad(self.ends, ((0, 0), (0, 0), (0, 0), more))
                self.shares = np.pad(self.shares, ((0, 0), (0, 0), more))
            self.ends[environment, ..., :number], self.shares[environment, :, :number] = found.ends, found.shares
        counts[:, layout.LINKS] = self.shares.shape[2]
        for first, parts in zip((layout.PUSHES, layout.MOVES), known[2].parts, strict=True):
            counts[environment, first : first + PARTS + 1] = parts

    def links(self) -> tuple[np.ndarray, np.ndarray]:
        """What kernels whose light nodes follow take besides `arguments`."""
        return self.ends.reshape(-1), self.shares.reshape(-1)

    def arguments(self) -> tuple[np.ndarray, ...]:
        """What every kernel with a body takes, in this order."""
        return self.rows.reshape(-1), self.masses.reshape(-1, 4 * NODES), self.velocities.reshape(-1, 4 * NODES)


def row_length(particles: int) -> int:
    """Room for so many particles in a row: whole cache lines and odd many, so that rows do not compete for places in
    the cache, which holds few lines whose addresses differ by a power of two."""
    return (-(-particles // CACHE_LINE) | 1) * CACHE_LINE


def first_particle(part: int, particles: int) -> int:
    """Where a part of the particles begins: at a block of lanes (tacsim.physics.body.transfers.block_range)."""
    return min(padded(particles) // LANES * part // COPIES * LANES, particles)


def extents_of(x: np.ndarray) -> np.ndarray:
    """See `BodyState.extents`; x: places of all particles (n, 3)."""
    found = np.empty((COPIES, 2, 3), np.float32)
    for part in range(COPIES):
        own = x[first_particle(part, len(x)) : first_particle(part + 1, len(x))]
        found[part] = bounds(own) if len(own) else ([[np.inf] * 3, [-np.inf] * 3])
    return found


def bounds(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest coordinates (3,) of points (n, 3). By columns: NumPy is ten times slower along such a row."""
    columns = [x[:, d] for d in range(x.shape[1])]
    return np.array([c.min() for c in columns]), np.array([c.max() for c in columns])


def centre_of(x: np.ndarray) -> np.ndarray:
    """Mean (3,) of points (n, 3) in float64."""
    centre: np.ndarray = x.T.mean(axis=1, dtype=np.float64)
    return centre


def bounds_of(extents: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest coordinates (3,) over all parts, (COPIES, 2, 3)."""
    return extents[:, 0].min(axis=0), extents[:, 1].max(axis=0)


def fit_grid(
    least: np.ndarray, most: np.ndarray, cell: float, margin: float
) -> tuple[np.ndarray, tuple[int, int, int]]:
    """Origin and node counts of a grid round particles from `least` to `most` (3,) [mm]; whole strips along z.

    The middle of the body is a node: what is symmetric about it stays so. margin: at least a cell.
    """
    middle, reach = (least + most) / 2, np.ceil(((most - least) / 2 + margin) / cell).astype(int)
    counts = 2 * reach + 1
    return (middle - reach * cell).astype(np.float32), (
        int(counts[0]),
        int(counts[1]),
        -(-int(counts[2]) // NODES) * NODES,
    )
