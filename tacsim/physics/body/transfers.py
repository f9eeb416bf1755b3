"""The body's substep: APIC MLS-MPM with quadratic B-splines (Hu et al. 2018; Jiang et al. 2015).

Work is laid out for a CPU's vector registers. What concerns one particle alone (stencil, strain, return mapping) is
done for LANES particles in an inner loop over arrays of its own, which LLVM turns into whole vectors: nothing else can
lie where it writes. Particles are kept in rows of one number of all of them, so such a block is loaded and stored in
whole vectors, too. What goes to nodes and comes from them is done particle by particle with NODES neighbours of a grid
line in a register; a stencil of three nodes begins at any node, a strip at every second one, so two strips hold it, and
the node too many has weight 0.

On a device LANES and NODES are 1, and all inner loops run once. Numbers behind the last particle are nobody's: they
stay as they are.
"""

from tacsim.compute.runtime import ti
from tacsim.physics.body.material import ELASTIC, convect, mat3, return_far, return_near, stress_near, vec6
from tacsim.physics.exec.lanes import (
    COPIES,
    LANES,
    NODES,
    ON_DEVICE,
    add_to,
    copy_of,
    keep_or,
    least_lane,
    note_least,
    note_more,
    note_most,
    note_sum,
    opaque,
    part_range,
    real,
    slot_of,
    small,
    strip,
    vec2,
    vec3,
    vec4,
)
from tacsim.physics.exec.layout import (
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
    KNOWN,
    MOTION,
    NEVER,
    OFF_GRID,
    ORIGIN,
    PARTICLES,
    PLACE,
    PLANE,
    SLAB,
    SMALLEST_STEP_VOLUME,
    STEP,
    STRAIN,
    STRIDE,
    VELOCITY,
)

# One axis each, environments one after the other: kernels find their way with one number that they have worked out
# beforehand, which is much faster than several indices into arrays of several axes.
Particles = ti.types.ndarray(dtype=ti.f32, ndim=1)  # rows of one number of all particles (tacsim.physics.exec.layout)
Strips = ti.types.ndarray(dtype=strip, ndim=1)  # masses, velocities

LINE = 2 if NODES == 2 else 3  # strips that hold three neighbours

# Rows of a block's own arrays, LANES numbers each.
AT = 0  # offset of the particle from the stencil's first node; along z from its first strip
W_X, W_Y, W_Z = 3, 6, 9  # weights by axis
D_X, D_Y = W_Z + NODES * LINE, W_Z + NODES * LINE + 2  # j w_j of the second and third node
STENCIL = D_Y + 2
# Whole numbers: the first strip of each of the stencil's 9 lines along z, then
OFF, FAR = 9, 10  # off the grid; strain for `return_far`
WHOLE = 11
# What node (i, j, n) gets is w_i w_j w_n (q + i ax + j ay + n az), each of these momentum x, y, z and mass.
PULL, PULL_X, PULL_Y, PULL_Z = 0, 4, 8, 12
# Sums over the stencil: plain, and by x, y, z with the node's number as a factor
SUM, BY_X, BY_Y, BY_Z = 0, 1, 2, 3


@ti.func
def twice(a):
    """A vector of four for every node of a strip."""
    return strip([a[c % 4] for c in range(4 * NODES)])


