"""The same physics on a device (a GPU): one thread for each particle, element or node, one kernel for each substep.

Threads of a device cannot synchronise inside a loop, so each phase of a substep is a separate loop, and the host counts
the substeps. The functions for single particles and nodes are those of the CPU's kernels; this module has the loops.
Sums are atomic, so their order and the last bits differ from run to run.

Its arrays: tacsim.physics.worlds.device_state.
"""

from tacsim.compute.runtime import ti
from tacsim.physics.body.grid_motion import Drive, grid_update
from tacsim.physics.body.mass import CHANGE, SECOND, cell_means, grid_changes, second_changes
from tacsim.physics.body.tied_node_kernels import Ends, set_tied_velocities, transfer_impulses
from tacsim.physics.body.transfers import Body, Strips, grid_to_particles, particles_to_grid
from tacsim.physics.contact.indenter import (
    POINTS,
    Anchor,
    Indenter,
    Pressure,
    Values,
    apply_indenter,
    update_node_pressure,
)
from tacsim.physics.exec import layout
from tacsim.physics.exec.environment import Counts, Environment, Floats, Params, Partial, record_min
from tacsim.physics.exec.graph import Graph
from tacsim.physics.exec.lanes import LANES, PARTS, min_over_lanes, strip
from tacsim.physics.gel.element import MIN_VOLUME_ROW, ROWS, element_block
from tacsim.physics.gel.kernels import (
    Gels,
    Lattice,
    columns_of,
    first_node,
    gel_advance,
    gel_of,
    gel_of_part,
    node_block,
    nodes_of_part,
    surface_at,
)
from tacsim.physics.gel.mass import gel_advance_filtered, gel_filter_first_pass, gel_means
from tacsim.physics.worlds.hybrid_kernels import ContactHistories, Records, gel_contact, store_record
from tacsim.physics.worlds.survey import BLOCKS
from tacsim.physics.worlds.survey_kernels import Sums

# (2,) number of this substep, for all loops but the last, which increments it; the same for the last.
Clock = ti.types.ndarray(dtype=ti.i32, ndim=1)
# (environments, gels, 2) height of the highest surface node [mm], at least 0, in even substeps and in odd ones.
Ceiling = ti.types.ndarray(dtype=ti.f32, ndim=3)


@ti.func
def is_active(env: ti.template(), clock: ti.template()):
    """Whether an environment takes part in this substep."""
    return clock[0] < env.count(layout.STEPS)


@ti.func
def grid_nodes(env: ti.template()):
    return env.count(layout.GRID) * env.count(layout.GRID + 1) * env.count(layout.GRID + 2)


@ti.func
def clear_sums(env: ti.template(), slot):
    """Sets the sums of a substep to zero, without the sum of the particles' velocities, which is kept."""
    env.partial[env.index, slot, layout.OVERLAP] = 0.0
    for n in range(12):
        env.partial[env.index, slot, layout.FORCE + n] = 0.0
    for n in range(3):
        env.partial[env.index, slot, layout.BACKING + n] = 0.0
    for n in range(6):
        env.partial[env.index, slot, layout.HOUSING_FORCE + n] = 0.0


@ti.func
def element_forces(env: ti.template(), gels: ti.template(), k, n):
    """Corner forces of the element whose first node is in column n and layer k."""
    gel = ti.static(gel_of(env, gels, gel_of_part(env, gels, n)))
    _slot, block, _last = nodes_of_part(env, gels, gel, n)
    if k < gel.layers:
        blocks = columns_of(gel)
        axis, row = (gel.layers + 1) * blocks, blocks + gel.ny + 2
        u = first_node(env, gel) + k * blocks + block
        to = env.count(layout.GEL_CORNERS + gel.index) + k * 24 * row + gel.ny + 2 + block
        rows = ti.Matrix.zero(ti.f32, ROWS, LANES)
        rows[MIN_VOLUME_ROW, 0] = 1e9
        element_block(env, gel, block, u, axis, blocks, to, row, rows)
        record_min(env, block % PARTS, layout.SMALLEST_VOLUME, min_over_lanes(rows, MIN_VOLUME_ROW))


