"""Contact of particles with the deformed gel surface and its housing; friction with memory.

The gel surface is the C1 quadratic B-spline over its top nodes; the renderer draws the same surface. The normal force
is a penalty plus a stored multiplier (augmented Lagrangian, Simo & Laursen 1992), so that the overlap is zero at rest.
Coulomb friction acts through an elastic slip with memory (Cundall & Strack 1979); without memory, friction creeps and
carries no load. The memory is the anchor, the point to which a contact sticks; a slip that is integrated from
velocities has another value after a cycle of stretch, shear and rotation. The friction limit of a particle follows its
normal force without the dashpot's part. A delayed limit, as for rigid indenters (indenter.py), gives up to 15 % too
little drag where a contact grows while it slides.
"""

from tacsim.compute.runtime import ti
from tacsim.physics.contact.tuning import CONTACT_DAMPING, MIN_SURFACE_AREA, PARTICLE_TANGENTIAL_STIFFNESS
from tacsim.physics.exec import layout
from tacsim.physics.exec.environment import record_addition, record_max
from tacsim.physics.exec.lanes import ON_DEVICE, add_four, filled, slot_of, vec2, vec3, vec4
from tacsim.physics.gel.kernels import surface_at

ContactHistory = ti.types.vector(7, ti.f32)  # memory of the contact of one particle with one gel

ANCHOR_FREE, ANCHOR_ON_GEL, ANCHOR_ON_HOUSING = map(float, range(3))  # the part on which a particle's anchor lies


@ti.func
def spline_stencil(a):
    """First node of the 3-node stencil around lattice coordinate a, weights, and their derivatives by a."""
    first = int(ti.floor(a + 0.5)) - 1
    t = a - first
    w = vec3(0.5 * (1.5 - t) ** 2, 0.75 - (t - 1.0) ** 2, 0.5 * (t - 0.5) ** 2)
    d = vec3(t - 1.5, -2.0 * (t - 1.0), t - 0.5)
    return first, w, d


@ti.func
def surface_sum(gel: ti.template(), row, i, j, wx, wy):
    """Sum over the 3 x 3 nodes of a stencil from (i, j), weighted by wx and wy; row: first row of the quantity.

    The loop runs over the four numbers of a node, which a CPU handles as a vector; loading the same number of several
    nodes would be a gather.
    """
    if ti.static(ON_DEVICE):
        total = vec4(0.0)
        for p, q in ti.static(ti.ndrange(3, 3)):
            at = surface_at(gel, row + i + p + 1, j + q + 1)
            total += (wx[p] * wy[q]) * vec4([gel.surface[at + c] for c in range(4)])
        return total
    else:
        sums = filled(0.0, 4, 1)
        for c in range(4):
            total = 0.0
            for p, q in ti.static(ti.ndrange(3, 3)):
                total += (wx[p] * wy[q]) * gel.surface[surface_at(gel, row + i + p + 1, j + q + 1) + c]
            sums[c, 0] = total
        return vec4([sums[c, 0] for c in range(4)])


@ti.func
def surface_sums(gel: ti.template(), row, i, j, wx, wy, dx, dy):
    """The same sum, and the sums with the weights' derivatives by x and by y."""
    if ti.static(ON_DEVICE):
        return (
            surface_sum(gel, row, i, j, wx, wy),
            surface_sum(gel, row, i, j, dx, wy),
            surface_sum(gel, row, i, j, wx, dy),
        )
    else:
        sums = filled(0.0, 3, 4)
        for c in range(4):
            value, by_x, by_y = 0.0, 0.0, 0.0
            for p in ti.static(range(3)):
                first, second, third = [gel.surface[surface_at(gel, row + i + p + 1, j + q + 1) + c] for q in range(3)]
                line = wy[0] * first + wy[1] * second + wy[2] * third
                value += wx[p] * line
                by_x += dx[p] * line
                by_y += wx[p] * (dy[0] * first + dy[1] * second + dy[2] * third)
            sums[0, c], sums[1, c], sums[2, c] = value, by_x, by_y
        return (
            vec4([sums[0, c] for c in range(4)]),
            vec4([sums[1, c] for c in range(4)]),
            vec4([sums[2, c] for c in range(4)]),
        )


@ti.func
def newton_step(t1, t2, miss):
    """Newton step in lattice coordinates to the surface point under a particle; miss: the step for an undeformed
    surface.

    t1, t2: tangents of the surface. A folded surface has no inverse; the step is then that of an undeformed surface.
    """
    det = t1[0] * t2[1] - t1[1] * t2[0]
    step = miss
    if det > MIN_SURFACE_AREA:
        step = vec2(t2[1] * miss[0] - t2[0] * miss[1], t1[0] * miss[1] - t1[1] * miss[0]) / det
    return step


