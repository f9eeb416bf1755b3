"""Motion of a rigid object between gel pads, and of the pads that a grip force closes, inside a kernel.

Inertia is scaled, since only the state at rest counts: the object, and the pads, have the mass of the layer of gel
that they touch. So every motion of theirs is as stable as one of the gel's own surface, whatever is touched, and
relaxes with the gel. It is an inertia relative to the mean motion of the pads: pads that move together carry their
object with them.
"""

from typing import Any, NamedTuple

from tacsim.compute.runtime import ti
from tacsim.physics.body.grid_motion import part_sum
from tacsim.physics.exec import layout as press
from tacsim.physics.exec.environment import Environment
from tacsim.physics.exec.lanes import PARTS, filled, vec3, vec4
from tacsim.physics.grip import layout
from tacsim.physics.grip.tuning import LAYER_SHARE, SUPPORT_ZETA

Frames = ti.types.ndarray(dtype=ti.f32, ndim=5)  # (grips, moving substeps + 1, pads + 1, FRAME_ROWS, 3)
Constants = ti.types.ndarray(dtype=ti.f32, ndim=2)
Whole = ti.types.ndarray(dtype=ti.i32, ndim=2)
Objects = ti.types.ndarray(dtype=ti.f32, ndim=2)


class Grip(NamedTuple):
    """One grip inside a kernel."""

    index: Any
    frames: Any
    constants: Any
    whole: Any
    objects: Any
    patches: Any
    shared: Any  # params, counts, partial of all gels


@ti.func
def constant3(grip: ti.template(), first):
    return vec3([grip.constants[grip.index, first + c] for c in range(3)])


@ti.func
def object3(grip: ti.template(), first):
    return vec3([grip.objects[grip.index, first + c] for c in range(3)])


@ti.func
def write3(grip: ti.template(), first, values):
    for c in ti.static(range(3)):
        grip.objects[grip.index, first + c] = values[c]


@ti.func
def frame_number(grip: ti.template(), it):
    return ti.min(it, grip.whole[grip.index, layout.MOVING])


@ti.func
def frame_row(grip: ti.template(), it, g, r):
    return vec3([grip.frames[grip.index, frame_number(grip, it), g, r, c] for c in range(3)])


@ti.func
def frame_axes(grip: ti.template(), it, g):
    return ti.Matrix.rows([frame_row(grip, it, g, r) for r in ti.static(range(3))])


@ti.func
def pad_place(grip: ti.template(), it, g, axes):
    """Position of a pad in the grip's frame, moved along its z axis by the closing."""
    outward = vec3(axes[0, 2], axes[1, 2], axes[2, 2])
    return frame_row(grip, it, g, 3) + grip.objects[grip.index, layout.CLOSING] * outward


@ti.func
def turned_axes(grip: ti.template()):
    """Rotation matrix of the object since the start of the step."""
    first = layout.TURNED
    x, y, z, w = [grip.objects[grip.index, first + c] for c in range(4)]
    return ti.Matrix.rows(
        [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)],
            [2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)],
            [2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)],
        ]
    )


@ti.func
def write_drive(grip: ti.template(), it, drive: ti.template()):
    """Pose and velocity of the object in the frame of each pad, for substep `it`."""
    place, velocity, spin = (
        object3(grip, layout.PLACE),
        object3(grip, layout.VELOCITY),
        object3(grip, layout.SPIN),
    )
    start = ti.Matrix.rows([constant3(grip, layout.TURN + 3 * r) for r in ti.static(range(3))])
    turn = turned_axes(grip) @ start
    for g in range(grip.frames.shape[2] - 1):
        axes = frame_axes(grip, it, g)
        back = axes.transpose()
        arm = place - pad_place(grip, it, g, axes)
        pad_spin = frame_row(grip, it, g, 5)
        outward = vec3(axes[0, 2], axes[1, 2], axes[2, 2])
        pad_velocity = frame_row(grip, it, g, 4) + grip.objects[grip.index, layout.CLOSING_SPEED] * outward
        relative = back @ turn
        centre, moving = back @ arm, back @ (velocity - pad_velocity - pad_spin.cross(arm))
        turning = back @ (spin - pad_spin)
        gel_index = grip.index * (grip.frames.shape[2] - 1) + g
        for c in ti.static(range(3)):
            for r in ti.static(range(3)):
                drive[gel_index, 0, 0, r, c] = relative[r, c]
            drive[gel_index, 0, 0, 3, c] = centre[c]
            drive[gel_index, 0, 0, 4, c] = moving[c]
            drive[gel_index, 0, 0, 5, c] = turning[c]


