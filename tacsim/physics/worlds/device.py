"""The same physics on a device (a GPU): one thread a particle, element or node, one kernel a substep.

Threads of a device cannot meet inside a loop, so each phase of a substep is a loop of its own, and the host counts the
substeps. What happens to one particle or node stands in the functions that the CPU's kernels call too; here are only
the loops round them. Sums are atomic, so their order, and the last bits, differ from run to run.

Arrays stay on the device for a launch. Before it they are copied there (distances from meshes only once they have
changed), after it what has changed is copied back, so everybody else goes on working with NumPy.
"""

from typing import Any

import numpy as np

from tacsim.compute.runtime import launching, ti
from tacsim.physics.body.plasticine import BodyState
from tacsim.physics.body.transfers import Particles, Strips, grid_to_particles, particles_to_grid
from tacsim.physics.contact.contact import Kept
from tacsim.physics.contact.indenter import POINTS, Pressure, Slip, Values, indent
from tacsim.physics.exec.lanes import (
    LANES,
    PARTS,
    Counts,
    Params,
    Partial,
    least_lane,
    note_least,
    real,
    strip,
    vec3,
    vec4,
)
from tacsim.physics.exec.layout import (
    BACKING,
    CAPACITY,
    ELEMENTS,
    FORCE,
    GRID,
    HOUSED,
    MOTION,
    OVERLAP,
    PARTICLES,
    SMALLEST_VOLUME,
    STEPS,
)  # fmt: skip
from tacsim.physics.gel.element import ROWS, SMALLEST, element_block
from tacsim.physics.gel.gel import (
    Corners,
    GelState,
    Lattice,
    Nodes,
    Skin,
    Touch,
    gel_advance,
    margin,
    node_block,
    skin_at,
    skin_row,
)
from tacsim.physics.worlds.hybrid_kernels import ContactMemory, Drive, grid_update, touch_gel

Ceiling = ti.types.ndarray(dtype=ti.f32, ndim=2)  # (environments, gels) height of the highest surface node [mm]


@ti.func
def goes(env, it, counts: ti.template()):
    """Whether an environment takes part in this substep."""
    return it < counts[env, STEPS]


@ti.func
def clear_sums(env, slot, partial: ti.template()):
    """What parts add up anew each substep, but for the particles' motion, which outlives it."""
    partial[env, slot, OVERLAP] = 0.0
    for n in range(12):
        partial[env, slot, FORCE + n] = 0.0
    for n in range(3):
        partial[env, slot, BACKING + n] = 0.0
    for n in range(6):
        partial[env, slot, HOUSED + n] = 0.0


@ti.func
def element(
    env, gel, k, block, nodes: ti.template(), corners: ti.template(), lattice: ti.template(), params: ti.template(),
    partial: ti.template(), layers, nx, ny,
):  # fmt: skip
    """Forces of one element on its corners; gel: counted over all environments."""
    blocks = (nx + 1) * (ny + 1)
    axis, row = (layers + 1) * blocks, blocks + ny + 2
    u = margin(ny) + gel * 9 * axis + k * blocks + block
    to = margin(ny) + (gel * layers + k) * 24 * row + ny + 2 + block
    rows = ti.Matrix.zero(ti.f32, ROWS, LANES)
    rows[SMALLEST, 0] = 1e9
    element_block(env, u, axis, blocks, to, row, block, nodes, 1, ny + 1, corners, lattice, params, rows, 0)
    note_least(partial, env, block % PARTS, SMALLEST_VOLUME, least_lane(rows, SMALLEST))


