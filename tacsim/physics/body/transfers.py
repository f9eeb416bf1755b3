"""The body's substep: APIC MLS-MPM with quadratic B-splines (Hu et al. 2018; Jiang et al. 2015).

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
    ELASTIC,
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

LINE = 2 if NODES == 2 else 3  # strips that hold three neighbours

# Rows of a block's own arrays, LANES numbers each.
AT = 0  # offset of the particle from the stencil's first node; along z from its first strip
W_X, W_Y, W_Z = 3, 6, 9  # weights by axis
STENCIL = W_Z + NODES * LINE
# Whole numbers: the first strip of each of the stencil's 9 lines along z, then
OFF, LARGE = 9, 10  # off the grid; strain for `return_any_strain`
INDICES = 11
# What node (i, j, n) gets is w_i w_j w_n (q + i ax + j ay + n az), each of these momentum x, y, z and mass.
MOMENTUM, MOMENTUM_X, MOMENTUM_Y, MOMENTUM_Z = 0, 4, 8, 12
# Sums over the stencil: plain, and by x, y, z with the node's number as a factor
SUM, BY_X, BY_Y, BY_Z = 0, 1, 2, 3


class Body(NamedTuple):
    """The bodies of all environments inside a kernel: the arrays of `BodyState`."""

    particles: Any
    masses: Any
    velocities: Any
    changes: Any = None  # see tacsim.physics.body.mass


class Slab(NamedTuple):
    """Inside a kernel: the slab of the grid that a part's particles lie in."""

    origin: Any  # of node (0, 0, 0) [mm]
    scale: Any  # 1 / grid spacing
    low: Any  # first plane of nodes
    high: Any  # the one after the last
    ny: Any
    nz: Any
    base: Any  # where the grid begins in an array of strips
    discard: Any  # where three planes behind the grid begin, which are never read


