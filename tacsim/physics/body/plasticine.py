"""Elastoplastic body: state of its particles, and their grid. Its kernels: tacsim/physics/body/transfers.py.

Elastic state e = b_e - I per particle. Inside: mm, N, MPa; density scaled so that the P-wave speed is 1.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tacsim.models.material import BodyMaterial, elastic_constants
from tacsim.physics.body.material import UNREACHABLE_LIMIT
from tacsim.physics.body.tied_nodes import Links, node_masses, tied_node_links
from tacsim.physics.body.tuning import STENCIL_REACH
from tacsim.physics.exec import layout
from tacsim.physics.exec.lanes import (
    CACHE_LINE,
    COPIES,
    LANES,
    MAX_NUMBERS,
    NODES,
    PARTS,
    aligned_zeros,
    round_up_to_lanes,
)
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
class GridLayout:
    """Reference positions of a body's particles on their grid, which stay for many launches, and sums of them."""

    rows: np.ndarray  # (3, n) [mm]
    extents: np.ndarray  # of `BodyState.extents`
    centre: np.ndarray  # (3,) [mm]
    arms: np.ndarray  # (3, n) from the centre, in float64 [mm]
    second: np.ndarray  # (3, 3) sum of arm arm^T [mm^2]


class BodyState:
    """Particles of all environments and their grids, arranged for the kernels in whole lanes and cache lines.

    rows: (E, PARTICLE_ROWS, W), each row one quantity of all particles (tacsim.physics.exec.layout), zeros after the
    last particle; masses: (E, COPIES, strips, 4 NODES) momentum and mass of NODES neighbours along z, one copy a part;
    velocities: (E, strips, 4 NODES); changes: (E, 3, strips, 4 NODES), of tacsim.physics.body.mass; ends: (E, 2, 2, n)
    and shares (E, 2, n) of tied nodes, see tacsim.physics.body.tied_nodes.
    Lines of the grid have an even number of nodes where NODES is 2.
    """

    def __init__(self, points: Sequence[np.ndarray], planes: Sequence[np.ndarray] | None = None) -> None:
        """points, planes: of each environment, (n, 3) [mm], [1/mm]; without planes all of them are zero."""
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
        self._laid: dict[int, GridLayout] = {}
        self._linked: dict[int, tuple[GridLayout, tuple[int, int, int], Links]] = {}  # and the grid's shape then
        self._grid: dict[int, tuple[int, int, int]] = {}  # shapes of the grids whose velocities are kept after a launch

    def place(self, environment: int, points: np.ndarray, planes: np.ndarray) -> None:
        """Puts another body into one environment, at rest, see __init__. All rows grow if it has more particles."""
        count, room = len(points), self.rows.shape[2]
        if row_length(count) > room:
            rows = aligned_zeros(*self.rows.shape[:2], row_length(count))
            rows[..., :room] = self.rows
            self.rows = rows
        self.counts[environment] = count
        self.drop_grid_velocities(environment)
        self.rows[environment] = 0.0
        self.x(environment)[...], self.plane(environment)[...] = points, planes
        self.reference(environment)[...] = points

    def _rows(self, environment: int, first: int, count: int) -> np.ndarray:
        return self.rows[environment, first : first + count, : self.counts[environment]]

    def particle_rows(self, environment: int) -> np.ndarray:
        """All quantities of its particles (PARTICLE_ROWS, n), a view."""
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
        """Affine velocities over the reference positions, (n, 3, 3), a view."""
        columns: np.ndarray = self.rows[environment, layout.AFFINE : layout.AFFINE + 9].reshape(3, 3, -1)
        return columns[..., : self.counts[environment]].T

    def reference(self, environment: int = 0) -> np.ndarray:
        """Reference positions on the grid [mm], (n, 3), a view."""
        return self._rows(environment, layout.REFERENCE, 3).T

    def gradient(self, environment: int = 0) -> np.ndarray:
        """Displacement gradients H since the reference, (n, 3, 3), a view."""
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
    def max_grid_nodes(self) -> int:
        """Grid nodes that each environment may have: its share of the largest index of kernels, in all copies."""
        return MAX_NUMBERS // (4 * COPIES * len(self.rows))

    def spin_matrices(self, environment: int = 0) -> np.ndarray:
        """C F^T, (n, 3, 3): its skew part is that of the angular momentum, over mass dx^2/4."""
        spin: np.ndarray = self.c(environment) @ self.deformation(environment).swapaxes(1, 2)
        return spin

    def move_reference(self, environment: int) -> None:
        """Makes the particles' present positions the reference on the grid, in which they are undeformed.

        The symmetric part of the affine velocity becomes that of C F^-1; the skew part conserves the angular momentum,
        mass dx^2/4 skew(C F^T).
        """
        c, f = self.c(environment), self.deformation(environment)
        in_space = c @ np.linalg.inv(f)
        more = (self.spin_matrices(environment) - in_space) / 2
        c[...] = in_space + more - more.swapaxes(1, 2)
        self.reference(environment)[...] = self.x(environment)
        self.gradient(environment)[...] = 0.0
        self.drop_grid_velocities(environment)

    def grid_velocity(self, environment: int, shape: tuple[int, int, int] | None = None) -> np.ndarray:
        """Velocities of the grid's nodes, (nx, ny, nz, 3), a view; empty where only particles have velocities: before
        the first launch, and on a new grid. shape: of `stored_grid_shape`, if not the present one."""
        nx, ny, nz = self.stored_grid_shape(environment) if shape is None else shape
        strips: np.ndarray = self.velocities[environment, : nx * ny * nz // NODES]
        return strips.reshape(nx, ny, nz, 4)[:, :, : max(nz - NODES + 1, 0), :3]

    def set_grid_velocities(self, environment: int, counts: np.ndarray, velocities: np.ndarray | None = None) -> None:
        """Marks the velocities of the present grid's nodes as valid; `velocities` replaces them."""
        nx, ny, nz = counts[environment, layout.GRID : layout.GRID + 3].tolist()
        self._grid[environment] = (nx, ny, nz)
        if velocities is not None:
            self.velocities[environment] = 0.0
            self.grid_velocity(environment)[...] = velocities

    def drop_grid_velocities(self, environment: int) -> None:
        """Marks the velocities of the grid's nodes as not valid: only the particles' velocities count."""
        self._grid.pop(environment, None)

    def stored_grid_shape(self, environment: int) -> tuple[int, int, int]:
        """Node counts, with padding, of the grid whose nodes have velocities; zeros if there is none."""
        return self._grid.get(environment, (0, 0, 0))

    def grid_layout(self, environment: int) -> GridLayout:
        """Reference positions of its particles; computed again only if a position has changed since the last call."""
        rows, known = self._rows(environment, layout.REFERENCE, 3), self._laid.get(environment)
        if known is None or not np.array_equal(known.rows, rows):
            x = self.reference(environment)
            centre = centre_of(x)
            arms = (x - centre).T
            known = GridLayout(rows.copy(), extents_of(x), centre, arms, arms @ arms.T)
            self._laid[environment] = known
        return known

    def extents(self, environment: int) -> np.ndarray:
        """Lowest and highest reference positions of each part's particles [mm], (COPIES, 2, 3); infinity and minus
        infinity for a part without particles."""
        return self.grid_layout(environment).extents

    def fit_grid(
        self, environment: int, cell: float, margin: float, params: np.ndarray, counts: np.ndarray,
        extents: np.ndarray | None = None,
    ) -> None:  # fmt: skip
        """Fits the grid of one environment to its particles' reference positions, so that all indices are valid.

        margin [mm]: smallest distance of border nodes from the particles; extents: of `extents`, if known. Writes
        origin, node counts and the parts' slabs of node planes into `params` and `counts` (tacsim.physics.exec.layout).

        The memory of all environments grows if this one needs more; only velocities are kept between substeps. Raises
        MemoryError, with the old memory unchanged, where there is not enough.
        """
        extents = self.extents(environment) if extents is None else extents
        origin, shape = grid_around(*bounds_of_parts(extents), cell, margin)
        params[environment, layout.ORIGIN : layout.ORIGIN + 3] = origin
        counts[environment, layout.GRID : layout.GRID + 3] = shape
        counts[environment, layout.PARTICLES] = self.counts[environment]
        for part, (lowest, highest) in enumerate(extents[:, :, 0].tolist()):
            low, high = 0, 0
            if lowest <= highest:
                low = max(math.ceil((lowest - float(origin[0])) / cell - STENCIL_REACH), 0)
                high = min(math.floor((highest - float(origin[0])) / cell + STENCIL_REACH) + 1, shape[0])
            counts[environment, layout.SLAB + 2 * part : layout.SLAB + 2 * part + 2] = low, high
        # three more planes, which take what particles off the grid add
        strips = (shape[0] + 3) * shape[1] * shape[2] // NODES
        if self.masses.shape[2] < strips:
            # with reserve, since a body that spreads needs more nodes again and again
            room = max(strips, min(strips * 5 // 4, self.max_grid_nodes // NODES))
            masses = aligned_zeros(*self.masses.shape[:2], room, 4 * NODES)
            velocities = aligned_zeros(len(masses), room, 4 * NODES)
            changes = aligned_zeros(len(masses), 3, room, 4 * NODES)
            velocities[:, : self.velocities.shape[1]] = self.velocities
            self.masses, self.velocities, self.changes = masses, velocities, changes
        counts[environment, layout.GRID_HAS_VELOCITIES] = self._grid.get(environment) == shape
        self._tie_nodes(environment, origin, cell, shape, counts)
        counts[:, layout.STRIDE], counts[:, layout.CAPACITY] = self.rows.shape[2], self.masses.shape[2]

    def _tie_nodes(
        self, environment: int, origin: np.ndarray, cell: float, shape: tuple[int, int, int], counts: np.ndarray
    ) -> None:  # fmt: skip
        """Finds tied nodes and their full nodes; they stay until the particles' reference positions change."""
        current, known = self.grid_layout(environment), self._linked.get(environment)
        if known is None or known[0] is not current or known[1] != shape:
            found = tied_node_links(node_masses(self.reference(environment), origin, cell, shape))
            known = self._linked[environment] = current, shape, found
            number = found.shares.shape[1]
            if number > self.shares.shape[2]:
                more = (0, number * 5 // 4 - self.shares.shape[2])
                self.ends = np.pad(self.ends, ((0, 0), (0, 0), (0, 0), more))
                self.shares = np.pad(self.shares, ((0, 0), (0, 0), more))
            self.ends[environment, ..., :number], self.shares[environment, :, :number] = found.ends, found.shares
        counts[:, layout.LINKS] = self.shares.shape[2]
        for first, parts in zip((layout.IMPULSE_LINKS, layout.VELOCITY_LINKS), known[2].parts, strict=True):
            counts[environment, first : first + PARTS + 1] = parts

    def links(self) -> tuple[np.ndarray, np.ndarray]:
        """Arguments of kernels with tied nodes, in addition to `arguments`."""
        return self.ends.reshape(-1), self.shares.reshape(-1)

    def arguments(self) -> tuple[np.ndarray, ...]:
        """Arguments of every kernel with a body, in this order."""
        return self.rows.reshape(-1), self.masses.reshape(-1, 4 * NODES), self.velocities.reshape(-1, 4 * NODES)


def row_length(particles: int) -> int:
    """Length of a row of so many particles: an odd number of whole cache lines, so that rows do not displace each other
    in the cache, which holds few lines whose addresses differ by a power of two."""
    return (-(-particles // CACHE_LINE) | 1) * CACHE_LINE


def first_particle(part: int, particles: int) -> int:
    """First particle of a part: the first of a block of lanes (tacsim.physics.body.transfers.block_range)."""
    return min(round_up_to_lanes(particles) // LANES * part // COPIES * LANES, particles)


def extents_of(x: np.ndarray) -> np.ndarray:
    """See `BodyState.extents`; x: positions of all particles (n, 3)."""
    found = np.empty((COPIES, 2, 3), np.float32)
    for part in range(COPIES):
        own = x[first_particle(part, len(x)) : first_particle(part + 1, len(x))]
        found[part] = bounds_of_points(own) if len(own) else ([[np.inf] * 3, [-np.inf] * 3])
    return found


def bounds_of_points(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest coordinates (3,) of points (n, 3). By columns, which is ten times faster in NumPy."""
    columns = [x[:, d] for d in range(x.shape[1])]
    return np.array([c.min() for c in columns]), np.array([c.max() for c in columns])


def centre_of(x: np.ndarray) -> np.ndarray:
    """Mean (3,) of points (n, 3) in float64."""
    centre: np.ndarray = x.T.mean(axis=1, dtype=np.float64)
    return centre


def bounds_of_parts(extents: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest coordinates (3,) over all parts, (COPIES, 2, 3)."""
    return extents[:, 0].min(axis=0), extents[:, 1].max(axis=0)


def grid_around(
    low: np.ndarray, high: np.ndarray, cell: float, margin: float
) -> tuple[np.ndarray, tuple[int, int, int]]:
    """Origin and node counts of a grid around particles from `low` to `high` (3,) [mm]; whole strips along z.

    The middle of the body is a node, which keeps symmetric bodies symmetric. margin: at least a cell.
    """
    middle, reach = (low + high) / 2, np.ceil(((high - low) / 2 + margin) / cell).astype(int)
    counts = 2 * reach + 1
    return (middle - reach * cell).astype(np.float32), (
        int(counts[0]),
        int(counts[1]),
        -(-int(counts[2]) // NODES) * NODES,
    )
