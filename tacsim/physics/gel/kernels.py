"""Kernels of the gels: forces of the elements on the nodes, then the nodes' motion. On a device a part is one column of
nodes (tacsim/physics/worlds/device.py)."""

from typing import Any, NamedTuple

from tacsim.compute.runtime import ti
from tacsim.physics.exec import layout
from tacsim.physics.exec.environment import record_least, record_sum
from tacsim.physics.exec.lanes import (
    COPIES,
    LANES,
    ON_DEVICE,
    PARTS,
    bounded,
    filled,
    lanes,
    load_lanes,
    opaque,
    overwrite,
    share_start,
    smallest_lane,
    store_lanes,
    vec4,
)
from tacsim.physics.gel.element import ROWS, SMALLEST, element_block
from tacsim.physics.gel.gel import QUANTITIES

Lattice = ti.types.ndarray(dtype=lanes, ndim=1)


class Gels(NamedTuple):
    """The gels of all environments inside a kernel: the arrays of `GelState`, and how every gel is cut."""

    nodes: Any
    surface: Any
    contact_force: Any
    corners: Any
    lattice: Any
    number: Any  # of gels in an environment
    nx: Any  # elements along x, y, z
    ny: Any
    layers: Any


@ti.func
def gels_of(
    env: ti.template(), nodes: ti.template(), surface: ti.template(), contact_force: ti.template(),
    corners: ti.template(), lattice: ti.template(), number: ti.template(),
):  # fmt: skip
    """The group of what every kernel with gels takes."""
    nx, ny, layers = [env.count(layout.ELEMENTS + d) for d in range(3)]
    return ti.static(Gels(nodes, surface, contact_force, corners, lattice, number, nx, ny, layers))


@ti.func
def surface_row(env: ti.template(), gels: ti.template(), g):
    """First row of a gel's displacements in `surface`; its velocities begin nx + 3 rows further on."""
    return (env.index * gels.number + g) * 2 * (gels.nx + 3)


@ti.func
def surface_at(gels: ti.template(), row, column):
    """Where the four numbers of a node stand in `surface`."""
    return bounded(4 * (row * (gels.ny + 3) + column), 1)


@ti.func
def contact_force_start(env: ti.template(), gels: ti.template(), copy, g):
    """Where a gel's forces on its nodes begin in a copy of `contact_force`."""
    blocks = ((gels.nx + 1) * (gels.ny + 1) + LANES - 1) // LANES
    return ((env.index * COPIES + copy) * gels.number + g) * 4 * LANES * blocks


@ti.func
def margin(gels: ti.template()):
    """Numbers before the first of `nodes` and `corners`."""
    return (gels.ny + 2 + LANES - 1) // LANES * LANES


@ti.func
def node_block(gels: ti.template(), to, i, j, below, above, row, zero):
    """Internal force on LANES nodes along one axis, from the elements above them, at i in `corners`, and below, at j.

    to: where the force stands in `nodes`; below, above: 1 or 0, whether there are any; row: as for `element_block`.
    """
    under, over = lanes(0.0), lanes(0.0)
    for p, q in ti.static(ti.ndrange(2, 2)):  # of the element that has these nodes as its corners p, q
        offset = (12 * p + 6 * q) * row - p * (gels.ny + 1) - q
        under += load_lanes(gels.corners, i + offset)
        over += load_lanes(gels.corners, j + 3 * row + offset)
    store_lanes(gels.nodes, to, below * under + above * over, zero)


