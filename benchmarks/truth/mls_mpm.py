"""MLS-MPM as in the paper (Hu et al. 2018, "A moving least squares material point method"; APIC: Jiang et al.
2015): one material, a singular value decomposition for every particle in every substep, sums by atomics, not optimised.

One substep: `clear`, `particles_to_grid`, `grid_update`, `grid_to_particles`. Tests compare the transfers
of tacsim/physics/body with it stage by stage, benchmarks measure both. Units: mm, N, MPa, wave speed 1.
"""

from tacsim.compute.runtime import ti

f32 = ti.f32
vec3 = ti.types.vector(3, f32)
mat3 = ti.types.matrix(3, 3, f32)
Vectors = ti.types.ndarray(dtype=vec3, ndim=1)
Matrices = ti.types.ndarray(dtype=mat3, ndim=1)
GridVectors = ti.types.ndarray(dtype=vec3, ndim=3)
GridScalars = ti.types.ndarray(dtype=f32, ndim=3)


@ti.dataclass
class Material:
    """Constants of one particle: Hencky elasticity with von Mises yield."""

    mass: f32
    volume: f32
    mu: f32
    lam: f32
    limit: f32  # |dev e| at yield, sigma_y / (2 mu)


@ti.func
def weights(fx):
    """Quadratic B-spline: weights of three nodes by axis, fx cells behind the particle's first."""
    return [0.5 * (1.5 - fx) ** 2, 0.75 - (fx - 1.0) ** 2, 0.5 * (fx - 0.5) ** 2]


@ti.func
def return_mapping(F, material):
    """Elastic F and Kirchhoff stress 2 mu e + lambda tr(e) I of the Hencky strain e, its deviator cut to the limit."""
    u, sigma, w = ti.svd(F)
    strain = vec3(ti.log(sigma[0, 0]), ti.log(sigma[1, 1]), ti.log(sigma[2, 2]))
    mean = strain.sum() / 3.0
    deviator = strain - mean
    norm = deviator.norm()
    elastic = F
    if norm > material.limit:
        deviator *= material.limit / norm
        strain = deviator + mean
        stretch = ti.exp(strain)
        elastic = u @ mat3([[stretch[0], 0, 0], [0, stretch[1], 0], [0, 0, stretch[2]]]) @ w.transpose()
    tau = 2.0 * material.mu * strain + 3.0 * material.lam * mean
    return elastic, u @ mat3([[tau[0], 0, 0], [0, tau[1], 0], [0, 0, tau[2]]]) @ u.transpose()


@ti.kernel
def clear(momentum: GridVectors, mass: GridScalars):
    for node in ti.grouped(mass):
        momentum[node] = vec3(0.0)
        mass[node] = 0.0


@ti.kernel
def particles_to_grid(
    x: Vectors, v: Vectors, C: Matrices, F: Matrices, momentum: GridVectors, mass: GridScalars, dx: f32, dt: f32,
    material: Material,
):  # fmt: skip
    """F <- return mapping of (I + dt C) F, then P2G: m v + (m C - dt V 4/dx^2 tau) (x_i - x_p) by weights."""
    for p in x:
        elastic, stress = return_mapping((ti.Matrix.identity(f32, 3) + dt * C[p]) @ F[p], material)
        F[p] = elastic
        affine = (-dt * material.volume * 4.0 / (dx * dx)) * stress + material.mass * C[p]
        base = ti.floor(x[p] / dx - 0.5).cast(ti.i32)
        fx = x[p] / dx - base.cast(f32)
        w = weights(fx)
        for i, j, k in ti.static(ti.ndrange(3, 3, 3)):
            offset = ti.Vector([i, j, k])
            share = w[i][0] * w[j][1] * w[k][2]
            momentum[base + offset] += share * (material.mass * v[p] + affine @ ((offset.cast(f32) - fx) * dx))
            mass[base + offset] += share * material.mass


@ti.kernel
def grid_update(momentum: GridVectors, mass: GridScalars, dt: f32, gravity: vec3):
    """Momentum to velocity, in place."""
    for node in ti.grouped(mass):
        if mass[node] > 0.0:
            momentum[node] = momentum[node] / mass[node] + dt * gravity


@ti.kernel
def grid_to_particles(x: Vectors, v: Vectors, C: Matrices, velocity: GridVectors, dx: f32, dt: f32):
    """G2P: v = sum w v_i, C = 4/dx^2 sum w v_i (x_i - x_p)^T; then x <- x + dt v."""
    for p in x:
        base = ti.floor(x[p] / dx - 0.5).cast(ti.i32)
        fx = x[p] / dx - base.cast(f32)
        w = weights(fx)
        new_v, new_C = vec3(0.0), mat3(0.0)
        for i, j, k in ti.static(ti.ndrange(3, 3, 3)):
            offset = ti.Vector([i, j, k])
            share = w[i][0] * w[j][1] * w[k][2]
            at = velocity[base + offset]
            new_v += share * at
            new_C += (4.0 / dx) * share * at.outer_product(offset.cast(f32) - fx)
        v[p], C[p] = new_v, new_C
        x[p] = x[p] + dt * new_v
