"""Elastoplastic body: APIC MLS-MPM with quadratic B-splines; elastic state e = b_e - I per particle.

Hu et al. 2018 (MLS-MPM), Jiang et al. 2015 (APIC). Inside: mm, N, MPa; density scaled so that the P-wave speed is 1.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tacsim.physics.gel import MM, MPA
from tacsim.physics.lanes import (
    COPIES,
    ON_DEVICE,
    PARTS,
    add_to,
    copy_of,
    keep_or,
    note_least,
    note_more,
    note_most,
    note_sum,
    part_range,
    slot_of,
    vec3,
    vec4,
)
from tacsim.physics.layout import (
    BODY_BULK,
    BODY_CELL,
    BODY_HARDENING,
    BODY_LIMIT,
    BODY_MASS,
    BODY_MU,
    BODY_VOLUME,
    CAPACITY,
    FASTEST,
    GRID,
    MOTION,
    NEVER,
    OFF_GRID,
    ORIGIN,
    PARTICLES,
    SLAB,
    SMALLEST_STEP_VOLUME,
    STEP,
    STRIDE,
)
from tacsim.physics.material import convect, hencky_return, mat3, vec6
from tacsim.runtime import ti
from tacsim.scene import BodyMaterial, lame

# One axis each, environments one after the other: kernels find their way with one number that they have worked out
# beforehand, which is much faster than several indices into arrays of several axes.
Points = ti.types.ndarray(dtype=vec4, ndim=1)
Rates = ti.types.ndarray(dtype=vec4, ndim=2)
Strains = ti.types.ndarray(dtype=vec4, ndim=1)
Masses = ti.types.ndarray(dtype=vec4, ndim=1)
Velocities = ti.types.ndarray(dtype=vec4, ndim=1)
Sums = ti.types.ndarray(dtype=vec4, ndim=1)
APART = 1 if ON_DEVICE else 4  # slots in `sums`: far enough that the CPU's compiler does not merge two of them
SUMS = 16 * APART  # of `sums` for each part

ELASTIC = 1e9  # strain limit that is never reached


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
    masses: (E, COPIES, nodes, 4) momentum and mass, one copy a part; velocities: (E, nodes, 4).
    """

    def __init__(self, points: Sequence[np.ndarray], planes: Sequence[np.ndarray] | None = None) -> None:
        """points, planes: of each environment, (n, 3) [mm], [1/mm]; without planes no particle knows a surface."""
        self.counts = [len(p) for p in points]
        n, e = max(self.counts), len(points)
        self.points = np.zeros((e, n, 4), np.float32)
        self.planes = np.zeros((e, n, 4), np.float32)
        for index, p in enumerate(points):
            self.points[index, : len(p), :3] = p
            if planes is not None:
                self.planes[index, : len(p), :3] = planes[index]
        self.rates = np.zeros((e, n, 4, 4), np.float32)
        self.strains = np.zeros((e, n, 8), np.float32)
        self.masses = np.zeros((e, COPIES, 1, 4), np.float32)
        self.velocities = np.zeros((e, 1, 4), np.float32)
        self._sums = np.zeros((e * PARTS * SUMS, 4), np.float32)

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
        nodes = (shape[0] + 3) * shape[1] * shape[2]  # three planes for what particles off the grid would add
        if self.masses.shape[2] < nodes:
            nodes = nodes * 5 // 4  # a body that spreads asks for more again and again
            self.masses = np.zeros((*self.masses.shape[:2], nodes, 4), np.float32)
            self.velocities = np.zeros((len(self.masses), nodes, 4), np.float32)
        counts[:, STRIDE], counts[:, CAPACITY] = self.points.shape[1], self.masses.shape[2]

    def arguments(self) -> tuple[np.ndarray, ...]:
        """What every kernel with a body takes, in this order."""
        flat = (a.reshape(-1, 4) for a in (self.strains, self.masses, self.velocities, self._sums))
        return (self.points.reshape(-1, 4), self.planes.reshape(-1, 4), self.rates.reshape(-1, 4, 4), *flat)


