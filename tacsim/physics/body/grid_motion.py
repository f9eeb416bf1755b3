"""Motion of the body's grid: velocities of its nodes, damped towards the affine motion that the two sensors impose."""

from tacsim.compute.runtime import ti
from tacsim.physics.body.mass import CHANGE, box_of_part, changes_at, filter_strip, motion_of
from tacsim.physics.body.transfers import has_velocities
from tacsim.physics.body.tuning import ROTATION_BOOST
from tacsim.physics.exec import layout
from tacsim.physics.exec.lanes import (
    NODES,
    PARTS,
    hide_from_compiler,
    load_strip,
    mask_strip,
    overwrite,
    strip,
    tile_numbers,
    tile_vector,
    vec3,
    vec4,
)

Drive = ti.types.ndarray(dtype=ti.f32, ndim=5)  # (environments, substeps, gels, rows, 3)


@ti.func
def drive_row(drive: ti.template(), env: ti.template(), it, g, r):
    return vec3([drive[env.index, it, g, r, c] for c in range(3)])


@ti.func
def drive_rotation(drive: ti.template(), env: ti.template(), it, g):
    return ti.Matrix.rows(
        [drive_row(drive, env, it, g, 0), drive_row(drive, env, it, g, 1), drive_row(drive, env, it, g, 2)]
    )


@ti.func
def part_sum(env: ti.template(), first):
    """Sum of three numbers over all parts, in their order."""
    total = vec3(0.0)
    for part in ti.static(range(PARTS)):
        total += vec3([env.partial[env.index, part, first + c] for c in range(3)])
    return total


@ti.func
def moment_about(centre, origin, rotate, force, moment):
    """Moment about `centre`, world axes, of a force and a moment about a sensor's `origin`, both in sensor axes."""
    return rotate @ moment + (origin - centre).cross(rotate @ force)


