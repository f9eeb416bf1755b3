"""A rigid indenter on the gel surface: contact by area-weighted quadrature on the surface.

Each surface cell has 3 x 3 points of equal area. The normal pressure is the pressure stored at the surface's nodes (a
multiplier; augmented Lagrangian, Simo & Laursen 1992) plus a penalty of the overlap at the point, which stands for the
compliance of a half-space between the nodes. Friction stores the point of the indenter to which a point sticks. All
else is in the sensor frame [mm, MPa]. Why: docs/physics-contact.md.
"""

from typing import Any, NamedTuple

from tacsim.compute.runtime import ti
from tacsim.physics.contact.contact import coulomb_friction, surface_node
from tacsim.physics.contact.distance import GRID, DistanceGrid, box_distance, signed_distance
from tacsim.physics.contact.tuning import (
    CONTACT_DAMPING,
    INDENTER_TANGENTIAL_STIFFNESS,
    MAX_SUBSTEP_TRAVEL,
    MAX_TOUCH_DISTANCE,
    MIN_PRESSURE,
    RIM_DEPTH,
    RIM_STIFFNESS,
    SURFACE_SMOOTHING,
)
from tacsim.physics.exec import layout
from tacsim.physics.exec.environment import record_addition, record_max, record_sum
from tacsim.physics.exec.lanes import (
    COPIES,
    LANES,
    ON_DEVICE,
    add_four,
    copy_of,
    filled,
    part_range,
    slot_of,
    vec3,
    vec4,
)
from tacsim.physics.exec.team import one_if
from tacsim.physics.gel.kernels import contact_force_start, surface_at

Anchor = ti.types.ndarray(dtype=vec3, ndim=3)  # of the quadrature points, on the indenter, in its own axes [mm]
Pressure = ti.types.ndarray(dtype=ti.f32, ndim=3)
Values = ti.types.ndarray(dtype=ti.f32, ndim=4)  # (environments, x, y, z)

# How kernels on the CPU take these arrays
IndenterArrays = ti.types.argpack(anchor=Anchor, pressure=Pressure, values=Values)

POINTS = 3  # quadrature points along one edge of a surface cell
PATCH_MOMENTS = 10  # of the points that touch: their number, sums of their coordinates and of the products of these
SPLINE_SMOOTHING = 0.125  # of the quadratic B-spline over the same nodes


class Indenter(NamedTuple):
    """The indenters of all environments inside a kernel: memory of the quadrature points, and mesh distances."""

    anchor: Any
    pressure: Any
    values: Any
    has_patches: Any = False
    patches: Any = None  # moments of the points that touch, of each part (tacsim.physics.grip.layout), if it has them


class Law(NamedTuple):
    """Numbers of one environment's contact inside a kernel, which are the same at all points."""

    spacing: Any  # of the surface's nodes
    area: Any  # of a point
    stiffness: Any
    damping: Any  # of the dashpots
    friction: Any
    relaxation: Any  # share of a change of the pressure that the limit of friction takes over in a substep


class Shape(NamedTuple):
    """One environment's indenter inside a kernel: its shape, and its motion in the sensor frame."""

    kind: Any
    size: Any
    grid: Any  # DistanceGrid
    rotate: Any
    centre: Any
    velocity: Any
    spin: Any


def point_weights() -> tuple[tuple[float, ...], ...]:
    """Weights of the two nodes before and the two after a cell's middle, at each point along the cell. They are exact
    for linear functions; for a parabola, the error is SURFACE_SMOOTHING at all points."""
    first = 0.5 / POINTS  # distance from the nearest node; the middle point has two
    spread = first**2 + 2 * SURFACE_SMOOTHING
    near, far = (spread - first) / 2, (spread + first) / 2
    edge = (SURFACE_SMOOTHING - SPLINE_SMOOTHING) / 2
    return (near, 1 - near - far, far, 0.0), (edge, 0.5 - edge, 0.5 - edge, edge), (0.0, far, 1 - near - far, near)