@ti.func
def uniform_mobility(env: ti.template()):
    """Acceleration times mass over force for a uniform force on a surface: the factor by which the filter reduces its
    inertia."""
    return 3.0 * env.param(layout.FILTERED_WEIGHT) + env.param(layout.OWN_WEIGHT)


@ti.func
def normal_force(spring, memory, drag, rate):
    """Normal force of a contact, its part without the dashpot, and its new memory, which is the force at rest.

    spring: penalty force of the overlap; drag: dashpot force, away from the contact; rate: see FORCE_MEMORY_RATE.
    """
    held = ti.max(spring + memory, 0.0)
    return ti.max(spring + memory - drag, 0.0), held, ti.max(memory + rate * spring, 0.0)


@ti.func
def coulomb_friction(slip, vt, limit, k_t, c_t):
    """Coulomb friction with stick. Returns the tangential force, and the remaining share of the elastic slip.

    slip: elastic slip, vt: velocity, both along the surface; limit: friction coefficient times normal force.
    """
    ft = -k_t * slip - c_t * vt
    size, left = ft.norm(), 1.0
    if size > limit:
        ft *= limit / size
        held = k_t * slip.norm()
        if held > limit:
            left = limit / held
    return ft, left


@ti.func
def anchored_friction(anchor, under, t1, t2, vt, limit, k_t, c_t):
    """Friction of a particle with an anchor. Returns the tangential force and the anchor, which moves with slip.

    anchor, under: positions of the anchor and of the particle on the undeformed surface; t1, t2: tangents of the
    surface.
    """
    slip = under - anchor
    ft, left = coulomb_friction(slip[0] * t1 + slip[1] * t2, vt, limit, k_t, c_t)
    return ft, anchor + (1.0 - left) * slip


@ti.func
def rescale_springs(anchor, under, spring, memory, stiffened):
    """Anchor and stored normal force that give the same contact force as before a change of stiffness.

    stiffened: old stiffness over new stiffness, minus 1. under, spring: see `anchored_friction` and `normal_force`.
    """
    return anchor + stiffened * (anchor - under), ti.max(memory + stiffened * (spring + memory), 0.0)


@ti.func
def surface_node(gel: ti.template(), i, j):
    """Index of the surface node (i, j) in the row of a layer; outside the rim, the nearest rim node."""
    return ti.max(0, ti.min(i, gel.nx)) * (gel.ny + 1) + ti.max(0, ti.min(j, gel.ny))


@ti.func
def support_radius(plane, spacing):
    """Distance of a particle from the body's surface: 1 / |plane|; half a spacing deep inside (plane = 0).

    plane: tangent plane of the nearest surface, outward normal over distance [1/mm] (tacsim/physics/body/surface.py).
    """
    size = plane.norm()
    radius = 0.5 * spacing
    if size > 0.0:
        radius = ti.min(1.0 / size, spacing)  # a plane at a larger distance does not belong to this particle
    return radius


@ti.func
def max_surface_height(gel: ti.template()):
    """Height of the highest surface node [mm], at least 0: the spline stays below it, so particles above it do not
    touch."""
    highest = 0.0
    for i in range(1, gel.nx + 2):
        for j in range(1, gel.ny + 2):
            height = gel.surface[surface_at(gel, i, j) + 2]
            highest = ti.select(height > highest, height, highest)
    return highest


@ti.func
def max_nearby_height(gel: ti.template(), i, j):
    """Height of the highest of the 3 x 3 nodes of a stencil from (i, j) [mm]."""
    highest = gel.surface[surface_at(gel, i + 1, j + 1) + 2]
    for p, q in ti.static(ti.ndrange(3, 3)):
        highest = ti.max(highest, gel.surface[surface_at(gel, i + p + 1, j + q + 1) + 2])
    return highest