@ti.func
def slab_of(env: ti.template(), part, base):
    copy = copy_of(part)
    ny, nz = env.count(layout.GRID + 1), env.count(layout.GRID + 2)
    low, high = env.count(layout.SLAB + 2 * copy), env.count(layout.SLAB + 2 * copy + 1)
    discard = base + env.count(layout.GRID) * ny * (nz // NODES)
    origin, scale = env.param3(layout.ORIGIN), 1.0 / env.param(layout.BODY_CELL)
    return ti.static(Slab(origin, scale, low, high, ny, nz, base, discard))


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
def stencil(x, slab: ti.template(), rows: ti.template(), indices: ti.template(), lane):
    """Of one particle, into `rows` and `indices`. Off the slab (or NaN) its lines are at `slab.discard`."""
    s = (x - slab.origin) * slab.scale
    ny, nz = slab.ny, slab.nz
    wanted = ti.floor(s - 0.5).cast(ti.i32)
    lowest, highest = ti.Vector([slab.low, 0, 0]), ti.Vector([slab.high - 3, ny - 3, nz - 3])
    first = ti.max(lowest, ti.min(wanted, highest))  # never a wild index
    off = (
        ti.select(wanted[0] == first[0], 0, 1)
        | ti.select(wanted[1] == first[1], 0, 1)
        | ti.select(wanted[2] == first[2], 0, 1)
    )
    shift = first[2] & (NODES - 1)  # nodes of the first strip before the stencil
    f = s - first.cast(ti.f32)
    # of nodes 0, 1, 2 between two that get nothing
    w = [vec3(0.0), 0.5 * (1.5 - f) ** 2, 0.75 - (f - 1.0) ** 2, 0.5 * (f - 0.5) ** 2, vec3(0.0)]
    rows[AT, lane], rows[AT + 1, lane], rows[AT + 2, lane] = f[0], f[1], f[2] + ti.cast(shift, ti.f32)
    for i in ti.static(range(3)):
        rows[W_X + i, lane] = w[i + 1][0]
        rows[W_Y + i, lane] = w[i + 1][1]
    for n in ti.static(range(NODES * LINE)):
        rows[W_Z + n, lane] = ti.select(shift == 0, w[n + 1][2], w[n][2])
    row, at = nz // NODES, (first[0] * ny + first[1]) * (nz // NODES) + first[2] // NODES
    at = ti.select(off == 0, slab.base + at, slab.discard)
    for i, j in ti.static(ti.ndrange(3, 3)):
        indices[3 * i + j, lane] = at + (i * ny + j) * row
    indices[OFF, lane] = off


@ti.func
def clear_masses(env: ti.template(), part, body: ti.template()):
    """This part's copy of the grid, where it may write."""
    plane = env.count(layout.GRID + 1) * (env.count(layout.GRID + 2) // NODES)
    base = (env.index * COPIES + part) * env.count(layout.CAPACITY)
    for strip_ in range(env.count(layout.SLAB + 2 * part) * plane, env.count(layout.SLAB + 2 * part + 1) * plane):
        at = opaque(env.count(layout.ZERO), base + strip_)
        body.masses[at] = overwrite(env.count(layout.ZERO), body.masses[at], strip(0.0))


@ti.func
def particles_to_grid(env: ti.template(), part, body: ti.template()):
    """Return mapping; momentum and mass of this part's particles onto their nodes, in its copy of the grid."""
    zero, cell, dt = env.count(layout.ZERO), env.param(layout.BODY_CELL), env.param(layout.STEP)
    mass, mu, bulk = env.param(layout.BODY_MASS), env.param(layout.BODY_MU), env.param(layout.BODY_BULK)
    yield_strain, hardening = env.param(layout.BODY_LIMIT), env.param(layout.BODY_HARDENING)
    impulse, inertia = -dt * env.param(layout.BODY_VOLUME) * 4.0 / cell, mass * cell
    first_block, last_block = block_range(env, part)
    stride = env.count(layout.STRIDE)
    slab = ti.static(slab_of(env, part, (env.index * COPIES + copy_of(part)) * env.count(layout.CAPACITY)))
    float_zero = ti.cast(zero, ti.f32)  # 0, but a 0 that the compiler knows would make a lane unlike its neighbours
    lost, spare = 0, opaque(zero, 16)
    place = filled(0.0, 3, LANES)  # on the grid
    carried = filled(0.0, 9, LANES)  # displacement gradient
    old = filled(0.0, 7, LANES)  # elastic strain, plastic strain
    new = filled(0.0, 7, LANES)
    stress = filled(0.0, 6, LANES)
    rate = filled(0.0, 12, LANES)  # velocity, affine velocity
    momentum = filled(0.0, 17, LANES)
    grid = filled(0.0, STENCIL, LANES)
    shares = filled(0.0, 9, LANES)  # of the stencil's lines
    indices = filled(0, INDICES, LANES)
    for lane in range(LANES):
        momentum[MOMENTUM + 3, lane] = mass
    for block in range(first_block, last_block):
        start = env.index * layout.PARTICLE_ROWS * stride + block * LANES
        load_rows(body.particles, start, stride, layout.STRAIN, 7, old)
        load_rows(body.particles, start, stride, layout.VELOCITY, 12, rate)
        load_rows(body.particles, start, stride, layout.REFERENCE, 3, place)
        load_rows(body.particles, start, stride, layout.GRADIENT, 9, carried)
        for lane in range(LANES):
            stencil(three(place, 0, lane), slab, grid, indices, lane)
        if yield_strain < ELASTIC:
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
        for lane in range(LANES):
            # P = tau F^-T: its columns are tau times the rows of F^-1
            tau, back = full(six(stress, 0, lane)), inverse_of(gradient(carried, lane))
            ax = impulse * (tau @ vec3([back[0, d] for d in range(3)])) + inertia * three(rate, 3, lane)
            ay = impulse * (tau @ vec3([back[1, d] for d in range(3)])) + inertia * three(rate, 6, lane)
            az = impulse * (tau @ vec3([back[2, d] for d in range(3)])) + inertia * three(rate, 9, lane)
            q = mass * three(rate, 0, lane)
            q -= grid[AT, lane] * ax + grid[AT + 1, lane] * ay + grid[AT + 2, lane] * az
            put(momentum, MOMENTUM, lane, q)
            put(momentum, MOMENTUM_X, lane, ax)
            put(momentum, MOMENTUM_Y, lane, ay)
            put(momentum, MOMENTUM_Z, lane, az)
            for i, j in ti.static(ti.ndrange(3, 3)):
                shares[3 * i + j, lane] = grid[W_X + i, lane] * grid[W_Y + j, lane]
        store_rows(body.particles, start, stride, layout.STRAIN, 7, new, zero)
        for lane in range(ti.min(LANES, env.count(layout.PARTICLES) - block * LANES)):
            lost += indices[OFF, lane]
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
    """A tangent plane of the surface goes with the material, as F^-T does: m' = -L^T m; step: dt L."""
    return plane - step.transpose() @ plane


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
    nodes = filled(0.0, 4, 4 * NODES)  # the same of one particle, by nodes of a strip
    # fastest, sum of velocities, smallest volume of a step, largest Green strain
    extremes = filled(0.0, 8, LANES)
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
            for c in range(4 * NODES):
                total, by_x, by_y, by_z = 0.0, 0.0, 0.0, 0.0
                for s in ti.static(range(LINE)):
                    plane, sloped = vec3(0.0), vec3(0.0)  # sums over y
                    for i in ti.static(range(3)):
                        v0, v1, v2 = [
                            body.velocities[bounded(indices[3 * i + j, lane], 4 * NODES) + s][c] for j in range(3)
                        ]
                        plane[i], sloped[i] = sums_of(grid, W_Y, lane, v0, v1, v2)
                    w = ti.select(c < 4, grid[W_Z + NODES * s, lane], grid[W_Z + NODES * s + NODES - 1, lane])
                    here, across = sums_of(grid, W_X, lane, plane[0], plane[1], plane[2])
                    here *= w
                    total += here
                    by_x += w * across
                    by_y += w * mean(grid, W_X, lane, sloped[0], sloped[1], sloped[2])
                    by_z += ti.select(c < 4, float(NODES * s), float(NODES * s + 1)) * here
                nodes[SUM, c], nodes[BY_X, c], nodes[BY_Y, c], nodes[BY_Z, c] = total, by_x, by_y, by_z
            for k in ti.static(range(4)):
                for d in ti.static(range(3)):
                    total = nodes[k, d]
                    for n in ti.static(range(1, NODES)):
                        total += nodes[k, 4 * n + d]
                    sums[3 * k + d, lane] = total
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