POINT_WEIGHTS = point_weights()
MAX_WEIGHT_SUM = max(sum(map(abs, weights)) for weights in POINT_WEIGHTS) ** 2  # of the nodes' numbers at a point
WEIGHTS_OF_NODES = tuple(zip(*POINT_WEIGHTS, strict=True))  # of the three points, for each of the four nodes


@ti.func
def weights_of(point):
    """Weights of the four nodes around a cell along one axis, for its point number `point`."""
    w = vec4([ti.static(POINT_WEIGHTS[0][c]) for c in range(4)])
    if point > 0:
        w = vec4([ti.static(POINT_WEIGHTS[1][c]) for c in range(4)])
    if point > 1:
        w = vec4([ti.static(POINT_WEIGHTS[2][c]) for c in range(4)])
    return w


@ti.func
def weighted_sum(values: ti.template(), weights: ti.template()):
    """Sum of `values` with weights that are known when a kernel is compiled; terms with weight 0 are left out."""
    total = 0.0
    for k in ti.static(range(len(weights))):
        if ti.static(weights[k] != 0.0):
            total += weights[k] * values[k]
    return total


@ti.func
def patch_sum(gel: ti.template(), row, i, j, wx, wy):
    """Sum of a surface quantity over the 4 x 4 nodes around cell (i, j); row: first row of the quantity."""
    total = vec4(0.0)
    for p, q in ti.static(ti.ndrange(4, 4)):
        at = surface_at(gel, row + i + p, j + q)
        total += (wx[p] * wy[q]) * vec4([gel.surface[at + c] for c in range(4)])
    return total


@ti.func
def patch_sums(gel: ti.template(), i, j, points: ti.template()):
    """The same sums at all points of a cell and of both quantities, into `points` (2 x 9, 4), axis by axis.

    Each node is read once. The loop runs over its four numbers, as in `surface_sum`.
    """
    for quantity in range(2):
        for c in range(4):
            nodes = [
                [gel.surface[surface_at(gel, quantity * (gel.nx + 3) + i + p, j + q) + c] for q in range(4)]
                for p in range(4)
            ]
            for y in ti.static(range(POINTS)):
                line = [weighted_sum(nodes[p], ti.static(POINT_WEIGHTS[y])) for p in range(4)]
                for x in ti.static(range(POINTS)):
                    value = weighted_sum(line, ti.static(POINT_WEIGHTS[x]))
                    points[POINTS * (POINTS * quantity + x) + y, c] = value


@ti.func
def scatter_to_nodes(gel: ti.template(), forces, i, j, pushes: ti.template()):
    """Adds the forces `pushes` (9, 4) at the points of cell (i, j) to its 4 x 4 nodes: the transpose of
    `patch_sums`."""
    nodes = filled(0.0, 16, 4)
    for c in range(4):
        at = [[pushes[POINTS * x + y, c] for y in range(POINTS)] for x in range(POINTS)]
        for q in ti.static(range(4)):
            line = [weighted_sum(at[x], ti.static(WEIGHTS_OF_NODES[q])) for x in range(POINTS)]
            for p in ti.static(range(4)):
                nodes[4 * p + q, c] = weighted_sum(line, ti.static(WEIGHTS_OF_NODES[p]))
    for p, q in ti.static(ti.ndrange(4, 4)):
        node = surface_node(gel, i + p - 1, j + q - 1)
        add_four(gel.contact_force, forces + 4 * node, vec4([nodes[4 * p + q, c] for c in range(4)]))


