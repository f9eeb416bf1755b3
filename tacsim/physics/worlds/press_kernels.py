"""Kernel of a rigid indenter on one gel."""

from tacsim.compute.runtime import ti
from tacsim.physics.body.grid_motion import Drive
from tacsim.physics.contact.indenter import Indenter, IndenterArrays, apply_indenter, update_node_pressure
from tacsim.physics.exec import layout
from tacsim.physics.exec.environment import Environment, EnvironmentArrays, share_min
from tacsim.physics.exec.lanes import PARTS
from tacsim.physics.exec.team import (
    CHUNK,
    ENVIRONMENT,
    SERIAL,
    Sync,
    claim_work,
    first_in_chunk,
    first_own_part,
    one_if,
    report_work_done,
)
from tacsim.physics.gel.kernels import GelArrays, Gels, gel_advance, gel_of, only_gel_forces


@ti.kernel
def substeps(
    team: ti.i32, drive: Drive, gel_arrays: GelArrays, indenter_arrays: IndenterArrays,
    environments: EnvironmentArrays, sync: Sync,
):  # fmt: skip
    """Explicit substeps in one launch by `team` threads; drive: pose and velocity of the indenter, sensor frame."""
    ti.loop_config(serialize=SERIAL)
    for task in range(sync.shape[0] * team * CHUNK):
        for _ in range(first_in_chunk(task)):
            turn = task // CHUNK // team
            index = sync[turn, ENVIRONMENT]
            env = ti.static(Environment(index, environments.params, environments.counts, environments.partial))
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
            gel = ti.static(gel_of(env, gels, 0))
            indenter = ti.static(Indenter(indenter_arrays.anchor, indenter_arrays.pressure, indenter_arrays.values))
            # two stages a substep: forces, then motion
            stages, own = 2 * env.count(layout.STEPS), first_own_part(task, team)
            piece = claim_work(sync, turn, own, stages)
            while piece < stages * PARTS:
                stage, part = piece // PARTS, piece % PARTS
                for _forces in range(one_if(stage % 2 == 0)):
                    apply_indenter(env, part, stage // 2, drive, gel, indenter)
                    only_gel_forces(env, part, gels, team)
                for _motion in range(one_if(stage % 2 == 1)):
                    share_min(env, part, layout.SMALLEST_VOLUME)
                    update_node_pressure(env, part, gel)
                    gel_advance(env, part, gels)
                report_work_done(sync, turn)
                piece = claim_work(sync, turn, own, stages)
