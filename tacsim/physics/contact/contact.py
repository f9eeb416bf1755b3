"""Contact: particles against the deformed gel surface and its housing; friction with memory.

The gel surface is the C1 quadratic B-spline over its top nodes; the renderer draws the same surface. The normal force
is a penalty plus a multiplier that remembers (augmented Lagrangian, Simo & Laursen 1992), so that nothing overlaps at
rest. Coulomb friction acts by an elastic slip with memory (Cundall & Strack 1979): without it, friction creeps and
holds nothing. What is remembered is the point that a contact sticks to, its anchor: a slip summed up from velocities
comes back from a loop of stretch, shear and turns with another value. The limit of a particle's friction is that of its
normal force without the dashpot's: a limit that lags behind, as rigid indenters need it (indenter.py), drags up to 15 %
too little where a contact grows while it slides.
"""

from tacsim.compute.runtime import ti
from tacsim.physics.contact.tuning import CONTACT_DAMPING, MIN_SURFACE_AREA, PARTICLE_TANGENTIAL_STIFFNESS
from tacsim.physics.exec import layout
from tacsim.physics.exec.environment import record_more, record_most
from tacsim.physics.exec.lanes import ON_DEVICE, add_four, filled, slot_of, vec2, vec3, vec4
from tacsim.physics.gel.kernels import surface_at

ContactHistory = ti.types.vector(7, ti.f32)  # what contact remembers of a particle and a gel

FREE, ON_GEL, ON_HOUSING = map(float, range(3))  # what a particle's anchor is on


@ti.func
def spline(a):
    """First node of the 3-node stencil round lattice coordinate a, weights, and their derivatives by a."""
    first = int(ti.floor(a + 0.5)) - 1
    t = a - first
    w = vec3(0.5 * (1.5 - t) ** 2, 0.75 - (t - 1.0) ** 2, 0.5 * (t - 0.5) ** 2)
    d = vec3(t - 1.5, -2.0 * (t - 1.0), t - 0.5)
    return first, w, d


@ti.func
def surface_sum(gel: ti.template(), row, i, j, wx, wy):
    """Sum over the 3 x 3 nodes of a stencil from (i, j) on, weighted by wx and wy; row: the quantity's first.

    A loop over the four numbers of a node, of which a CPU makes vectors; all four nodes' first numbers at once would be
    a gather.
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
    """The same sum, with the weights' derivatives by x, and by y."""
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
    """Step in lattice coordinates to where the surface lies under a point; miss: its distance in them, were it unmoved.

    t1, t2: tangents of the surface. One that is folded has no inverse: then the step is that of an unmoved surface.
    """
    det = t1[0] * t2[1] - t1[1] * t2[0]
    step = miss
    if det > MIN_SURFACE_AREA:
        step = vec2(t2[1] * miss[0] - t2[0] * miss[1], t1[0] * miss[1] - t1[1] * miss[0]) / det
    return step


@ti.func
def even_mobility(env: ti.template()):
    """Of an even push on a surface, times its mass: by how much the filter makes it lighter."""
    return 3.0 * env.param(layout.FILTERED) + env.param(layout.OWN)


@ti.func
def normal_force(spring, memory, drag, rate):
    """Normal force of a contact, what of it is not of the dashpot, and its new memory, which carries the force at rest.

    spring: of the overlap; drag: of the dashpot, away from the contact; rate: see FORCE_MEMORY_RATE.
    """
    held = ti.max(spring + memory, 0.0)
    return ti.max(spring + memory - drag, 0.0), held, ti.max(memory + rate * spring, 0.0)


@ti.func
def friction(slip, vt, limit, k_t, c_t):
    """Coulomb's law with stick. Returns the tangential force, and the share of the elastic slip that is left.

    slip: elastic, and vt: velocity, both along the surface; limit: of the force, the coefficient times a normal force.
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
def cling(anchor, under, t1, t2, vt, limit, k_t, c_t):
    """Friction of a particle by its anchor. Returns the tangential force and the anchor, which slip moves.

    anchor, under: where it sticks and where it is, both on the untouched surface; t1, t2: tangents of the surface.
    """
    slip = under - anchor
    ft, left = friction(slip[0] * t1 + slip[1] * t2, vt, limit, k_t, c_t)
    return ft, anchor + (1.0 - left) * slip


@ti.func
def keep_force(anchor, under, spring, memory, stiffened):
    """Anchor and remembered normal force with which a contact pulls and presses as it did before its springs changed.

    stiffened: the old stiffness over the new one, minus 1. under, spring: see `cling` and `normal_force`.
    """
    return anchor + stiffened * (anchor - under), ti.max(memory + stiffened * (spring + memory), 0.0)


@ti.func
def surface_node(gel: ti.template(), i, j):
    """Index of the surface node (i, j) in a layer's row, repeated beyond the rim."""
    return ti.max(0, ti.min(i, gel.nx)) * (gel.ny + 1) + ti.max(0, ti.min(j, gel.ny))


@ti.func
def support_radius(plane, spacing):
    """Distance of a particle from the body's surface: 1 / |plane|; half a spacing deep inside (plane = 0).

    plane: the nearest surface's tangent plane, outward normal over distance [1/mm], see tacsim/physics/body/surface.py.
    """
    size = plane.norm()
    radius = 0.5 * spacing
    if size > 0.0:
        radius = ti.min(1.0 / size, spacing)  # a plane stretched further away says nothing of this particle
    return radius


