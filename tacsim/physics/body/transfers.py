"""The body's substep: MLS-MPM with quadratic B-splines (Hu et al. 2018). Nodes keep their velocities, and particles add
impulses; on a new grid particles give all of their momentum (APIC: Jiang et al. 2015).

The code is arranged for the vector registers of a CPU. Work on single particles (stencil, strain, return mapping) is
done for LANES particles in an inner loop over local arrays, which LLVM turns into vector operations, since local arrays
have no aliases. Each row of the particle array has one quantity of all particles, so a block is loaded and stored in
whole vectors. Transfers to and from nodes are done particle by particle, with NODES (1 or 2) neighbours of a grid line
in a register. With two, a strip begins at every second node and a stencil of three at any node: two strips hold it, and
the fourth node has weight 0.

Stencils are computed at a particle's reference position on the grid and do not change; F = I + H is the deformation
since then, and A = dv/dX the affine velocity over the reference (total-Lagrangian MPM: de Vaucorbeil et al. 2020).

On a device LANES and NODES are 1, and all inner loops run once. Lanes after the last particle stay zero.
"""

from typing import Any, NamedTuple

from tacsim.compute.runtime import ti
from tacsim.physics.body.material import (
    UNREACHABLE_LIMIT,
    full_matrix,
    gradient,
    green_strain,
    inverse_of,
    mat3,
    return_any_strain,
    return_small_strain,
    squared_norm,
    stress_small_strain,
    transport_strain,
    vec6,
)
from tacsim.physics.body.stencil import (
    INDICES,
    LARGE_STRAIN_INDEX,
    LINE,
    OFF_GRID_INDEX,
    OFFSET_ROW,
    STENCIL,
    W_X,
    W_Y,
    W_Z,
    slab_of,
    write_stencil,
)
from tacsim.physics.exec import layout
from tacsim.physics.exec.environment import record_addition, record_max, record_min, record_sum
from tacsim.physics.exec.lanes import (
    COPIES,
    LANES,
    NODES,
    ON_DEVICE,
    add_to,
    bounded,
    copy_of,
    filled,
    hide_from_compiler,
    load_rows,
    max_over_lanes,
    min_over_lanes,
    overwrite,
    part_range,
    read_four,
    read_three,
    slot_of,
    store_rows,
    strip,
    tile_numbers,
    tile_vector,
    vec3,
    write_rows,
)

Strips = ti.types.ndarray(dtype=strip, ndim=1)  # masses, velocities

# Node (i, j, n) receives w_i w_j w_n (q + i ax + j ay + n az); each of these is momentum x, y, z and mass.
MOMENTUM, MOMENTUM_X, MOMENTUM_Y, MOMENTUM_Z = range(0, 16, 4)
# Sums over the stencil: plain, and by x, y, z with the node's number as a factor
SUM, BY_X, BY_Y, BY_Z = range(4)


class Body(NamedTuple):
    """The bodies of all environments inside a kernel: the arrays of `BodyState`."""

    particles: Any
    masses: Any
    velocities: Any
    changes: Any = None  # see tacsim.physics.body.mass
    ends: Any = None  # this and the next: see tacsim.physics.body.tied_nodes
    shares: Any = None


