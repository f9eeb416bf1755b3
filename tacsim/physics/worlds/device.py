"""The same physics on a device (a GPU): one thread a particle, element or node, one kernel a substep.

Threads of a device cannot meet inside a loop, so each phase of a substep is a loop of its own, and the host counts the
substeps. What happens to one particle or node stands in the functions that the CPU's kernels call too; here are only
the loops round them. Sums are atomic, so their order, and the last bits, differ from run to run.

Arrays stay on the device for a launch. Before it they are copied there (distances from meshes only once they have
changed), after it what has changed is copied back, so everybody else is_active on working with NumPy.
"""

from typing import Any

import numpy as np

from tacsim.compute.runtime import launching, ti
from tacsim.physics.body.plasticine import BodyState
from tacsim.physics.body.transfers import Body, Strips, grid_to_particles, particles_to_grid
from tacsim.physics.contact.contact import ContactHistory
from tacsim.physics.contact.indenter import POINTS, Indenter, Pressure, Slip, Values, indent
from tacsim.physics.exec import layout
from tacsim.physics.exec.environment import Counts, Environment, Floats, Params, Partial, record_least
from tacsim.physics.exec.lanes import LANES, PARTS, lanes, smallest_lane, strip, vec3, vec4
from tacsim.physics.gel.element import ROWS, SMALLEST, element_block
from tacsim.physics.gel.gel import GelState
from tacsim.physics.gel.kernels import (
    Lattice,
    gel_advance,
    gels_of,
    margin,
    node_block,
    surface_at,
    surface_row,
)
from tacsim.physics.worlds.hybrid_kernels import ContactHistories, Drive, gel_contact, grid_update

Ceiling = ti.types.ndarray(dtype=ti.f32, ndim=2)  # (environments, gels) height of the highest surface node [mm]


@ti.func
def is_active(env: ti.template(), it):
    """Whether an environment takes part in this substep."""
    return it < env.count(layout.STEPS)


@ti.func
def grid_nodes(env: ti.template()):
    return env.count(layout.GRID) * env.count(layout.GRID + 1) * env.count(layout.GRID + 2)


@ti.func
def clear_sums(env: ti.template(), slot):
    """What parts add up anew each substep, but for the particles' velocities, which outlive it."""
    env.partial[env.index, slot, layout.OVERLAP] = 0.0
    for n in range(12):
        env.partial[env.index, slot, layout.FORCE + n] = 0.0
    for n in range(3):
        env.partial[env.index, slot, layout.BACKING + n] = 0.0
    for n in range(6):
        env.partial[env.index, slot, layout.HOUSING_FORCE + n] = 0.0


@ti.func
def element(env: ti.template(), gels: ti.template(), g, k, block):
    """Forces of one element of gel g on its corners."""
    gel, blocks = env.index * gels.number + g, (gels.nx + 1) * (gels.ny + 1)
    axis, row = (gels.layers + 1) * blocks, blocks + gels.ny + 2
    u = margin(gels) + gel * 9 * axis + k * blocks + block
    to = margin(gels) + (gel * gels.layers + k) * 24 * row + gels.ny + 2 + block
    rows = ti.Matrix.zero(ti.f32, ROWS, LANES)
    rows[SMALLEST, 0] = 1e9
    element_block(env, gels, block, u, axis, blocks, to, row, rows)
    record_least(env, block % PARTS, layout.SMALLEST_VOLUME, smallest_lane(rows, SMALLEST))


@ti.func
def column(env: ti.template(), gels: ti.template(), g, block):
    """Forces on one column of nodes of gel g, from its backing to its surface, and its motion."""
    gel, blocks, layers = env.index * gels.number + g, (gels.nx + 1) * (gels.ny + 1), gels.layers
    axis, row = (layers + 1) * blocks, blocks + gels.ny + 2
    for k in range(layers + 1):
        i = margin(gels) + (gel * layers + ti.min(k, layers - 1)) * 24 * row + gels.ny + 2 + block
        j = margin(gels) + (gel * layers + ti.max(k - 1, 0)) * 24 * row + gels.ny + 2 + block
        below, above = ti.select(k < layers, 1.0, 0.0), ti.select(k > 0, 1.0, 0.0)
        for d in ti.static(range(3)):
            to = margin(gels) + (gel * 9 + 6 + d) * axis + k * blocks + block
            node_block(gels, to, i + d * row, j + d * row, below, above, row, 0)
    gel_advance(env, g * blocks + block, gels)


