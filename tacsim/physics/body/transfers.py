"""The body's substep: MLS-MPM with quadratic B-splines (Hu et al. 2018). Nodes keep their velocities, particles give
them impulses; where the grid is laid anew they give all of their momentum (APIC: Jiang et al. 2015).

Work is laid out for a CPU's vector registers. What concerns one particle alone (stencil, strain, return mapping) is
done for LANES particles in an inner loop over arrays of its own, which LLVM turns into whole vectors: nothing else can
lie where it writes. Particles are kept in rows of one number of all of them, so such a block is loaded and stored in
whole vectors, too. What goes to nodes and comes from them is done particle by particle with NODES neighbours of a grid
line in a register, one or two; with two a strip begins at every second node, a stencil of three at any, so two strips
hold it, and the node too many has weight 0.

Stencils belong to where a particle was when the grid was laid, its reference, and stay; F = I + H is its deformation
since then, and A = dv/dX its affine velocity over the reference (total-Lagrangian MPM: de Vaucorbeil et al. 2020).

On a device LANES and NODES are 1, and all inner loops run once. Lanes behind the last particle stay zero.
"""

from typing import Any, NamedTuple

from tacsim.compute.runtime import ti
from tacsim.physics.body.material import (
    UNREACHABLE_LIMIT,
    convect,
    full,
    gradient,
    green,
    inverse_of,
    mat3,
    return_any_strain,
    return_small_strain,
    square,
    stress_small_strain,
    vec6,
)
from tacsim.physics.body.stencil import (
    AT,
    INDICES,
    LARGE,
    LINE,
    OFF,
    STENCIL,
    W_X,
    W_Y,
    W_Z,
    slab_of,
    stencil,
)
from tacsim.physics.exec import layout
from tacsim.physics.exec.environment import record_least, record_more, record_most, record_sum
from tacsim.physics.exec.lanes import (
    COPIES,
    LANES,
    NODES,
    ON_DEVICE,
    add_to,
    bounded,
    copy_of,
    filled,
    four,
    largest_lane,
    load_rows,
    opaque,
    overwrite,
    part_range,
    put,
    slot_of,
    smallest_lane,
    store_rows,
    strip,
    three,
    vec3,
)

Strips = ti.types.ndarray(dtype=strip, ndim=1)  # masses, velocities

# What node (i, j, n) gets is w_i w_j w_n (q + i ax + j ay + n az), each of these momentum x, y, z and mass.
MOMENTUM, MOMENTUM_X, MOMENTUM_Y, MOMENTUM_Z = range(0, 16, 4)
# Sums over the stencil: plain, and by x, y, z with the node's number as a factor
SUM, BY_X, BY_Y, BY_Z = range(4)


class Body(NamedTuple):
    """The bodies of all environments inside a kernel: the arrays of `BodyState`."""

    particles: Any
    masses: Any
    velocities: Any
    changes: Any = None  # see tacsim.physics.body.mass
    ends: Any = None  # these two: see tacsim.physics.body.followers
    shares: Any = None


@ti.func
def per_node(a):
    """A vector of four for every node of a strip."""
    return strip([a[c % 4] for c in range(4 * NODES)])