@ti.func
def contact_ceiling(gel: ti.template()):
    """Height of the highest surface node [mm], at least 0: the spline stays below it, so nothing above it touches."""
    highest = 0.0
    for i in range(1, gel.nx + 2):
        for j in range(1, gel.ny + 2):
            height = gel.surface[surface_at(gel, i, j) + 2]
            highest = ti.select(height > highest, height, highest)
    return highest


@ti.func
def highest_near(gel: ti.template(), i, j):
    """Height of the highest of the 3 x 3 nodes of a stencil from (i, j) on [mm]."""
    highest = gel.surface[surface_at(gel, i + 1, j + 1) + 2]
    for p, q in ti.static(ti.ndrange(3, 3)):
        highest = ti.max(highest, gel.surface[surface_at(gel, i + p + 1, j + q + 1) + 2])
    return highest


@ti.func
def particle_contact(env: ti.template(), part, x, v, history, radius, stiffened, gel: ti.template(), forces):
    """Force on one particle from a gel (or its housing); all in the sensor frame. The opposite acts on the gel's nodes.

    x, v: position, and velocity relative to the moving sensor. history: its anchor on the untouched gel or on the
    housing [mm], and on which of these; the remembered normal force as the overlap whose penalty it equals [mm]; how
    far the gel under it has moved aside [mm]; its radius [mm]. stiffened: see `keep_force`. forces: where those on the
    gel's nodes begin. Returns whether it touches, whether it touches the housing, the force, and the new history.
    """
    h, k_n, dt = (
        env.param(layout.GEL_SPACING + gel.index),
        env.param(layout.STIFFNESS + gel.index),
        env.param(layout.STEP),
    )
    mu, housing = env.param(layout.FRICTION + gel.index), env.param(layout.HOUSING + gel.index)
    deepest = env.param(layout.BODY_CELL)  # two particle spacings: the largest overlap answered in full
    nx, ny, layers = gel.nx, gel.ny, gel.layers
    in_contact, housed = False, False
    force = vec3(0.0)
    anchor, holder = vec2(history[0], history[1]), history[2]
    pressed = k_n * history[3]
    moved = vec2(0.0)
    overlap = 0.0
    reach = 2.2 * 0.5 * h
    c_n, k_t = CONTACT_DAMPING * k_n * dt / even_mobility(env), PARTICLE_TANGENTIAL_STIFFNESS * k_n
    rate = env.param(layout.MEMORY)
    if x[2] > -1.2 * h * layers and ti.abs(x[0]) < reach * nx and ti.abs(x[1]) < reach * ny:
        start = vec2(x[0] / h + 0.5 * nx, x[1] / h + 0.5 * ny)  # lattice coordinates, were the surface unmoved
        last = start - vec2(history[4], history[5]) / h
        a = vec2(ti.max(0.0, ti.min(last[0], nx)), ti.max(0.0, ti.min(last[1], ny)))
        i, wx, dx = spline(a[0])
        j, wy, dy = spline(a[1])
        moved = vec2(history[4], history[5])
        # most particles near the gel lie behind others: its nodes are lower. Where it ends, the housing counts.
        ends = i < 0 or j < 0 or i + 2 > nx or j + 2 > ny
        if ends or x[2] < highest_near(gel, i, j) + radius + 0.25 * deepest:
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
                    gap = depth * n[2]  # overlap; negative where they have parted
                    if gap > deepest:  # an overlap found late must not explode; counted
                        gap = deepest
                        record_more(env, slot_of(part), layout.CAPPED, 1.0)
                    vr = v - vec3(vs[0], vs[1], vs[2])
                    vn = vr.dot(n)
                    under = vec2(x[0], x[1]) - moved
                    if holder != ON_GEL:
                        anchor, holder = under, ON_GEL
                    anchor, pressed = keep_force(anchor, under, k_n * gap, pressed, stiffened)
                    fn, held, pressed = normal_force(k_n * gap, pressed, c_n * vn, rate)
                    ft, anchor = cling(anchor, under, e1, e2, vr - vn * n, mu * held, k_t, c_n)
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
                        record_more(env, slot_of(part), layout.CAPPED, 1.0)
                    n = vec3(0.0, 0.0, 1.0)
                    under = vec2(x[0], x[1])
                    if holder != ON_HOUSING:
                        anchor, holder = under, ON_HOUSING
                    anchor, pressed = keep_force(anchor, under, k_n * gap, pressed, stiffened)
                    fn, held, pressed = normal_force(k_n * gap, pressed, c_n * v[2], rate)
                    e1, e2, vt = vec3(1.0, 0.0, 0.0), vec3(0.0, 1.0, 0.0), vec3(v[0], v[1], 0.0)
                    ft, anchor = cling(anchor, under, e1, e2, vt, mu * held, k_t, c_n)
                    force = fn * n + ft
                    in_contact, housed = True, True
                    overlap = gap
    remembered = ContactHistory([0.0, 0.0, FREE, 0.0, moved[0], moved[1], radius])
    if in_contact:
        remembered = ContactHistory([anchor[0], anchor[1], holder, pressed / k_n, moved[0], moved[1], radius])
        record_most(env, slot_of(part), layout.OVERLAP, overlap)
    return in_contact, housed, force, remembered