def fit_grid(x: np.ndarray, cell: float, margin: float) -> tuple[np.ndarray, tuple[int, int, int]]:
    """Origin and node counts of a grid round the particles (n, 3) [mm]."""
    low = np.floor((x.min(axis=0) - margin) / cell) * cell
    counts = np.ceil((x.max(axis=0) + margin - low) / cell).astype(int) + 3
    return low.astype(np.float32), (int(counts[0]), int(counts[1]), int(counts[2]))


@ti.func
def stencil(x, origin, cell, low, high, ny, nz):
    """First node of the 3x3x3 stencil, offset from it, weights by axis; `inside` is False off the slab (or NaN)."""
    s = (vec3(x[0], x[1], x[2]) - origin) * (1.0 / cell)
    wanted = ti.floor(s - 0.5).cast(ti.i32)
    base = ti.max(ti.Vector([low, 0, 0]), ti.min(wanted, ti.Vector([high - 3, ny - 3, nz - 3])))  # never a wild index
    inside = wanted[0] == base[0] and wanted[1] == base[1] and wanted[2] == base[2]
    fx = s - base.cast(ti.f32)
    w0 = 0.5 * (1.5 - fx) ** 2
    w1 = 0.75 - (fx - 1.0) ** 2
    w2 = 0.5 * (fx - 0.5) ** 2
    return inside, base, fx, w0, w1, w2


@ti.func
def clear_masses(env, part, masses: ti.template(), counts: ti.template()):
    """This part's copy of the grid, where it may write."""
    plane = counts[env, GRID + 1] * counts[env, GRID + 2]
    base = (env * COPIES + part) * counts[env, CAPACITY]
    for node in range(counts[env, SLAB + 2 * part] * plane, counts[env, SLAB + 2 * part + 1] * plane):
        masses[base + node] = vec4(0.0)


@ti.func
def strain_of(strains: ti.template(), at):
    a, b = strains[2 * at], strains[2 * at + 1]
    return vec6(a[0], a[1], a[2], a[3], b[0], b[1]), b[2]


@ti.func
def store_strain(strains: ti.template(), at, e, flow):
    strains[2 * at] = vec4(e[0], e[1], e[2], e[3])
    strains[2 * at + 1] = vec4(e[4], e[5], flow, 0.0)


