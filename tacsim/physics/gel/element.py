"""The gel's element: a trilinear hexahedron with one-point quadrature and hourglass stiffness (Flanagan & Belytschko
1981), neo-Hookean. LANES neighbours are computed together, arranged as in tacsim/physics/body/transfers.py."""

from tacsim.compute.runtime import ti
from tacsim.physics.body.material import lanes_log
from tacsim.physics.exec import layout
from tacsim.physics.exec.lanes import LANES, hide_from_compiler, lanes, load_lanes, store_lanes, vec3
from tacsim.physics.gel.corner import add_corner_forces
from tacsim.physics.gel.tuning import HOURGLASS_STIFFNESS, MIN_SKEW, MIN_VOLUME_RATIO

# Rows of the local array of a block of elements: displacements of eight corners, axis by axis, later the forces on them
_rows = layout.Layout()
_rows.place(24)
INSIDE_ROW = _rows.place()  # 1 if the element is inside the gel, else 0
MIN_VOLUME_ROW = _rows.place()  # det F so far
HOURGLASS_FORCE_ROW = _rows.place()  # squared force of the hourglass modes
ROWS = _rows.size


@ti.func
def fill_row(rows: ti.template(), row, values):
    """Sets one number of all lanes."""
    for lane in ti.static(range(LANES)):
        rows[row, lane] = values[lane]


@ti.func
def element_block(
    env: ti.template(), gel: ti.template(), block, u, axis, layer, to, row, rows: ti.template()
):  # fmt: skip
    """Forces of LANES elements on their corners; records the smallest det F of each lane in row MIN_VOLUME_ROW.

    u: index of the displacement of the block's first node in `nodes`, `axis` and `layer` the index steps to the next of
    each; to: index of the forces in `corners`, `row` the index step to the next corner or axis.
    """
    h, mu, lam = [env.param(first + gel.index) for first in (layout.GEL_SPACING, layout.GEL_MU, layout.GEL_LAMBDA)]
    zero, quarter = env.count(layout.ZERO), 0.25 / h
    for d in range(3):  # not unrolled: kernels with more statements take much longer to compile
        for i, j, k in ti.static(ti.ndrange(2, 2, 2)):
            at = u + d * axis + k * layer + j + i * (gel.ny + 1)
            fill_row(rows, 8 * d + 4 * i + 2 * j + k, load_lanes(gel.nodes, at))
    fill_row(rows, INSIDE_ROW, gel.lattice[hide_from_compiler(zero, gel.lattice_start + block)])
    for lane in range(LANES):
        whole = rows[INSIDE_ROW, lane]
        area, stiffness = (0.25 * h * h) * whole, (HOURGLASS_STIFFNESS * 2.0 * mu * h / 8.0) * whole
        # columns of F; hourglass forces of the modes s_x s_y, s_y s_z, s_x s_z, s_x s_y s_z
        fx, fy, fz = vec3(1.0, 0.0, 0.0), vec3(0.0, 1.0, 0.0), vec3(0.0, 0.0, 1.0)
        hxy, hyz, hxz, hxyz = vec3(0.0), vec3(0.0), vec3(0.0), vec3(0.0)
        for d in ti.static(range(3)):
            a, b, c, e = rows[8 * d, lane], rows[8 * d + 1, lane], rows[8 * d + 2, lane], rows[8 * d + 3, lane]
            p, q, r, s = rows[8 * d + 4, lane], rows[8 * d + 5, lane], rows[8 * d + 6, lane], rows[8 * d + 7, lane]
            # sums and differences along z, then y, then x
            az, cz, pz, rz = b + a, e + c, q + p, s + r
            aw, cw, pw, rw = b - a, e - c, q - p, s - r
            left, right, left_y, right_y = cz + az, rz + pz, cz - az, rz - pz
            left_z, right_z, left_yz, right_yz = cw + aw, rw + pw, cw - aw, rw - pw
            fx[d] += quarter * (right - left)
            fy[d] += quarter * (left_y + right_y)
            fz[d] += quarter * (left_z + right_z)
            hxy[d] = stiffness * (right_y - left_y)
            hyz[d] = stiffness * (left_yz + right_yz)
            hxz[d] = stiffness * (right_z - left_z)
            hxyz[d] = stiffness * (right_yz - left_yz)
        rows[HOURGLASS_FORCE_ROW, lane] = hxy.norm_sqr() + hyz.norm_sqr() + hxz.norm_sqr() + hxyz.norm_sqr()
        x, y, z = fy.cross(fz), fz.cross(fx), fx.cross(fy)  # columns of the cofactor matrix
        jacobian = fx.dot(x)
        safe = ti.max(jacobian, MIN_VOLUME_RATIO)  # keeps the logarithm finite; the recorded minimum reports it
        # neo-Hooke: P = mu F + (lambda ln J - mu) cof(F) / J
        pressure = (lam * lanes_log(safe) - mu) / safe
        rows[MIN_VOLUME_ROW, lane] = ti.min(rows[MIN_VOLUME_ROW, lane], ti.select(whole > 0.0, jacobian, 1.0))
        for d in ti.static(range(3)):
            px = area * (mu * fx[d] + pressure * x[d])
            py = area * (mu * fy[d] + pressure * y[d])
            pz = area * (mu * fz[d] + pressure * z[d])
            # on corner (s_x, s_y, s_z) = -(s_x p_x + s_y p_y + s_z p_z + s_x s_y h_1 + ...), in two steps: y and z
            # first
            near, far = pz - hyz[d], pz + hyz[d]  # s_y = -1, 1
            left, right = px - hxy[d], px + hxy[d]
            skew_left, skew_right = hxz[d] - hxyz[d], hxz[d] + hxyz[d]
            yz = [py + near, py - near, far - py, -far - py]  # 00, 01, 10, 11
            odd = [left - skew_left, left + skew_left, right - skew_right, right + skew_right]
            for k in ti.static(range(4)):
                rows[3 * k + d, lane] = yz[k] + odd[k]
                rows[12 + 3 * k + d, lane] = yz[k] - odd[k]
    for r in range(24):
        store_lanes(gel.corners, to + r * row, lanes([rows[r, lane] for lane in range(LANES)]), zero)
    largest = 0.0
    for lane in range(LANES):
        largest = ti.max(largest, rows[HOURGLASS_FORCE_ROW, lane])
    if largest > (MIN_SKEW * HOURGLASS_STIFFNESS * mu * h * h) ** 2:
        add_corner_forces(env, gel, block, u, axis, layer, to, row)
