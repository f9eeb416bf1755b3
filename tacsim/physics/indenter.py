"""A rigid indenter on the gel surface: signed distance, and contact by area-weighted quadrature on the surface.

Each surface cell carries 3 x 3 points of equal area. Normal pressure is a penalty plus a multiplier that remembers
(augmented Lagrangian, Simo & Laursen 1992), so that at rest nothing overlaps; friction remembers its elastic slip.
Everything is in the sensor frame [mm, MPa].
"""

from tacsim.physics.contact import CONTACT_DAMPING, TANGENT_STIFFNESS, friction, spline, top_node
from tacsim.physics.material import vec3
from tacsim.runtime import ti

SPHERE, CYLINDER, BOX, GRID = 0, 1, 2, 3
POINTS = 3  # quadrature points along one edge of a surface cell
FAR = 1e9
MULTIPLIER_RATE = 0.05  # share of the penalty force that the multiplier takes over each substep


@ti.func
def corner_distance(d, sign):
    """Distance and gradient of the region where all of d <= 0; sign: direction of each axis."""
    outside = ti.max(d, 0.0)
    length = outside.norm()
    n = vec3(0.0)
    phi = length
    if length > 0.0:
        n = outside / length
    else:
        phi = ti.max(d[0], d[1], d[2])
        if d[0] == phi:
            n = vec3(1.0, 0.0, 0.0)
        elif d[1] == phi:
            n = vec3(0.0, 1.0, 0.0)
        else:
            n = vec3(0.0, 0.0, 1.0)
    return phi, n * sign


@ti.func
def direction(y):
    s = vec3(1.0)
    for d in ti.static(range(3)):
        if y[d] < 0.0:
            s[d] = -1.0
    return s


@ti.func
def signed_distance(kind, size, y, values: ti.template(), origin, spacing):
    """Distance from the indenter's surface (negative inside) and its outward normal, at y in the indenter's frame.

    size: half extents of a box; radius, -, half height of a cylinder; radius of a sphere.
    """
    phi, n = FAR, vec3(0.0, 0.0, 1.0)
    if kind == SPHERE:
        r = y.norm()
        phi = r - size[0]
        n = y / ti.max(r, 1e-12)
    elif kind == BOX:
        phi, n = corner_distance(ti.abs(y) - size, direction(y))
    elif kind == CYLINDER:
        r = ti.sqrt(y[0] * y[0] + y[1] * y[1])
        phi, radial = corner_distance(vec3(r - size[0], -FAR, ti.abs(y[2]) - size[2]), vec3(1.0))
        n = vec3(radial[0] * y[0] / ti.max(r, 1e-12), radial[0] * y[1] / ti.max(r, 1e-12), radial[2] * direction(y)[2])
    else:
        at = (y - origin) / spacing
        known = True
        for d in ti.static(range(3)):
            known = known and at[d] >= 0.0 and at[d] < values.shape[d] - 1
        if known:
            cell = ti.floor(at).cast(ti.i32)
            w = at - cell.cast(ti.f32)
            phi = 0.0
            n = vec3(0.0)
            for a, b, c in ti.static(ti.ndrange(2, 2, 2)):
                wx, wy, wz = (w[0] if a else 1.0 - w[0]), (w[1] if b else 1.0 - w[1]), (w[2] if c else 1.0 - w[2])
                value = values[cell + ti.Vector([a, b, c])]
                phi += value * wx * wy * wz
                n += value * vec3((2 * a - 1) * wy * wz, (2 * b - 1) * wx * wz, (2 * c - 1) * wx * wy)
            n = n / ti.max(n.norm(), 1e-12)
    return phi, n


@ti.func
def indent(
    u: ti.template(), gv: ti.template(), gf: ti.template(), h, slip: ti.template(), pressure: ti.template(),
    kind, size, values: ti.template(), grid_origin, grid_spacing, rotate, centre, velocity, spin,
    k_n, mu, dt, health: ti.template(),
):  # fmt: skip
    """Contact of the indenter with gel 0. Returns force and moment of the indenter on the sensor, sensor axes.

    k_n: penalty [MPa/mm]; slip, pressure: memory of each quadrature point.
    """
    nx, ny = u.shape[1] - 1, u.shape[2] - 1
    area = h * h / (POINTS * POINTS)
    c_n = CONTACT_DAMPING * k_n * dt
    back = rotate.transpose()
    total, moment = vec3(0.0), vec3(0.0)
    for i in range(nx * POINTS):
        a = (i + 0.5) / POINTS
        first_i, wx, _dx = spline(a)
        for j in range(ny * POINTS):
            b = (j + 0.5) / POINTS
            first_j, wy, _dy = spline(b)
            us, vs = vec3(0.0), vec3(0.0)
            for p, q in ti.static(ti.ndrange(3, 3)):
                node = top_node(u, 0, first_i + p, first_j + q)
                us += (wx[p] * wy[q]) * u[node]
                vs += (wx[p] * wy[q]) * gv[node]
            x = vec3((a - 0.5 * nx) * h, (b - 0.5 * ny) * h, 0.0) + us
            phi, n_local = signed_distance(kind, size, back @ (x - centre), values, grid_origin, grid_spacing)
            touching = False
            if phi < 0.5 * h:
                n = rotate @ n_local  # out of the indenter: pushes the gel
                moving = velocity + spin.cross(x - centre) - vs  # indenter relative to gel
                closing = moving.dot(n)
                normal = pressure[i, j] - k_n * phi + c_n * closing
                if normal > 0.0:
                    touching = True
                    ft, memory = friction(
                        slip[i, j], n, moving - closing * n, normal, TANGENT_STIFFNESS * k_n, c_n, mu, dt
                    )
                    slip[i, j] = memory
                    pressure[i, j] = ti.max(pressure[i, j] - MULTIPLIER_RATE * k_n * phi, 0.0)
                    force = area * (normal * n - ft)
                    total += force
                    moment += x.cross(force)
                    health[5] = ti.max(health[5], -phi)
                    for p, q in ti.static(ti.ndrange(3, 3)):
                        node = top_node(u, 0, first_i + p, first_j + q)
                        gf[node] = gf[node] + (wx[p] * wy[q]) * force
            if not touching:
                slip[i, j] = vec3(0.0)
                pressure[i, j] = 0.0
    return total, moment