@ti.func
def particles_to_grid(
    env, part, points: ti.template(), rates: ti.template(), strains: ti.template(), masses: ti.template(),
    facts: ti.template(), counts: ti.template(), partial: ti.template(),
):  # fmt: skip
    """Return mapping; momentum and mass of this part's particles onto their 27 nodes each, in its copy of the grid."""
    cell, mass, dt = facts[env, BODY_CELL], facts[env, BODY_MASS], facts[env, STEP]
    mu, bulk, limit, hardening = (
        facts[env, BODY_MU], facts[env, BODY_BULK], facts[env, BODY_LIMIT], facts[env, BODY_HARDENING]
    )  # fmt: skip
    impulse = -dt * facts[env, BODY_VOLUME] * 4.0 / cell
    origin = vec3(facts[env, ORIGIN], facts[env, ORIGIN + 1], facts[env, ORIGIN + 2])
    ny, nz = counts[env, GRID + 1], counts[env, GRID + 2]
    copy = copy_of(part)
    low, high = counts[env, SLAB + 2 * copy], counts[env, SLAB + 2 * copy + 1]
    start = env * counts[env, STRIDE]
    first_p, last_p = part_range(counts[env, PARTICLES], part)
    base = (env * COPIES + copy) * counts[env, CAPACITY]
    dump = base + counts[env, GRID] * ny * nz  # three planes behind the grid, never read: for particles off the grid
    lost = 0
    for p in range(start + first_p, start + last_p):
        inside, node, fx, w0, w1, w2 = stencil(points[p], origin, cell, low, high, ny, nz)
        lost += ti.select(inside, 0, 1)
        e, flow = strain_of(strains, p)
        elastic, new_flow, tau = hencky_return(e, flow, mu, bulk, limit, hardening)
        store_strain(strains, p, elastic, new_flow)
        inertia = mass * cell
        ax = impulse * vec4(tau[0], tau[3], tau[4], 0.0) + inertia * rates[p, 1]
        ay = impulse * vec4(tau[3], tau[1], tau[5], 0.0) + inertia * rates[p, 2]
        az = impulse * vec4(tau[4], tau[5], tau[2], 0.0) + inertia * rates[p, 3]
        velocity = rates[p, 0]
        q = mass * vec4(velocity[0], velocity[1], velocity[2], 1.0) - fx[0] * ax - fx[1] * ay - fx[2] * az
        wx, wy, wz = vec3(w0[0], w1[0], w2[0]), vec3(w0[1], w1[1], w2[1]), vec3(w0[2], w1[2], w2[2])
        first = base + (node[0] * ny + node[1]) * nz + node[2]
        first = ti.select(inside, first, dump)  # no branch: in one the compiler would not merge lanes
        for i in ti.static(range(3)):
            qi, yi, zi = wx[i] * (q + float(i) * ax), wx[i] * ay, wx[i] * az
            for j in ti.static(range(3)):
                qj, zj = wy[j] * (qi + float(j) * yi), wy[j] * zi
                line = first + (i * ny + j) * nz
                for k in ti.static(range(3)):
                    add_to(masses, line + k, wz[k] * (qj + float(k) * zj))
    note_more(partial, env, slot_of(part), OFF_GRID, float(lost))


@ti.func
def node_sum(env, i, node, masses: ti.template(), counts: ti.template()):
    """Momentum and mass of a node in plane i: the copies of all parts, in their order."""
    q = vec4(0.0)
    for part in ti.static(range(COPIES)):
        if i >= counts[env, SLAB + 2 * part] and i < counts[env, SLAB + 2 * part + 1]:
            q += masses[(env * COPIES + part) * counts[env, CAPACITY] + node]
    return q


@ti.func
def moved_plane(plane, x, y, z, dt):
    """A tangent plane of the surface goes with the material, as F^-T does: m' = -C^T m; x, y, z: columns of C."""
    return plane - dt * vec4(x.dot(plane), y.dot(plane), z.dot(plane), 0.0)


@ti.func
def grid_to_particles(
    env, part, points: ti.template(), planes: ti.template(), rates: ti.template(), strains: ti.template(),
    velocities: ti.template(), sums: ti.template(), facts: ti.template(), counts: ti.template(), partial: ti.template(),
):  # fmt: skip
    """`gather` with this part's share of `sums`."""
    drop = (env * PARTS + part) * SUMS
    gather(env, part, points, planes, rates, strains, velocities, sums, drop, facts, counts, partial)


