"""Kernels of tied grid nodes: they give impulses to full nodes and take their velocity (see `tied_nodes`)."""

from tacsim.compute.runtime import ti
from tacsim.physics.body.mass import CHANGE, changes_at
from tacsim.physics.body.transfers import node_sum
from tacsim.physics.exec import layout
from tacsim.physics.exec.lanes import NODES, ON_DEVICE, bounded, strip, vec4

Ends = ti.types.ndarray(dtype=ti.i32, ndim=1)  # `Links.ends` of all environments

IMPULSE_TABLE, VELOCITY_TABLE = range(2)  # the two tables of `Links`
RECEIVER_ROW, GIVER_ROW = range(2)  # the two rows of each


@ti.func
def links_of_part(env: ti.template(), table: ti.template(), part):
    """First pair of a part in a table, and the one after its last; on a device a part is one pair."""
    if ti.static(ON_DEVICE):
        return part, part + 1
    else:
        first = ti.static(layout.IMPULSE_LINKS if table == IMPULSE_TABLE else layout.VELOCITY_LINKS)
        return env.count(first + part), env.count(first + part + 1)


@ti.func
def end_of(env: ti.template(), body: ti.template(), table: ti.template(), row: ti.template(), n):
    """A node of a pair."""
    return body.ends[((env.index * 2 + table) * 2 + row) * env.count(layout.LINKS) + n]


@ti.func
def share_of(env: ti.template(), body: ti.template(), table: ti.template(), n):
    return body.shares[(env.index * 2 + table) * env.count(layout.LINKS) + n]


@ti.func
def node_of(numbers, node):
    """The four numbers of one node of a strip."""
    found = vec4([numbers[c] for c in range(4)])
    for n in ti.static(range(1, NODES)):
        if node % NODES == n:
            found = vec4([numbers[4 * n + c] for c in range(4)])
    return found


@ti.func
def in_strip(numbers, node):
    """A strip with the four numbers of one node and zeros elsewhere."""
    found = strip(0.0)
    for n in ti.static(range(NODES)):
        if node % NODES == n:
            for c in ti.static(range(4)):
                found[4 * n + c] = numbers[c]
    return found


@ti.func
def transfer_impulses(env: ti.template(), part, body: ti.template()):
    """After `grid_changes`: adds the momentum changes and masses of tied nodes to the full nodes of this part, and sets
    those of this part's tied nodes to zero."""
    dt, weight = env.param(layout.STEP), env.param3(layout.GRAVITY)
    plane = env.count(layout.GRID + 1) * env.count(layout.GRID + 2)
    first, last = links_of_part(env, VELOCITY_TABLE, part)
    for n in range(first, last):
        s = changes_at(env, CHANGE, end_of(env, body, VELOCITY_TABLE, RECEIVER_ROW, n))
        for c in ti.static(range(4)):
            body.changes[s + c] = 0.0
    first, last = links_of_part(env, IMPULSE_TABLE, part)
    for n in range(first, last):
        light = end_of(env, body, IMPULSE_TABLE, GIVER_ROW, n)
        q = node_of(node_sum(env, light // plane, light // NODES, body), light)
        for d in ti.static(range(3)):
            q[d] += q[3] * dt * weight[d]
        q *= share_of(env, body, IMPULSE_TABLE, n)
        s = bounded(changes_at(env, CHANGE, end_of(env, body, IMPULSE_TABLE, RECEIVER_ROW, n)), 1)
        for c in ti.static(range(4)):
            if ti.static(ON_DEVICE):
                ti.atomic_add(body.changes[s + c], q[c])
            else:
                body.changes[s + c] = body.changes[s + c] + q[c]


@ti.func
def set_tied_velocities(env: ti.template(), part, body: ti.template()):
    """After `grid_update`, which leaves tied nodes at rest: gives them the velocities of their full nodes."""
    base = env.index * env.count(layout.CAPACITY)
    first, last = links_of_part(env, VELOCITY_TABLE, part)
    for n in range(first, last):
        light, full = (
            end_of(env, body, VELOCITY_TABLE, RECEIVER_ROW, n),
            end_of(env, body, VELOCITY_TABLE, GIVER_ROW, n),
        )
        velocity = share_of(env, body, VELOCITY_TABLE, n) * node_of(body.velocities[base + full // NODES], full)
        at = base + light // NODES
        if ti.static(ON_DEVICE):
            ti.atomic_add(body.velocities[at], in_strip(velocity, light))
        else:
            body.velocities[at] = body.velocities[at] + in_strip(velocity, light)