@ti.func
def patch_sums_of(grip: ti.template(), gel_index, first, count: ti.template()):
    """Sums over the parts, in their order, of `count` moments of a gel's patch."""
    sums = ti.Vector([0.0] * count)
    for part in ti.static(range(PARTS)):
        for c in ti.static(range(count)):
            sums[c] += grip.patches[gel_index, part, first + c]
    return sums


@ti.func
def add_block(system: ti.template(), first: ti.template(), column: ti.template(), block):
    for r, c in ti.static(ti.ndrange(3, 3)):
        system[first + r, column + c] += block[r, c]


@ti.func
def cross_matrix(a):
    return ti.Matrix.rows([[0.0, -a[2], a[1]], [a[2], 0.0, -a[0]], [-a[1], a[0], 0.0]])


@ti.func
def outer(a, b):
    return ti.Matrix.rows([a[0] * b, a[1] * b, a[2] * b])


@ti.func
def add_layer_mass(system: ti.template(), mass, points, arm, axes, first, second):
    """Adds the inertia of the layer of gel under a patch to `system` (6, 7), about the object's centre.

    mass: of a point; points: their number; arm: from the centre to the pad's origin; first, second: sums of the points'
    positions and of their products, in the pad's axes.
    """
    moved = axes @ first
    middle = points * arm + moved
    spread = axes @ second @ axes.transpose() + outer(moved, arm) + outer(arm, moved) + points * outer(arm, arm)
    eye = ti.Matrix.rows([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    add_block(system, 0, 0, mass * points * eye)
    add_block(system, 0, 3, -mass * cross_matrix(middle))
    add_block(system, 3, 0, mass * cross_matrix(middle))
    add_block(system, 3, 3, mass * (spread.trace() * eye - spread))


@ti.func
def solve(system: ti.template()):
    """Solution of the symmetric positive definite `system` (6, 7), in its last column: Gauss without pivoting."""
    for row in range(6):
        for below in range(row + 1, 6):
            share = system[below, row] / system[row, row]
            for column in range(row, 7):
                system[below, column] -= share * system[row, column]
    for back in range(6):
        row = 5 - back
        total = system[row, 6]
        for column in range(row + 1, 6):
            total -= system[row, column] * system[column, 6]
        system[row, 6] = total / system[row, row]


@ti.func
def contact_load(grip: ti.template(), it, system: ti.template()):
    """Adds inertia of all patches to `system` (6, 7), and the pads' forces and moments on the object to its last
    column.

    Returns the mass of the patches, the sum of the normal forces on the pads, and the largest contact force [N].
    """
    mass, along, largest = 0.0, 0.0, 0.0
    centre = object3(grip, layout.PLACE)
    pads = grip.frames.shape[2] - 1
    for g in range(pads):
        gel_index = grip.index * pads + g
        env = ti.static(Environment(gel_index, *grip.shared))
        axes = frame_axes(grip, it, g)
        arm = pad_place(grip, it, g, axes) - centre
        force, moment = part_sum(env, press.FORCE), part_sum(env, press.FORCE + 3)
        for c in ti.static(range(3)):
            grip.patches[gel_index, 0, layout.CONTACT + c] = force[c]
        largest, along = ti.max(largest, force.norm()), along + force[2]
        push = -(axes @ force)
        turning = arm.cross(push) - axes @ moment
        for c in ti.static(range(3)):
            system[c, 6] += push[c]
            system[3 + c, 6] += turning[c]
        sums = patch_sums_of(grip, gel_index, layout.COUNT, layout.PATCH)
        first = vec3(sums[1], sums[2], sums[3])
        second = ti.Matrix.rows([
            [sums[4], sums[9], sums[8]], [sums[9], sums[5], sums[7]], [sums[8], sums[7], sums[6]]
        ])  # fmt: skip
        spacing = env.param(press.GEL_SPACING)
        # of a point, a ninth of an element's surface; half an element deep
        layer = LAYER_SHARE * env.param(press.GEL_DENSITY) * spacing * spacing * spacing / 18.0
        add_layer_mass(system, layer, sums[0], arm, axes, first, second)
        mass += layer * sums[0]
    return mass, along, largest


@ti.func
def measure_lag(grip: ti.template()):
    """Records how much the gels still deform. Called in the stage of the forces, since the reactions of the backings
    are written in the stage of the motion."""
    pads = grip.frames.shape[2] - 1
    lag = 0.0
    for g in range(pads):
        gel_index = grip.index * pads + g
        env = ti.static(Environment(gel_index, *grip.shared))
        force = vec3([grip.patches[gel_index, 0, layout.CONTACT + c] for c in range(3)])
        lag = ti.max(lag, (force - part_sum(env, press.BACKING)).norm())
    grip.objects[grip.index, layout.LAG] = lag


@ti.func
def world_motion(grip: ti.template(), it, axes):
    """Velocity of the object's centre and its spin, world axes; axes: of the grip's frame in world."""
    pads = grip.frames.shape[2] - 1
    carried = frame_row(grip, it, pads, 5)
    velocity = axes @ object3(grip, layout.VELOCITY) + frame_row(grip, it, pads, 4)
    velocity += carried.cross(axes @ object3(grip, layout.PLACE))
    return velocity, axes @ object3(grip, layout.SPIN) + carried


@ti.func
def add_support(grip: ti.template(), axes, path, velocity, spin, step, system: ti.template()):
    """Adds force and moment of the object's support to `system` (6, 7): springs with dashpots in world axes, up to a
    limit, beyond which the support slides along; and the stops of a guide. They are integrated implicitly, so they
    may be stiff.

    path: of the object's centre since the start of the step, world axes.
    """
    for half in ti.static(range(2)):
        stiffness = constant3(grip, layout.SUPPORT + 3 * half)
        stretch = object3(grip, layout.STRETCH + 3 * half)
        limit = grip.constants[grip.index, layout.SUPPORT_LIMIT + half]
        limited = constant3(grip, layout.SUPPORT_AXES) if half == 0 else vec3(1.0)
        moving = velocity if half == 0 else spin
        masses = vec3([system[3 * half + c, 3 * half + c] for c in ti.static(range(3))])
        rate = 2.0 * SUPPORT_ZETA * ti.sqrt(stiffness * masses) + step * stiffness
        spring = -stiffness * stretch
        load = spring - rate * moving
        size, held = (limited * load).norm(), (limited * spring).norm()
        if held > limit:
            write3(grip, layout.STRETCH + 3 * half, stretch * (1.0 - limited * (1.0 - limit / held)))
        grown = step * rate
        if size > limit:
            load *= 1.0 - limited * (1.0 - limit / size)
            grown *= 1.0 - limited
        if half == 0:
            low, high = grip.constants[grip.index, layout.GUIDE_ROOM], grip.constants[grip.index, layout.GUIDE_ROOM + 1]
            at = limited.dot(path)
            beyond = at - ti.max(low, ti.min(high, at))
            if beyond != 0.0:
                load -= limited * (stiffness * beyond + rate * moving)
                grown += step * rate * limited
        back = axes.transpose()
        push = back @ load
        for r in ti.static(range(3)):
            system[3 * half + r, 6] += push[r]
            for c in ti.static(range(3)):
                total = 0.0
                for d in ti.static(range(3)):
                    total += back[r, d] * grown[d] * axes[d, c]
                system[3 * half + r, 3 * half + c] += total


@ti.func
def balance(grip: ti.template(), touched, closing_load, largest, system: ti.template()):
    """Records the imbalance of the substep, and whether the launch may end.

    The measure is that of `tacsim.physics.motion.controller.residual`, without the change of forces: here many substeps
    in succession must be balanced.
    """
    index = grip.index
    reach = grip.constants[index, layout.REACH]
    net = vec3(system[0, 6], system[1, 6], system[2, 6]).norm()
    turning = vec3(system[3, 6], system[4, 6], system[5, 6]).norm() / reach
    worst = ti.max(grip.objects[index, layout.LAG], ti.abs(closing_load))
    if touched:
        worst = ti.max(worst, net, turning)
    share = worst / ti.max(largest, grip.constants[index, layout.MIN_FORCE])
    grip.objects[index, layout.IMBALANCE] = share
    return share <= grip.constants[index, layout.TOLERANCE]


@ti.func
def move_closing(grip: ti.template(), step, mass, along):
    """Closes the pads by the grip force. Returns the force that still moves each [N]."""
    index = grip.index
    pads = grip.frames.shape[2] - 1
    low, high = grip.constants[index, layout.CLOSING_RANGE], grip.constants[index, layout.CLOSING_RANGE + 1]
    load = grip.constants[index, layout.CLOSING_FORCE] + along / pads
    speed = grip.objects[index, layout.CLOSING_SPEED] + step * pads * load / mass
    speed /= 1.0 + step * grip.constants[index, layout.CLOSING_RATE]
    fastest = grip.constants[index, layout.MAX_CLOSING_SPEED]
    speed = ti.max(-fastest, ti.min(fastest, speed))
    wanted = grip.objects[index, layout.CLOSING] + step * speed
    closing = ti.max(low, ti.min(high, wanted))
    if closing != wanted:
        speed, load = 0.0, 0.0
    grip.objects[index, layout.CLOSING], grip.objects[index, layout.CLOSING_SPEED] = closing, speed
    return load


@ti.func
def turn_on(grip: ti.template(), angle):
    """Turns the object by a small rotation vector."""
    half = 0.5 * angle
    size = half.norm_sqr()
    q = half * (1.0 - size / 6.0)
    w = 1.0 - 0.5 * size
    first = layout.TURNED
    p = object3(grip, first)
    s = grip.objects[grip.index, first + 3]
    v = w * p + s * q + q.cross(p)
    turned = vec4(v[0], v[1], v[2], w * s - q.dot(p))
    turned /= turned.norm()
    for c in ti.static(range(4)):
        grip.objects[grip.index, first + c] = turned[c]


@ti.func
def move_object(grip: ti.template(), it):
    """Moves the object by the forces of substep `it`, and the pads that a force closes."""
    index = grip.index
    pads = grip.frames.shape[2] - 1
    step = ti.static(Environment(index * pads, *grip.shared)).param(press.STEP)
    system = filled(0.0, 6, 7)
    mass, along, largest = contact_load(grip, it, system)
    touched = mass > 0.0
    least = grip.constants[index, layout.MIN_MASS]
    for c in ti.static(range(3)):
        system[c, c] += least
        system[3 + c, 3 + c] += grip.constants[index, layout.MIN_INERTIA]
    axes = frame_axes(grip, it, pads)
    velocity, spin = world_motion(grip, it, axes)
    supported = constant3(grip, layout.SUPPORT).norm() + constant3(grip, layout.SUPPORT + 3).norm() > 0.0
    if supported:
        path = frame_row(grip, it, pads, 3) + axes @ object3(grip, layout.PLACE)
        add_support(grip, axes, path, velocity, spin, step, system)
    load = axes.transpose() @ constant3(grip, layout.LOAD)
    torque = axes.transpose() @ constant3(grip, layout.TORQUE)
    arm = turned_axes(grip) @ constant3(grip, layout.WEIGHT_ARM)
    torque += arm.cross(axes.transpose() @ constant3(grip, layout.WEIGHT))
    for c in ti.static(range(3)):
        system[c, 6] += load[c]
        system[3 + c, 6] += torque[c]
    closing_load = 0.0
    if grip.whole[index, layout.IS_CLOSING] == 1:
        closing_load = move_closing(grip, step, mass + least, along)
    balanced = balance(grip, touched or supported, closing_load, largest, system)
    solve(system)
    moving, turning = vec3(0.0), vec3(0.0)
    if touched or supported:
        change = vec3(system[0, 6], system[1, 6], system[2, 6])
        moving = object3(grip, layout.VELOCITY) + step * change
        turning = object3(grip, layout.SPIN) + step * vec3(system[3, 6], system[4, 6], system[5, 6])
        fastest = moving.norm() + grip.constants[index, layout.REACH] * turning.norm()
        limit = grip.constants[index, layout.MAX_SPEED]
        if fastest > limit:
            moving, turning = moving * (limit / fastest), turning * (limit / fastest)
            grip.whole[index, layout.LIMITED] += 1
    if supported and it + 1 == grip.whole[index, layout.MOVING]:  # it stops with the pads: it has no momentum
        moving, turning = vec3(0.0), vec3(0.0)
    write3(grip, layout.VELOCITY, moving)
    write3(grip, layout.SPIN, turning)
    write3(grip, layout.PLACE, object3(grip, layout.PLACE) + step * moving)
    turn_on(grip, step * turning)
    velocity, spin = world_motion(grip, it, axes)
    write3(grip, layout.STRETCH, object3(grip, layout.STRETCH) + step * velocity)
    write3(grip, layout.STRETCH + 3, object3(grip, layout.STRETCH + 3) + step * spin)
    quiet = grip.whole[index, layout.QUIET_SUBSTEPS]
    if it >= grip.whole[index, layout.MOVING]:
        grip.whole[index, layout.QUIET] = ti.select(balanced, grip.whole[index, layout.QUIET] + 1, 0)
        if quiet > 0 and grip.whole[index, layout.QUIET] >= quiet:
            grip.whole[index, layout.LAST] = it
