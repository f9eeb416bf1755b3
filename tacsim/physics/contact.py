"""Contact: particles against the deformed gel surface and its housing; friction with memory.

The gel surface is the C1 quadratic B-spline over its top nodes; the renderer draws the same surface. The normal force
is a penalty plus a multiplier that remembers (augmented Lagrangian, Simo & Laursen 1992), so that nothing overlaps at
rest. Coulomb friction acts by an elastic slip with memory (Cundall & Strack 1979): without it, friction creeps and
holds nothing.
"""

from tacsim.physics.material import vec3, vec4
from tacsim.runtime import ti

vec2 = ti.types.vector(2, ti.f32)

CONTACT_DAMPING = 0.3  # c = 0.3 k dt = 0.3 m / dt, for normal and tangential motion
TANGENT_STIFFNESS = 0.5  # k_t / k_n
MULTIPLIER_RATE = 0.05  # share of the penalty force that the multiplier takes over each substep


@ti.func
def spline(a):
    """First node of the 3-node stencil round lattice coordinate a, weights, and their derivatives by a."""
    first = int(ti.floor(a + 0.5)) - 1
    t = a - first
    w = vec3(0.5 * (1.5 - t) ** 2, 0.75 - (t - 1.0) ** 2, 0.5 * (t - 0.5) ** 2)
    d = vec3(t - 1.5, -2.0 * (t - 1.0), t - 0.5)
    return first, w, d


@ti.func
def top_node(u: ti.template(), g, i, j):
    """Index of the surface node (i, j), repeated beyond the rim."""
    return ti.Vector([g, ti.max(0, ti.min(i, u.shape[1] - 1)), ti.max(0, ti.min(j, u.shape[2] - 1)), u.shape[3] - 1])


@ti.func
def displacement_at(u: ti.template(), g, a):
    i, wx, _ = spline(a[0])
    j, wy, _ = spline(a[1])
    us = vec3(0.0)
    for p, q in ti.static(ti.ndrange(3, 3)):
        us += (wx[p] * wy[q]) * u[top_node(u, g, i + p, j + q)]
    return us


@ti.func
def material_point(u: ti.template(), g, x, h):
    """Lattice coordinates a of the surface point now under (x, y): three fixed-point steps of a h + u(a) = x."""
    nx, ny = float(u.shape[1] - 1), float(u.shape[2] - 1)
    start = vec2(x[0] / h + 0.5 * nx, x[1] / h + 0.5 * ny)
    a = start
    us = vec3(0.0)
    for _ in ti.static(range(3)):
        us = displacement_at(u, g, vec2(ti.max(0.0, ti.min(a[0], nx)), ti.max(0.0, ti.min(a[1], ny))))
        a = start - vec2(us[0], us[1]) / h
    return a, us


@ti.func
def friction(slip, n, vt, fn, k_t, c_t, mu, dt):
    """Coulomb with stick memory. Returns the tangential force on the particle and the new elastic slip."""
    slip -= slip.dot(n) * n
    slip += dt * vt
    ft = -k_t * slip - c_t * vt
    size, limit = ft.norm(), mu * fn
    if size > limit:
        ft *= limit / size
        length = slip.norm()
        if k_t * length > limit:
            slip *= limit / (k_t * length)
    return ft, slip


@ti.func
def support_radius(plane, spacing):
    """Distance of a particle from the body's surface: 1 / |plane|; half a spacing where it knows none (plane = 0).

    plane: the nearest surface's tangent plane, outward normal over distance [1/mm], see body_surface.py.
    """
    size = plane.norm()
    radius = 0.5 * spacing
    if size > 0.0:
        radius = ti.min(1.0 / size, spacing)  # a plane torn further away is no longer this particle's to speak for
    return radius


@ti.func
def contact_ceiling(u: ti.template(), g):
    """Height of the highest surface node [mm], at least 0: the spline stays below it, and what is above touches not."""
    highest = 0.0
    for i in range(u.shape[1]):
        for j in range(u.shape[2]):
            highest = ti.max(highest, u[g, i, j, u.shape[3] - 1][2])
    return highest


@ti.func
def particle_contact(
    g, x, v, memory, u: ti.template(), gv: ti.template(), gf: ti.template(), h, radius, deepest, k_n, mu, housing, dt,
    health: ti.template(),
):  # fmt: skip
    """Force on one particle from gel g (or its housing); all in the sensor frame. The opposite acts on the gel's nodes.

    x, v: position, and velocity relative to the moving sensor. memory: elastic slip, and the multiplier as the overlap
    whose penalty it equals [mm]. deepest: largest overlap answered in full [mm]. Returns touching, force, new memory,
    overlap.
    """
    nx, ny = float(u.shape[1] - 1), float(u.shape[2] - 1)
    touching = False
    force = vec3(0.0)
    slip = vec3(memory[0], memory[1], memory[2])
    taken = memory[3]
    overlap = 0.0
    reach = 2.2 * 0.5 * h
    thickness = h * (u.shape[3] - 1)
    c_n = CONTACT_DAMPING * k_n * dt
    if x[2] > -1.2 * thickness and ti.abs(x[0]) < reach * nx and ti.abs(x[1]) < reach * ny:
        a, us = material_point(u, g, x, h)
        inside = a[0] > 0.0 and a[1] > 0.0 and a[0] < nx and a[1] < ny
        if inside:
            depth = us[2] + radius - x[2]
            if depth + taken > 0.0:
                i, wx, dx = spline(a[0])
                j, wy, dy = spline(a[1])
                t1, t2, vs = vec3(1.0, 0.0, 0.0), vec3(0.0, 1.0, 0.0), vec3(0.0)
                for p, q in ti.static(ti.ndrange(3, 3)):
                    node = top_node(u, g, i + p, j + q)
                    t1 += (dx[p] * wy[q] / h) * u[node]
                    t2 += (wx[p] * dy[q] / h) * u[node]
                    vs += (wx[p] * wy[q]) * gv[node]
                n = t1.cross(t2).normalized()
                gap = depth * n[2]  # overlap; negative where they have parted
                if gap > deepest:  # an overlap found late must not explode; counted
                    gap = deepest
                    health[4] += 1.0
                vr = v - vs
                vn = vr.dot(n)
                fn = ti.max(k_n * (gap + taken) - c_n * vn, 0.0)
                taken = ti.max(taken + MULTIPLIER_RATE * gap, 0.0)
                ft, slip = friction(slip, n, vr - vn * n, fn, TANGENT_STIFFNESS * k_n, c_n, mu, dt)
                force = fn * n + ft
                touching = True
                overlap = gap
                for p, q in ti.static(ti.ndrange(3, 3)):
                    node = top_node(u, g, i + p, j + q)
                    gf[node] = gf[node] - (wx[p] * wy[q]) * force
        elif housing >= 0.0:
            gap = radius - housing - x[2]
            if gap + taken > 0.0:
                if gap > deepest:
                    gap = deepest
                    health[4] += 1.0
                n = vec3(0.0, 0.0, 1.0)
                fn = ti.max(k_n * (gap + taken) - c_n * v[2], 0.0)
                taken = ti.max(taken + MULTIPLIER_RATE * gap, 0.0)
                ft, slip = friction(slip, n, vec3(v[0], v[1], 0.0), fn, TANGENT_STIFFNESS * k_n, c_n, mu, dt)
                force = fn * n + ft
                touching = True
                overlap = gap
    kept = vec4(0.0)
    if touching:
        kept = vec4(slip[0], slip[1], slip[2], taken)
    return touching, force, kept, overlap