@ti.func
def update_node_pressure(env: ti.template(), part, gel: ti.template()):
    """Moves the stored pressure of this part's nodes towards the present pressure; on a device a part is one node."""
    row = gel.ny + 1
    count, h = (gel.nx + 1) * row, env.param(layout.GEL_SPACING)
    blocks = (count + LANES - 1) // LANES
    first, last = part_range(blocks, part)
    min_pressure = MIN_PRESSURE * env.param(layout.GEL_MU)
    i, j = first * LANES // row, first * LANES % row
    for node in range(first * LANES, ti.min(last * LANES, count)):
        total = 0.0
        for copy in ti.static(range(COPIES)):
            total += gel.contact_force[contact_force_start(gel, copy) + 4 * node + 3]
        at = surface_at(gel, i + 1, j + 1) + 3
        old = gel.surface[at]
        if total != 0.0 or old != 0.0:
            area = h * h
            if i == 0 or i == gel.nx:
                area *= 0.5
            if j == 0 or j == gel.ny:
                area *= 0.5
            # a pressure below the limit becomes 0; it would only be halved again and again
            rate = env.param(layout.MEMORY_SHARE)
            new = old + rate * (total / area - old)
            gel.surface[at] = ti.select(total == 0.0 and (new < min_pressure or rate == 0.0), 0.0, new)
        j += 1
        if j == row:
            i, j = i + 1, 0


@ti.func
def shape_of(env: ti.template(), it, drive: ti.template(), indenter: ti.template()):
    """The indenter's shape and motion; drive: its pose and velocity in the sensor frame."""
    kind, size = env.count(layout.KIND), env.param3(layout.SHAPE)
    nodes = ti.Vector([env.count(layout.SHAPE_NODES + d) for d in range(3)])
    first = ti.Vector([env.count(layout.SHAPE_FIRST + d) for d in range(3)])
    origin, spacing = env.param3(layout.SHAPE_ORIGIN), env.param(layout.SHAPE_SPACING)
    grid = ti.static(DistanceGrid(indenter.values, first, nodes, origin, spacing))
    rows = [vec3([drive[env.index, it, 0, r, c] for c in range(3)]) for r in range(6)]
    rotate = ti.Matrix.rows([rows[0], rows[1], rows[2]])
    return ti.static(Shape(kind, size, grid, rotate, rows[3], rows[4], rows[5]))


@ti.func
def law_of(env: ti.template()):
    h, dt = env.param(layout.GEL_SPACING), env.param(layout.STEP)
    # without this delay, slides oscillate (Prakash & Clifton 1993)
    relaxation = ti.min(dt * env.param(layout.LIMIT_RELAXATION_RATE), 1.0)
    damping = CONTACT_DAMPING * env.param(layout.GEL_DENSITY) * h / (2.0 * dt)
    area, stiffness, friction = h * h / (POINTS * POINTS), env.param(layout.STIFFNESS), env.param(layout.FRICTION)
    return ti.static(Law(h, area, stiffness, damping, friction, relaxation))


@ti.func
def clearance(env: ti.template(), gel: ti.template(), i, j, shape: ti.template(), law: ti.template()):
    """Lower bound of the distance of the points of cell (i, j) from the indenter [mm], and of the distance from which
    none of them touches.

    The first uses the distance of the cell's middle, since most cells are far from the indenter; for a mesh, whose
    distances are valid only near it, the distance from its bounding box. The second: outside, a point touches only
    where pressure or dashpot exceed the spring of its distance.
    """
    h = law.spacing
    middle = vec3(0.0)
    for p, q in ti.static(ti.ndrange(2, 2)):
        node = surface_at(gel, i + p + 1, j + q + 1)
        middle += 0.25 * vec3([gel.surface[node + c] for c in range(3)])
    at = vec3((i + 0.5 - 0.5 * gel.nx) * h, (j + 0.5 - 0.5 * gel.ny) * h, 0.0)
    at += middle
    far, y = 0.0, shape.rotate.transpose() @ (at - shape.centre)
    if shape.kind == GRID:
        far, _ = box_distance(shape.size, y)
    else:
        far, _ = signed_distance(env, shape.kind, shape.size, y, shape.grid)
    # largest distance of a point from the middle
    reach = 0.0
    for p, q in ti.static(ti.ndrange(2, 2)):
        node = surface_at(gel, i + p + 1, j + q + 1)
        corner = vec3([gel.surface[node + c] for c in range(3)]) - middle
        reach = ti.max(reach, (corner + h * vec3(p - 0.5, q - 0.5, 0.0)).norm_sqr())
    reach = ti.sqrt(reach)
    gap, touch = far - reach, MAX_TOUCH_DISTANCE * h
    if gap > 0.0 and gap < touch:
        pressure, speed = 0.0, 0.0
        for p in range(4):
            for q in ti.static(range(4)):
                node, moving = surface_at(gel, i + p, j + q), surface_at(gel, gel.nx + 3 + i + p, j + q)
                velocity = vec3([gel.surface[moving + c] for c in range(3)])
                pressure = ti.max(pressure, gel.surface[node + 3])
                speed = ti.max(speed, velocity.norm_sqr())
        closing = MAX_WEIGHT_SUM * ti.sqrt(speed) + shape.velocity.norm() + shape.spin.norm() * (y.norm() + reach)
        push = MAX_WEIGHT_SUM * pressure + law.damping * closing
        touch = ti.min(touch, 1.01 * push / (RIM_STIFFNESS * law.stiffness))  # above the error of rounding
    return gap, touch


