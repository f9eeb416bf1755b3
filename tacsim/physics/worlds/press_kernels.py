"""Kernel of a rigid indenter on one gel."""

from tacsim.compute.runtime import ti
from tacsim.physics.contact.indenter import (
    Anchor,
    Indenter,
    Pressure,
    Values,
    carry,
    indent,
)
from tacsim.physics.exec import layout
from tacsim.physics.exec.environment import Counts, Environment, Floats, Params, Partial
from tacsim.physics.exec.lanes import PARTS
from tacsim.physics.exec.team import (
    CHUNK,
    ENVIRONMENT,
    Sync,
    first_in_chunk,
    next_piece,
    once_if,
    own_part,
    piece_done,
)
from tacsim.physics.gel.kernels import Gels, Lattice, gel_advance, gel_forces, gel_of
from tacsim.physics.worlds.hybrid_kernels import Drive


@ti.kernel
def substeps(
    team: ti.i32, drive: Drive,
    nodes: Floats, surface: Floats, contact_force: Floats, corners: Floats, lattice: Lattice,
    anchor: Anchor, pressure: Pressure, values: Values,
    params: Params, counts: Counts, partial: Partial, sync: Sync,
):  # fmt: skip
    """Explicit substeps in one launch by `team` threads; drive: pose and velocity of the indenter, sensor frame."""
    for task in range(sync.shape[0] * team * CHUNK):
        for _ in range(first_in_chunk(task)):
            turn = task // CHUNK // team
            index = sync[turn, ENVIRONMENT]
            env = ti.static(Environment(index, params, counts, partial))
            gels = ti.static(Gels(nodes, surface, contact_force, corners, lattice, 1))
            gel = ti.static(gel_of(env, gels, 0))
            indenter = ti.static(Indenter(anchor, pressure, values))
            stages, own = 2 * env.count(layout.STEPS), own_part(task, team)  # two a substep: forces, then motion
            piece = next_piece(sync, turn, own, stages)
            while piece < stages * PARTS:
                stage, part = piece // PARTS, piece % PARTS
                for _forces in range(once_if(stage % 2 == 0)):
                    indent(env, part, stage // 2, drive, gel, indenter)
                    gel_forces(env, part, gels)
                for _motion in range(once_if(stage % 2 == 1)):
                    carry(env, part, gel)
                    gel_advance(env, part, gels)
                piece_done(sync, turn)
                piece = next_piece(sync, turn, own, stages)