@ti.func
def column(
    env, g, gels, block, nodes: ti.template(), skin: ti.template(), touch: ti.template(), corners: ti.template(),
    lattice: ti.template(), params: ti.template(), counts: ti.template(), partial: ti.template(), layers, nx, ny,
):  # fmt: skip
    """Forces on one column of nodes of gel g, from its backing to its surface, and its motion."""
    gel, blocks = env * gels + g, (nx + 1) * (ny + 1)
    axis, row = (layers + 1) * blocks, blocks + ny + 2
    for k in range(layers + 1):
        i = margin(ny) + (gel * layers + ti.min(k, layers - 1)) * 24 * row + ny + 2 + block
        j = margin(ny) + (gel * layers + ti.max(k - 1, 0)) * 24 * row + ny + 2 + block
        below, above = ti.select(k < layers, 1.0, 0.0), ti.select(k > 0, 1.0, 0.0)
        for d in ti.static(range(3)):
            node_block(
                margin(ny) + (gel * 9 + 6 + d) * axis + k * blocks + block, i + d * row, j + d * row, below, above, row,
                nodes, corners, 1, ny + 1, 0,
            )  # fmt: skip
    gel_advance(env, g * blocks + block, gels, nodes, skin, touch, lattice, params, counts, partial, layers, nx, ny)


