"""Small kernels that drive the product's own laws, transfers and elements directly, where no World has the boundary
conditions of a closed form. Units as in the physics: mm, N, MPa, wave speed 1."""

from tacsim.physics.gel import Nodes, gel_advance, gel_forces
from tacsim.physics.material import convect, hencky_return, mat3, vec3, vec4
from tacsim.physics.plasticine import Grid, Matrices, Strains, Vectors, clear_grid, grid_to_particles, particles_to_grid
from tacsim.runtime import ti

Scalars = ti.types.ndarray(dtype=ti.f32, ndim=1)


@ti.kernel
def body_substeps(
    n: ti.i32, dt: ti.f32, x: Vectors, v: Vectors, c: Matrices, e: Strains, grid: Grid,
    ox: ti.f32, oy: ti.f32, oz: ti.f32, spacing: ti.f32, mu: ti.f32, bulk: ti.f32, limit: ti.f32,
    keep_x: ti.f32, keep_y: ti.f32, keep_z: ti.f32, health: Scalars,
):  # fmt: skip
    """A free body, no damping; `keep` 0 forbids motion along an axis, 1 allows it."""
    ti.loop_config(serialize=True)
    for _ in range(n):
        cell, volume = 2.0 * spacing, spacing * spacing * spacing
        mass = (bulk + 4.0 / 3.0 * mu) * volume
        origin = vec3(ox, oy, oz)
        clear_grid(grid)
        particles_to_grid(x, v, c, e, grid, origin, cell, mass, volume, mu, bulk, limit, dt, health)
        for i in range(grid.shape[0]):
            for j in range(grid.shape[1]):
                for k in range(grid.shape[2]):
                    q = grid[i, j, k]
                    if q[3] > 0.0:
                        grid[i, j, k] = vec4(keep_x * q[0] / q[3], keep_y * q[1] / q[3], keep_z * q[2] / q[3], q[3])
        grid_to_particles(x, v, c, e, grid, origin, cell, dt, health)


@ti.kernel
def gel_substeps(
    n: ti.i32, dt: ti.f32, u: Nodes, v: Nodes, f: Nodes, h: ti.f32, mu: ti.f32, lam: ti.f32, damping: ti.f32,
    keep_x: ti.f32, keep_y: ti.f32, keep_z: ti.f32, driven: ti.i32, speed: ti.f32, backing: Scalars, health: Scalars,
):  # fmt: skip
    """A gel on its backing; `keep` as above. If `driven`, the top moves along z with `speed`."""
    ti.loop_config(serialize=True)
    for _ in range(n):
        gel_forces(0, u, f, h, mu, lam, health)
        held = gel_advance(0, u, v, f, h, lam + 2.0 * mu, damping, dt)
        for d in ti.static(range(3)):
            backing[d] = held[d]
        top = u.shape[3] - 1
        for i in range(u.shape[1]):
            for j in range(u.shape[2]):
                for k in range(1, u.shape[3]):
                    before = v[0, i, j, k]
                    after = before * vec3(keep_x, keep_y, keep_z)
                    if driven == 1 and k == top:
                        after[2] = speed
                    v[0, i, j, k] = after
                    u[0, i, j, k] = u[0, i, j, k] + dt * (after - before)


@ti.kernel
def shear_points(n: ti.i32, step: ti.f32, e: Strains, tau: Strains, mu: ti.f32, bulk: ti.f32, limit: ti.f32):
    """Material points in simple shear: n increments of d(v_x)/dy, each followed by the return mapping."""
    for p in range(e.shape[0]):
        for _ in range(n):
            moved = convect(e[p], mat3([[0.0, step, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]]))
            elastic, stress = hencky_return(moved, mu, bulk, limit)
            e[p] = elastic
            tau[p] = stress