@ti.func
def column_forces(env: ti.template(), gels: ti.template(), n):
    """Elements' forces on node column n, from its backing to its surface."""
    gel = ti.static(gel_of(env, gels, gel_of_part(env, gels, n)))
    _slot, block, _last = nodes_of_part(env, gels, gel, n)
    blocks, layers = columns_of(gel), gel.layers
    axis, row = (layers + 1) * blocks, blocks + gel.ny + 2
    for k in range(layers + 1):
        corners = env.count(layout.GEL_CORNERS + gel.index) + gel.ny + 2 + block
        i, j = corners + ti.min(k, layers - 1) * 24 * row, corners + ti.max(k - 1, 0) * 24 * row
        below, above = ti.select(k < layers, 1.0, 0.0), ti.select(k > 0, 1.0, 0.0)
        for d in ti.static(range(3)):
            to = first_node(env, gel) + (6 + d) * axis + k * blocks + block
            node_block(gel, to, i + d * row, j + d * row, below, above, row, 0)


@ti.kernel
def press_substep(
    clock: Clock, drive: Drive,
    nodes: Floats, surface: Floats, contact_force: Floats, corners: Floats, lattice: Lattice,
    anchor: Anchor, pressure: Pressure, values: Values,
    params: Params, counts: Counts, partial: Partial, layers: ti.i32, columns: ti.i32,
):  # fmt: skip
    """One substep of every environment's indenter on its gel; see `tacsim.physics.worlds.press_kernels.substeps`."""
    for e, k, n in ti.ndrange(counts.shape[0], layers, columns):
        env = ti.static(Environment(e, params, counts, partial))
        if is_active(env, clock):
            element_forces(env, ti.static(Gels(nodes, surface, contact_force, corners, lattice, 1)), k, n)
            if k == 0 and n < PARTS:
                clear_sums(env, n)
        if e + k + n == 0:
            clock[1] = clock[0]
    for e, cell in ti.ndrange(counts.shape[0], anchor.shape[1] * anchor.shape[2] // (POINTS * POINTS)):
        env = ti.static(Environment(e, params, counts, partial))
        if is_active(env, clock):
            gels = ti.static(Gels(nodes, surface, contact_force, corners, lattice, 1))
            apply_indenter(
                env,
                cell,
                clock[0],
                drive,
                ti.static(gel_of(env, gels, 0)),
                ti.static(Indenter(anchor, pressure, values)),
            )
    for e, n in ti.ndrange(counts.shape[0], columns):
        env = ti.static(Environment(e, params, counts, partial))
        if clock[1] < counts[e, layout.STEPS]:
            gels = ti.static(Gels(nodes, surface, contact_force, corners, lattice, 1))
            update_node_pressure(env, n, ti.static(gel_of(env, gels, 0)))
            column_forces(env, gels, n)
            gel_advance(env, n, gels)
        if e + n == 0:
            clock[0] += 1


# A kernel may have local arrays in one of its loops only: Taichi 1.7 confuses the constants of several loops (IR
# broken: MatrixPtrStmt cannot have operand ConstStmt). So the substep of a body has three kernels. A loop length that
# is computed at the loop is a separate launch on a device: therefore all lengths are computed at the beginning of a
# kernel.


@ti.kernel
def elements_of_hybrid(
    clock: Clock, nodes: Floats, corners: Floats, lattice: Lattice,
    params: Params, counts: Counts, partial: Partial, ceiling: Ceiling, layers: ti.i32, columns: ti.i32,
):  # fmt: skip
    """First third of a substep of every environment's two gels and body
    (`tacsim.physics.worlds.hybrid_kernels.substeps`): corner forces of the elements; sums are set to zero."""
    for e, k, n in ti.ndrange(counts.shape[0], layers, columns):
        env = ti.static(Environment(e, params, counts, partial))
        if is_active(env, clock):
            element_forces(env, ti.static(Gels(nodes, None, None, corners, lattice, 2)), k, n)
            if k == 0 and n < PARTS:
                clear_sums(env, n)
            if k == 0 and n < 2:
                ceiling[e, n, (clock[0] + 1) % 2] = 0.0
        if e + k + n == 0:
            clock[1] = clock[0]


@ti.kernel
def scatter_of_hybrid(
    clock: Clock, drive: Drive,
    nodes: Floats, surface: Floats, contact_force: Floats, corners: Floats, lattice: Lattice,
    particles: Floats, masses: Strips, velocities: Strips, changes: Floats, ends: Ends, shares: Floats,
    histories: ContactHistories, params: Params, counts: Counts, partial: Partial, ceiling: Ceiling,
    columns: ti.i32, max_particles: ti.i32, max_nodes: ti.i32, max_links: ti.i32,
):  # fmt: skip
    """Second third: contact, particles to the grid, motion of the gels' and the grid's nodes; sets grid masses to zero.

    columns: of nodes of both gels; max_particles, max_nodes, max_links: of the largest body and grid.
    """
    columns_and_nodes = columns + max_nodes
    all_particles, all_nodes = counts.shape[0] * max_particles, counts.shape[0] * max_nodes
    all_columns_and_nodes, all_links = counts.shape[0] * columns_and_nodes, counts.shape[0] * max_links
    for i in range(all_particles):
        e, p = i // max_particles, i % max_particles
        env = ti.static(Environment(e, params, counts, partial))
        if is_active(env, clock) and p < env.count(layout.PARTICLES):
            gels = ti.static(Gels(nodes, surface, contact_force, corners, lattice, 2))
            body = ti.static(Body(particles, masses, velocities))
            for g in range(2):
                gel_contact(env, p, g, clock[0], drive, body, histories, gels, ceiling[e, g, clock[0] % 2])
            particles_to_grid(env, p, clock[0], body)
    for i in range(all_columns_and_nodes):
        e, n = i // columns_and_nodes, i % columns_and_nodes
        env = ti.static(Environment(e, params, counts, partial))
        if is_active(env, clock):
            if n < columns:
                gels = ti.static(Gels(nodes, surface, contact_force, corners, lattice, 2))
                column_forces(env, gels, n)
                gel_means(env, n, gels)
            elif n - columns < grid_nodes(env):
                body = ti.static(Body(particles, masses, velocities, changes))
                grid_changes(env, n - columns, body)
    for i in range(all_links):
        e, n = i // max_links, i % max_links
        env = ti.static(Environment(e, params, counts, partial))
        if is_active(env, clock) and n < env.count(layout.IMPULSE_LINKS + PARTS):
            transfer_impulses(env, n, ti.static(Body(particles, masses, velocities, changes, ends, shares)))
    for i in range(all_columns_and_nodes):
        e, n = i // columns_and_nodes, i % columns_and_nodes
        env = ti.static(Environment(e, params, counts, partial))
        if is_active(env, clock):
            if n < columns:
                gel_filter_first_pass(env, n, ti.static(Gels(nodes, surface, contact_force, corners, lattice, 2)))
            elif n - columns < grid_nodes(env):
                cell_means(env, n - columns, CHANGE, ti.static(Body(particles, masses, velocities, changes)))
    for i in range(all_columns_and_nodes):
        e, n = i // columns_and_nodes, i % columns_and_nodes
        env = ti.static(Environment(e, params, counts, partial))
        if is_active(env, clock):
            if n < columns:
                gels = ti.static(Gels(nodes, surface, contact_force, corners, lattice, 2))
                gel_advance_filtered(env, n, gels)
                gel = ti.static(gel_of(env, gels, gel_of_part(env, gels, n)))
                _slot, at, _last = nodes_of_part(env, gels, gel, n)
                x, y, g = at // (gel.ny + 1), at % (gel.ny + 1), gel.index
                height = surface[surface_at(gel, x + 1, y + 1) + 2]
                if height > ceiling[e, g, (clock[0] + 1) % 2]:
                    ti.atomic_max(ceiling[e, g, (clock[0] + 1) % 2], height)
            elif n - columns < grid_nodes(env):
                second_changes(env, n - columns, ti.static(Body(particles, masses, velocities, changes)))
    for i in range(all_nodes):
        e, node = i // max_nodes, i % max_nodes
        env = ti.static(Environment(e, params, counts, partial))
        if is_active(env, clock) and node < grid_nodes(env):
            cell_means(env, node, SECOND, ti.static(Body(particles, masses, velocities, changes)))
    for i in range(all_nodes):
        e, node = i // max_nodes, i % max_nodes
        env = ti.static(Environment(e, params, counts, partial))
        if is_active(env, clock) and node < grid_nodes(env):
            grid_update(env, node, clock[0], drive, ti.static(Body(particles, masses, velocities, changes)))
            masses[e * env.count(layout.CAPACITY) + node] = strip(0.0)
    for i in range(all_links):
        e, n = i // max_links, i % max_links
        env = ti.static(Environment(e, params, counts, partial))
        if is_active(env, clock) and n < env.count(layout.IMPULSE_LINKS + PARTS):
            set_tied_velocities(env, n, ti.static(Body(particles, masses, velocities, changes, ends, shares)))


@ti.kernel
def gather_of_hybrid(
    clock: Clock, particles: Floats, masses: Strips, velocities: Strips,
    params: Params, counts: Counts, partial: Partial, records: Records, sums: Sums, max_particles: ti.i32,
):  # fmt: skip
    """Last third: grid to particles, and the sum of their velocities, block by block: atomic additions of single
    particles would wait for a few addresses, with another order each time."""
    slots, all_particles = counts.shape[0] * PARTS, counts.shape[0] * max_particles
    blocks, sums_of_slots = counts.shape[0] * 3 * BLOCKS, counts.shape[0] * PARTS * 3
    for i in range(slots):
        e, slot = i // PARTS, i % PARTS
        env = ti.static(Environment(e, params, counts, partial))
        if is_active(env, clock):
            store_record(env, slot, clock[0], records)
    for i in range(all_particles):
        e, p = i // max_particles, i % max_particles
        env = ti.static(Environment(e, params, counts, partial))
        if is_active(env, clock) and p < env.count(layout.PARTICLES):
            grid_to_particles(env, p, ti.static(Body(particles, masses, velocities)))
    for i in range(blocks):
        e, d, block = i // (3 * BLOCKS), i // BLOCKS % 3, i % BLOCKS
        env = ti.static(Environment(e, params, counts, partial))
        if is_active(env, clock):
            row = (e * layout.PARTICLE_ROWS + layout.VELOCITY + d) * env.count(layout.STRIDE)
            total = 0.0
            for n in range((env.count(layout.PARTICLES) - block + BLOCKS - 1) // BLOCKS):
                total += particles[row + n * BLOCKS + block]  # neighbouring threads read neighbours
            sums[e, d, block] = total
    for i in range(sums_of_slots):
        e, slot, d = i // (3 * PARTS), i // 3 % PARTS, i % 3
        if clock[1] < counts[e, layout.STEPS]:
            total = 0.0
            for block in range(slot * BLOCKS // PARTS, (slot + 1) * BLOCKS // PARTS):
                total += sums[e, d, block]
            partial[e, slot, layout.VELOCITY_SUM + d] = total
        if e + slot + d == 0:
            clock[0] += 1


press_substeps = Graph(press_substep)
hybrid_substeps = Graph(elements_of_hybrid, scatter_of_hybrid, gather_of_hybrid)