@ti.kernel
def press_substep(
    it: ti.i32, drive: Drive,
    nodes: Floats, surface: Floats, contact_force: Floats, corners: Floats, lattice: Lattice,
    slip: Slip, pressure: Pressure, values: Values, params: Params, counts: Counts, partial: Partial, layers: ti.i32,
):  # fmt: skip
    """One substep of every environment's indenter on its gel; see `tacsim.physics.worlds.press.press_substeps`."""
    for e, slot in ti.ndrange(counts.shape[0], PARTS):
        env = ti.static(Environment(e, params, counts, partial))
        if is_active(env, it):
            clear_sums(env, slot)
    for e, k, n in ti.ndrange(counts.shape[0], layers, lattice.shape[0] // 2):
        env = ti.static(Environment(e, params, counts, partial))
        if is_active(env, it):
            element(env, ti.static(gels_of(env, nodes, surface, contact_force, corners, lattice, 1)), 0, k, n)
    for e, cell in ti.ndrange(counts.shape[0], slip.shape[1] * slip.shape[2] // (POINTS * POINTS)):
        env = ti.static(Environment(e, params, counts, partial))
        if is_active(env, it):
            gels = ti.static(gels_of(env, nodes, surface, contact_force, corners, lattice, 1))
            indent(env, cell, it, drive, gels, ti.static(Indenter(slip, pressure, values)))
    for e, n in ti.ndrange(counts.shape[0], lattice.shape[0] // 2):
        env = ti.static(Environment(e, params, counts, partial))
        if is_active(env, it):
            column(env, ti.static(gels_of(env, nodes, surface, contact_force, corners, lattice, 1)), 0, n)


# One kernel may have local arrays in one of its loops only: Taichi 1.7 mixes up the constants of several (IR broken:
# MatrixPtrStmt cannot have operand ConstStmt). So the substep of a body is three.


@ti.kernel
def elements_of_hybrid(
    it: ti.i32,
    nodes: Floats, surface: Floats, contact_force: Floats, corners: Floats, lattice: Lattice, masses: Strips,
    params: Params, counts: Counts, partial: Partial, ceiling: Ceiling, layers: ti.i32, most_nodes: ti.i32,
):  # fmt: skip
    """First third of a substep of every environment's two gels and body
    (`tacsim.physics.worlds.hybrid_kernels.substeps`): what is summed starts from zero; elements pull at their corners.
    most_nodes: of the largest grid."""
    for e, slot in ti.ndrange(counts.shape[0], PARTS):
        env = ti.static(Environment(e, params, counts, partial))
        if is_active(env, it):
            clear_sums(env, slot)
    for e, g in ti.ndrange(counts.shape[0], 2):
        if it < counts[e, layout.STEPS]:
            ceiling[e, g] = 0.0
    for e, g, n in ti.ndrange(counts.shape[0], 2, lattice.shape[0] // 2):
        env = ti.static(Environment(e, params, counts, partial))
        if is_active(env, it):
            gels = ti.static(gels_of(env, nodes, surface, contact_force, corners, lattice, 2))
            i, j = n // (gels.ny + 1), n % (gels.ny + 1)
            height = surface[surface_at(gels, surface_row(env, gels, g) + i + 1, j + 1) + 2]
            if height > ceiling[e, g]:
                ti.atomic_max(ceiling[e, g], height)
    for e, node in ti.ndrange(counts.shape[0], most_nodes):
        env = ti.static(Environment(e, params, counts, partial))
        if is_active(env, it) and node < grid_nodes(env):
            masses[e * env.count(layout.CAPACITY) + node] = strip(0.0)
    for e, g, k, n in ti.ndrange(counts.shape[0], 2, layers, lattice.shape[0] // 2):
        env = ti.static(Environment(e, params, counts, partial))
        if is_active(env, it):
            element(env, ti.static(gels_of(env, nodes, surface, contact_force, corners, lattice, 2)), g, k, n)


@ti.kernel
def scatter_of_hybrid(
    it: ti.i32, drive: Drive,
    nodes: Floats, surface: Floats, contact_force: Floats, corners: Floats, lattice: Lattice,
    particles: Floats, masses: Strips, velocities: Strips, histories: ContactHistories,
    params: Params, counts: Counts, partial: Partial, ceiling: Ceiling, most_particles: ti.i32, most_nodes: ti.i32,
):  # fmt: skip
    """Second third: contact, particles to the grid, motion of the gels' and the grid's nodes.

    most_particles, most_nodes: of the largest body and grid.
    """
    for e, p in ti.ndrange(counts.shape[0], most_particles):
        env = ti.static(Environment(e, params, counts, partial))
        if is_active(env, it) and p < env.count(layout.PARTICLES):
            gels = ti.static(gels_of(env, nodes, surface, contact_force, corners, lattice, 2))
            body = ti.static(Body(particles, masses, velocities))
            for g in range(2):
                gel_contact(env, p, g, it, drive, body, histories, gels, ceiling[e, g])
    for e, p in ti.ndrange(counts.shape[0], most_particles):
        env = ti.static(Environment(e, params, counts, partial))
        if is_active(env, it) and p < env.count(layout.PARTICLES):
            particles_to_grid(env, p, ti.static(Body(particles, masses, velocities)))
    for e, g, n in ti.ndrange(counts.shape[0], 2, lattice.shape[0] // 2):
        env = ti.static(Environment(e, params, counts, partial))
        if is_active(env, it):
            column(env, ti.static(gels_of(env, nodes, surface, contact_force, corners, lattice, 2)), g, n)
    for e, node in ti.ndrange(counts.shape[0], most_nodes):
        env = ti.static(Environment(e, params, counts, partial))
        if is_active(env, it) and node < grid_nodes(env):
            grid_update(env, node, it, drive, ti.static(Body(particles, masses, velocities)))
    for e, slot, d in ti.ndrange(counts.shape[0], PARTS, 3):
        if it < counts[e, layout.STEPS]:
            partial[e, slot, layout.VELOCITY_SUM + d] = 0.0


@ti.kernel
def gather_of_hybrid(
    it: ti.i32, particles: Floats, masses: Strips, velocities: Strips,
    params: Params, counts: Counts, partial: Partial, most_particles: ti.i32,
):  # fmt: skip
    """Last third: the grid back to the particles."""
    for e, p in ti.ndrange(counts.shape[0], most_particles):
        env = ti.static(Environment(e, params, counts, partial))
        if is_active(env, it) and p < env.count(layout.PARTICLES):
            grid_to_particles(env, p, ti.static(Body(particles, masses, velocities)))


class DeviceArrays:
    """Arrays on the device, by name: made when first asked for, and anew when a shape changes."""

    def __init__(self) -> None:
        self._there: dict[str, Any] = {}
        self._versions: dict[str, int] = {}

    def allocate(self, name: str, dtype: Any, shape: tuple[int, ...]) -> Any:
        """An array that only the device uses; zeros at first."""
        known = self._there.get(name)
        if known is None or known.shape != shape:
            self._there[name] = known = ti.ndarray(dtype, shape)
            known.fill(0)
        return known

    def upload(self, name: str, host: np.ndarray, dtype: Any) -> Any:
        """A copy of `host`, whose last axis is the vector if dtype is one."""
        there = self.allocate(name, dtype, host.shape[:-1] if isinstance(dtype, type(vec4)) else host.shape)
        there.from_numpy(np.ascontiguousarray(host))
        return there

    def upload_if_changed(self, name: str, host: np.ndarray, dtype: Any, version: int) -> Any:
        """The same of an array that seldom changes: copied only if it has another `version` than what is there."""
        if self._versions.get(name) != version:
            self.upload(name, host, dtype)
            self._versions[name] = version
        return self._there[name]

    def download(self, **hosts: np.ndarray) -> None:
        """Copies back into these arrays what the device has by their names."""
        for name, host in hosts.items():
            host[...] = self._there[name].to_numpy().reshape(host.shape)

    def upload_gels(self, gels: GelState) -> tuple[Any, ...]:
        """What every kernel with gels takes."""
        nodes, surface, contact_force, corners, lattice = gels.arguments()
        return (
            self.upload("nodes", nodes, ti.f32), self.upload("surface", surface, ti.f32),
            self.allocate("contact_force", ti.f32, contact_force.shape),
            self.allocate("corners", ti.f32, corners.shape), self.upload("lattice", lattice, lanes),
        )  # fmt: skip

    def upload_numbers(self, params: np.ndarray, counts: np.ndarray, partial: np.ndarray) -> tuple[Any, ...]:
        return (
            self.upload("params", params, ti.f32), self.upload("counts", counts, ti.i32),
            self.upload("partial", partial, ti.f32),
        )  # fmt: skip


@launching()
def run_press(
    arrays: DeviceArrays, drive: np.ndarray, gels: GelState, slip: np.ndarray, pressure: np.ndarray,
    values: np.ndarray, version: int, numbers: tuple[np.ndarray, np.ndarray, np.ndarray],
) -> None:  # fmt: skip
    """One launch; the arrays are those of `PressState`. version: another whenever `values` has changed; numbers:
    params, counts, partial."""
    arguments = (
        arrays.upload("drive", drive, ti.f32), *arrays.upload_gels(gels), arrays.upload("slip", slip, vec3),
        arrays.upload("pressure", pressure, ti.f32), arrays.upload_if_changed("values", values, ti.f32, version),
        *arrays.upload_numbers(*numbers),
    )  # fmt: skip
    for it in range(drive.shape[1]):
        press_substep(it, *arguments, gels.nodes.shape[4] - 1)
    arrays.download(nodes=gels.arguments()[0], slip=slip, pressure=pressure, partial=numbers[2])


@launching()
def run_hybrid(
    arrays: DeviceArrays, drive: np.ndarray, gels: GelState, body: BodyState, contact_history: np.ndarray,
    numbers: tuple[np.ndarray, np.ndarray, np.ndarray],
) -> None:  # fmt: skip
    """One launch; the arrays are those of `HybridState`. numbers: params, counts, partial."""
    rows, masses, velocities = body.arguments()
    drives, gel_arrays = arrays.upload("drive", drive, ti.f32), arrays.upload_gels(gels)
    bodies = (
        arrays.upload("rows", rows, ti.f32), arrays.allocate("masses", strip, masses.shape[:-1]),
        arrays.allocate("velocities", strip, velocities.shape[:-1]),
    )  # fmt: skip
    histories = arrays.upload("contact_history", contact_history, ContactHistory)
    small = arrays.upload_numbers(*numbers)
    counts = numbers[1]
    ceiling = arrays.allocate("ceiling", ti.f32, (len(counts), 2))
    layers, most_particles = gels.nodes.shape[4] - 1, max(body.counts)
    most_nodes = int(counts[:, layout.GRID : layout.GRID + 3].prod(axis=1).max())
    for it in range(drive.shape[1]):
        elements_of_hybrid(it, *gel_arrays, bodies[1], *small, ceiling, layers, most_nodes)
        scatter_of_hybrid(it, drives, *gel_arrays, *bodies, histories, *small, ceiling, most_particles, most_nodes)
        gather_of_hybrid(it, *bodies, *small, most_particles)
    arrays.download(nodes=gels.arguments()[0], rows=rows, contact_history=contact_history, partial=numbers[2])
