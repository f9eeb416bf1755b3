"""Kernels of the gels: forces of the elements on the nodes, then the nodes' motion. On a device a part is one column of
nodes (tacsim/physics/worlds/device.py)."""

from typing import Any, NamedTuple

from tacsim.compute.runtime import ti
from tacsim.physics.exec import layout
from tacsim.physics.exec.environment import Floats, record_min, record_sum
from tacsim.physics.exec.lanes import (
    COPIES,
    LANES,
    ON_DEVICE,
    PARTS,
    bounded,
    filled,
    hide_from_compiler,
    lanes,
    load_lanes,
    min_over_lanes,
    overwrite,
    share_start,
    store_lanes,
    vec4,
)
from tacsim.physics.gel.element import MIN_VOLUME_ROW, ROWS, element_block

Lattice = ti.types.ndarray(dtype=lanes, ndim=1)

# `GelState.arguments`, as kernels take them
GelArrays = ti.types.argpack(nodes=Floats, surface=Floats, contact_force=Floats, corners=Floats, lattice=Lattice)


class Gels(NamedTuple):
    """The gels of all environments inside a kernel: the arrays of `GelState`."""

    nodes: Any
    surface: Any
    contact_force: Any
    corners: Any
    lattice: Any
    number: Any  # of gels in an environment


class Gel(NamedTuple):
    """One gel of an environment inside a kernel: the arrays, its lattice, and its first indices in the arrays."""

    nodes: Any
    surface: Any
    contact_force: Any
    corners: Any
    lattice: Any
    index: Any  # 0 or 1
    nx: Any  # elements along x, y, z
    ny: Any
    layers: Any
    surface_start: Any
    force_start: Any
    lattice_start: Any


@ti.func
def gel_of(env: ti.template(), gels: ti.template(), g):
    """Gel number g of an environment."""
    nx, ny, layers = [env.count(layout.ELEMENTS + 3 * g + d) for d in range(3)]
    surface, force, lattice = [
        env.count(first + g) for first in (layout.GEL_SURFACE, layout.GEL_FORCES, layout.GEL_LATTICE)
    ]
    return ti.static(
        Gel(
            gels.nodes, gels.surface, gels.contact_force, gels.corners, gels.lattice, g, nx, ny, layers, surface, force,
            lattice,
        )
    )  # fmt: skip


@ti.func
def columns_of(gel: ti.template()):
    """Columns of nodes, in blocks of LANES."""
    return ((gel.nx + 1) * (gel.ny + 1) + LANES - 1) // LANES


@ti.func
def surface_at(gel: ti.template(), row, column):
    """Index of the four numbers of a node in `surface`; velocities begin in row nx + 3."""
    return bounded(gel.surface_start + 4 * (row * (gel.ny + 3) + column), 1)


@ti.func
def contact_force_start(gel: ti.template(), copy):
    """First index of a gel's nodal forces in a copy of `contact_force`."""
    return gel.force_start + copy * 4 * LANES * columns_of(gel)


@ti.func
def first_node(env: ti.template(), gel: ti.template()):
    """First index of a gel's displacements in `nodes`."""
    return env.count(layout.GEL_NODES + gel.index)


@ti.func
def lattice_at(gel: ti.template(), row, block):
    """Index of a block of a row in `lattice`."""
    return gel.lattice_start + row * columns_of(gel) + block


@ti.func
def node_block(gel: ti.template(), to, i, j, below, above, row, zero):
    """Internal force on LANES nodes along one axis, from the elements above them, at i in `corners`, and below, at j.

    to: index of the force in `nodes`; below, above: 1 if there are such elements, else 0; row: see `element_block`.
    """
    under, over = lanes(0.0), lanes(0.0)
    for p, q in ti.static(ti.ndrange(2, 2)):  # of the element that has these nodes as its corners p, q
        offset = (12 * p + 6 * q) * row - p * (gel.ny + 1) - q
        under += load_lanes(gel.corners, i + offset)
        over += load_lanes(gel.corners, j + 3 * row + offset)
    store_lanes(gel.nodes, to, below * under + above * over, zero)


