"""Kernels of two gels and a plasticine body: contact, transfers and motion, many substeps in one launch."""

from tacsim.compute.runtime import ti
from tacsim.compute.taichi_patches.separate_functions import compiled_separately
from tacsim.physics.body.grid_motion import Drive, drive_rotation, drive_row, grid_update
from tacsim.physics.body.mass import (
    CHANGE,
    SECOND,
    cell_means,
    grid_changes,
    second_changes,
)
from tacsim.physics.body.tied_node_kernels import Ends, set_tied_velocities, transfer_impulses
from tacsim.physics.body.transfers import (
    Body,
    Strips,
    block_range,
    clear_masses,
    grid_to_particles,
    particles_to_grid,
)
from tacsim.physics.contact.contact import ContactHistory, max_surface_height, particle_contact, support_radius
from tacsim.physics.exec import layout
from tacsim.physics.exec.environment import (
    Counts,
    Environment,
    EnvironmentArrays,
    Floats,
    Params,
    Partial,
    record_sum,
)
from tacsim.physics.exec.lanes import (
    LANES,
    PARTS,
    add_to,
    copy_of,
    filled,
    ivec3,
    load_rows,
    min_over_lanes,
    read_three,
    slot_of,
    vec2,
    vec3,
)
from tacsim.physics.exec.team import (
    CHUNK,
    ENVIRONMENT,
    Sync,
    claim_work,
    first_in_chunk,
    first_own_part,
    one_if,
    report_work_done,
)
from tacsim.physics.gel.kernels import GelArrays, Gels, Lattice, contact_force_start, gel_forces, gel_of
from tacsim.physics.gel.mass import gel_advance_filtered, gel_filter_first_pass, gel_means

Records = ti.types.ndarray(dtype=ti.f32, ndim=4)
STAGES = 7  # of a substep

ContactHistories = ti.types.ndarray(dtype=ContactHistory, ndim=3)
# Argument pack of `BodyState.arguments`, `changes` and `links`
BodyArrays = ti.types.argpack(
    particles=Floats, masses=Strips, velocities=Strips, changes=Floats, ends=Ends, shares=Floats
)


@ti.func
def three_rows(particles: ti.template(), at, stride):
    """Three rows of one particle, from index `at`."""
    return vec3(particles[at], particles[at + stride], particles[at + 2 * stride])


@ti.func
def gel_contact(
    env: ti.template(), part, g, it, drive: ti.template(), body: ti.template(), histories: ti.template(),
    gels: ti.template(), highest,
):  # fmt: skip
    """Contact of this part's particles with gel g. Records force and moment of the body on the sensor, sensor axes.

    highest: `max_surface_height` of that gel.
    """
    rotate = drive_rotation(drive, env, it, g)
    origin, velocity, spin = (
        drive_row(drive, env, it, g, 3),
        drive_row(drive, env, it, g, 4),
        drive_row(drive, env, it, g, 5),
    )
    back = rotate.transpose()
    outward = vec3(rotate[0, 2], rotate[1, 2], rotate[2, 2])  # the sensor's z axis
    spacing = 0.5 * env.param(layout.BODY_CELL)
    rate = env.param(layout.STEP) / env.param(layout.BODY_MASS)
    real_time = env.param(layout.MEMORY_SHARE) == 0.0
    stiffened = ti.select(it == 0, env.param(layout.STIFFNESS_RATIO + g) - 1.0, 0.0)
    total, moment, on_housing = vec3(0.0), vec3(0.0), vec3(0.0)
    stride = env.count(layout.STRIDE)
    gel = ti.static(gel_of(env, gels, g))
    forces = contact_force_start(gel, copy_of(part))
    first, last = block_range(env, part)
    place = filled(0.0, 4, LANES)  # of a block's particles; their distance from the gel
    for block in range(first, last):
        start = env.index * layout.PARTICLE_ROWS * stride + block * LANES
        load_rows(body.particles, start, stride, layout.POSITION, 3, place)
        for lane in range(LANES):
            place[3, lane] = outward.dot(read_three(place, 0, lane) - origin) - highest
        # most of the body is far away: one dot product for each particle of a block
        near = ti.select(min_over_lanes(place, 3) < 2.5 * spacing, LANES, 0)
        for lane in range(ti.min(near, env.count(layout.PARTICLES) - block * LANES)):
            at, p, away = start + lane, block * LANES + lane, place[3, lane]
            arm = read_three(place, 0, lane) - origin
            radius = spacing  # at most
            if away < 2.5 * spacing:
                radius = support_radius(three_rows(body.particles, at + layout.PLANE * stride, stride), spacing)
                # A radius that changes with the strain does work without a force on the body. Without damping this
                # would excite waves, so a particle keeps the radius of its first contact.
                if real_time and histories[env.index, g, p][6] > 0.0:
                    radius = histories[env.index, g, p][6]
            # one radius for contact, half a spacing for the contact's memory
            if away < radius + 0.5 * spacing:
                local = back @ arm
                moving = three_rows(body.particles, at + layout.VELOCITY * stride, stride)
                relative = back @ (moving - velocity - spin.cross(arm))
                in_contact, housed, force, history = particle_contact(
                    env, part, local, relative, histories[env.index, g, p], radius, stiffened, gel, forces
                )
                histories[env.index, g, p] = history
                if in_contact:
                    kick = rate * (rotate @ force)
                    for d in ti.static(range(3)):
                        add_to(body.particles, at + (layout.PUSH + d) * stride, kick[d])
                    total -= force
                    moment -= local.cross(force)
                    if housed:
                        on_housing -= force
            elif away < 2.5 * spacing:  # no particle crosses this margin in one substep: farther ones have no memory
                histories[env.index, g, p] = ContactHistory(0.0)
    slot = slot_of(part)
    for d in ti.static(range(3)):
        record_sum(env, slot, layout.FORCE + 6 * g + d, total[d])
        record_sum(env, slot, layout.FORCE + 6 * g + 3 + d, moment[d])
        record_sum(env, slot, layout.HOUSING_FORCE + 3 * g + d, on_housing[d])