@ti.func
def clear_contact_memory(env: ti.template(), indenter: ti.template(), i, j):
    """Sets the contact memory of the quadrature point (i, j) to zero."""
    indenter.anchor[env.index, i, j] = vec3(0.0)
    indenter.pressure[env.index, i, j] = 0.0


@ti.func
def point_push(
    env: ti.template(), indenter: ti.template(), shape: ti.template(), law: ti.template(), i, j, x, us, vs
):  # fmt: skip
    """Contact of the indenter with the gel at the quadrature point (i, j), which is at x: whether it touches, force and
    pressure times area as a vector of four [N], overlap [mm].

    us: displacement of the point and the stored pressure of the nodes; vs: velocity of the point.
    """
    h, k_n, c_n = law.spacing, law.stiffness, law.damping
    y = shape.rotate.transpose() @ (x - shape.centre)
    phi, n_local = signed_distance(env, shape.kind, shape.size, y, shape.grid)
    touching, push = False, vec4(0.0)
    if phi < MAX_TOUCH_DISTANCE * h:
        stiff = RIM_STIFFNESS + (1.0 - RIM_STIFFNESS) * ti.max(0.0, ti.min(1.0, -phi / (RIM_DEPTH * h)))
        pressure = us[3] - stiff * k_n * phi
        n = shape.rotate @ n_local  # out of the indenter: pushes the gel
        moving = shape.velocity + shape.spin.cross(x - shape.centre) - vec3(vs[0], vs[1], vs[2])  # relative to the gel
        closing = moving.dot(n)
        normal = pressure + c_n * closing
        if normal > 0.0:
            touching = True
            sliding = moving - closing * n
            rest = ti.max(pressure, 0.0)
            memory = indenter.pressure[env.index, i, j]
            anchor = indenter.anchor[env.index, i, j] if memory > 0.0 else y
            slip = anchor - y
            slip -= slip.dot(n_local) * n_local
            memory += law.relaxation * (rest - memory)
            limit = law.friction * memory
            ft, left = coulomb_friction(shape.rotate @ slip, sliding, limit, INDENTER_TANGENTIAL_STIFFNESS * k_n, c_n)
            indenter.anchor[env.index, i, j] = anchor - (1.0 - left) * slip
            indenter.pressure[env.index, i, j] = memory
            force = law.area * (normal * n - ft)
            push = vec4(force[0], force[1], force[2], law.area * rest)
    if not touching:
        clear_contact_memory(env, indenter, i, j)
    return touching, push, -phi


@ti.func
def add_to_patch(env: ti.template(), part, indenter: ti.template(), x):
    """Adds a point at x that touches to the moments of this part's patch."""
    moments = [1.0, x[0], x[1], x[2], x[0] * x[0], x[1] * x[1], x[2] * x[2], x[1] * x[2], x[0] * x[2], x[0] * x[1]]
    for c in ti.static(range(PATCH_MOMENTS)):
        indenter.patches[env.index, part, c] += moments[c]


