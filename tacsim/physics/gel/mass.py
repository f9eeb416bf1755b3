"""Selective mass scaling of a gel: motions that its mesh resolves have a sixth of the inertia, the shortest waves all.

An acceleration a, force over mass, becomes OWN_WEIGHT a + FILTERED_WEIGHT (4 S - 1)^2 a. S is the mean over the
elements around a node; each element has the mass-weighted mean of its nodes (Olovsson et al. 2005). The state at rest
does not change. Why: docs/decisions/0002. Rows of `nodes` after the forces: means along z; (4 S - 1) a; its means
along z.
"""

from tacsim.compute.runtime import ti
from tacsim.physics.exec import layout
from tacsim.physics.exec.lanes import LANES, hide_from_compiler, lanes, load_lanes, store_lanes
from tacsim.physics.gel.kernels import (
    columns_of,
    first_node,
    gel_of,
    gel_of_part,
    gel_totals,
    lattice_at,
    nodes_of_part,
    write_surface,
)


@ti.func
def z_weights(k, layers):
    """Weights of the nodes below, here and above in a mean over the elements around a node of layer k, along z. The
    backing does not move, and there is no node above the surface."""
    below = ti.select(k == 1, 0.0, ti.select(k == layers, 0.5, 0.25))
    return below, 0.5, ti.select(k < layers, 0.25, 0.0)


@ti.func
def lateral_mean(gel: ti.template(), at, block, zero):
    """The same mean along x and y for LANES nodes from index `at`."""
    row = gel.ny + 1
    weights = [gel.lattice[hide_from_compiler(zero, lattice_at(gel, r, block))] for r in range(2, 6)]
    total = lanes(0.0)
    for dx in ti.static(range(-1, 2)):
        line = 0.5 * load_lanes(gel.nodes, at + dx * row)
        line += weights[2] * load_lanes(gel.nodes, at + dx * row - 1)
        line += weights[3] * load_lanes(gel.nodes, at + dx * row + 1)
        total += (0.5 if dx == 0 else weights[0] if dx < 0 else weights[1]) * line
    return total


@ti.func
def gel_means(env: ti.template(), part, gels: ti.template()):
    """Total forces on this part's nodes of its gel, and their means along z, as accelerations times the mass of an
    inner node."""
    gel_totals(env, part, gels)
    gel = ti.static(gel_of(env, gels, gel_of_part(env, gels, part)))
    zero, layers, blocks = env.count(layout.ZERO), gel.layers, columns_of(gel)
    _slot, first, last = nodes_of_part(env, gels, gel, part)
    layer = blocks * LANES
    axis = (layers + 1) * layer
    u = first_node(env, gel)
    for k in range(1, layers + 1):
        for block in range(first, last):
            share = gels.lattice[hide_from_compiler(zero, lattice_at(gel, 1, block))]
            for d in range(3):
                f = u + (6 + d) * axis + k * layer + block * LANES
                below, here, above = z_weights(k, layers)
                # surface nodes have half the mass
                here *= ti.select(k == layers, 2.0, 1.0)
                above *= ti.select(k == layers - 1, 2.0, 1.0)
                # not the backing's force: after a failed attempt, 0 times this value may be NaN
                under = ti.select(k > 1, layer, 0)
                mean = below * load_lanes(gels.nodes, f - under) + here * load_lanes(gels.nodes, f)
                mean += above * load_lanes(gels.nodes, f + ti.select(k < layers, layer, 0))
                store_lanes(gels.nodes, f + 3 * axis, share * mean, zero)


@ti.func
def gel_filter_first_pass(env: ti.template(), part, gels: ti.template()):
    """First pass of the filter: 4 S - 1 of the accelerations of this part's nodes, and its means along z."""
    gel = ti.static(gel_of(env, gels, gel_of_part(env, gels, part)))
    zero, layers, blocks = env.count(layout.ZERO), gel.layers, columns_of(gel)
    _slot, first, last = nodes_of_part(env, gels, gel, part)
    layer = blocks * LANES
    axis = (layers + 1) * layer
    u = first_node(env, gel)
    for k in range(1, layers + 1):
        scale = ti.select(k == layers, 2.0, 1.0)
        for block in range(first, last):
            share = scale * gels.lattice[hide_from_compiler(zero, lattice_at(gel, 1, block))]
            for d in range(3):
                f = u + (6 + d) * axis + k * layer + block * LANES
                mean = lateral_mean(gel, f + 3 * axis, block, zero)
                store_lanes(gels.nodes, f + 6 * axis, 4.0 * mean - share * load_lanes(gels.nodes, f), zero)
    for k in range(1, layers + 1):
        for block in range(first, last):
            for d in range(3):
                b = u + (12 + d) * axis + k * layer + block * LANES
                below, here, above = z_weights(k, layers)
                mean = below * load_lanes(gels.nodes, b - layer) + here * load_lanes(gels.nodes, b)
                mean += above * load_lanes(gels.nodes, b + ti.select(k < layers, layer, 0))
                store_lanes(gels.nodes, b + 3 * axis, mean, zero)


@ti.func
def gel_advance_filtered(env: ti.template(), part, gels: ti.template()):
    """Second pass of the filter, and the motion: see `tacsim.physics.gel.kernels.gel_advance`."""
    gel = ti.static(gel_of(env, gels, gel_of_part(env, gels, part)))
    zero, dt, layers, blocks = env.count(layout.ZERO), env.param(layout.STEP), gel.layers, columns_of(gel)
    h = env.param(layout.GEL_SPACING + gel.index)
    _slot, first, last = nodes_of_part(env, gels, gel, part)
    layer = blocks * LANES
    axis = (layers + 1) * layer
    u = first_node(env, gel)
    keep = 1.0 - env.param(layout.GEL_DAMPING + gel.index) * dt
    rate = dt / (env.param(layout.GEL_DENSITY + gel.index) * h * h * h)
    own, even = env.param(layout.OWN_WEIGHT), env.param(layout.FILTERED_WEIGHT)
    for k in range(1, layers + 1):
        scale = ti.select(k == layers, 2.0, 1.0)
        for block in range(first, last):
            share = gels.lattice[hide_from_compiler(zero, lattice_at(gel, 1, block))] * scale
            for d in range(3):
                x = u + d * axis + k * layer + block * LANES
                v, f = x + 3 * axis, x + 6 * axis
                a = 4.0 * lateral_mean(gel, f + 9 * axis, block, zero) - load_lanes(gels.nodes, f + 6 * axis)
                a = even * a + own * share * load_lanes(gels.nodes, f)
                speed = keep * load_lanes(gels.nodes, v) + rate * a
                place = load_lanes(gels.nodes, x) + dt * speed
                store_lanes(gels.nodes, v, speed, zero)
                store_lanes(gels.nodes, x, place, zero)
    write_surface(env, part, gels)
