"""Selective mass scaling of the body on its grid: motions that the grid resolves have a sixth of the inertia.

The change a of a node's velocity in a substep becomes OWN_WEIGHT a + FILTERED_WEIGHT (4 S - 1)^2 a. S is the mean over
the cells around a node; each cell has the mass-weighted mean of its nodes. The gel's accelerations are filtered in the
same way (tacsim.physics.gel.mass). Nodes keep their velocities between substeps and launches. The first substep on a
new grid has no earlier velocities and is not filtered. Why: docs/decisions/0002.
"""

from tacsim.compute.runtime import ti
from tacsim.physics.body.transfers import node_sum
from tacsim.physics.exec import layout
from tacsim.physics.exec.lanes import (
    NODES,
    ON_DEVICE,
    bounded,
    hide_from_compiler,
    load_strip,
    mask_strip,
    part_range,
    store_strip,
    strip,
    tile_numbers,
)

# In `changes` (environments, 3, nodes, 4): momentum change and mass of a node; mean velocity change of the cell whose
# first node it is; momentum change and mass after the first pass of the filter
CHANGE, CELL, SECOND = range(3)
MOTION = (1.0, 1.0, 1.0, 0.0)  # of a node's numbers


@ti.func
def changes_at(env: ti.template(), which, node):
    return 4 * ((env.index * 3 + which) * env.count(layout.CAPACITY) * NODES + node)