@ti.func
def gather(
    env, part, points: ti.template(), planes: ti.template(), rates: ti.template(), strains: ti.template(),
    velocities: ti.template(), sums: ti.template(), drop: ti.template(), facts: ti.template(), counts: ti.template(),
    partial: ti.template(),
):  # fmt: skip
    """Velocity and affine velocity back to this part's particles; strain and position follow.

    No branch for particles off the grid, which would keep the compiler from merging lanes: they read some node of it,
    and the launch is taken back anyway, since particles_to_grid has counted them.
    """
    never, dt, cell = counts[env, NEVER], facts[env, STEP], facts[env, BODY_CELL]
    origin = vec3(facts[env, ORIGIN], facts[env, ORIGIN + 1], facts[env, ORIGIN + 2])
    ny, nz = counts[env, GRID + 1], counts[env, GRID + 2]
    copy, slot = copy_of(part), slot_of(part)
    low, high = counts[env, SLAB + 2 * copy], counts[env, SLAB + 2 * copy + 1]
    start = env * counts[env, STRIDE]
    first_p, last_p = part_range(counts[env, PARTICLES], part)
    base = env * counts[env, CAPACITY]
    total, fastest, smallest = vec4(0.0), 0.0, 1e9
    for p in range(start + first_p, start + last_p):
        _, node, fx, w0, w1, w2 = stencil(points[p], origin, cell, low, high, ny, nz)
        wx, wy, wz = vec3(w0[0], w1[0], w2[0]), vec3(w0[1], w1[1], w2[1]), vec3(w0[2], w1[2], w2[2])
        first = base + (node[0] * ny + node[1]) * nz + node[2]
        # Sums by line, then by plane, dropped in `sums` on their way: this is where vectors of four are recognised.
        for i in ti.static(range(3)):
            for j in ti.static(range(3)):
                line = first + (i * ny + j) * nz
                middle, end = velocities[line + 1], velocities[line + 2]
                sums[drop + APART * j] = wz[0] * velocities[line] + wz[1] * middle + wz[2] * end
                sums[drop + APART * (12 + j)] = wz[1] * middle + (2.0 * wz[2]) * end
            new = wy[0] * sums[drop] + wy[1] * sums[drop + APART] + wy[2] * sums[drop + APART * 2]
            sums[drop + APART * (3 + i)] = keep_or(never, sums[drop + APART * (3 + i)], new)
            new = wy[1] * sums[drop + APART] + (2.0 * wy[2]) * sums[drop + APART * 2]
            sums[drop + APART * (6 + i)] = keep_or(never, sums[drop + APART * (6 + i)], new)
            new = wy[0] * sums[drop + APART * 12] + wy[1] * sums[drop + APART * 13] + wy[2] * sums[drop + APART * 14]
            sums[drop + APART * (9 + i)] = keep_or(never, sums[drop + APART * (9 + i)], new)
        velocity = wx[0] * sums[drop + APART * 3] + wx[1] * sums[drop + APART * 4] + wx[2] * sums[drop + APART * 5]
        x = wx[1] * sums[drop + APART * 4] + (2.0 * wx[2]) * sums[drop + APART * 5]
        y = wx[0] * sums[drop + APART * 6] + wx[1] * sums[drop + APART * 7] + wx[2] * sums[drop + APART * 8]
        z = wx[0] * sums[drop + APART * 9] + wx[1] * sums[drop + APART * 10] + wx[2] * sums[drop + APART * 11]
        scale = 4.0 / cell
        x, y, z = scale * (x - fx[0] * velocity), scale * (y - fx[1] * velocity), scale * (z - fx[2] * velocity)
        rates[p, 0] = keep_or(never, rates[p, 0], velocity)
        rates[p, 1] = keep_or(never, rates[p, 1], x)
        rates[p, 2] = keep_or(never, rates[p, 2], y)
        rates[p, 3] = keep_or(never, rates[p, 3], z)
        points[p] = points[p] + dt * velocity
        planes[p] = moved_plane(planes[p], x, y, z, dt)
        step = dt * mat3([[x[i], y[i], z[i]] for i in range(3)])
        smallest = ti.min(smallest, (mat3([[1, 0, 0], [0, 1, 0], [0, 0, 1]]) + step).determinant())
        e, flow = strain_of(strains, p)
        store_strain(strains, p, convect(e, step), flow)
        fastest = ti.max(fastest, ti.abs(velocity[0]), ti.abs(velocity[1]), ti.abs(velocity[2]))
        total += velocity
    note_least(partial, env, slot, SMALLEST_STEP_VOLUME, smallest)
    note_most(partial, env, slot, FASTEST, fastest)
    for d in ti.static(range(3)):
        note_sum(partial, env, slot, MOTION + d, total[d])