@ti.func
def particle_contact(env: ti.template(), part, x, v, history, radius, stiffened, gel: ti.template(), forces):
    """Force on one particle from a gel (or its housing); all in the sensor frame. The opposite acts on the gel's nodes.

    x, v: position, and velocity relative to the moving sensor. history: anchor on the undeformed gel or on the housing
    [mm], and on which of these; the stored normal force as the overlap with the same penalty force [mm]; the lateral
    displacement of the gel under the particle [mm]; the particle's radius [mm]. stiffened: see `rescale_springs`.
    forces: first index of the forces on the gel's nodes. Returns whether the particle touches, whether it touches the
    housing, the force, and the new history.
    """
    h, k_n, dt = (
        env.param(layout.GEL_SPACING + gel.index),
        env.param(layout.STIFFNESS + gel.index),
        env.param(layout.STEP),
    )
    mu, housing = env.param(layout.FRICTION + gel.index), env.param(layout.HOUSING + gel.index)
    deepest = env.param(layout.BODY_CELL)  # two particle spacings: larger overlaps are limited
    nx, ny, layers = gel.nx, gel.ny, gel.layers
    in_contact, housed = False, False
    force = vec3(0.0)
    anchor, holder = vec2(history[0], history[1]), history[2]
    pressed = k_n * history[3]
    moved = vec2(0.0)
    overlap = 0.0
    reach = 2.2 * 0.5 * h
    c_n, k_t = CONTACT_DAMPING * k_n * dt / uniform_mobility(env), PARTICLE_TANGENTIAL_STIFFNESS * k_n
    rate = env.param(layout.MEMORY_SHARE)
    if x[2] > -1.2 * h * layers and ti.abs(x[0]) < reach * nx and ti.abs(x[1]) < reach * ny:
        start = vec2(x[0] / h + 0.5 * nx, x[1] / h + 0.5 * ny)  # lattice coordinates on an undeformed surface
        last = start - vec2(history[4], history[5]) / h
        a = vec2(ti.max(0.0, ti.min(last[0], nx)), ti.max(0.0, ti.min(last[1], ny)))
        i, wx, dx = spline_stencil(a[0])
        j, wy, dy = spline_stencil(a[1])
        moved = vec2(history[4], history[5])
        # most particles near the gel are not at the body's surface: the nodes are lower. At the gel's rim, the housing
        # counts.
        ends = i < 0 or j < 0 or i + 2 > nx or j + 2 > ny
        if ends or x[2] < max_nearby_height(gel, i, j) + radius + 0.25 * deepest:
            us, t1, t2 = surface_sums(gel, 0, i, j, wx, wy, dx / h, dy / h)
            t1[0] += 1.0
            t2[1] += 1.0
            step = newton_step(t1, t2, start - a - vec2(us[0], us[1]) / h)
            a += step
            moved = h * (start - a)
            inside = a[0] > 0.0 and a[1] > 0.0 and a[0] < nx and a[1] < ny
            if inside:
                depth = us[2] + h * (step[0] * t1[2] + step[1] * t2[2]) + radius - x[2]
                if k_n * depth + pressed > 0.0:
                    vs = surface_sum(gel, nx + 3, i, j, wx, wy)
                    e1, e2 = vec3(t1[0], t1[1], t1[2]), vec3(t2[0], t2[1], t2[2])
                    n = e1.cross(e2).normalized()
                    gap = depth * n[2]  # overlap; negative where they are separated
                    if gap > deepest:  # a large overlap would cause an instability; counted
                        gap = deepest
                        record_addition(env, slot_of(part), layout.CAPPED, 1.0)
                    vr = v - vec3(vs[0], vs[1], vs[2])
                    vn = vr.dot(n)
                    under = vec2(x[0], x[1]) - moved
                    if holder != ANCHOR_ON_GEL:
                        anchor, holder = under, ANCHOR_ON_GEL
                    anchor, pressed = rescale_springs(anchor, under, k_n * gap, pressed, stiffened)
                    fn, held, pressed = normal_force(k_n * gap, pressed, c_n * vn, rate)
                    ft, anchor = anchored_friction(anchor, under, e1, e2, vr - vn * n, mu * held, k_t, c_n)
                    force = fn * n + ft
                    in_contact = True
                    overlap = gap
                    back = vec4(force[0], force[1], force[2], 0.0)
                    for p, q in ti.static(ti.ndrange(3, 3)):
                        node = surface_node(gel, i + p, j + q)
                        add_four(gel.contact_force, forces + 4 * node, -(wx[p] * wy[q]) * back)
            elif housing >= 0.0:
                gap = radius - housing - x[2]
                if k_n * gap + pressed > 0.0:
                    if gap > deepest:
                        gap = deepest
                        record_addition(env, slot_of(part), layout.CAPPED, 1.0)
                    n = vec3(0.0, 0.0, 1.0)
                    under = vec2(x[0], x[1])
                    if holder != ANCHOR_ON_HOUSING:
                        anchor, holder = under, ANCHOR_ON_HOUSING
                    anchor, pressed = rescale_springs(anchor, under, k_n * gap, pressed, stiffened)
                    fn, held, pressed = normal_force(k_n * gap, pressed, c_n * v[2], rate)
                    e1, e2, vt = vec3(1.0, 0.0, 0.0), vec3(0.0, 1.0, 0.0), vec3(v[0], v[1], 0.0)
                    ft, anchor = anchored_friction(anchor, under, e1, e2, vt, mu * held, k_t, c_n)
                    force = fn * n + ft
                    in_contact, housed = True, True
                    overlap = gap
    remembered = ContactHistory([0.0, 0.0, ANCHOR_FREE, 0.0, moved[0], moved[1], radius])
    if in_contact:
        remembered = ContactHistory([anchor[0], anchor[1], holder, pressed / k_n, moved[0], moved[1], radius])
        record_max(env, slot_of(part), layout.OVERLAP, overlap)
    return in_contact, housed, force, remembered