@ti.func
def apply_indenter(env: ti.template(), part, it, drive: ti.template(), gel: ti.template(), indenter: ti.template()):
    """Contact of the indenter with this part's cells of the gel. Records force and moment on the sensor, sensor axes.

    drive: pose and velocity of the indenter in the sensor frame.
    """
    law = ti.static(law_of(env))
    shape = ti.static(shape_of(env, it, drive, indenter))
    nx, ny, h = gel.nx, gel.ny, law.spacing
    total, moment, deepest = vec3(0.0), vec3(0.0), 0.0
    forces = contact_force_start(gel, copy_of(part))
    first_cell, last_cell, low, high = 0, 0, 0, ny
    points = filled(0.0, 2 * POINTS * POINTS, 4)  # of one cell: values at its points, and forces of its points
    pushes = filled(0.0, POINTS * POINTS, 4)
    if ti.static(indenter.has_patches):
        for c in range(PATCH_MOMENTS):
            indenter.patches[env.index, part, c] = 0.0
    if ti.static(ON_DEVICE):
        first_cell, low = part // ny, part % ny
        last_cell, high = first_cell + 1, low + 1
    else:
        first_cell, last_cell = part_range(nx, part)
    for cell_i in range(first_cell, last_cell):
        for cell_j in range(low, high):
            gap, touch = clearance(env, gel, cell_i, cell_j, shape, law)
            if gap > touch:
                if gap < (MAX_TOUCH_DISTANCE + MAX_SUBSTEP_TRAVEL) * h:
                    for p, q in ti.static(ti.ndrange(POINTS, POINTS)):
                        clear_contact_memory(env, indenter, cell_i * POINTS + p, cell_j * POINTS + q)
            else:
                if ti.static(not ON_DEVICE):
                    patch_sums(gel, cell_i, cell_j, points)
                pushed = False
                for point in range(POINTS * POINTS):
                    i, j = cell_i * POINTS + point // POINTS, cell_j * POINTS + point % POINTS
                    wx, wy = weights_of(point // POINTS), weights_of(point % POINTS)
                    us, vs = vec4(0.0), vec4(0.0)
                    if ti.static(ON_DEVICE):
                        us = patch_sum(gel, 0, cell_i, cell_j, wx, wy)
                        vs = patch_sum(gel, nx + 3, cell_i, cell_j, wx, wy)
                    else:
                        us = vec4([points[point, c] for c in range(4)])
                        vs = vec4([points[POINTS * POINTS + point, c] for c in range(4)])
                    at_rest = vec3((i + 0.5) / POINTS - 0.5 * nx, (j + 0.5) / POINTS - 0.5 * ny, 0.0)
                    x = h * at_rest + vec3(us[0], us[1], us[2])
                    touching, push, overlap = point_push(env, indenter, shape, law, i, j, x, us, vs)
                    if touching:
                        pushed = True
                        force = vec3(push[0], push[1], push[2])
                        total += force
                        moment += x.cross(force)
                        if ti.static(indenter.has_patches):
                            add_to_patch(env, part, indenter, x)
                        deepest = ti.max(deepest, overlap)
                    if ti.static(not ON_DEVICE):
                        for c in ti.static(range(4)):
                            pushes[point, c] = push[c]
                    elif touching:
                        for p, q in ti.static(ti.ndrange(4, 4)):
                            node = surface_node(gel, cell_i + p - 1, cell_j + q - 1)
                            add_four(gel.contact_force, forces + 4 * node, (wx[p] * wy[q]) * push)
                if ti.static(not ON_DEVICE):
                    for _ in range(one_if(pushed)):
                        scatter_to_nodes(gel, forces, cell_i, cell_j, pushes)
    slot = slot_of(part)
    if ti.static(ON_DEVICE):
        record_max(env, slot, layout.OVERLAP, deepest)
    else:
        env.partial[env.index, part, layout.OVERLAP] = deepest
    for d in ti.static(range(3)):
        record_sum(env, slot, layout.FORCE + d, total[d])
        record_sum(env, slot, layout.FORCE + 3 + d, moment[d])
        record_addition(env, slot, layout.FORCE_SUM + d, total[d])
        record_addition(env, slot, layout.FORCE_SUM + 3 + d, moment[d])