@ti.func
def symmetric(env: ti.template(), first):
    """A symmetric matrix from six numbers: xx, yy, zz, xy, xz, yz."""
    xx, yy, zz, xy, xz, yz = [env.param(first + c) for c in range(6)]
    return ti.Matrix([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


@ti.func
def cross_columns(a, columns):
    """The cross products of a vector with the columns of a matrix, as columns."""
    return ti.Matrix.cols([a.cross(vec3([columns[r, c] for r in range(3)])) for c in range(3)])


@ti.func
def four_of(a):
    return vec4(a[0], a[1], a[2], 0.0)


@ti.func
def line_value(start, slopes, i, j, k):
    """start + slopes @ (i, j, k) for the nodes of a strip; k: a strip with their numbers."""
    line = start + vec3([i * slopes[r, 0] + j * slopes[r, 1] for r in range(3)])
    return tile_vector(four_of(line)) + k * tile_vector(vec4(slopes[0, 2], slopes[1, 2], slopes[2, 2], 0.0))


@ti.func
def grid_update(env: ti.template(), part, it, drive: ti.template(), body: ti.template()):
    """Computes node velocities from momenta; damps towards the affine motion that the two sensors impose.

    A boost is added to each velocity: selective mass scaling of the slowest modes, the rigid motions of a body between
    two soft gels. The inertia is artificial; the state at rest does not depend on it.

    Only a sensor that touches the body imposes a motion; a body without contact is damped towards rest. Normal to the
    sensors' axis, while a sensor moves, the target velocity is the body's mean velocity: a body on one sensor must not
    be dragged by the other.
    """
    dt, cell, damping = env.param(layout.STEP), env.param(layout.BODY_CELL), env.param(layout.BODY_DAMPING)
    origin = env.param3(layout.ORIGIN)
    weight = env.param3(layout.GRAVITY)
    force0, force1 = part_sum(env, layout.FORCE), part_sum(env, layout.FORCE + 6)
    particle_mass, particles = env.param(layout.BODY_MASS), env.count(layout.PARTICLES)
    push = particle_mass * particles * weight  # total force on the body: weight and contact
    push -= drive_rotation(drive, env, it, 0) @ force0
    push -= drive_rotation(drive, env, it, 1) @ force1
    touches0, touches1 = force0.norm_sqr() > 0.0, force1.norm_sqr() > 0.0
    mean = part_sum(env, layout.VELOCITY_SUM) / particles
    boost = ((env.param(layout.RIGID_MASS_SCALE) - 1.0) * dt / (particle_mass * particles)) * push
    p0, p1 = drive_row(drive, env, it, 0, 3), drive_row(drive, env, it, 1, 3)
    centre = env.param3(layout.CENTRE)
    torque = -moment_about(centre, p0, drive_rotation(drive, env, it, 0), force0, part_sum(env, layout.FORCE + 3))
    torque -= moment_about(centre, p1, drive_rotation(drive, env, it, 1), force1, part_sum(env, layout.FORCE + 9))
    turn = (
        (ROTATION_BOOST * (env.param(layout.RIGID_MASS_SCALE) - 1.0) * dt)
        * symmetric(env, layout.INVERSE_INERTIA)
        @ torque
    )
    v0, v1 = drive_row(drive, env, it, 0, 4), drive_row(drive, env, it, 1, 4)
    w0, w1 = drive_row(drive, env, it, 0, 5), drive_row(drive, env, it, 1, 5)
    axis = p1 - p0
    length2 = axis.norm_sqr() + 1e-12
    share = ti.select(touches0 and touches1, 1.0, 0.0)  # 1: interpolate between the sensors; 0: one sensor
    only_upper = ti.select(touches1 and not touches0, 1.0, 0.0)
    held = ti.select(touches0 or touches1, 1.0, 0.0)
    driven = held * (v0.norm_sqr() + v1.norm_sqr() + w0.norm_sqr() + w1.norm_sqr()) > 0.0
    identity = ti.Matrix([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    along, across = held * identity, vec3(0.0)
    if driven:
        along, across = held / length2 * axis.outer_product(axis), mean - axis * (mean.dot(axis) / length2)
    # Positions, and velocities of rigid motions, are linear in the numbers i, j, k of a node: start and slopes
    carried = ti.Matrix([[env.param(layout.MEAN_GRADIENT + 3 * i + j) for j in range(3)] for i in range(3)])
    arm, edges = origin - env.param3(layout.REFERENCE_CENTRE), cell * (identity + carried)
    x = centre + arm + carried @ arm
    lift, lifts = boost + turn.cross(x - centre), cross_columns(turn, edges)
    lower, lowers = along @ (v0 + w0.cross(x - p0)), along @ cross_columns(w0, edges)
    upper, uppers = along @ (v1 + w1.cross(x - p1)), along @ cross_columns(w1, edges)
    place, places = (x - p0).dot(axis) / length2, edges.transpose() @ axis / length2
    # Damped: (1 - d) (velocity + lift) + d (lower + t (upper - lower) + across), with t between the sensors
    d = damping * dt
    lift, lifts = (1.0 - d) * lift + d * (lower + across), (1.0 - d) * lifts + d * lowers
    pull, pulls = d * (upper - lower), d * (uppers - lowers)
    own, filtered, kept = 1.0, 0.0, 0.0
    if has_velocities(env, it):
        own, filtered, kept = env.param(layout.OWN_WEIGHT), env.param(layout.FILTERED_WEIGHT), 1.0
    ny, nz, zero = env.count(layout.GRID + 1), env.count(layout.GRID + 2), env.count(layout.ZERO)
    base, motion = env.index * env.count(layout.CAPACITY), motion_of(env)
    numbers = tile_numbers(ti.cast(zero, ti.f32), ti.cast(zero + 1, ti.f32))  # of nodes in a strip; see `motion_of`
    low, high = box_of_part(env, part)
    for i in range(low[0], high[0]):
        for j in range(low[1], high[1]):
            for n in range(low[2] // NODES, high[2] // NODES):
                filter_strip(env, body, motion, own, filtered, i, j, n)
            for n in range(low[2] // NODES, high[2] // NODES):
                node = (i * ny + j) * (nz // NODES) + n
                at, k = hide_from_compiler(zero, base + node), numbers + ti.cast(NODES * n, ti.f32)
                before, change = body.velocities[at], load_strip(body.changes, changes_at(env, CHANGE, NODES * node))
                t = only_upper + share * ti.max(0.0, ti.min(1.0, place + i * places[0] + j * places[1] + k * places[2]))
                velocity = (1.0 - d) * (mask_strip(strip(kept), before) + change)
                velocity += line_value(lift, lifts, i, j, k) + t * line_value(pull, pulls, i, j, k)
                # a mass that is not 0: true of NaN, which must not be hidden
                mass = motion * tile_numbers(change[3], change[4 * NODES - 1])
                body.velocities[at] = overwrite(zero, before, mask_strip(mass, velocity))
