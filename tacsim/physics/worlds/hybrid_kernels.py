"""Kernels of two gels round a plasticine body: contact, transfers and motion, many substeps in one launch."""

from tacsim.compute.runtime import ti
from tacsim.physics.body.transfers import (
    Particles,
    Strips,
    block_range,
    clear_masses,
    grid_to_particles,
    node_sum,
    particles_to_grid,
)
from tacsim.physics.contact.contact import Kept, contact_ceiling, particle_contact, support_radius
from tacsim.physics.exec.lanes import (
    LANES,
    NODES,
    ON_DEVICE,
    PARTS,
    Counts,
    Params,
    Partial,
    copy_of,
    note_sum,
    part_range,
    slot_of,
    strip,
    vec3,
)
from tacsim.physics.exec.layout import (
    BODY_CELL,
    BODY_DAMPING,
    BODY_MASS,
    CAPACITY,
    CENTRE,
    ELEMENTS,
    FORCE,
    GRAVITY,
    GRID,
    HOUSED,
    KNOWN,
    LIGHTNESS,
    MOTION,
    ORIGIN,
    OVERLAP,
    PARTICLES,
    PLACE,
    PLANE,
    SPREAD,
    STEP,
    STEPS,
    STRIDE,
    TURNING,
    VELOCITY,
)  # fmt: skip
from tacsim.physics.exec.team import CHUNK, ENVIRONMENT, Sync, first_in_chunk, next_piece, once_if, piece_done
from tacsim.physics.gel.gel import (
    Corners,
    Lattice,
    Nodes,
    Skin,
    Touch,
    gel_advance,
    gel_forces,
    skin_row,
    touch_start,
)

Drive = ti.types.ndarray(dtype=ti.f32, ndim=5)
TURN = 1.0 / 3.0  # share of the boost that rotations get: with more of it bodies overshoot when a slide stops

ContactMemory = ti.types.ndarray(dtype=Kept, ndim=3)


@ti.func
def row(drive: ti.template(), env, it, g, r):
    return vec3(drive[env, it, g, r, 0], drive[env, it, g, r, 1], drive[env, it, g, r, 2])


@ti.func
def numbers(particles: ti.template(), at, stride):
    """Three rows of one particle, from that at `at` on."""
    return vec3(particles[at], particles[at + stride], particles[at + 2 * stride])


@ti.func
def rotation(drive: ti.template(), env, it, g):
    return ti.Matrix.rows([row(drive, env, it, g, 0), row(drive, env, it, g, 1), row(drive, env, it, g, 2)])


@ti.func
def part_sum(partial: ti.template(), env, first):
    """Sum of three numbers over all parts, in their order."""
    total = vec3(0.0)
    for part in ti.static(range(PARTS)):
        total += vec3(partial[env, part, first], partial[env, part, first + 1], partial[env, part, first + 2])
    return total


@ti.func
def moment_about(centre, origin, rotate, force, moment):
    """Of a force and a moment about a sensor's `origin`, both in its axes: the moment about `centre`, world axes."""
    return rotate @ moment + (origin - centre).cross(rotate @ force)


