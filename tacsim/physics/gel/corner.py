"""Corner forces: they prevent the inversion of an element at a corner, which its one integration point does not
resolve.

A corner and its three neighbours span a tetrahedron. Where its volume is below a share of the volume at rest, it has a
pressure with a bulk modulus of the gel's P-wave modulus. The forces are along the gradients of that volume; their sum
and their moment are zero.
"""

from tacsim.compute.runtime import ti
from tacsim.physics.exec import layout
from tacsim.physics.exec.lanes import LANES, vec3
from tacsim.physics.gel.tuning import CORNER_STIFFNESS, MAX_CORNER_FREQUENCY, MIN_CORNER_RATIO


@ti.func
def node_displacement(gel: ti.template(), u, axis, layer, i, j, k):
    at = u + k * layer + j + i * (gel.ny + 1)
    return vec3([gel.nodes[at + d * axis] for d in range(3)])


@ti.func
def add_corner_forces(env: ti.template(), gel: ti.template(), block, u, axis, layer, to, row):
    """Adds the forces of narrow corners to those of a block of elements; arguments as of `element_block`."""
    h, mu, lam = [env.param(first + gel.index) for first in (layout.GEL_SPACING, layout.GEL_MU, layout.GEL_LAMBDA)]
    stiffness = lam + 2.0 * mu
    share, dt = CORNER_STIFFNESS * stiffness * h * h / 8.0, env.param(layout.STEP)
    max_stiffness = MAX_CORNER_FREQUENCY * env.param(layout.GEL_DENSITY + gel.index) * (h * h / dt) ** 2 / 2.0
    for lane in range(LANES):
        if gel.lattice[gel.lattice_start + block][lane] > 0.0:
            for corner in range(8):
                i, j, k = corner // 4, corner // 2 % 2, corner % 2
                sx, sy, sz = 1.0 - 2.0 * i, 1.0 - 2.0 * j, 1.0 - 2.0 * k
                here = node_displacement(gel, u + lane, axis, layer, i, j, k)
                # edges, over their length at rest
                ex = sx / h * (node_displacement(gel, u + lane, axis, layer, 1 - i, j, k) - here) + vec3(1.0, 0.0, 0.0)
                ey = sy / h * (node_displacement(gel, u + lane, axis, layer, i, 1 - j, k) - here) + vec3(0.0, 1.0, 0.0)
                ez = sz / h * (node_displacement(gel, u + lane, axis, layer, i, j, 1 - k) - here) + vec3(0.0, 0.0, 1.0)
                x, y, z = ey.cross(ez), ez.cross(ex), ex.cross(ey)
                deficit = MIN_CORNER_RATIO - ex.dot(x)
                if deficit > 0.0:
                    square = x.norm_sqr() + y.norm_sqr() + z.norm_sqr() + (sx * x + sy * y + sz * z).norm_sqr()
                    push = ti.min(share, max_stiffness / square) * deficit
                    fx, fy, fz = push * sx * x, push * sy * y, push * sz * z
                    for d in ti.static(range(3)):
                        at = to + lane + d * row
                        gel.corners[at + 3 * row * (4 * (1 - i) + 2 * j + k)] += fx[d]
                        gel.corners[at + 3 * row * (4 * i + 2 * (1 - j) + k)] += fy[d]
                        gel.corners[at + 3 * row * (4 * i + 2 * j + 1 - k)] += fz[d]
                        gel.corners[at + 3 * row * corner] -= fx[d] + fy[d] + fz[d]