@ti.func
def gel_forces(env: ti.template(), part, gels: ti.template()):
    """Internal forces on this part's nodes of its gel. A layer of elements, then the nodes below it, and so on up."""
    zero, nx, ny, layers = env.count(layout.ZERO), gels.nx, gels.ny, gels.layers
    pieces = PARTS // gels.number
    g, piece = part // pieces, part % pieces
    blocks = ((nx + 1) * (ny + 1) + LANES - 1) // LANES
    first, last = share_start(blocks, piece, pieces), share_start(blocks, piece + 1, pieces)
    halo = (ny + 1 + LANES) // LANES  # blocks before `first` whose elements reach into it
    row = ((blocks + pieces - 1) // pieces + halo) * LANES  # of corners
    layer = blocks * LANES
    axis = (layers + 1) * layer
    u = margin(gels) + (env.index * gels.number + g) * 3 * QUANTITIES * axis
    rows = filled(0.0, ROWS, LANES)
    for lane in range(LANES):
        rows[SMALLEST, lane] = 1e9
    for k in range(layers + 1):
        here = margin(gels) + (2 * (env.index * PARTS + part) + k % 2) * 24 * row + (halo - first) * LANES
        before = margin(gels) + (2 * (env.index * PARTS + part) + (k + 1) % 2) * 24 * row + (halo - first) * LANES
        if k < layers:
            for block in range(ti.max(first - halo, 0), last):
                element_block(
                    env, gels, block, u + k * layer + block * LANES, axis, layer, here + block * LANES, row, rows
                )  # fmt: skip
        below, above = ti.select(k < layers, 1.0, 0.0), ti.select(k > 0, 1.0, 0.0)
        for block in range(first, last):
            i, j = here + block * LANES, before + block * LANES
            for d in range(3):
                to = u + (6 + d) * axis + k * layer + block * LANES
                node_block(gels, to, i + d * row, j + d * row, below, above, row, zero)
    record_least(env, part, layout.SMALLEST_VOLUME, smallest_lane(rows, SMALLEST))


@ti.func
def add_contact_forces(env: ti.template(), gels: ti.template(), g, first, last, forces, axis, zero):
    """Adds the contact forces of all parts to those on a gel's surface nodes, `first` to `last` by blocks, and leaves
    zeros for the next substep. forces: where those along x begin, `axis` the distance to those along y and z."""
    push = filled(0.0, 4 * LANES, 1)
    turned = filled(0.0, 4, LANES)
    for block in range(first, last):
        for c in range(4 * LANES):
            total = 0.0
            for copy in ti.static(range(COPIES)):
                start = bounded(contact_force_start(env, gels, copy, g) + block * 4 * LANES, 1)
                total += gels.contact_force[start + c]
            push[c, 0] = total
        for lane in range(LANES):
            for d in ti.static(range(4)):
                turned[d, lane] = push[4 * lane + d, 0]
        for d in ti.static(range(3)):
            at = forces + d * axis + block * LANES
            force = load_lanes(gels.nodes, at) + lanes([turned[d, lane] for lane in range(LANES)])
            store_lanes(gels.nodes, at, force, zero)
        for copy in ti.static(range(COPIES)):
            for quarter in range(4):
                at = contact_force_start(env, gels, copy, g) + (block * 4 + quarter) * LANES
                store_lanes(gels.contact_force, at, lanes(0.0), zero)


@ti.func
def nodes_of_part(gels: ti.template(), part):
    """A part's gel, where it notes its sums, and its columns of nodes: first block, and the one after the last. On a
    device a part is one column: of gel part // columns, number part % columns."""
    pieces = PARTS // gels.number
    blocks = ((gels.nx + 1) * (gels.ny + 1) + LANES - 1) // LANES
    g, slot, piece = part // pieces, part, part % pieces
    first, last = share_start(blocks, piece, pieces), share_start(blocks, piece + 1, pieces)
    if ti.static(ON_DEVICE):
        g, first = part // blocks, part % blocks
        slot, last = g * pieces + first % pieces, first + 1
    return g, slot, first, last


@ti.func
def gel_totals(env: ti.template(), part, gels: ti.template()):
    """Whole forces on this part's nodes of its gel, contact included. Their force on the backing is noted."""
    zero, layers = env.count(layout.ZERO), gels.layers
    blocks = ((gels.nx + 1) * (gels.ny + 1) + LANES - 1) // LANES
    g, slot, first, last = nodes_of_part(gels, part)
    layer = blocks * LANES
    axis = (layers + 1) * layer
    u = margin(gels) + (env.index * gels.number + g) * 3 * QUANTITIES * axis
    for d in ti.static(range(3)):
        held = lanes(0.0)
        for block in range(first, last):
            force = load_lanes(gels.nodes, u + (6 + d) * axis + block * LANES)
            held += ti.select(gels.lattice[blocks + block] > 0.0, force, 0.0)
        record_sum(env, slot, layout.BACKING + d, held.sum())
    top = u + layers * layer
    if ti.static(ON_DEVICE):
        at = contact_force_start(env, gels, 0, g) + 4 * first
        for d in ti.static(range(3)):
            gels.nodes[top + (6 + d) * axis + first] += gels.contact_force[at + d]
        for d in ti.static(range(4)):
            gels.contact_force[at + d] = 0.0
    else:
        add_contact_forces(env, gels, g, first, last, top + 6 * axis, axis, zero)


@ti.func
def gel_advance(env: ti.template(), part, gels: ti.template()):
    """Symplectic Euler with lumped masses on this part's nodes of its gel, and their surface. Damps the old velocity
    only, so that force readings stay exact."""
    gel_totals(env, part, gels)
    zero, dt, h, layers = env.count(layout.ZERO), env.param(layout.STEP), env.param(layout.GEL_SPACING), gels.layers
    blocks = ((gels.nx + 1) * (gels.ny + 1) + LANES - 1) // LANES
    g, _slot, first, last = nodes_of_part(gels, part)
    layer = blocks * LANES
    axis = (layers + 1) * layer
    u = margin(gels) + (env.index * gels.number + g) * 3 * QUANTITIES * axis
    keep = 1.0 - env.param(layout.GEL_DAMPING) * dt
    rate = dt / (env.param(layout.GEL_DENSITY) * h * h * h)
    for k in range(1, layers + 1):
        scale = ti.select(k == layers, 2.0 * rate, rate)
        for block in range(first, last):
            share = gels.lattice[opaque(zero, blocks + block)] * scale
            for d in range(3):
                x = u + d * axis + k * layer + block * LANES
                v, f = x + 3 * axis, x + 6 * axis
                speed = keep * load_lanes(gels.nodes, v) + share * load_lanes(gels.nodes, f)
                place = load_lanes(gels.nodes, x) + dt * speed
                store_lanes(gels.nodes, v, speed, zero)
                store_lanes(gels.nodes, x, place, zero)
    lay_surface(env, part, gels)


@ti.func
def lay_surface(env: ti.template(), part, gels: ti.template()):
    """This part's nodes of the top layer, displacement and velocity, to `surface`, and its rim outside."""
    zero, nx, ny, layers = env.count(layout.ZERO), gels.nx, gels.ny, gels.layers
    row, count = ny + 1, (nx + 1) * (ny + 1)
    layer = (count + LANES - 1) // LANES * LANES
    g, _slot, first, last = nodes_of_part(gels, part)
    axis = (layers + 1) * layer
    top = margin(gels) + (env.index * gels.number + g) * 3 * QUANTITIES * axis + layers * layer
    first_row = surface_row(env, gels, g)
    i, j = first * LANES // row, first * LANES % row
    for block in range(first, last):
        for lane in range(ti.min(LANES, count - block * LANES)):
            p0, p1 = i + ti.select(i > 0, 1, 0), i + ti.select(i < nx, 2, 3)
            q0, q1 = j + ti.select(j > 0, 1, 0), j + ti.select(j < ny, 2, 3)
            for quantity in ti.static(range(2)):
                at = vec4(0.0)
                for d in ti.static(range(3)):
                    at[d] = gels.nodes[top + (3 * quantity + d) * axis + block * LANES + lane]
                at[3] = gels.surface[surface_at(gels, first_row + quantity * (nx + 3) + i + 1, j + 1) + 3]
                for p in range(p0, p1):
                    for q in range(q0, q1):
                        to = surface_at(gels, first_row + quantity * (nx + 3) + p, q)
                        values = vec4([overwrite(zero, gels.surface[to + c], at[c]) for c in range(4)])
                        for c in ti.static(range(4)):
                            gels.surface[to + c] = values[c]
            j += 1
            if j == row:
                i, j = i + 1, 0
