"""Signed distance from rigid indenters, and its gradient."""

from typing import Any, NamedTuple

from tacsim.compute.runtime import ti
from tacsim.physics.exec import layout
from tacsim.physics.exec.lanes import vec3

SPHERE, CYLINDER, BOX, GRID = range(4)
UNKNOWN_DISTANCE = 1e9  # outside of the distance grid


class DistanceGrid(NamedTuple):
    """Distance grid of one environment's mesh inside a kernel: `values` has `nodes` values, the first is node
    `first`."""

    values: Any
    first: Any
    nodes: Any
    origin: Any
    spacing: Any


@ti.func
def corner_distance(d, sign):
    """Distance and gradient of the region in which all of d <= 0; sign: direction of each axis."""
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
def box_distance(size, y):
    """Distance and outward normal of a box of half extents `size`."""
    return corner_distance(ti.abs(y) - size, direction(y))


@ti.func
def signed_distance(env: ti.template(), kind, size, y, grid: ti.template()):
    """Distance from the indenter's surface (negative inside) and its outward normal, at y in the indenter's frame.

    size: half extents of a box; radius, -, half height of a cylinder; radius of a sphere; half extents of the bounding
    box of a mesh. The grid of a mesh covers the part that can touch (`PressState.cover`).
    """
    phi, n = UNKNOWN_DISTANCE, vec3(0.0, 0.0, 1.0)
    rounding = env.param(layout.EDGE_RADIUS)
    if kind == SPHERE:
        r = y.norm()
        phi = r - size[0]
        n = y / ti.max(r, 1e-12)
    elif kind == BOX:
        phi, n = box_distance(size - rounding, y)
        phi -= rounding
    elif kind == CYLINDER:
        r = ti.sqrt(y[0] * y[0] + y[1] * y[1])
        beyond = vec3(r - size[0] + rounding, -UNKNOWN_DISTANCE, ti.abs(y[2]) - size[2] + rounding)
        phi, radial = corner_distance(beyond, vec3(1.0))
        phi -= rounding
        n = vec3(radial[0] * y[0] / ti.max(r, 1e-12), radial[0] * y[1] / ti.max(r, 1e-12), radial[2] * direction(y)[2])
    else:
        at = (y - grid.origin) / grid.spacing
        whole = ti.floor(at)
        cell, w = whole.cast(ti.i32) - grid.first, at - whole
        known = True
        for d in ti.static(range(3)):
            known = known and cell[d] >= 0 and cell[d] < grid.nodes[d] - 1
        if known:
            phi = 0.0
            n = vec3(0.0)
            for a, b, c in ti.static(ti.ndrange(2, 2, 2)):
                wx, wy, wz = (w[0] if a else 1.0 - w[0]), (w[1] if b else 1.0 - w[1]), (w[2] if c else 1.0 - w[2])
                value = grid.values[env.index, cell[0] + a, cell[1] + b, cell[2] + c]
                phi += value * wx * wy * wz
                n += value * vec3((2 * a - 1) * wy * wz, (2 * b - 1) * wx * wz, (2 * c - 1) * wx * wy)
            n = n / ti.max(n.norm(), 1e-12)
    return phi, n