@ti.func
def block_range(env: ti.template(), part):
    """First block of LANES particles of a part, and the one after its last."""
    return part_range((env.count(layout.PARTICLES) + LANES - 1) // LANES, part)


@ti.func
def read_six(rows: ti.template(), row: ti.template(), lane):
    return vec6([rows[row + d, lane] for d in range(6)])


@ti.func
def clear_masses(env: ti.template(), part, body: ti.template()):
    """Sets this part's copy of the grid to zero where the part may write."""
    plane = env.count(layout.GRID + 1) * (env.count(layout.GRID + 2) // NODES)
    base = (env.index * COPIES + part) * env.count(layout.CAPACITY)
    for strip_ in range(env.count(layout.SLAB + 2 * part) * plane, env.count(layout.SLAB + 2 * part + 1) * plane):
        at = hide_from_compiler(env.count(layout.ZERO), base + strip_)
        body.masses[at] = overwrite(env.count(layout.ZERO), body.masses[at], strip(0.0))


@ti.func
def return_block(
    env: ti.template(), old: ti.template(), new: ti.template(), stress: ti.template(), indices: ti.template()
):
    """Return mapping of LANES particles: elastic and plastic strain in `old` -> in `new`, and Kirchhoff stress."""
    mu, bulk = env.param(layout.BODY_MU), env.param(layout.BODY_BULK)
    yield_strain, hardening = env.param(layout.BODY_LIMIT), env.param(layout.BODY_HARDENING)
    if yield_strain < UNREACHABLE_LIMIT:
        for lane in range(LANES):
            elastic, plastic_strain, tau, large = return_small_strain(
                read_six(old, 0, lane), old[6, lane], mu, bulk, yield_strain, hardening
            )
            write_rows(new, 0, lane, elastic)
            write_rows(stress, 0, lane, tau)
            new[6, lane], indices[LARGE_STRAIN_INDEX, lane] = plastic_strain, large
    else:  # a body that never yields: no return mapping
        for lane in range(LANES):
            tau, large = stress_small_strain(read_six(old, 0, lane), mu, bulk)
            write_rows(new, 0, lane, read_six(old, 0, lane))
            write_rows(stress, 0, lane, tau)
            new[6, lane], indices[LARGE_STRAIN_INDEX, lane] = old[6, lane], large
    for lane in range(LANES):
        if indices[LARGE_STRAIN_INDEX, lane] != 0:
            elastic, plastic_strain, tau = return_any_strain(
                read_six(old, 0, lane), old[6, lane], mu, bulk, yield_strain, hardening
            )
            write_rows(new, 0, lane, elastic)
            write_rows(stress, 0, lane, tau)
            new[6, lane] = plastic_strain


@ti.func
def scatter_particle(
    env: ti.template(), body: ti.template(), momentum: ti.template(), grid: ti.template(), shares: ti.template(),
    indices: ti.template(), lane,
):  # fmt: skip
    """Adds momentum and mass of one particle to the nodes of its stencil; shares: weights of its lines along z."""
    # 0 that the compiler does not know: with a known 0 this lane would differ from its neighbours
    float_zero = ti.cast(env.count(layout.ZERO), ti.f32)
    spare = hide_from_compiler(env.count(layout.ZERO), 16)
    q, ax, ay, az = [read_four(momentum, row, lane, spare) for row in (MOMENTUM, MOMENTUM_X, MOMENTUM_Y, MOMENTUM_Z)]
    for s in ti.static(range(LINE)):
        w = tile_numbers(grid[W_Z + NODES * s, lane], grid[W_Z + NODES * s + NODES - 1, lane])
        by_x, by_y = w * tile_vector(ax), w * tile_vector(ay)
        plane = w * (
            tile_vector(q) + tile_numbers(float_zero + NODES * s, float_zero + (NODES * s + 1)) * tile_vector(az)
        )
        for i in ti.static(range(3)):
            line = plane
            for j in ti.static(range(3)):
                add_to(
                    body.masses,
                    bounded(indices[3 * i + j, lane], 4 * NODES) + s,
                    shares[3 * i + j, lane] * line,
                )
                line += by_y
            plane += by_x


@ti.func
def has_velocities(env: ti.template(), it):
    """Whether the grid's nodes have velocities in substep `it` of a launch; particles then add impulses only. Otherwise
    the grid is new, and particles give all of their momentum."""
    return it + env.count(layout.GRID_HAS_VELOCITIES) > 0


@ti.func
def particles_to_grid(env: ti.template(), part, it, body: ti.template()):
    """Return mapping of this part's particles; adds their mass and the impulses of stress and contact to the nodes of
    this part's copy of the grid, and their momentum where the nodes have no velocities."""
    zero, cell, dt = env.count(layout.ZERO), env.param(layout.BODY_CELL), env.param(layout.STEP)
    mass = env.param(layout.BODY_MASS)
    impulse, inertia = -dt * env.param(layout.BODY_VOLUME) * 4.0 / cell, mass * cell
    first_block, last_block = block_range(env, part)
    stride = env.count(layout.STRIDE)
    slab = ti.static(slab_of(env, part, (env.index * COPIES + copy_of(part)) * env.count(layout.CAPACITY)))
    lost = 0
    place = filled(0.0, 3, LANES)  # on the grid
    gradients = filled(0.0, 9, LANES)  # displacement gradient
    old = filled(0.0, 7, LANES)  # elastic strain, plastic strain
    new = filled(0.0, 7, LANES)
    stress = filled(0.0, 6, LANES)
    rate = filled(0.0, 12, LANES)  # velocity, affine velocity
    push = filled(0.0, 3, LANES)
    momentum = filled(0.0, 17, LANES)
    grid = filled(0.0, STENCIL, LANES)
    shares = filled(0.0, 9, LANES)  # of the stencil's lines
    indices = filled(0, INDICES, LANES)
    for lane in range(LANES):
        momentum[MOMENTUM + 3, lane] = mass
    for block in range(first_block, last_block):
        start = env.index * layout.PARTICLE_ROWS * stride + block * LANES
        load_rows(body.particles, start, stride, layout.STRAIN, 7, old)
        if not has_velocities(env, it):
            load_rows(body.particles, start, stride, layout.VELOCITY, 12, rate)
        load_rows(body.particles, start, stride, layout.PUSH, 3, push)
        load_rows(body.particles, start, stride, layout.REFERENCE, 3, place)
        load_rows(body.particles, start, stride, layout.GRADIENT, 9, gradients)
        for lane in range(LANES):
            write_stencil(read_three(place, 0, lane), slab, grid, indices, lane)
        return_block(env, old, new, stress, indices)
        for lane in range(LANES):
            # P = tau F^-T: its columns are tau times the rows of F^-1
            tau, back = full_matrix(read_six(stress, 0, lane)), inverse_of(gradient(gradients, lane))
            ax = impulse * (tau @ vec3([back[0, d] for d in range(3)])) + inertia * read_three(rate, 3, lane)
            ay = impulse * (tau @ vec3([back[1, d] for d in range(3)])) + inertia * read_three(rate, 6, lane)
            az = impulse * (tau @ vec3([back[2, d] for d in range(3)])) + inertia * read_three(rate, 9, lane)
            q = mass * (read_three(rate, 0, lane) + read_three(push, 0, lane))
            write_rows(push, 0, lane, vec3(0.0))
            q -= grid[OFFSET_ROW, lane] * ax + grid[OFFSET_ROW + 1, lane] * ay + grid[OFFSET_ROW + 2, lane] * az
            write_rows(momentum, MOMENTUM, lane, q)
            write_rows(momentum, MOMENTUM_X, lane, ax)
            write_rows(momentum, MOMENTUM_Y, lane, ay)
            write_rows(momentum, MOMENTUM_Z, lane, az)
            for i, j in ti.static(ti.ndrange(3, 3)):
                shares[3 * i + j, lane] = grid[W_X + i, lane] * grid[W_Y + j, lane]
        store_rows(body.particles, start, stride, layout.STRAIN, 7, new, zero)
        store_rows(body.particles, start, stride, layout.PUSH, 3, push, zero)
        for lane in range(ti.min(LANES, env.count(layout.PARTICLES) - block * LANES)):
            lost += indices[OFF_GRID_INDEX, lane]
            scatter_particle(env, body, momentum, grid, shares, indices, lane)
    record_addition(env, slot_of(part), layout.OFF_GRID, float(lost))


@ti.func
def node_sum(env: ti.template(), i, at, body: ti.template()):
    """Momentum and mass of a strip of nodes in plane i: sum of the copies of all parts, in their order."""
    if ti.static(ON_DEVICE):
        return body.masses[env.index * env.count(layout.CAPACITY) + at]
    else:
        total, zero = strip(0.0), env.count(layout.ZERO)
        for part in ti.static(range(COPIES)):
            if i >= env.count(layout.SLAB + 2 * part) and i < env.count(layout.SLAB + 2 * part + 1):
                total += body.masses[
                    hide_from_compiler(zero, (env.index * COPIES + part) * env.count(layout.CAPACITY) + at)
                ]
        return total


@ti.func
def weighted_sum(rows: ti.template(), row: ti.template(), lane, a, b, c):
    """Sum of three numbers by the weights in three rows."""
    return rows[row, lane] * a + rows[row + 1, lane] * b + rows[row + 2, lane] * c


@ti.func
def weighted_sums(rows: ti.template(), row: ti.template(), lane, a, b, c):
    """The same sum, and the sum with the node's number (0, 1, 2) as a factor."""
    second, third = rows[row + 1, lane] * b, rows[row + 2, lane] * c
    without_first = second + third
    return rows[row, lane] * a + without_first, without_first + third


@ti.func
def transport_plane(plane, step):
    """A tangent plane of the surface, transformed by F^-T with the material; step: dt L. A first-order update would add
    half the square of each substep's rotation, and a rolling body would seem to shrink."""
    return inverse_of(step).transpose() @ plane


@ti.func
def gather_velocities(
    body: ti.template(), grid: ti.template(), indices: ti.template(), nodes: ti.template(), nodes_x: ti.template(),
    nodes_y: ti.template(), nodes_z: ti.template(), sums: ti.template(), lane,
):  # fmt: skip
    """Sums SUM, BY_X, BY_Y and BY_Z of the node velocities of one particle's stencil, into `sums`; nodes, ...: local
    arrays for the same sums by nodes of a strip."""
    for c in range(4 * NODES):
        total, by_x, by_y, by_z = 0.0, 0.0, 0.0, 0.0
        for s in ti.static(range(LINE)):
            plane, sloped = vec3(0.0), vec3(0.0)  # sums over y
            for i in ti.static(range(3)):
                v0, v1, v2 = [body.velocities[bounded(indices[3 * i + j, lane], 4 * NODES) + s][c] for j in range(3)]
                plane[i], sloped[i] = weighted_sums(grid, W_Y, lane, v0, v1, v2)
            w = ti.select(c < 4, grid[W_Z + NODES * s, lane], grid[W_Z + NODES * s + NODES - 1, lane])
            here, across = weighted_sums(grid, W_X, lane, plane[0], plane[1], plane[2])
            here *= w
            total += here
            by_x += w * across
            by_y += w * weighted_sum(grid, W_X, lane, sloped[0], sloped[1], sloped[2])
            by_z += ti.select(c < 4, float(NODES * s), float(NODES * s + 1)) * here
        nodes[c, 0], nodes_x[c, 0], nodes_y[c, 0], nodes_z[c, 0] = total, by_x, by_y, by_z
    for k, of_strip in ti.static([(SUM, nodes), (BY_X, nodes_x), (BY_Y, nodes_y), (BY_Z, nodes_z)]):
        for d in ti.static(range(3)):
            total = of_strip[d, 0]
            for n in ti.static(range(1, NODES)):
                total += of_strip[4 * n + d, 0]
            sums[3 * k + d, lane] = total


@ti.func
def note_extremes(env: ti.template(), slot, extremes: ti.template()):
    """Records a part's results, rows of `extremes`: largest and summed velocity (3 components each), smallest volume
    ratio of a step, largest Green strain."""
    record_min(env, slot, layout.SMALLEST_STEP_VOLUME, min_over_lanes(extremes, 6))
    fastest = 0.0
    for lane in ti.static(range(LANES)):
        for d in ti.static(range(3)):
            fastest = ti.max(fastest, extremes[d, lane])
    record_max(env, slot, layout.PEAK_SPEED, fastest)
    record_max(env, slot, layout.SQUARED_GREEN_STRAIN, max_over_lanes(extremes, 7))
    if ti.static(not ON_DEVICE):  # a device sums them block by block (tacsim.physics.worlds.device)
        for d in ti.static(range(3)):
            total = 0.0
            for lane in ti.static(range(LANES)):
                total += extremes[3 + d, lane]
            record_sum(env, slot, layout.VELOCITY_SUM + d, total)


@ti.func
def grid_to_particles(env: ti.template(), part, body: ti.template()):
    """Interpolates velocity and affine velocity for this part's particles; updates strain, position, tangent plane.

    Particles off the grid read nodes after its end. That launch is undone, since `particles_to_grid` has counted them.
    """
    zero, dt, slot = env.count(layout.ZERO), env.param(layout.STEP), slot_of(part)
    first_block, last_block = block_range(env, part)
    stride = env.count(layout.STRIDE)
    slab = ti.static(slab_of(env, part, env.index * env.count(layout.CAPACITY)))
    place = filled(0.0, 6, LANES)  # tangent plane, position
    reference = filled(0.0, 3, LANES)  # place on the grid
    gradients = filled(0.0, 9, LANES)  # displacement gradient
    strain = filled(0.0, 6, LANES)
    rate = filled(0.0, 12, LANES)  # velocity, affine velocity
    grid = filled(0.0, STENCIL, LANES)
    indices = filled(0, INDICES, LANES)
    sums = filled(0.0, 12, LANES)  # SUM, BY_X, BY_Y, BY_Z: three numbers each
    # The same of one particle, by nodes of a strip. Four arrays: LLVM checks 100 uses of an array for aliases; with
    # more uses it would not merge lanes.
    nodes, nodes_x = filled(0.0, 4 * NODES, 1), filled(0.0, 4 * NODES, 1)
    nodes_y, nodes_z = filled(0.0, 4 * NODES, 1), filled(0.0, 4 * NODES, 1)
    extremes = filled(0.0, 8, LANES)  # see note_extremes
    for lane in range(LANES):
        extremes[6, lane] = 1e9
    for block in range(first_block, last_block):
        start = env.index * layout.PARTICLE_ROWS * stride + block * LANES
        load_rows(body.particles, start, stride, layout.PLANE, 6, place)
        load_rows(body.particles, start, stride, layout.STRAIN, 6, strain)
        load_rows(body.particles, start, stride, layout.REFERENCE, 3, reference)
        load_rows(body.particles, start, stride, layout.GRADIENT, 9, gradients)
        for lane in range(LANES):
            write_stencil(read_three(reference, 0, lane), slab, grid, indices, lane)
        count = ti.min(LANES, env.count(layout.PARTICLES) - block * LANES)
        for lane in range(count, LANES):  # after the last particle
            for r in ti.static(range(12)):
                sums[r, lane] = 0.0
        for lane in range(count):
            gather_velocities(body, grid, indices, nodes, nodes_x, nodes_y, nodes_z, sums, lane)
        for lane in range(LANES):
            velocity, factor = read_three(sums, 3 * SUM, lane), 4.0 * slab.scale
            x = factor * (read_three(sums, 3 * BY_X, lane) - grid[OFFSET_ROW, lane] * velocity)
            y = factor * (read_three(sums, 3 * BY_Y, lane) - grid[OFFSET_ROW + 1, lane] * velocity)
            z = factor * (read_three(sums, 3 * BY_Z, lane) - grid[OFFSET_ROW + 2, lane] * velocity)
            over_reference = dt * mat3([[x[i], y[i], z[i]] for i in range(3)])
            step = over_reference @ inverse_of(gradient(gradients, lane))
            volume = (mat3([[1, 0, 0], [0, 1, 0], [0, 0, 1]]) + step).determinant()
            write_rows(strain, 0, lane, transport_strain(read_six(strain, 0, lane), step))
            write_rows(place, 0, lane, transport_plane(read_three(place, 0, lane), step))
            write_rows(place, 3, lane, read_three(place, 3, lane) + dt * velocity)
            write_rows(rate, 0, lane, velocity)
            write_rows(rate, 3, lane, x)
            write_rows(rate, 6, lane, y)
            write_rows(rate, 9, lane, z)
            write_rows(gradients, 0, lane, read_three(gradients, 0, lane) + dt * x)
            write_rows(gradients, 3, lane, read_three(gradients, 3, lane) + dt * y)
            write_rows(gradients, 6, lane, read_three(gradients, 6, lane) + dt * z)
            extremes[7, lane] = ti.max(extremes[7, lane], squared_norm(green_strain(gradient(gradients, lane))))
            for d in ti.static(range(3)):
                extremes[d, lane] = ti.max(extremes[d, lane], ti.abs(velocity[d]))
                extremes[3 + d, lane] += velocity[d]
            extremes[6, lane] = ti.min(extremes[6, lane], volume)
        store_rows(body.particles, start, stride, layout.PLANE, 6, place, zero)
        store_rows(body.particles, start, stride, layout.STRAIN, 6, strain, zero)
        store_rows(body.particles, start, stride, layout.VELOCITY, 12, rate, zero)
        store_rows(body.particles, start, stride, layout.GRADIENT, 9, gradients, zero)
    note_extremes(env, slot, extremes)