@ti.func
def each(first, second):
    """The numbers of the nodes of a strip, each four times."""
    return strip([(first, second)[c // 4] for c in range(4 * NODES)])


@ti.func
def block_range(env, part, counts: ti.template()):
    """First block of LANES particles that a part does, and the one after its last."""
    return part_range((counts[env, PARTICLES] + LANES - 1) // LANES, part)


@ti.func
def load(particles: ti.template(), at, stride, first: ti.template(), count: ti.template(), rows: ti.template()):
    """Rows first, ... of a block of particles, `count` of them. In short loops: LLVM cuts a longer one across the rows,
    and gathers."""
    for begin in ti.static(range(0, count, 6)):
        for r in range(begin, min(begin + 6, count)):
            start = small(at + (first + r) * stride, 1)
            values = real([particles[start + lane] for lane in range(LANES)])
            for lane in ti.static(range(LANES)):
                rows[r, lane] = values[lane]


@ti.func
def store(
    particles: ti.template(), at, stride, first: ti.template(), count: ti.template(), rows: ti.template(), never
):  # fmt: skip
    for r in range(count):
        start = small(at + (first + r) * stride, 1)
        values = real([keep_or(never, particles[start + lane], rows[r, lane]) for lane in range(LANES)])
        for lane in ti.static(range(LANES)):
            particles[start + lane] = values[lane]


@ti.func
def three(rows: ti.template(), row: ti.template(), lane):
    return vec3(rows[row, lane], rows[row + 1, lane], rows[row + 2, lane])


@ti.func
def four(rows: ti.template(), row: ti.template(), lane, spare):
    """Four numbers of one lane. The write between them keeps LLVM from making a gather of them; spare: a row's number
    that the compiler does not know."""
    first = vec2(rows[row, lane], rows[row + 1, lane])
    rows[spare, lane] = first[0]
    return vec4(first[0], first[1], rows[row + 2, lane], rows[row + 3, lane])


@ti.func
def six(rows: ti.template(), row: ti.template(), lane):
    return vec6([rows[row + d, lane] for d in range(6)])


@ti.func
def put(rows: ti.template(), row: ti.template(), lane, values: ti.template()):
    for d in ti.static(range(values.n)):
        rows[row + d, lane] = values[d]


@ti.func
def stencil(x, origin, scale, low, high, ny, nz, base, dump, rows: ti.template(), whole: ti.template(), lane):
    """Of one particle, into `rows` and `whole`. Off the slab (or NaN): its lines are at `dump`, where nobody reads.

    scale: 1 / dx; low, high: the slab's first plane of nodes and the one after its last; base: where the grid begins.
    """
    s = (x - origin) * scale
    wanted = ti.floor(s - 0.5).cast(ti.i32)
    first = ti.max(ti.Vector([low, 0, 0]), ti.min(wanted, ti.Vector([high - 3, ny - 3, nz - 3])))  # never a wild index
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
    rows[D_X, lane], rows[D_X + 1, lane] = w[2][0], 2.0 * w[3][0]
    rows[D_Y, lane], rows[D_Y + 1, lane] = w[2][1], 2.0 * w[3][1]
    row, at = nz // NODES, (first[0] * ny + first[1]) * (nz // NODES) + first[2] // NODES
    at = ti.select(off == 0, base + at, dump)
    for i, j in ti.static(ti.ndrange(3, 3)):
        whole[3 * i + j, lane] = at + (i * ny + j) * row
    whole[OFF, lane] = off


@ti.func
def clear_masses(env, part, masses: ti.template(), counts: ti.template()):
    """This part's copy of the grid, where it may write."""
    plane = counts[env, GRID + 1] * (counts[env, GRID + 2] // NODES)
    base = (env * COPIES + part) * counts[env, CAPACITY]
    for strip_ in range(counts[env, SLAB + 2 * part] * plane, counts[env, SLAB + 2 * part + 1] * plane):
        at = opaque(counts[env, NEVER], base + strip_)
        masses[at] = keep_or(counts[env, NEVER], masses[at], strip(0.0))


@ti.func
def particles_to_grid(
    env, part, particles: ti.template(), masses: ti.template(), params: ti.template(), counts: ti.template(),
    partial: ti.template(),
):  # fmt: skip
    """Return mapping; momentum and mass of this part's particles onto their nodes, in its copy of the grid."""
    never, cell, mass, dt = counts[env, NEVER], params[env, BODY_CELL], params[env, BODY_MASS], params[env, STEP]
    mu, bulk, limit, hardening = (
        params[env, BODY_MU], params[env, BODY_BULK], params[env, BODY_LIMIT], params[env, BODY_HARDENING]
    )  # fmt: skip
    impulse, inertia, scale = -dt * params[env, BODY_VOLUME] * 4.0 / cell, mass * cell, 1.0 / cell
    origin = vec3(params[env, ORIGIN], params[env, ORIGIN + 1], params[env, ORIGIN + 2])
    ny, nz = counts[env, GRID + 1], counts[env, GRID + 2]
    copy = copy_of(part)
    low, high = counts[env, SLAB + 2 * copy], counts[env, SLAB + 2 * copy + 1]
    first_block, last_block = block_range(env, part, counts)
    stride = counts[env, STRIDE]
    base = (env * COPIES + copy) * counts[env, CAPACITY]
    dump = base + counts[env, GRID] * ny * (nz // NODES)  # three planes behind the grid
    none = ti.cast(never, ti.f32)  # 0, but a 0 that the compiler knows would make a lane unlike its neighbours
    lost, spare = 0, opaque(never, 16)
    place = ti.Matrix.zero(ti.f32, 3, LANES)
    old = ti.Matrix.zero(ti.f32, 7, LANES)  # strain, flow
    new = ti.Matrix.zero(ti.f32, 7, LANES)
    stress = ti.Matrix.zero(ti.f32, 6, LANES)
    rate = ti.Matrix.zero(ti.f32, 12, LANES)  # velocity, affine velocity
    pull = ti.Matrix.zero(ti.f32, 17, LANES)
    grid = ti.Matrix.zero(ti.f32, STENCIL, LANES)
    shares = ti.Matrix.zero(ti.f32, 9, LANES)  # of the stencil's lines
    whole = ti.Matrix.zero(ti.i32, WHOLE, LANES)
    for lane in range(LANES):
        pull[PULL + 3, lane] = mass
    for block in range(first_block, last_block):
        start = env * KNOWN * stride + block * LANES
        load(particles, start, stride, PLACE, 3, place)
        load(particles, start, stride, STRAIN, 7, old)
        load(particles, start, stride, VELOCITY, 12, rate)
        for lane in range(LANES):
            stencil(three(place, 0, lane), origin, scale, low, high, ny, nz, base, dump, grid, whole, lane)
        if limit < ELASTIC:
            for lane in range(LANES):
                elastic, flow, tau, far = return_near(six(old, 0, lane), old[6, lane], mu, bulk, limit, hardening)
                put(new, 0, lane, elastic)
                put(stress, 0, lane, tau)
                new[6, lane], whole[FAR, lane] = flow, far
        else:  # a body that never yields: no return mapping
            for lane in range(LANES):
                tau, far = stress_near(six(old, 0, lane), mu, bulk)
                put(new, 0, lane, six(old, 0, lane))
                put(stress, 0, lane, tau)
                new[6, lane], whole[FAR, lane] = old[6, lane], far
        for lane in range(LANES):
            if whole[FAR, lane] != 0:
                elastic, flow, tau = return_far(six(old, 0, lane), old[6, lane], mu, bulk, limit, hardening)
                put(new, 0, lane, elastic)
                put(stress, 0, lane, tau)
                new[6, lane] = flow
        for lane in range(LANES):
            tau = six(stress, 0, lane)
            ax = impulse * vec3(tau[0], tau[3], tau[4]) + inertia * three(rate, 3, lane)
            ay = impulse * vec3(tau[3], tau[1], tau[5]) + inertia * three(rate, 6, lane)
            az = impulse * vec3(tau[4], tau[5], tau[2]) + inertia * three(rate, 9, lane)
            q = mass * three(rate, 0, lane)
            q -= grid[AT, lane] * ax + grid[AT + 1, lane] * ay + grid[AT + 2, lane] * az
            put(pull, PULL, lane, q)
            put(pull, PULL_X, lane, ax)
            put(pull, PULL_Y, lane, ay)
            put(pull, PULL_Z, lane, az)
            for i, j in ti.static(ti.ndrange(3, 3)):
                shares[3 * i + j, lane] = grid[W_X + i, lane] * grid[W_Y + j, lane]
        store(particles, start, stride, STRAIN, 7, new, never)
        for lane in range(ti.min(LANES, counts[env, PARTICLES] - block * LANES)):
            lost += whole[OFF, lane]
            q, ax, ay, az = [four(pull, row, lane, spare) for row in (PULL, PULL_X, PULL_Y, PULL_Z)]
            for s in ti.static(range(LINE)):
                w = each(grid[W_Z + NODES * s, lane], grid[W_Z + NODES * s + NODES - 1, lane])
                by_x, by_y = w * twice(ax), w * twice(ay)
                plane = w * (twice(q) + each(none + NODES * s, none + (NODES * s + 1)) * twice(az))
                for i in ti.static(range(3)):
                    line = plane
                    for j in ti.static(range(3)):
                        add_to(masses, small(whole[3 * i + j, lane], 4 * NODES) + s, shares[3 * i + j, lane] * line)
                        line += by_y
                    plane += by_x
    note_more(partial, env, slot_of(part), OFF_GRID, float(lost))


@ti.func
def node_sum(env, i, at, masses: ti.template(), velocities: ti.template(), counts: ti.template()):
    """Momentum and mass of a strip of nodes in plane i: the copies of all parts, in their order.

    They are added up where the velocities will be: stores to neighbours make it sums of whole vectors.
    """
    if ti.static(ON_DEVICE):
        return masses[env * counts[env, CAPACITY] + at]
    else:
        never = counts[env, NEVER]
        here = opaque(never, env * counts[env, CAPACITY] + at)
        velocities[here] = keep_or(never, velocities[here], strip(0.0))
        for part in ti.static(range(COPIES)):
            if i >= counts[env, SLAB + 2 * part] and i < counts[env, SLAB + 2 * part + 1]:
                copy = opaque(never, (env * COPIES + part) * counts[env, CAPACITY] + at)
                velocities[here] = velocities[here] + masses[copy]
        return velocities[here]


@ti.func
def mean(rows: ti.template(), row: ti.template(), lane, a, b, c):
    """Sum of three numbers by the weights in three rows."""
    return rows[row, lane] * a + rows[row + 1, lane] * b + rows[row + 2, lane] * c


@ti.func
def slope(rows: ti.template(), row: ti.template(), lane, b, c):
    """The same with the node's number as a factor, by two rows: it is 0 for the first node."""
    return rows[row, lane] * b + rows[row + 1, lane] * c


@ti.func
def moved_plane(plane, x, y, z, dt):
    """A tangent plane of the surface goes with the material, as F^-T does: m' = -C^T m; x, y, z: columns of C."""
    return plane - dt * vec3(x.dot(plane), y.dot(plane), z.dot(plane))


@ti.func
def grid_to_particles(
    env, part, particles: ti.template(), velocities: ti.template(), params: ti.template(), counts: ti.template(),
    partial: ti.template(),
):  # fmt: skip
    """Velocity and affine velocity back to this part's particles; strain, position and tangent plane follow.

    Particles off the grid read nodes behind it: the launch is taken back anyway, since `particles_to_grid` has counted
    them.
    """
    never, dt, cell = counts[env, NEVER], params[env, STEP], params[env, BODY_CELL]
    origin, scale = vec3(params[env, ORIGIN], params[env, ORIGIN + 1], params[env, ORIGIN + 2]), 1.0 / cell
    ny, nz = counts[env, GRID + 1], counts[env, GRID + 2]
    copy, slot = copy_of(part), slot_of(part)
    low, high = counts[env, SLAB + 2 * copy], counts[env, SLAB + 2 * copy + 1]
    first_block, last_block = block_range(env, part, counts)
    stride = counts[env, STRIDE]
    base = env * counts[env, CAPACITY]
    dump = base + counts[env, GRID] * ny * (nz // NODES)
    place = ti.Matrix.zero(ti.f32, 6, LANES)  # tangent plane, position
    strain = ti.Matrix.zero(ti.f32, 6, LANES)
    rate = ti.Matrix.zero(ti.f32, 12, LANES)  # velocity, affine velocity
    grid = ti.Matrix.zero(ti.f32, STENCIL, LANES)
    whole = ti.Matrix.zero(ti.i32, WHOLE, LANES)
    sums = ti.Matrix.zero(ti.f32, 12, LANES)  # SUM, BY_X, BY_Y, BY_Z: three numbers each
    nodes = ti.Matrix.zero(ti.f32, 4, 4 * NODES)  # the same of one particle, by nodes of a strip
    seen = ti.Matrix.zero(ti.f32, 7, LANES)  # fastest, sum of velocities, smallest volume of a step
    for lane in range(LANES):
        seen[6, lane] = 1e9
    for block in range(first_block, last_block):
        start = env * KNOWN * stride + block * LANES
        load(particles, start, stride, PLANE, 6, place)
        load(particles, start, stride, STRAIN, 6, strain)
        for lane in range(LANES):
            stencil(three(place, 3, lane), origin, scale, low, high, ny, nz, base, dump, grid, whole, lane)
        count = ti.min(LANES, counts[env, PARTICLES] - block * LANES)
        for lane in range(count, LANES):  # nobody's
            for r in ti.static(range(12)):
                sums[r, lane] = 0.0
        for lane in range(count):
            for c in range(4 * NODES):
                total, by_x, by_y, by_z = 0.0, 0.0, 0.0, 0.0
                for s in ti.static(range(LINE)):
                    plane, sloped = vec3(0.0), vec3(0.0)  # sums over y
                    for i in ti.static(range(3)):
                        v0, v1, v2 = [velocities[small(whole[3 * i + j, lane], 4 * NODES) + s][c] for j in range(3)]
                        plane[i] = mean(grid, W_Y, lane, v0, v1, v2)
                        sloped[i] = slope(grid, D_Y, lane, v1, v2)
                    w = ti.select(c < 4, grid[W_Z + NODES * s, lane], grid[W_Z + NODES * s + NODES - 1, lane])
                    here = w * mean(grid, W_X, lane, plane[0], plane[1], plane[2])
                    total += here
                    by_x += w * slope(grid, D_X, lane, plane[1], plane[2])
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
            velocity, far = three(sums, 3 * SUM, lane), 4.0 * scale
            x = far * (three(sums, 3 * BY_X, lane) - grid[AT, lane] * velocity)
            y = far * (three(sums, 3 * BY_Y, lane) - grid[AT + 1, lane] * velocity)
            z = far * (three(sums, 3 * BY_Z, lane) - grid[AT + 2, lane] * velocity)
            step = dt * mat3([[x[i], y[i], z[i]] for i in range(3)])
            volume = (mat3([[1, 0, 0], [0, 1, 0], [0, 0, 1]]) + step).determinant()
            put(strain, 0, lane, convect(six(strain, 0, lane), step))
            put(place, 0, lane, moved_plane(three(place, 0, lane), x, y, z, dt))
            put(place, 3, lane, three(place, 3, lane) + dt * velocity)
            put(rate, 0, lane, velocity)
            put(rate, 3, lane, x)
            put(rate, 6, lane, y)
            put(rate, 9, lane, z)
            for d in ti.static(range(3)):
                seen[d, lane] = ti.max(seen[d, lane], ti.abs(velocity[d]))
                seen[3 + d, lane] += velocity[d]
            seen[6, lane] = ti.min(seen[6, lane], volume)
        store(particles, start, stride, PLANE, 6, place, never)
        store(particles, start, stride, STRAIN, 6, strain, never)
        store(particles, start, stride, VELOCITY, 12, rate, never)
    note_least(partial, env, slot, SMALLEST_STEP_VOLUME, least_lane(seen, 6))
    fastest = 0.0
    for lane in ti.static(range(LANES)):
        for d in ti.static(range(3)):
            fastest = ti.max(fastest, seen[d, lane])
    note_most(partial, env, slot, FASTEST, fastest)
    for d in ti.static(range(3)):
        total = 0.0
        for lane in ti.static(range(LANES)):
            total += seen[3 + d, lane]
        note_sum(partial, env, slot, MOTION + d, total)
