"""Selective mass scaling of the body on its grid: motions that the grid resolves have a sixth of the inertia.

The change a of a node's velocity in a substep becomes OWN_WEIGHT a + FILTERED_WEIGHT (4 S - 1)^2 a. S is the mean over
the cells around a node; each cell has the mass-weighted mean of its nodes. The gel's accelerations are filtered in the
same way (tacsim.physics.gel.mass). Nodes keep their velocities between substeps and launches. The first substep on a
new grid has no earlier velocities and is not filtered. Why: docs/decisions/0002.
"""

from tacsim.compute.runtime import ti
from tacsim.physics.body.transfers import has_velocities, node_sum
from tacsim.physics.exec import layout
from tacsim.physics.exec.lanes import NODES, ON_DEVICE, bounded, part_range, vec3

# In `changes` (environments, 3, nodes, 4): momentum change and mass of a node; mean velocity change of the cell whose
# first node it is; momentum change and mass after the first pass of the filter
CHANGE, CELL, SECOND = range(3)


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
def cell_means(env: ti.template(), part, which, body: ti.template()):
    """Mean velocity change of the cells whose first nodes are this part's, from the momentum changes at `which`."""
    nx, ny, nz = env.count(layout.GRID), env.count(layout.GRID + 1), env.count(layout.GRID + 2)
    source, to, line, plane = changes_at(env, which, 0), changes_at(env, CELL, 0), 4 * nz, 4 * nz * ny
    low, high = box_of_part(env, part)
    for i in range(low[0], ti.min(high[0], nx - 1)):
        for j in range(low[1], ti.min(high[1], ny - 1)):
            here, last = i * plane + j * line, ti.min(high[2], nz - 1)
            for x in range(4 * low[2], 4 * last):
                s = bounded(source + here + x, 1)
                body.changes[bounded(to + here + x, 1)] = (
                    (body.changes[s] + body.changes[s + 4])
                    + (body.changes[s + line] + body.changes[s + line + 4])
                    + (body.changes[s + plane] + body.changes[s + plane + 4])
                    + (body.changes[s + plane + line] + body.changes[s + plane + line + 4])
                )
            for k in range(low[2], last):
                s = bounded(to + here + 4 * k, 1)
                mass = body.changes[s + 3]
                for c in ti.static(range(3)):
                    body.changes[s + c] = ti.select(mass > 0.0, body.changes[s + c] / mass, 0.0)


@ti.func
def mean_of_cells(env: ti.template(), body: ti.template(), i, j, k):
    """Mean of the eight cells around a node that is not at the border of the grid."""
    ny, nz = env.count(layout.GRID + 1), env.count(layout.GRID + 2)
    total, s = vec3(0.0), bounded(changes_at(env, CELL, (i * ny + j) * nz + k), 1)
    for p, q, r in ti.static(ti.ndrange(2, 2, 2)):
        for c in ti.static(range(3)):
            total[c] += body.changes[s - 4 * ((p * ny + q) * nz + r) + c]
    return 0.125 * total


@ti.func
def second_changes(env: ti.template(), part, body: ti.template()):
    """(4 S - 1) applied to the changes of this part's nodes. The mean is 0 at the border, where the array may hold
    values of an earlier grid of another shape."""
    nx, ny, nz = env.count(layout.GRID), env.count(layout.GRID + 1), env.count(layout.GRID + 2)
    low, high = box_of_part(env, part)
    for i in range(low[0], high[0]):
        for j in range(low[1], high[1]):
            for k in range(low[2], high[2]):
                node, mean = (i * ny + j) * nz + k, vec3(0.0)
                s, t = bounded(changes_at(env, CHANGE, node), 1), bounded(changes_at(env, SECOND, node), 1)
                mass = body.changes[s + 3]
                if mass != 0.0 and i > 0 and j > 0 and k > 0 and i < nx - 1 and j < ny - 1 and k < nz - 1:
                    mean = mean_of_cells(env, body, i, j, k)
                for c in ti.static(range(3)):
                    body.changes[t + c] = 4.0 * mass * mean[c] - body.changes[s + c]
                body.changes[t + 3] = mass


@ti.func
def filtered_change(env: ti.template(), body: ti.template(), it, i, j, k):
    """Velocity change of a node in this substep, and its mass."""
    ny, nz = env.count(layout.GRID + 1), env.count(layout.GRID + 2)
    node = (i * ny + j) * nz + k
    s, t = bounded(changes_at(env, CHANGE, node), 1), bounded(changes_at(env, SECOND, node), 1)
    mass, change = body.changes[s + 3], vec3(0.0)
    if mass != 0.0:  # true of NaN, which must not be hidden
        change = vec3([body.changes[s + c] for c in range(3)]) / mass
        if has_velocities(env, it) and i > 0 and j > 0 and k > 0:
            second = vec3([body.changes[t + c] for c in range(3)]) / mass
            change *= env.param(layout.OWN_WEIGHT)
            change += env.param(layout.FILTERED_WEIGHT) * (4.0 * mean_of_cells(env, body, i, j, k) - second)
    return change, mass