@ti.func
def store_record(env: ti.template(), part, it, records: ti.template()):
    """Copies the part's numbers at the end of substep `it`, if a record is due."""
    every = env.count(layout.RECORD_INTERVAL)
    record = (it + 1) // every - 1
    for _wanted in range(one_if((it + 1) % every == 0 and record < layout.RECORDS)):
        for number in range(layout.NUMBERS):
            records[env.index, record, part, number] = env.partial[env.index, part, number]


# Nearly all functions are compiled separately from the kernel. `particles_to_grid` is not: it is so large that LLVM
# does not inline it, loads the addresses of its arrays after each store, and merges no lanes. Arrays that a function
# does not use are None, since Taichi passes arrays to a separate function one by one.


@compiled_separately
def on_gels(
    work: ti.template(), index: ti.i32, part: ti.i32,
    nodes: Floats, surface: Floats, contact_force: Floats, corners: Floats, lattice: Lattice,
    params: Params, counts: Counts, partial: Partial,
):  # fmt: skip
    """Calls work(env, part, gels)."""
    env = ti.static(Environment(index, params, counts, partial))
    work(env, part, ti.static(Gels(nodes, surface, contact_force, corners, lattice, 2)))


@compiled_separately
def on_body(
    work: ti.template(), index: ti.i32, part: ti.i32,
    particles: Floats, masses: Strips, velocities: Strips, changes: Floats,
    params: Params, counts: Counts, partial: Partial,
):  # fmt: skip
    """Calls work(env, part, body)."""
    env = ti.static(Environment(index, params, counts, partial))
    work(env, part, ti.static(Body(particles, masses, velocities, changes)))


@compiled_separately
def on_links(
    work: ti.template(), index: ti.i32, part: ti.i32,
    masses: Strips, velocities: Strips, changes: Floats, ends: Ends, shares: Floats,
    params: Params, counts: Counts, partial: Partial,
):  # fmt: skip
    """Calls work(env, part, body) with the links between tied nodes and full nodes."""
    env = ti.static(Environment(index, params, counts, partial))
    work(env, part, ti.static(Body(None, masses, velocities, changes, ends, shares)))


@compiled_separately
def particle_contacts(
    place: ivec3, highest: vec2, drive: Drive, surface: Floats, contact_force: Floats, particles: Floats,
    histories: ContactHistories, params: Params, counts: Counts, partial: Partial,
):  # fmt: skip
    """Contact of a part's particles with both gels.

    place: environment, part, substep; highest: `max_surface_height` of each gel.
    """
    index, part, it = place[0], place[1], place[2]
    env = ti.static(Environment(index, params, counts, partial))
    gels = ti.static(Gels(None, surface, contact_force, None, None, 2))
    body = ti.static(Body(particles, None, None))
    partial[index, part, layout.OVERLAP] = 0.0
    for g in range(2):
        gel_contact(env, part, g, it, drive, body, histories, gels, highest[g])


