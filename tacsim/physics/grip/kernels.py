"""Kernel of rigid objects between gel pads: gels and objects advance together, many substeps in one launch."""

from tacsim.compute.runtime import ti
from tacsim.physics.body.grid_motion import Drive
from tacsim.physics.contact.indenter import Indenter, IndenterArrays, apply_indenter, update_node_pressure
from tacsim.physics.exec.environment import Environment, EnvironmentArrays, share_min
from tacsim.physics.exec.lanes import PARTS
from tacsim.physics.exec.layout import SMALLEST_VOLUME
from tacsim.physics.exec.team import (
    CHUNK,
    DONE,
    ENVIRONMENT,
    Sync,
    claim_work,
    first_in_chunk,
    first_own_part,
    one_if,
    report_work_done,
)
from tacsim.physics.gel.kernels import GelArrays, Gels, gel_advance, gel_of, only_gel_forces
from tacsim.physics.grip import layout
from tacsim.physics.grip.object_kernels import (
    Constants,
    Frames,
    Grip,
    Objects,
    Whole,
    measure_lag,
    move_object,
    write_drive,
)

Patches = ti.types.ndarray(dtype=ti.f32, ndim=3)  # (gels, PARTS, PATCH)
GripArrays = ti.types.argpack(frames=Frames, constants=Constants, whole=Whole, objects=Objects, patches=Patches)


@ti.kernel
def substeps(
    team: ti.i32, drive: Drive, gel_arrays: GelArrays, indenter_arrays: IndenterArrays,
    environments: EnvironmentArrays, grip_arrays: GripArrays, sync: Sync,
):  # fmt: skip
    """Explicit substeps of all grips in one launch by `team` threads each.

    Each gel is an environment of one gel; those of a grip follow each other. drive: pose and velocity of the object in
    the frame of each pad, of one substep: the kernel writes it. Stages: the drive of the first substep; then of each
    substep the forces, and the motion of gels and object. One part moves the object, whose new drive is not read
    before the next stage.
    """
    for task in range(sync.shape[0] * team * CHUNK):
        for _ in range(first_in_chunk(task)):
            turn = task // CHUNK // team
            index = sync[turn, ENVIRONMENT]
            shared = ti.static((environments.params, environments.counts, environments.partial))
            gels = ti.static(
                Gels(
                    gel_arrays.nodes,
                    gel_arrays.surface,
                    gel_arrays.contact_force,
                    gel_arrays.corners,
                    gel_arrays.lattice,
                    1,
                )
            )
            indenter = ti.static(
                Indenter(
                    indenter_arrays.anchor, indenter_arrays.pressure, indenter_arrays.values, True, grip_arrays.patches
                )
            )
            grip = ti.static(
                Grip(
                    index,
                    grip_arrays.frames,
                    grip_arrays.constants,
                    grip_arrays.whole,
                    grip_arrays.objects,
                    grip_arrays.patches,
                    shared,
                )
            )
            pads = grip_arrays.frames.shape[2] - 1
            stages = 2 * grip_arrays.whole[index, layout.SUBSTEPS] + 1
            own = first_own_part(task, team)
            piece = claim_work(sync, turn, own, stages)
            while piece < stages * PARTS:
                stage, part = piece // PARTS, piece % PARTS
                it = (stage - 1) // 2
                # the part that moves the object may have ended the launch after a substep before this one
                goes_on = it <= grip_arrays.whole[index, layout.LAST]
                for _first in range(one_if(stage == 0 and part == 0)):
                    write_drive(grip, 0, drive)
                for _forces in range(one_if(stage % 2 == 1 and goes_on)):
                    for _lag in range(one_if(part == 0 and it > 0)):
                        measure_lag(grip)
                    for g in range(pads):
                        gel_index = index * pads + g
                        env = ti.static(Environment(gel_index, *shared))
                        gel = ti.static(gel_of(env, gels, 0))
                        apply_indenter(env, part, 0, drive, gel, indenter)
                        only_gel_forces(env, part, gels, team)
                for _motion in range(one_if(stage > 0 and stage % 2 == 0 and goes_on)):
                    for g in range(pads):
                        gel_index = index * pads + g
                        env = ti.static(Environment(gel_index, *shared))
                        gel = ti.static(gel_of(env, gels, 0))
                        share_min(env, part, SMALLEST_VOLUME)
                        update_node_pressure(env, part, gel)
                        gel_advance(env, part, gels)
                    for _object in range(one_if(part == 0)):
                        move_object(grip, it)
                        write_drive(grip, it + 1, drive)
                report_work_done(sync, turn)
                for _end in range(one_if(not goes_on)):
                    ti.atomic_max(sync[turn, DONE], stages * PARTS)
                piece = claim_work(sync, turn, own, stages)