@ti.func
def box_of_part(env: ti.template(), part):
    """First node of a part and the one after its last, along x, y, z; on a device a part is one node."""
    nx, ny, nz = env.count(layout.GRID), env.count(layout.GRID + 1), env.count(layout.GRID + 2)
    low, high = ti.Vector([0, 0, 0]), ti.Vector([0, ny, nz])
    if ti.static(ON_DEVICE):
        low = ti.Vector([part // (ny * nz), part // nz % ny, part % nz])
        high = low + 1
    else:
        low[0], high[0] = part_range(nx, part)
    return low, high


@ti.func
def grid_changes(env: ti.template(), part, body: ti.template()):
    """Momentum changes in this substep and masses of this part's nodes."""
    dt, weight = env.param(layout.STEP), env.param3(layout.GRAVITY)
    ny, nz = env.count(layout.GRID + 1), env.count(layout.GRID + 2)
    to = changes_at(env, CHANGE, 0)
    low, high = box_of_part(env, part)
    for i in range(low[0], high[0]):
        first, last = ((i * ny + low[1]) * nz + low[2]) // NODES, ((i * ny + high[1] - 1) * nz + high[2]) // NODES
        for at in range(first, last):
            q = node_sum(env, i, at, body)
            for n in ti.static(range(NODES)):
                start, mass = bounded(to + 4 * (at * NODES + n), 1), q[4 * n + 3]
                for c in ti.static(range(3)):
                    body.changes[start + c] = q[4 * n + c] + mass * dt * weight[c]
                body.changes[start + 3] = mass


@ti.func
def sum_around(changes: ti.template(), at, line, plane, zero):
    """Sum of a strip over eight nodes, or cells, of which the first is at `at`."""
    total = load_strip(changes, hide_from_compiler(zero, at))
    for p, q, r in ti.static([(0, 0, 1), (0, 1, 0), (0, 1, 1), (1, 0, 0), (1, 0, 1), (1, 1, 0), (1, 1, 1)]):
        total += load_strip(changes, hide_from_compiler(zero, at + p * plane + q * line + 4 * r))
    return total


@ti.func
def cell_means(env: ti.template(), part, which, body: ti.template()):
    """Mean velocity change of the cells whose first nodes are this part's, from the momentum changes at `which`. Cells
    behind the last node of a line, which whole strips include, are not read."""
    nx, ny, nz = env.count(layout.GRID), env.count(layout.GRID + 1), env.count(layout.GRID + 2)
    source, to, line, plane = changes_at(env, which, 0), changes_at(env, CELL, 0), 4 * nz, 4 * nz * ny
    zero = env.count(layout.ZERO)
    low, high = box_of_part(env, part)
    for i in range(low[0], ti.min(high[0], nx - 1)):
        for j in range(low[1], ti.min(high[1], ny - 1)):
            here, first, last = i * plane + j * line, low[2] // NODES, (ti.min(high[2], nz - 1) + NODES - 1) // NODES
            for n in range(first, last):
                at = here + 4 * NODES * n
                store_strip(body.changes, to + at, sum_around(body.changes, source + at, line, plane, zero), zero)
            for n in range(first, last):
                total = load_strip(body.changes, to + here + 4 * NODES * n)
                mass = tile_numbers(total[3], total[4 * NODES - 1])
                store_strip(body.changes, to + here + 4 * NODES * n, mask_strip(mass, total / mass), zero)


@ti.func
def nodes_inside(env: ti.template(), i, j, n):
    """For each node of a strip, four times: 1 if it is not at the border of the grid, else 0."""
    nx, ny, nz, k = env.count(layout.GRID), env.count(layout.GRID + 1), env.count(layout.GRID + 2), NODES * n
    line = ti.min(1, i, j, nx - 1 - i, ny - 1 - j)
    last = k + NODES - 1
    return tile_numbers(
        ti.cast(ti.min(line, k, nz - 1 - k), ti.f32), ti.cast(ti.min(line, last, nz - 1 - last), ti.f32)
    )


@ti.func
def motion_of(env: ti.template()):
    """A strip with 1 for the numbers x, y, z of a node and 0 for its mass. The compiler does not know them: with known
    numbers, lanes would differ (tacsim.physics.exec.lanes)."""
    zero = ti.cast(env.count(layout.ZERO), ti.f32)
    return strip([zero + MOTION[c % 4] for c in range(4 * NODES)])


@ti.func
def second_changes(env: ti.template(), part, body: ti.template()):
    """(4 S - 1) applied to the changes of this part's nodes. The mean is 0 at the border, where the array may hold
    values of an earlier grid of another shape."""
    ny, nz, zero = env.count(layout.GRID + 1), env.count(layout.GRID + 2), env.count(layout.ZERO)
    line, plane, motion = 4 * nz, 4 * nz * ny, motion_of(env)
    low, high = box_of_part(env, part)
    for i in range(low[0], high[0]):
        for j in range(low[1], high[1]):
            for n in range(low[2] // NODES, high[2] // NODES):
                node = (i * ny + j) * nz + NODES * n
                change, cells = load_strip(body.changes, changes_at(env, CHANGE, node)), changes_at(env, CELL, node)
                mean = sum_around(body.changes, cells - plane - line - 4, line, plane, zero)
                mass = 0.5 * tile_numbers(change[3], change[4 * NODES - 1])
                mean = mask_strip(nodes_inside(env, i, j, n), mean)
                second = motion * mass * mean + (1.0 - 2.0 * motion) * change
                store_strip(body.changes, changes_at(env, SECOND, node), second, zero)


@ti.func
def filter_strip(env: ti.template(), body: ti.template(), motion, own, filtered, i, j, n):
    """Replaces the momentum changes of a strip of nodes by their velocity changes in this substep. motion: of
    `motion_of`; own, filtered: weights of nodes that are not at the border of the grid."""
    ny, nz, zero = env.count(layout.GRID + 1), env.count(layout.GRID + 2), env.count(layout.ZERO)
    node, line, plane = (i * ny + j) * nz + NODES * n, 4 * nz, 4 * nz * ny
    at, cells = changes_at(env, CHANGE, node), changes_at(env, CELL, node) - plane - line - 4
    change, second = load_strip(body.changes, at), load_strip(body.changes, changes_at(env, SECOND, node))
    mean = sum_around(body.changes, cells, line, plane, zero)
    mass, inside = tile_numbers(change[3], change[4 * NODES - 1]), nodes_inside(env, i, j, n)
    wanted = ((own - 1.0) * inside + 1.0) * (change / mass)
    wanted += filtered * mask_strip(inside, 0.5 * mean - second / mass)
    # a mass that is not 0: true of NaN, which must not be hidden
    store_strip(body.changes, at, motion * mask_strip(mass, wanted) + (1.0 - motion) * change, zero)