@compiled_separately
def grid_motion(
    index: ti.i32, part: ti.i32, it: ti.i32, drive: Drive, velocities: Strips, changes: Floats,
    params: Params, counts: Counts, partial: Partial,
):  # fmt: skip
    """Calls `grid_update`."""
    env = ti.static(Environment(index, params, counts, partial))
    grid_update(env, part, it, drive, ti.static(Body(None, None, velocities, changes)))


@ti.kernel
def substeps(
    team: ti.i32, drive: Drive, gel_arrays: GelArrays, body_arrays: BodyArrays, histories: ContactHistories,
    environments: EnvironmentArrays, records: Records, sync: Sync,
):  # fmt: skip
    """Explicit substeps of every environment's scene in one launch, `team` threads an environment.

    Stages of a substep: scattered values are complete before they are summed, sums before each pass of the filters
    reads those of neighbours, velocities of full nodes before those of tied nodes, and these before they are gathered.
    A part is gathered in the stage in which it is scattered again.
    """
    for task in range(sync.shape[0] * team * CHUNK):
        for _ in range(first_in_chunk(task)):
            turn = task // CHUNK // team
            index = sync[turn, ENVIRONMENT]
            shared = ti.static((environments.params, environments.counts, environments.partial))
            env = ti.static(Environment(index, *shared))
            of_gels = ti.static(
                (gel_arrays.nodes, gel_arrays.surface, gel_arrays.contact_force, gel_arrays.corners, gel_arrays.lattice)
            )
            gels = ti.static(Gels(*of_gels, number=2))
            of_grid = ti.static((body_arrays.masses, body_arrays.velocities, body_arrays.changes))
            of_links = ti.static((body_arrays.ends, body_arrays.shares))
            body = ti.static(Body(body_arrays.particles, *of_grid, *of_links))
            steps = env.count(layout.STEPS)
            stages, own = STAGES * steps + 1, first_own_part(task, team)
            highest, known = vec2(0.0), -1  # of the two gels, in this stage
            piece = claim_work(sync, turn, own, stages)
            while piece < stages * PARTS:
                stage, part = piece // PARTS, piece % PARTS
                it, scatters = stage // STAGES, stage % STAGES == 0
                for _new in range(one_if(scatters and stage != known)):
                    known = stage
                    for g in ti.static(range(2)):
                        highest[g] = max_surface_height(ti.static(gel_of(env, gels, g)))
                for _gather in range(one_if(scatters and it > 0)):
                    on_body(grid_to_particles, index, part, body.particles, *of_grid, *shared)
                for _scatter in range(one_if(scatters and it < steps)):
                    place = ivec3(index, part, it)
                    particle_contacts(
                        place, highest, drive, gels.surface, gels.contact_force, body.particles, histories, *shared
                    )
                    clear_masses(env, part, body)
                    particles_to_grid(env, part, it, body)
                    on_gels(gel_forces, index, part, *of_gels, *shared)
                for _totals in range(one_if(stage % STAGES == 1)):
                    on_gels(gel_means, index, part, *of_gels, *shared)
                    on_body(grid_changes, index, part, body.particles, *of_grid, *shared)
                    on_links(transfer_impulses, index, part, *of_grid, *of_links, *shared)
                for _even in range(one_if(stage % STAGES == 2)):
                    on_gels(gel_filter_first_pass, index, part, *of_gels, *shared)
                for _cells in range(one_if(stage % STAGES == 2 or stage % STAGES == 4)):
                    cell_means(env, part, ti.select(stage % STAGES == 2, CHANGE, SECOND), body)
                for _motion in range(one_if(stage % STAGES == 3)):
                    on_gels(gel_advance_filtered, index, part, *of_gels, *shared)
                    on_body(second_changes, index, part, body.particles, *of_grid, *shared)
                for _motion in range(one_if(stage % STAGES == 5)):
                    grid_motion(index, part, it, drive, body.velocities, body.changes, *shared)
                for _light in range(one_if(stage % STAGES == 6)):
                    on_links(set_tied_velocities, index, part, *of_grid, *of_links, *shared)
                for _end in range(one_if(stage % STAGES == STAGES - 1)):
                    store_record(env, part, it, records)
                report_work_done(sync, turn)
                piece = claim_work(sync, turn, own, stages)
