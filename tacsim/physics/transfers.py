"""The body's substep: APIC MLS-MPM with quadratic B-splines (Hu et al. 2018; Jiang et al. 2015).

Work is laid out for a CPU's vector registers. What concerns one particle alone (stencil, strain, return mapping) is
done for LANES particles in an inner loop over arrays of its own, which LLVM turns into whole vectors: nothing else can
lie where it writes. What goes to nodes and comes from them is done particle by particle with NODES neighbours of a grid
line in a register; a stencil of three nodes begins at any node, a strip at every second one, so two strips hold it, and
the node too many has weight 0. Between the two kinds of loop numbers are copied one by one, `as_it_comes`.

On a device LANES and NODES are 1, and all inner loops run once.
"""

from tacsim.physics.lanes import (
    COPIES,
    LANES,
    NODES,
    ON_DEVICE,
    PARTS,
    SUMS,
    add_to,
    anchor,
    copy_of,
    keep_or,
    least_lane,
    note_least,
    note_more,
    note_most,
    note_sum,
    opaque,
    part_range,
    slot_of,
    strip,
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
from tacsim.physics.material import ELASTIC, convect, mat3, return_far, return_near, stress_near, vec6
from tacsim.runtime import ti

# One axis each, environments one after the other: kernels find their way with one number that they have worked out
# beforehand, which is much faster than several indices into arrays of several axes.
Points = ti.types.ndarray(dtype=vec4, ndim=1)
Rates = ti.types.ndarray(dtype=vec4, ndim=2)
Strains = ti.types.ndarray(dtype=vec4, ndim=1)
Strips = ti.types.ndarray(dtype=strip, ndim=1)  # masses, velocities, sums

LINE = 2 if NODES == 2 else 3  # strips that hold three neighbours
APART = 1 if ON_DEVICE else 2  # slots in `sums`: the CPU's compiler must not merge two of them
SPARE = SUMS - 1  # slot that nobody reads

# Rows of a block's own arrays, LANES numbers each.
AT = 0  # offset of the particle from the stencil's first node; along z from its first strip
W_X, W_Y, W_Z = 3, 6, 9  # weights by axis
D_X, D_Y = W_Z + NODES * LINE, W_Z + NODES * LINE + 2  # j w_j of the second and third node
STENCIL = D_Y + 2


@ti.func
def as_it_comes(sums: ti.template(), drop: ti.template(), value):
    """Keeps LLVM from merging the loads of a loop into gather instructions, which are slower than single loads."""
    if ti.static(not ON_DEVICE):
        sums[drop + SPARE][0] = value


@ti.func
def twice(a):
    """A vector of four for every node of a strip."""
    return strip([a[c % 4] for c in range(4 * NODES)])


@ti.func
def each(first, second):
    """The numbers of the nodes of a strip, each four times."""
    return strip([(first, second)[c // 4] for c in range(4 * NODES)])


@ti.func
def stencil(x, origin, scale, low, high, ny, nz, rows: ti.template(), lane):
    """Of one particle, into `rows`; returns its first strip in the grid, and 1 if it is off the slab (or NaN), else 0.

    scale: 1 / dx; low, high: the slab's first plane of nodes and the one after its last.
    """
    s = (x - origin) * scale
    wanted = ti.floor(s - 0.5).cast(ti.i32)
    base = ti.max(ti.Vector([low, 0, 0]), ti.min(wanted, ti.Vector([high - 3, ny - 3, nz - 3])))  # never a wild index
    off = (
        ti.select(wanted[0] == base[0], 0, 1)
        | ti.select(wanted[1] == base[1], 0, 1)
        | ti.select(wanted[2] == base[2], 0, 1)
    )
    shift = base[2] & (NODES - 1)  # nodes of the first strip before the stencil
    f = s - base.cast(ti.f32)
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
    return (base[0] * ny + base[1]) * (nz // NODES) + base[2] // NODES, off


@ti.func
def clear_masses(env, part, masses: ti.template(), counts: ti.template()):
    """This part's copy of the grid, where it may write."""
    plane = counts[env, GRID + 1] * (counts[env, GRID + 2] // NODES)
    base = (env * COPIES + part) * counts[env, CAPACITY]
    for at in range(counts[env, SLAB + 2 * part] * plane, counts[env, SLAB + 2 * part + 1] * plane):
        masses[base + at] = strip(0.0)


@ti.func
def particles_to_grid(
    env, part, points: ti.template(), rates: ti.template(), strains: ti.template(), masses: ti.template(),
    sums: ti.template(), facts: ti.template(), counts: ti.template(), partial: ti.template(),
):  # fmt: skip
    """`scatter` with this part's share of `sums`."""
    drop = (env * PARTS + part) * SUMS
    scatter(env, part, points, rates, strains, masses, sums, drop, facts, counts, partial)


@ti.func
def scatter(
    env, part, points: ti.template(), rates: ti.template(), strains: ti.template(), masses: ti.template(),
    sums: ti.template(), drop: ti.template(), facts: ti.template(), counts: ti.template(), partial: ti.template(),
):  # fmt: skip
    """Return mapping; momentum and mass of this part's particles onto their nodes, in its copy of the grid."""
    never, cell, mass, dt = counts[env, NEVER], facts[env, BODY_CELL], facts[env, BODY_MASS], facts[env, STEP]
    mu, bulk, limit, hardening = (
        facts[env, BODY_MU], facts[env, BODY_BULK], facts[env, BODY_LIMIT], facts[env, BODY_HARDENING]
    )  # fmt: skip
    impulse, inertia, scale = -dt * facts[env, BODY_VOLUME] * 4.0 / cell, mass * cell, 1.0 / cell
    origin = vec3(facts[env, ORIGIN], facts[env, ORIGIN + 1], facts[env, ORIGIN + 2])
    ny, nz = counts[env, GRID + 1], counts[env, GRID + 2]
    row, plane = nz // NODES, ny * (nz // NODES)
    copy = copy_of(part)
    low, high = counts[env, SLAB + 2 * copy], counts[env, SLAB + 2 * copy + 1]
    first_p, last_p = part_range(counts[env, PARTICLES], part)
    first_p, last_p = first_p + env * counts[env, STRIDE], last_p + env * counts[env, STRIDE]
    base = (env * COPIES + copy) * counts[env, CAPACITY]
    dump = base + counts[env, GRID] * plane  # three planes behind the grid, never read: for particles off the grid
    lost = 0
    old = ti.Matrix.zero(ti.f32, 10, LANES)  # e, flow, x
    new = ti.Matrix.zero(ti.f32, 13, LANES)  # e, flow, impulses
    grid = ti.Matrix.zero(ti.f32, STENCIL, LANES)
    whole = ti.Matrix.zero(ti.i32, 3, LANES)  # first strip, off the grid, far
    for block in range((last_p - first_p + LANES - 1) // LANES):
        start = first_p + block * LANES
        for lane in range(LANES):
            p = ti.min(start + lane, last_p - 1)
            a, b, x = strains[2 * p], strains[2 * p + 1], points[p]
            for d in ti.static(range(4)):
                old[d, lane] = a[d]
            for d in ti.static(range(3)):
                old[4 + d, lane] = b[d]
                old[7 + d, lane] = x[d]
            as_it_comes(sums, drop, a[0])
        for lane in range(LANES):
            x = vec3(old[7, lane], old[8, lane], old[9, lane])
            first, off = stencil(x, origin, scale, low, high, ny, nz, grid, lane)
            whole[0, lane], whole[1, lane] = ti.select(off == 0, base + first, dump), off
        if limit < ELASTIC:
            for lane in range(LANES):
                e = vec6([old[d, lane] for d in range(6)])
                elastic, flow, tau, far = return_near(e, old[6, lane], mu, bulk, limit, hardening)
                for d in ti.static(range(6)):
                    new[d, lane] = elastic[d]
                    new[7 + d, lane] = tau[d]
                new[6, lane], whole[2, lane] = flow, far
        else:  # a body that never yields: no return mapping
            for lane in range(LANES):
                e = vec6([old[d, lane] for d in range(6)])
                tau, far = stress_near(e, mu, bulk)
                for d in ti.static(range(6)):
                    new[d, lane] = e[d]
                    new[7 + d, lane] = tau[d]
                new[6, lane], whole[2, lane] = old[6, lane], far
        for lane in range(ti.min(LANES, last_p - start)):
            p = start + lane
            lost += whole[1, lane]
            if whole[2, lane] != 0:
                e = vec6([old[d, lane] for d in range(6)])
                elastic, flow, tau = return_far(e, old[6, lane], mu, bulk, limit, hardening)
                for d in ti.static(range(6)):
                    new[d, lane] = elastic[d]
                    new[7 + d, lane] = tau[d]
                new[6, lane] = flow
            strains[2 * p] = vec4(new[0, lane], new[1, lane], new[2, lane], new[3, lane])
            strains[2 * p + 1] = vec4(new[4, lane], new[5, lane], new[6, lane], 0.0)
            xy, xz, yz = new[10, lane], new[11, lane], new[12, lane]
            ax = impulse * vec4(new[7, lane], xy, xz, 0.0) + inertia * rates[p, 1]
            ay = impulse * vec4(xy, new[8, lane], yz, 0.0) + inertia * rates[p, 2]
            az = impulse * vec4(xz, yz, new[9, lane], 0.0) + inertia * rates[p, 3]
            velocity = rates[p, 0]
            q = mass * vec4(velocity[0], velocity[1], velocity[2], 1.0)
            q -= grid[AT, lane] * ax + grid[AT + 1, lane] * ay + grid[AT + 2, lane] * az
            first = whole[0, lane]
            # what node (i, j, n) gets is w_i w_j w_n (q + i ax + j ay + n az)
            for s in ti.static(range(LINE)):
                w = each(grid[W_Z + NODES * s, lane], grid[W_Z + NODES * s + NODES - 1, lane])
                along = twice(q) + each(float(NODES * s), float(NODES * s + 1)) * twice(az)
                anchor(sums, drop + APART * 3 * s, w * along, never)
                anchor(sums, drop + APART * (3 * s + 1), w * twice(ax), never)
                anchor(sums, drop + APART * (3 * s + 2), w * twice(ay), never)
            for i in ti.static(range(3)):
                for s in ti.static(range(LINE)):
                    w = grid[W_X + i, lane]
                    qi = w * (sums[drop + APART * 3 * s] + float(i) * sums[drop + APART * (3 * s + 1)])
                    yi = w * sums[drop + APART * (3 * s + 2)]
                    for j in ti.static(range(3)):
                        add_to(
                            masses,
                            opaque(never, first + i * plane + j * row + s),
                            grid[W_Y + j, lane] * (qi + float(j) * yi),
                        )
    note_more(partial, env, slot_of(part), OFF_GRID, float(lost))


@ti.func
def node_sum(env, i, at, masses: ti.template(), counts: ti.template()):
    """Momentum and mass of a strip of nodes in plane i: the copies of all parts, in their order."""
    q = strip(0.0)
    for part in ti.static(range(COPIES)):
        if i >= counts[env, SLAB + 2 * part] and i < counts[env, SLAB + 2 * part + 1]:
            q += masses[opaque(counts[env, NEVER], (env * COPIES + part) * counts[env, CAPACITY] + at)]
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

    Particles off the grid read some node of it: the launch is taken back anyway, since `scatter` has counted them.
    """
    never, dt, cell = counts[env, NEVER], facts[env, STEP], facts[env, BODY_CELL]
    origin, scale = vec3(facts[env, ORIGIN], facts[env, ORIGIN + 1], facts[env, ORIGIN + 2]), 1.0 / cell
    ny, nz = counts[env, GRID + 1], counts[env, GRID + 2]
    row, plane = nz // NODES, ny * (nz // NODES)
    copy, slot = copy_of(part), slot_of(part)
    low, high = counts[env, SLAB + 2 * copy], counts[env, SLAB + 2 * copy + 1]
    first_p, last_p = part_range(counts[env, PARTICLES], part)
    first_p, last_p = first_p + env * counts[env, STRIDE], last_p + env * counts[env, STRIDE]
    base = env * counts[env, CAPACITY]
    total, fastest = vec4(0.0), vec4(0.0)
    old = ti.Matrix.zero(ti.f32, 12, LANES)  # e, x, plane
    new = ti.Matrix.zero(ti.f32, 9, LANES)  # e, plane
    rate = ti.Matrix.zero(ti.f32, 10, LANES)  # C; smallest volume after a step so far
    grid = ti.Matrix.zero(ti.f32, STENCIL, LANES)
    whole = ti.Matrix.zero(ti.i32, 2, LANES)  # first strip, off the grid
    for lane in range(LANES):
        rate[9, lane] = 1e9
    for block in range((last_p - first_p + LANES - 1) // LANES):
        start = first_p + block * LANES
        for lane in range(LANES):
            p = ti.min(start + lane, last_p - 1)
            a, b, x, m = strains[2 * p], strains[2 * p + 1], points[p], planes[p]
            for d in ti.static(range(4)):
                old[d, lane] = a[d]
            old[4, lane], old[5, lane] = b[0], b[1]
            for d in ti.static(range(3)):
                old[6 + d, lane] = x[d]
                old[9 + d, lane] = m[d]
            as_it_comes(sums, drop, a[0])
        for lane in range(LANES):
            x = vec3(old[6, lane], old[7, lane], old[8, lane])
            first, off = stencil(x, origin, scale, low, high, ny, nz, grid, lane)
            whole[0, lane], whole[1, lane] = base + first, off
        for lane in range(ti.min(LANES, last_p - start)):
            p = start + lane
            # Sums over y, then x, then z, for the derivatives with the node's number as a factor; dropped in `sums` on
            # their way, where vectors are recognised: by planes 0 to 5, then all 6, by x 7 and by y 8.
            for s in ti.static(range(LINE)):
                here = ti.static(APART * 9 * s)
                for i in ti.static(range(3)):
                    line = whole[0, lane] + i * plane
                    v0, v1 = velocities[opaque(never, line + s)], velocities[opaque(never, line + row + s)]
                    v2 = velocities[opaque(never, line + 2 * row + s)]
                    sum_y = grid[W_Y, lane] * v0 + grid[W_Y + 1, lane] * v1 + grid[W_Y + 2, lane] * v2
                    anchor(sums, drop + (here + APART * i), sum_y, never)
                for i in ti.static(range(3)):
                    line = whole[0, lane] + i * plane
                    v1 = velocities[opaque(never, line + row + s)]
                    v2 = velocities[opaque(never, line + 2 * row + s)]
                    anchor(
                        sums, drop + (here + APART * (3 + i)), grid[D_Y, lane] * v1 + grid[D_Y + 1, lane] * v2, never
                    )
                w = each(grid[W_Z + NODES * s, lane], grid[W_Z + NODES * s + NODES - 1, lane])
                a0, a1, a2 = sums[drop + here], sums[drop + (here + APART)], sums[drop + (here + 2 * APART)]
                b0, b1 = sums[drop + (here + 3 * APART)], sums[drop + (here + 4 * APART)]
                b2 = sums[drop + (here + 5 * APART)]
                total_ = w * (grid[W_X, lane] * a0 + grid[W_X + 1, lane] * a1 + grid[W_X + 2, lane] * a2)
                anchor(sums, drop + (here + APART * 6), total_, never)
                by_x = w * (grid[D_X, lane] * a1 + grid[D_X + 1, lane] * a2)
                anchor(sums, drop + (here + APART * 7), by_x, never)
                by_y = w * (grid[W_X, lane] * b0 + grid[W_X + 1, lane] * b1 + grid[W_X + 2, lane] * b2)
                anchor(sums, drop + (here + APART * 8), by_y, never)
            velocity, x, y, z = vec4(0.0), vec4(0.0), vec4(0.0), vec4(0.0)
            for n in ti.static(range(NODES * LINE)):
                here = ti.static(APART * (9 * (n // NODES) + 6))
                for d in ti.static(range(4)):
                    c = ti.static(4 * (n % NODES) + d)
                    velocity[d] += sums[drop + here][c]
                    x[d] += sums[drop + (here + APART)][c]
                    y[d] += sums[drop + (here + 2 * APART)][c]
                    z[d] += float(n) * sums[drop + here][c]
            x = (4.0 * scale) * (x - grid[AT, lane] * velocity)
            y = (4.0 * scale) * (y - grid[AT + 1, lane] * velocity)
            z = (4.0 * scale) * (z - grid[AT + 2, lane] * velocity)
            rates[p, 0] = keep_or(never, rates[p, 0], velocity)
            rates[p, 1] = keep_or(never, rates[p, 1], x)
            rates[p, 2] = keep_or(never, rates[p, 2], y)
            rates[p, 3] = keep_or(never, rates[p, 3], z)
            points[p] = points[p] + dt * velocity
            for d in ti.static(range(3)):
                rate[d, lane], rate[3 + d, lane], rate[6 + d, lane] = x[d], y[d], z[d]
            fastest = ti.max(fastest, ti.abs(velocity))
            total += velocity
        for lane in range(LANES):
            x = vec4(rate[0, lane], rate[1, lane], rate[2, lane], 0.0)
            y = vec4(rate[3, lane], rate[4, lane], rate[5, lane], 0.0)
            z = vec4(rate[6, lane], rate[7, lane], rate[8, lane], 0.0)
            step = dt * mat3([[x[i], y[i], z[i]] for i in range(3)])
            e = convect(vec6([old[d, lane] for d in range(6)]), step)
            plane_ = moved_plane(vec4(old[9, lane], old[10, lane], old[11, lane], 0.0), x, y, z, dt)
            volume = (mat3([[1, 0, 0], [0, 1, 0], [0, 0, 1]]) + step).determinant()
            rate[9, lane] = ti.min(rate[9, lane], volume)
            for d in ti.static(range(6)):
                new[d, lane] = e[d]
            for d in ti.static(range(3)):
                new[6 + d, lane] = plane_[d]
        for lane in range(ti.min(LANES, last_p - start)):
            p = start + lane
            strains[2 * p] = vec4(new[0, lane], new[1, lane], new[2, lane], new[3, lane])
            strains[2 * p + 1] = vec4(new[4, lane], new[5, lane], strains[2 * p + 1][2], 0.0)
            planes[p] = vec4(new[6, lane], new[7, lane], new[8, lane], 0.0)
    note_least(partial, env, slot, SMALLEST_STEP_VOLUME, least_lane(rate, 9))
    note_most(partial, env, slot, FASTEST, ti.max(fastest[0], fastest[1], fastest[2]))
    for d in ti.static(range(3)):
        note_sum(partial, env, slot, MOTION + d, total[d])