@ti.kernel
def press_substep(
    it: ti.i32, drive: Drive,
    nodes: Nodes, skin: Skin, touch: Touch, corners: Corners, lattice: Lattice,
    slip: Slip, pressure: Pressure, values: Values, params: Params, counts: Counts, partial: Partial, layers: ti.i32,
):  # fmt: skip
    """One substep of every environment's indenter on its gel; see `tacsim.physics.worlds.press.press_substeps`."""
    for at in range(counts.shape[0] * PARTS):
        if goes(at // PARTS, it, counts):
            clear_sums(at // PARTS, at % PARTS, partial)
    for env, k, n in ti.ndrange(counts.shape[0], layers, lattice.shape[0] // 2):
        if goes(env, it, counts):
            nx, ny = counts[env, ELEMENTS], counts[env, ELEMENTS + 1]
            element(env, env, k, n, nodes, corners, lattice, params, partial, layers, nx, ny)
    for env, cell in ti.ndrange(counts.shape[0], slip.shape[1] * slip.shape[2] // (POINTS * POINTS)):
        if goes(env, it, counts):
            nx, ny = counts[env, ELEMENTS], counts[env, ELEMENTS + 1]
            indent(env, cell, it, drive, skin, touch, slip, pressure, values, params, counts, partial, nx, ny)
    for env, n in ti.ndrange(counts.shape[0], lattice.shape[0] // 2):
        if goes(env, it, counts):
            nx, ny = counts[env, ELEMENTS], counts[env, ELEMENTS + 1]
            column(env, 0, 1, n, nodes, skin, touch, corners, lattice, params, counts, partial, layers, nx, ny)


# One kernel may have local arrays in one of its loops only: Taichi 1.7 mixes up the constants of several (IR broken:
# MatrixPtrStmt cannot have operand ConstStmt). So the substep of a body is three.


@ti.kernel
def elements_of_hybrid(
    it: ti.i32, nodes: Nodes, skin: Skin, corners: Corners, lattice: Lattice, masses: Strips,
    params: Params, counts: Counts, partial: Partial, ceiling: Ceiling, layers: ti.i32, most: ti.i32,
):  # fmt: skip
    """First third of a substep of every environment's two gels and body
    (`tacsim.physics.worlds.hybrid_kernels.substeps`): what is summed starts from zero; elements pull at their corners.
    most: nodes of the largest grid."""
    for at in range(counts.shape[0] * PARTS):
        if goes(at // PARTS, it, counts):
            clear_sums(at // PARTS, at % PARTS, partial)
    for env, g in ti.ndrange(counts.shape[0], 2):
        if goes(env, it, counts):
            ceiling[env, g] = 0.0
    for env, g, n in ti.ndrange(counts.shape[0], 2, lattice.shape[0] // 2):
        if goes(env, it, counts):
            nx, ny = counts[env, ELEMENTS], counts[env, ELEMENTS + 1]
            height = skin[skin_at(skin_row(env, 2, g, nx) + n // (ny + 1) + 1, n % (ny + 1) + 1, ny) + 2]
            if height > ceiling[env, g]:
                ti.atomic_max(ceiling[env, g], height)
    for env, node in ti.ndrange(counts.shape[0], most):
        if goes(env, it, counts) and node < counts[env, GRID] * counts[env, GRID + 1] * counts[env, GRID + 2]:
            masses[env * counts[env, CAPACITY] + node] = strip(0.0)
    for env, g, k, n in ti.ndrange(counts.shape[0], 2, layers, lattice.shape[0] // 2):
        if goes(env, it, counts):
            nx, ny = counts[env, ELEMENTS], counts[env, ELEMENTS + 1]
            element(env, env * 2 + g, k, n, nodes, corners, lattice, params, partial, layers, nx, ny)


@ti.kernel
def scatter_of_hybrid(
    it: ti.i32, drive: Drive,
    nodes: Nodes, skin: Skin, touch: Touch, corners: Corners, lattice: Lattice,
    particles: Particles, masses: Strips, velocities: Strips, memory: ContactMemory,
    params: Params, counts: Counts, partial: Partial, ceiling: Ceiling, layers: ti.i32, room: ti.i32, most: ti.i32,
):  # fmt: skip
    """Second third: contact, particles to the grid, motion of the gels' and the grid's nodes.

    room: particles of the largest body.
    """
    for env, p in ti.ndrange(counts.shape[0], room):
        if goes(env, it, counts) and p < counts[env, PARTICLES]:
            nx, ny = counts[env, ELEMENTS], counts[env, ELEMENTS + 1]
            for g in range(2):
                touch_gel(
                    env, p, g, it, drive, particles, memory, skin, touch, params, counts, partial, ceiling[env, g],
                    layers, nx, ny,
                )  # fmt: skip
    for env, p in ti.ndrange(counts.shape[0], room):
        if goes(env, it, counts) and p < counts[env, PARTICLES]:
            particles_to_grid(env, p, particles, masses, params, counts, partial)
    for env, g, n in ti.ndrange(counts.shape[0], 2, lattice.shape[0] // 2):
        if goes(env, it, counts):
            nx, ny = counts[env, ELEMENTS], counts[env, ELEMENTS + 1]
            column(env, g, 2, n, nodes, skin, touch, corners, lattice, params, counts, partial, layers, nx, ny)
    for env, node in ti.ndrange(counts.shape[0], most):
        if goes(env, it, counts) and node < counts[env, GRID] * counts[env, GRID + 1] * counts[env, GRID + 2]:
            grid_update(env, node, it, drive, masses, velocities, params, counts, partial)
    for at in range(counts.shape[0] * PARTS):
        if goes(at // PARTS, it, counts):
            for d in range(3):
                partial[at // PARTS, at % PARTS, MOTION + d] = 0.0


@ti.kernel
def gather_of_hybrid(
    it: ti.i32, particles: Particles, velocities: Strips, params: Params, counts: Counts, partial: Partial,
    room: ti.i32,
):  # fmt: skip
    """Last third: the grid back to the particles."""
    for env, p in ti.ndrange(counts.shape[0], room):
        if goes(env, it, counts) and p < counts[env, PARTICLES]:
            grid_to_particles(env, p, particles, velocities, params, counts, partial)


class Mirror:
    """What a device has of the host's arrays, by name; made when first asked for, and anew when a shape changes."""

    def __init__(self) -> None:
        self._there: dict[str, Any] = {}
        self._versions: dict[str, int] = {}

    def room(self, name: str, dtype: Any, shape: tuple[int, ...]) -> Any:
        """An array that only the device uses; zeros at first."""
        known = self._there.get(name)
        if known is None or known.shape != shape:
            self._there[name] = known = ti.ndarray(dtype, shape)
            known.fill(0)
        return known

    def sent(self, name: str, host: np.ndarray, dtype: Any) -> Any:
        """A copy of `host`, whose last axis is the vector if dtype is one."""
        there = self.room(name, dtype, host.shape[:-1] if isinstance(dtype, type(vec4)) else host.shape)
        there.from_numpy(np.ascontiguousarray(host))
        return there

    def kept(self, name: str, host: np.ndarray, dtype: Any, version: int) -> Any:
        """The same of an array that seldom changes: copied only if it has another `version` than what is there."""
        if self._versions.get(name) != version:
            self.sent(name, host, dtype)
            self._versions[name] = version
        return self._there[name]

    def bring(self, **hosts: np.ndarray) -> None:
        """Copies back into these arrays what the device has by their names."""
        for name, host in hosts.items():
            host[...] = self._there[name].to_numpy().reshape(host.shape)

    def send_gels(self, gels: GelState) -> tuple[Any, ...]:
        """What every kernel with gels takes."""
        nodes, skin, touch, corners, lattice = gels.arguments()
        return (
            self.sent("nodes", nodes, ti.f32), self.sent("skin", skin, ti.f32),
            self.room("touch", ti.f32, touch.shape), self.room("corners", ti.f32, corners.shape),
            self.sent("lattice", lattice, real),
        )  # fmt: skip


@launching()
def run_press(
    mirror: Mirror, drive: np.ndarray, gels: GelState, slip: np.ndarray, pressure: np.ndarray, values: np.ndarray,
    version: int, params: np.ndarray, counts: np.ndarray, partial: np.ndarray,
) -> None:  # fmt: skip
    """One launch; the arrays are those of `PressState`. version: another whenever `values` has changed."""
    arguments = (
        mirror.sent("drive", drive, ti.f32), *mirror.send_gels(gels), mirror.sent("slip", slip, vec3),
        mirror.sent("pressure", pressure, ti.f32), mirror.kept("values", values, ti.f32, version),
        mirror.sent("facts", params, ti.f32), mirror.sent("counts", counts, ti.i32),
        mirror.sent("partial", partial, ti.f32),
    )  # fmt: skip
    for it in range(drive.shape[1]):
        press_substep(it, *arguments, gels.nodes.shape[4] - 1)
    mirror.bring(nodes=gels.arguments()[0], slip=slip, pressure=pressure, partial=partial)


@launching()
def run_hybrid(
    mirror: Mirror, drive: np.ndarray, gels: GelState, body: BodyState, memory: np.ndarray, params: np.ndarray,
    counts: np.ndarray, partial: np.ndarray,
) -> None:  # fmt: skip
    """One launch; the arrays are those of `HybridState`."""
    known, masses, velocities = body.arguments()
    there = mirror.sent("drive", drive, ti.f32)
    nodes, skin, touch, corners, lattice = mirror.send_gels(gels)
    particles = mirror.sent("known", known, ti.f32)
    mass = mirror.room("masses", strip, masses.shape[:-1])
    velocity = mirror.room("velocities", strip, velocities.shape[:-1])
    kept = mirror.sent("memory", memory, Kept)
    numbers = (
        mirror.sent("facts", params, ti.f32), mirror.sent("counts", counts, ti.i32),
        mirror.sent("partial", partial, ti.f32),
    )  # fmt: skip
    ceiling = mirror.room("ceiling", ti.f32, (len(counts), 2))
    layers, room = gels.nodes.shape[4] - 1, max(body.counts)
    most = int(counts[:, GRID : GRID + 3].prod(axis=1).max())
    for it in range(drive.shape[1]):
        elements_of_hybrid(it, nodes, skin, corners, lattice, mass, *numbers, ceiling, layers, most)
        scatter_of_hybrid(
            it, there, nodes, skin, touch, corners, lattice, particles, mass, velocity, kept, *numbers, ceiling,
            layers, room, most,
        )  # fmt: skip
        gather_of_hybrid(it, particles, velocity, *numbers, room)
    mirror.bring(nodes=gels.arguments()[0], known=known, memory=memory, partial=partial)