@ti.func
def symmetric(params: ti.template(), env, first):
    """A symmetric matrix of six facts: xx, yy, zz, xy, xz, yz."""
    xx, yy, zz = params[env, first], params[env, first + 1], params[env, first + 2]
    xy, xz, yz = params[env, first + 3], params[env, first + 4], params[env, first + 5]
    return ti.Matrix([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


@ti.func
def grid_update(
    env, part, it, drive: ti.template(), masses: ti.template(), velocities: ti.template(), params: ti.template(),
    counts: ti.template(), partial: ti.template(),
):  # fmt: skip
    """Momentum to velocity; damps towards the affine motion that the two sensors impose, not towards rest.

    A boost is added to every velocity: selective mass scaling of the slowest modes, the rigid motions of a body that
    hangs between two soft gels. Inertia is artificial here anyway; the resting state does not depend on it.

    With SPREAD the reference also widens as fast as a body must whose volume stays (docs/decisions/0002).

    Only a sensor that touches the body imposes anything; one that nobody touches is damped towards rest. Across the
    sensors' axis the reference is the body's own mean velocity while anything is driven: a body that rides on one
    sensor must not be dragged back by the other.
    """
    dt, cell, damping = params[env, STEP], params[env, BODY_CELL], params[env, BODY_DAMPING]
    origin = vec3(params[env, ORIGIN], params[env, ORIGIN + 1], params[env, ORIGIN + 2])
    weight = vec3(params[env, GRAVITY], params[env, GRAVITY + 1], params[env, GRAVITY + 2])
    force0, force1 = part_sum(partial, env, FORCE), part_sum(partial, env, FORCE + 6)
    push = params[env, BODY_MASS] * counts[env, PARTICLES] * weight  # total force on the body: weight and contact
    push -= rotation(drive, env, it, 0) @ force0
    push -= rotation(drive, env, it, 1) @ force1
    touch0, touch1 = force0.norm_sqr() > 0.0, force1.norm_sqr() > 0.0
    mean = part_sum(partial, env, MOTION) / counts[env, PARTICLES]
    boost = ((params[env, LIGHTNESS] - 1.0) * dt / (params[env, BODY_MASS] * counts[env, PARTICLES])) * push
    p0, p1 = row(drive, env, it, 0, 3), row(drive, env, it, 1, 3)
    centre = vec3(params[env, CENTRE], params[env, CENTRE + 1], params[env, CENTRE + 2])
    torque = -moment_about(centre, p0, rotation(drive, env, it, 0), force0, part_sum(partial, env, FORCE + 3))
    torque -= moment_about(centre, p1, rotation(drive, env, it, 1), force1, part_sum(partial, env, FORCE + 9))
    turn = (TURN * (params[env, LIGHTNESS] - 1.0) * dt) * symmetric(params, env, TURNING) @ torque
    v0, v1 = row(drive, env, it, 0, 4), row(drive, env, it, 1, 4)
    w0, w1 = row(drive, env, it, 0, 5), row(drive, env, it, 1, 5)
    axis = p1 - p0
    length2 = axis.norm_sqr() + 1e-12
    share = ti.select(touch0 and touch1, 1.0, 0.0)  # of the way from one sensor to the other that counts
    alone = ti.select(touch1 and not touch0, 1.0, 0.0)
    held = ti.select(touch0 or touch1, 1.0, 0.0)
    driven = held * (v0.norm_sqr() + v1.norm_sqr() + w0.norm_sqr() + w1.norm_sqr()) > 0.0
    mean_across = mean - axis * (mean.dot(axis) / length2)
    widening = -0.5 * params[env, SPREAD] * share * (v1 - v0).dot(axis) / length2
    nx, ny, nz = counts[env, GRID], counts[env, GRID + 1], counts[env, GRID + 2]
    base = env * counts[env, CAPACITY]
    nz = nz // NODES  # strips
    i0, i1, j0, j1, k0, k1 = 0, 0, 0, ny, 0, nz
    if ti.static(ON_DEVICE):  # one node
        i0, j0, k0 = part // (ny * nz), part // nz % ny, part % nz
        i1, j1, k1 = i0 + 1, j0 + 1, k0 + 1
    else:
        i0, i1 = part_range(nx, part)
    for i in range(i0, i1):
        for j in range(j0, j1):
            for k in range(k0, k1):
                at = (i * ny + j) * nz + k
                q = node_sum(env, i, at, masses, velocities, counts)
                moved = strip(0.0)
                for n in ti.static(range(NODES)):
                    if q[4 * n + 3] != 0.0:  # a mass that is not a number must show
                        x = origin + cell * vec3(i, j, k * NODES + n)
                        velocity = vec3(q[4 * n], q[4 * n + 1], q[4 * n + 2]) / q[4 * n + 3] + dt * weight
                        velocity += boost + turn.cross(x - centre)
                        t = alone + share * ti.max(0.0, ti.min(1.0, (x - p0).dot(axis) / length2))
                        reference = held * ((1.0 - t) * (v0 + w0.cross(x - p0)) + t * (v1 + w1.cross(x - p1)))
                        if driven:
                            across = (x - centre) - axis * ((x - centre).dot(axis) / length2)
                            reference = axis * (reference.dot(axis) / length2) + mean_across + widening * across
                        velocity -= damping * dt * (velocity - reference)
                        for d in ti.static(range(3)):
                            moved[4 * n + d] = velocity[d]
                velocities[base + at] = moved


@ti.func
def touch_gel(
    env, part, g, it, drive: ti.template(), particles: ti.template(), memory: ti.template(), skin: ti.template(),
    touch: ti.template(), params: ti.template(), counts: ti.template(), partial: ti.template(), highest, layers, nx, ny,
):  # fmt: skip
    """Contact of this part's particles with gel g. Notes force and moment of the body on the sensor, sensor axes.

    highest: contact_ceiling of that gel.
    """
    rotate = rotation(drive, env, it, g)
    origin, velocity, spin = row(drive, env, it, g, 3), row(drive, env, it, g, 4), row(drive, env, it, g, 5)
    back = rotate.transpose()
    outward = vec3(rotate[0, 2], rotate[1, 2], rotate[2, 2])  # the sensor's z axis
    spacing = 0.5 * params[env, BODY_CELL]
    rate = params[env, STEP] / params[env, BODY_MASS]
    total, moment, on_housing = vec3(0.0), vec3(0.0), vec3(0.0)
    stride, rows = counts[env, STRIDE], skin_row(env, 2, g, nx)
    pushed = touch_start(env, copy_of(part), 2, g, nx, ny)
    first, last = block_range(env, part, counts)
    for p in range(first * LANES, ti.min(last * LANES, counts[env, PARTICLES])):
        known = env * KNOWN * stride + p
        arm = numbers(particles, known + PLACE * stride, stride) - origin
        away = outward.dot(arm) - highest  # most of the body is far away: one dot product decides
        radius = spacing  # at most
        if away < 2.5 * spacing:
            radius = support_radius(numbers(particles, known + PLANE * stride, stride), spacing)
        # one radius to touch, half a spacing for what the contact's memory still bridges
        if away < radius + 0.5 * spacing:
            local = back @ arm
            moving = numbers(particles, known + VELOCITY * stride, stride)
            relative = back @ (moving - velocity - spin.cross(arm))
            touching, housed, force, kept = particle_contact(
                env,
                part,
                g,
                local,
                relative,
                memory[env, g, p],
                radius,
                skin,
                rows,
                touch,
                pushed,
                params,
                layers,
                nx,
                ny,
                partial,
            )
            memory[env, g, p] = kept
            if touching:
                moving += rate * (rotate @ force)
                for d in ti.static(range(3)):
                    particles[known + (VELOCITY + d) * stride] = moving[d]
                total -= force
                moment -= local.cross(force)
                if housed:
                    on_housing -= force
        elif away < 2.5 * spacing:  # nothing passes this margin in one substep, so what is beyond has forgotten
            memory[env, g, p] = Kept(0.0)
    slot = slot_of(part)
    for d in ti.static(range(3)):
        note_sum(partial, env, slot, FORCE + 6 * g + d, total[d])
        note_sum(partial, env, slot, FORCE + 6 * g + 3 + d, moment[d])
        note_sum(partial, env, slot, HOUSED + 3 * g + d, on_housing[d])


@ti.kernel
def substeps(
    team: ti.i32, drive: Drive,
    nodes: Nodes, skin: Skin, touch: Touch, corners: Corners, lattice: Lattice,
    particles: Particles, masses: Strips, velocities: Strips, memory: ContactMemory,
    params: Params, counts: Counts, partial: Partial, sync: Sync,
):  # fmt: skip
    """Explicit substeps of every environment's scene in one launch, `team` threads an environment.

    Two stages a substep: what is scattered must be whole before it is summed, and summed before it is gathered. A part
    is gathered in the stage in which it is scattered again.
    """
    for task in range(sync.shape[0] * team * CHUNK):
        for _ in range(first_in_chunk(task)):
            turn = task // CHUNK // team
            env = sync[turn, ENVIRONMENT]
            nx, ny, layers = counts[env, ELEMENTS], counts[env, ELEMENTS + 1], counts[env, ELEMENTS + 2]
            steps = counts[env, STEPS]
            pieces = PARTS * (2 * steps + 1)
            highest, known = ti.Vector([0.0, 0.0]), -1  # of the two gels, in this stage
            piece = next_piece(sync, turn, pieces)
            while piece < pieces:
                stage, part = piece // PARTS, piece % PARTS
                it, scatters = stage // 2, stage % 2 == 0
                for _new in range(once_if(scatters and stage != known)):
                    known = stage
                    for g in ti.static(range(2)):
                        highest[g] = contact_ceiling(skin, skin_row(env, 2, g, nx), nx, ny)
                for _gather in range(once_if(scatters and it > 0)):
                    grid_to_particles(env, part, particles, velocities, params, counts, partial)
                for _scatter in range(once_if(scatters and it < steps)):
                    partial[env, part, OVERLAP] = 0.0
                    for g in range(2):
                        touch_gel(
                            env, part, g, it, drive, particles, memory, skin, touch, params, counts, partial,
                            highest[g], layers, nx, ny,
                        )  # fmt: skip
                    clear_masses(env, part, masses, counts)
                    particles_to_grid(env, part, particles, masses, params, counts, partial)
                    gel_forces(
                        env, part, 2, nodes, corners, lattice, params, counts, partial,
                        layers, nx, ny,
                    )  # fmt: skip
                for _motion in range(once_if(not scatters)):
                    gel_advance(env, part, 2, nodes, skin, touch, lattice, params, counts, partial, layers, nx, ny)
                    grid_update(env, part, it, drive, masses, velocities, params, counts, partial)
                piece_done(sync, turn)
                piece = next_piece(sync, turn, pieces)