@ti.func
def by_node(first, second):
    """The numbers of the nodes of a strip, each four times."""
    return strip([(first, second)[c // 4] for c in range(4 * NODES)])


@ti.func
def block_range(env: ti.template(), part):
    """First block of LANES particles that a part does, and the one after its last."""
    return part_range((env.count(layout.PARTICLES) + LANES - 1) // LANES, part)


@ti.func
def six(rows: ti.template(), row: ti.template(), lane):
    return vec6([rows[row + d, lane] for d in range(6)])


@ti.func
def clear_masses(env: ti.template(), part, body: ti.template()):
    """This part's copy of the grid, where it may write."""
    plane = env.count(layout.GRID + 1) * (env.count(layout.GRID + 2) // NODES)
    base = (env.index * COPIES + part) * env.count(layout.CAPACITY)
    for strip_ in range(env.count(layout.SLAB + 2 * part) * plane, env.count(layout.SLAB + 2 * part + 1) * plane):
        at = opaque(env.count(layout.ZERO), base + strip_)
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
                six(old, 0, lane), old[6, lane], mu, bulk, yield_strain, hardening
            )
            put(new, 0, lane, elastic)
            put(stress, 0, lane, tau)
            new[6, lane], indices[LARGE, lane] = plastic_strain, large
    else:  # a body that never yields: no return mapping
        for lane in range(LANES):
            tau, large = stress_small_strain(six(old, 0, lane), mu, bulk)
            put(new, 0, lane, six(old, 0, lane))
            put(stress, 0, lane, tau)
            new[6, lane], indices[LARGE, lane] = old[6, lane], large
    for lane in range(LANES):
        if indices[LARGE, lane] != 0:
            elastic, plastic_strain, tau = return_any_strain(
                six(old, 0, lane), old[6, lane], mu, bulk, yield_strain, hardening
            )
            put(new, 0, lane, elastic)
            put(stress, 0, lane, tau)
            new[6, lane] = plastic_strain


@ti.func
def scatter(
    env: ti.template(), body: ti.template(), momentum: ti.template(), grid: ti.template(), shares: ti.template(),
    indices: ti.template(), lane,
):  # fmt: skip
    """Adds momentum and mass of one particle to the nodes of its stencil; shares: weights of its lines along z."""
    # 0, but a 0 that the compiler knows would make a lane unlike its neighbours
    float_zero = ti.cast(env.count(layout.ZERO), ti.f32)
    spare = opaque(env.count(layout.ZERO), 16)
    q, ax, ay, az = [four(momentum, row, lane, spare) for row in (MOMENTUM, MOMENTUM_X, MOMENTUM_Y, MOMENTUM_Z)]
    for s in ti.static(range(LINE)):
        w = by_node(grid[W_Z + NODES * s, lane], grid[W_Z + NODES * s + NODES - 1, lane])
        by_x, by_y = w * per_node(ax), w * per_node(ay)
        plane = w * (per_node(q) + by_node(float_zero + NODES * s, float_zero + (NODES * s + 1)) * per_node(az))
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
    """Whether the grid's nodes have velocities in substep `it` of a launch, to which particles add what pushes them.
    Otherwise the grid has been laid anew, and particles bring all of their momentum."""
    return it + env.count(layout.GRID_MOVES) > 0


@ti.func
def particles_to_grid(env: ti.template(), part, it, body: ti.template()):
    """Return mapping; impulses of stress and contact, and mass, of this part's particles onto their nodes, in its copy
    of the grid; their momentum too where the nodes have no velocities."""
    zero, cell, dt = env.count(layout.ZERO), env.param(layout.BODY_CELL), env.param(layout.STEP)
    mass = env.param(layout.BODY_MASS)
    impulse, inertia = -dt * env.param(layout.BODY_VOLUME) * 4.0 / cell, mass * cell
    first_block, last_block = block_range(env, part)
    stride = env.count(layout.STRIDE)
    slab = ti.static(slab_of(env, part, (env.index * COPIES + copy_of(part)) * env.count(layout.CAPACITY)))
    lost = 0
    place = filled(0.0, 3, LANES)  # on the grid
    carried = filled(0.0, 9, LANES)  # displacement gradient
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
        load_rows(body.particles, start, stride, layout.GRADIENT, 9, carried)
        for lane in range(LANES):
            stencil(three(place, 0, lane), slab, grid, indices, lane)
        return_block(env, old, new, stress, indices)
        for lane in range(LANES):
            # P = tau F^-T: its columns are tau times the rows of F^-1
            tau, back = full(six(stress, 0, lane)), inverse_of(gradient(carried, lane))
            ax = impulse * (tau @ vec3([back[0, d] for d in range(3)])) + inertia * three(rate, 3, lane)
            ay = impulse * (tau @ vec3([back[1, d] for d in range(3)])) + inertia * three(rate, 6, lane)
            az = impulse * (tau @ vec3([back[2, d] for d in range(3)])) + inertia * three(rate, 9, lane)
            q = mass * (three(rate, 0, lane) + three(push, 0, lane))
            put(push, 0, lane, vec3(0.0))
            q -= grid[AT, lane] * ax + grid[AT + 1, lane] * ay + grid[AT + 2, lane] * az
            put(momentum, MOMENTUM, lane, q)
            put(momentum, MOMENTUM_X, lane, ax)
            put(momentum, MOMENTUM_Y, lane, ay)
            put(momentum, MOMENTUM_Z, lane, az)
            for i, j in ti.static(ti.ndrange(3, 3)):
                shares[3 * i + j, lane] = grid[W_X + i, lane] * grid[W_Y + j, lane]
        store_rows(body.particles, start, stride, layout.STRAIN, 7, new, zero)
        store_rows(body.particles, start, stride, layout.PUSH, 3, push, zero)
        for lane in range(ti.min(LANES, env.count(layout.PARTICLES) - block * LANES)):
            lost += indices[OFF, lane]
            scatter(env, body, momentum, grid, shares, indices, lane)
    record_more(env, slot_of(part), layout.OFF_GRID, float(lost))


@ti.func
def node_sum(env: ti.template(), i, at, body: ti.template()):
    """Momentum and mass of a strip of nodes in plane i: the copies of all parts, in their order."""
    if ti.static(ON_DEVICE):
        return body.masses[env.index * env.count(layout.CAPACITY) + at]
    else:
        total, zero = strip(0.0), env.count(layout.ZERO)
        for part in ti.static(range(COPIES)):
            if i >= env.count(layout.SLAB + 2 * part) and i < env.count(layout.SLAB + 2 * part + 1):
                total += body.masses[opaque(zero, (env.index * COPIES + part) * env.count(layout.CAPACITY) + at)]
        return total


@ti.func
def mean(rows: ti.template(), row: ti.template(), lane, a, b, c):
    """Sum of three numbers by the weights in three rows."""
    return rows[row, lane] * a + rows[row + 1, lane] * b + rows[row + 2, lane] * c


@ti.func
def sums_of(rows: ti.template(), row: ti.template(), lane, a, b, c):
    """The same sum, and that with the node's number as a factor, which is 0, 1 and 2."""
    second, third = rows[row + 1, lane] * b, rows[row + 2, lane] * c
    without_first = second + third
    return rows[row, lane] * a + without_first, without_first + third


@ti.func
def moved_plane(plane, step):
    """A tangent plane of the surface goes with the material, as F^-T does; step: dt L. To first order it would grow by
    half the square of each substep's turn, and a body that rolls would seem to shrink."""
    return inverse_of(step).transpose() @ plane


@ti.func
def gather(
    body: ti.template(), grid: ti.template(), indices: ti.template(), nodes: ti.template(), nodes_x: ti.template(),
    nodes_y: ti.template(), nodes_z: ti.template(), sums: ti.template(), lane,
):  # fmt: skip
    """Velocities of the nodes of one particle's stencil: SUM, BY_X, BY_Y and BY_Z of them into `sums`; nodes, ...: room
    for the same by nodes of a strip."""
    for c in range(4 * NODES):
        total, by_x, by_y, by_z = 0.0, 0.0, 0.0, 0.0
        for s in ti.static(range(LINE)):
            plane, sloped = vec3(0.0), vec3(0.0)  # sums over y
            for i in ti.static(range(3)):
                v0, v1, v2 = [body.velocities[bounded(indices[3 * i + j, lane], 4 * NODES) + s][c] for j in range(3)]
                plane[i], sloped[i] = sums_of(grid, W_Y, lane, v0, v1, v2)
            w = ti.select(c < 4, grid[W_Z + NODES * s, lane], grid[W_Z + NODES * s + NODES - 1, lane])
            here, across = sums_of(grid, W_X, lane, plane[0], plane[1], plane[2])
            here *= w
            total += here
            by_x += w * across
            by_y += w * mean(grid, W_X, lane, sloped[0], sloped[1], sloped[2])
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
    """What a part saw, in the rows of `extremes`: largest and summed velocity (3 components each), smallest volume of a
    step, largest Green strain."""
    record_least(env, slot, layout.SMALLEST_STEP_VOLUME, smallest_lane(extremes, 6))
    fastest = 0.0
    for lane in ti.static(range(LANES)):
        for d in ti.static(range(3)):
            fastest = ti.max(fastest, extremes[d, lane])
    record_most(env, slot, layout.FASTEST, fastest)
    record_most(env, slot, layout.GREEN, largest_lane(extremes, 7))
    if ti.static(not ON_DEVICE):  # which sums them block by block (tacsim.physics.worlds.device)
        for d in ti.static(range(3)):
            total = 0.0
            for lane in ti.static(range(LANES)):
                total += extremes[3 + d, lane]
            record_sum(env, slot, layout.VELOCITY_SUM + d, total)


@ti.func
def grid_to_particles(env: ti.template(), part, body: ti.template()):
    """Velocity and affine velocity back to this part's particles; strain, position and tangent plane follow.

    Particles off the grid read nodes behind it: the launch is undone anyway, since `particles_to_grid` has counted
    them.
    """
    zero, dt, slot = env.count(layout.ZERO), env.param(layout.STEP), slot_of(part)
    first_block, last_block = block_range(env, part)
    stride = env.count(layout.STRIDE)
    slab = ti.static(slab_of(env, part, env.index * env.count(layout.CAPACITY)))
    place = filled(0.0, 6, LANES)  # tangent plane, position
    reference = filled(0.0, 3, LANES)  # place on the grid
    carried = filled(0.0, 9, LANES)  # displacement gradient
    strain = filled(0.0, 6, LANES)
    rate = filled(0.0, 12, LANES)  # velocity, affine velocity
    grid = filled(0.0, STENCIL, LANES)
    indices = filled(0, INDICES, LANES)
    sums = filled(0.0, 12, LANES)  # SUM, BY_X, BY_Y, BY_Z: three numbers each
    # The same of one particle, by nodes of a strip. Four arrays: of one LLVM looks at 100 uses only to see that nothing
    # else lies where it does, and would not merge lanes.
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
        load_rows(body.particles, start, stride, layout.GRADIENT, 9, carried)
        for lane in range(LANES):
            stencil(three(reference, 0, lane), slab, grid, indices, lane)
        count = ti.min(LANES, env.count(layout.PARTICLES) - block * LANES)
        for lane in range(count, LANES):  # behind the last particle
            for r in ti.static(range(12)):
                sums[r, lane] = 0.0
        for lane in range(count):
            gather(body, grid, indices, nodes, nodes_x, nodes_y, nodes_z, sums, lane)
        for lane in range(LANES):
            velocity, factor = three(sums, 3 * SUM, lane), 4.0 * slab.scale
            x = factor * (three(sums, 3 * BY_X, lane) - grid[AT, lane] * velocity)
            y = factor * (three(sums, 3 * BY_Y, lane) - grid[AT + 1, lane] * velocity)
            z = factor * (three(sums, 3 * BY_Z, lane) - grid[AT + 2, lane] * velocity)
            over_reference = dt * mat3([[x[i], y[i], z[i]] for i in range(3)])
            step = over_reference @ inverse_of(gradient(carried, lane))
            volume = (mat3([[1, 0, 0], [0, 1, 0], [0, 0, 1]]) + step).determinant()
            put(strain, 0, lane, convect(six(strain, 0, lane), step))
            put(place, 0, lane, moved_plane(three(place, 0, lane), step))
            put(place, 3, lane, three(place, 3, lane) + dt * velocity)
            put(rate, 0, lane, velocity)
            put(rate, 3, lane, x)
            put(rate, 6, lane, y)
            put(rate, 9, lane, z)
            put(carried, 0, lane, three(carried, 0, lane) + dt * x)
            put(carried, 3, lane, three(carried, 3, lane) + dt * y)
            put(carried, 6, lane, three(carried, 6, lane) + dt * z)
            extremes[7, lane] = ti.max(extremes[7, lane], square(green(gradient(carried, lane))))
            for d in ti.static(range(3)):
                extremes[d, lane] = ti.max(extremes[d, lane], ti.abs(velocity[d]))
                extremes[3 + d, lane] += velocity[d]
            extremes[6, lane] = ti.min(extremes[6, lane], volume)
        store_rows(body.particles, start, stride, layout.PLANE, 6, place, zero)
        store_rows(body.particles, start, stride, layout.STRAIN, 6, strain, zero)
        store_rows(body.particles, start, stride, layout.VELOCITY, 12, rate, zero)
        store_rows(body.particles, start, stride, layout.GRADIENT, 9, carried, zero)
    note_extremes(env, slot, extremes)