@ti.func
def gel_forces(env: ti.template(), part, gels: ti.template()):
    """Internal forces on this part's nodes of its gel."""
    pieces = PARTS // gels.number
    gel = ti.static(gel_of(env, gels, part // pieces))
    record_min(env, part, layout.SMALLEST_VOLUME, piece_forces(env, gel, part % pieces, pieces, 1))


@ti.func
def only_gel_forces(env: ti.template(), part, gels: ti.template(), team):
    """The same of an environment with one gel and `team` threads: in no more pieces than threads, since elements at the
    border of a piece are computed twice. Only some parts have work: `share_min` must follow in the next stage."""
    pieces = ti.select(team > 2, PARTS, team)
    each = PARTS // pieces  # parts for a piece
    has_work = 1 - ti.min(part % each, 1)
    gel = ti.static(gel_of(env, gels, 0))
    record_min(env, part, layout.SMALLEST_VOLUME, piece_forces(env, gel, part // each, pieces, has_work))


@ti.func
def piece_forces(env: ti.template(), gel: ti.template(), piece, pieces, has_work):
    """Internal forces on the nodes of a piece of a gel: a layer of elements, then the nodes below it, and so on up.
    Returns the smallest det F of its elements. has_work: 1; 0: does nothing."""
    zero, ny, layers, blocks = env.count(layout.ZERO), gel.ny, gel.layers, columns_of(gel)
    first, last = share_start(blocks, piece, pieces), share_start(blocks, piece + 1, pieces)
    halo = (ny + 1 + LANES) // LANES  # blocks before `first` whose elements reach into it
    row = ((blocks + pieces - 1) // pieces + halo) * LANES  # of corners
    layer = blocks * LANES
    axis = (layers + 1) * layer
    u, corners = first_node(env, gel), env.count(layout.GEL_CORNERS + gel.index)
    rows = filled(0.0, ROWS, LANES)
    for lane in range(LANES):
        rows[MIN_VOLUME_ROW, lane] = 1e9
    for k in range((layers + 1) * has_work):
        here = corners + (2 * piece + k % 2) * 24 * row + (halo - first) * LANES
        before = corners + (2 * piece + (k + 1) % 2) * 24 * row + (halo - first) * LANES
        # before the first element: a launch with another number of pieces has written there
        for block in range(first - halo, 0):
            for r in range(24):
                store_lanes(gel.corners, here + block * LANES + r * row, lanes(0.0), zero)
        if k < layers:
            for block in range(ti.max(first - halo, 0), last):
                element_block(
                    env, gel, block, u + k * layer + block * LANES, axis, layer, here + block * LANES, row, rows
                )  # fmt: skip
        below, above = ti.select(k < layers, 1.0, 0.0), ti.select(k > 0, 1.0, 0.0)
        for block in range(first, last):
            i, j = here + block * LANES, before + block * LANES
            for d in range(3):
                to = u + (6 + d) * axis + k * layer + block * LANES
                node_block(gel, to, i + d * row, j + d * row, below, above, row, zero)
    return min_over_lanes(rows, MIN_VOLUME_ROW)


@ti.func
def add_contact_forces(env: ti.template(), gel: ti.template(), first, last, forces, axis, zero):
    """Adds the contact forces of all parts to the forces on a gel's surface nodes, blocks `first` to `last`, and sets
    them to zero for the next substep. forces: first index of forces along x; `axis`: index step to those along y, z."""
    push = filled(0.0, 4 * LANES, 1)
    turned = filled(0.0, 4, LANES)
    for block in range(first, last):
        for c in range(4 * LANES):
            total = 0.0
            for copy in ti.static(range(COPIES)):
                start = bounded(contact_force_start(gel, copy) + block * 4 * LANES, 1)
                total += gel.contact_force[start + c]
            push[c, 0] = total
        for lane in range(LANES):
            for d in ti.static(range(4)):
                turned[d, lane] = push[4 * lane + d, 0]
        for d in ti.static(range(3)):
            at = forces + d * axis + block * LANES
            force = load_lanes(gel.nodes, at) + lanes([turned[d, lane] for lane in range(LANES)])
            store_lanes(gel.nodes, at, force, zero)
        for copy in ti.static(range(COPIES)):
            for quarter in range(4):
                at = contact_force_start(gel, copy) + (block * 4 + quarter) * LANES
                store_lanes(gel.contact_force, at, lanes(0.0), zero)


@ti.func
def gel_of_part(env: ti.template(), gels: ti.template(), part):
    """Number of a part's gel. On a device a part is one column; those of gel 1 come after those of gel 0."""
    if ti.static(not ON_DEVICE):
        return part // (PARTS // gels.number)
    elif ti.static(gels.number == 1):
        return 0
    else:
        return ti.select(part < columns_of(ti.static(gel_of(env, gels, 0))), 0, 1)


@ti.func
def nodes_of_part(env: ti.template(), gels: ti.template(), gel: ti.template(), part):
    """Index at which a part records its sums; its node columns in its gel: first block, and the one after the last."""
    pieces = PARTS // gels.number
    blocks = columns_of(gel)
    slot, piece = part, part % pieces
    first, last = share_start(blocks, piece, pieces), share_start(blocks, piece + 1, pieces)
    if ti.static(ON_DEVICE):
        first = part
        if gel.index > 0:
            first = part - columns_of(ti.static(gel_of(env, gels, 0)))
        slot, last = gel.index * pieces + first % pieces, first + 1
    return slot, first, last


@ti.func
def gel_totals(env: ti.template(), part, gels: ti.template()):
    """Total forces on this part's nodes of its gel, with contact. Records the force on the backing."""
    gel = ti.static(gel_of(env, gels, gel_of_part(env, gels, part)))
    zero, layers, blocks = env.count(layout.ZERO), gel.layers, columns_of(gel)
    slot, first, last = nodes_of_part(env, gels, gel, part)
    layer = blocks * LANES
    axis = (layers + 1) * layer
    u = first_node(env, gel)
    for d in ti.static(range(3)):
        held = lanes(0.0)
        for block in range(first, last):
            force = load_lanes(gels.nodes, u + (6 + d) * axis + block * LANES)
            held += ti.select(gels.lattice[lattice_at(gel, 1, block)] > 0.0, force, 0.0)
        record_sum(env, slot, layout.BACKING + d, held.sum())
    top = u + layers * layer
    if ti.static(ON_DEVICE):
        at = contact_force_start(gel, 0) + 4 * first
        for d in ti.static(range(3)):
            gels.nodes[top + (6 + d) * axis + first] += gels.contact_force[at + d]
        for d in ti.static(range(4)):
            gels.contact_force[at + d] = 0.0
    else:
        add_contact_forces(env, gel, first, last, top + 6 * axis, axis, zero)


@ti.func
def gel_advance(env: ti.template(), part, gels: ti.template()):
    """Symplectic Euler step with lumped masses for this part's nodes of its gel; writes their surface. Only the old
    velocity is damped, so that force readings stay exact."""
    gel_totals(env, part, gels)
    gel = ti.static(gel_of(env, gels, gel_of_part(env, gels, part)))
    zero, dt, layers, blocks = env.count(layout.ZERO), env.param(layout.STEP), gel.layers, columns_of(gel)
    h = env.param(layout.GEL_SPACING + gel.index)
    _slot, first, last = nodes_of_part(env, gels, gel, part)
    layer = blocks * LANES
    axis = (layers + 1) * layer
    u = first_node(env, gel)
    keep = 1.0 - env.param(layout.GEL_DAMPING + gel.index) * dt
    rate = dt / (env.param(layout.GEL_DENSITY + gel.index) * h * h * h)
    for k in range(1, layers + 1):
        scale = ti.select(k == layers, 2.0 * rate, rate)
        for block in range(first, last):
            share = gels.lattice[hide_from_compiler(zero, lattice_at(gel, 1, block))] * scale
            for d in range(3):
                x = u + d * axis + k * layer + block * LANES
                v, f = x + 3 * axis, x + 6 * axis
                speed = keep * load_lanes(gels.nodes, v) + share * load_lanes(gels.nodes, f)
                place = load_lanes(gels.nodes, x) + dt * speed
                store_lanes(gels.nodes, v, speed, zero)
                store_lanes(gels.nodes, x, place, zero)
    write_surface(env, part, gels)


@ti.func
def write_surface(env: ti.template(), part, gels: ti.template()):
    """Copies displacement and velocity of this part's nodes of the top layer to `surface`, with the rim outside."""
    gel = ti.static(gel_of(env, gels, gel_of_part(env, gels, part)))
    zero, nx, ny, layers = env.count(layout.ZERO), gel.nx, gel.ny, gel.layers
    row, count = ny + 1, (nx + 1) * (ny + 1)
    layer = (count + LANES - 1) // LANES * LANES
    _slot, first, last = nodes_of_part(env, gels, gel, part)
    axis = (layers + 1) * layer
    top = first_node(env, gel) + layers * layer
    i, j = first * LANES // row, first * LANES % row
    for block in range(first, last):
        for lane in range(ti.min(LANES, count - block * LANES)):
            p0, p1 = i + ti.select(i > 0, 1, 0), i + ti.select(i < nx, 2, 3)
            q0, q1 = j + ti.select(j > 0, 1, 0), j + ti.select(j < ny, 2, 3)
            for quantity in ti.static(range(2)):
                at = vec4(0.0)
                for d in ti.static(range(3)):
                    at[d] = gels.nodes[top + (3 * quantity + d) * axis + block * LANES + lane]
                at[3] = gels.surface[surface_at(gel, quantity * (nx + 3) + i + 1, j + 1) + 3]
                for p in range(p0, p1):
                    for q in range(q0, q1):
                        to = surface_at(gel, quantity * (nx + 3) + p, q)
                        values = vec4([overwrite(zero, gels.surface[to + c], at[c]) for c in range(4)])
                        for c in ti.static(range(4)):
                            gels.surface[to + c] = values[c]
            j += 1
            if j == row:
                i, j = i + 1, 0
