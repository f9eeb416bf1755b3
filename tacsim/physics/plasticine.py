"""Elastoplastic body: APIC MLS-MPM with quadratic B-splines; elastic state e = b_e - I per particle.

Hu et al. 2018 (MLS-MPM), Jiang et al. 2015 (APIC). Inside: mm, N, MPa; density scaled so that the P-wave speed is 1.
"""

import math
from dataclasses import dataclass

import numpy as np

from tacsim.physics.gel import MM, MPA
from tacsim.physics.material import convect, full, hencky_return, mat3, vec3, vec4, vec6
from tacsim.runtime import ti
from tacsim.scene import BodyMaterial, lame

Vectors = ti.types.ndarray(dtype=vec3, ndim=1)
Matrices = ti.types.ndarray(dtype=mat3, ndim=1)
Strains = ti.types.ndarray(dtype=vec6, ndim=1)
Grid = ti.types.ndarray(dtype=vec4, ndim=3)

ELASTIC = 1e9  # strain limit that is never reached


@dataclass(frozen=True)
class BodyFacts:
    """The body's material and resolution in kernel units."""

    spacing: float  # particle spacing h_p [mm]
    mu: float  # [MPa]
    bulk: float  # [MPa]
    limit: float  # k = sigma_y / (2 mu) [-]
    volume: float  # of one particle [mm^3]; about h_p^3

    @property
    def density(self) -> float:
        return self.bulk + 4.0 / 3.0 * self.mu

    @property
    def cell(self) -> float:
        """Grid spacing dx: 8 particles a cell."""
        return 2 * self.spacing

    @property
    def particle_mass(self) -> float:
        return self.density * self.volume


def body_facts(material: BodyMaterial, spacing: float, volume: float | None = None) -> BodyFacts:
    """`spacing` [m]; `volume` of one particle [m^3], without it spacing^3."""
    mu, lam = lame(material)
    limit = material.elastic_limit
    return BodyFacts(
        spacing * MM,
        mu * MPA,
        (lam + 2 * mu / 3) * MPA,
        limit if math.isfinite(limit) else ELASTIC,
        (spacing**3 if volume is None else volume) * MM**3,
    )


@dataclass
class BodyState:
    """Position, velocity, affine velocity and elastic strain of n particles, and the grid they share."""

    x: np.ndarray  # (n, 3)
    v: np.ndarray  # (n, 3)
    c: np.ndarray  # (n, 3, 3)
    e: np.ndarray  # (n, 6)


def body_state(points: np.ndarray) -> BodyState:
    n = len(points)
    return BodyState(
        np.ascontiguousarray(points, np.float32),
        np.zeros((n, 3), np.float32),
        np.zeros((n, 3, 3), np.float32),
        np.zeros((n, 6), np.float32),
    )


def fit_grid(x: np.ndarray, cell: float, margin: float) -> tuple[np.ndarray, tuple[int, int, int]]:
    """Origin and node counts of a grid round the particles: the grid follows the body, so no index is ever clamped."""
    low = np.floor((x.min(axis=0) - margin) / cell) * cell
    counts = np.ceil((x.max(axis=0) + margin - low) / cell).astype(int) + 3
    return low.astype(np.float32), (int(counts[0]), int(counts[1]), int(counts[2]))


@ti.func
def stencil(x, origin, cell, shape):
    """First node of the 3x3x3 stencil, offset from it, weights by axis; `inside` is False off the grid (or NaN)."""
    s = (x - origin) / cell
    inside = True
    for d in ti.static(range(3)):
        inside = inside and s[d] >= 0.5 and s[d] < shape[d] - 2.0
    base = ti.Vector([0, 0, 0])
    if inside:
        base = ti.floor(s - 0.5).cast(ti.i32)
    fx = s - base.cast(ti.f32)
    w0 = 0.5 * (1.5 - fx) ** 2
    w1 = 0.75 - (fx - 1.0) ** 2
    w2 = 0.5 * (fx - 0.5) ** 2
    return inside, base, fx, w0, w1, w2


@ti.func
def clear_grid(grid: ti.template()):
    for i in range(grid.shape[0]):
        for j in range(grid.shape[1]):
            for k in range(grid.shape[2]):
                grid[i, j, k] = vec4(0.0)


@ti.func
def particles_to_grid(
    x: ti.template(), v: ti.template(), c: ti.template(), e: ti.template(), grid: ti.template(),
    origin, cell, mass, volume, mu, bulk, limit, dt, health: ti.template(),
):  # fmt: skip
    """Return mapping, then momentum and mass of each particle onto its 27 nodes."""
    shape = vec3(grid.shape[0], grid.shape[1], grid.shape[2])
    for p in range(x.shape[0]):
        inside, base, fx, w0, w1, w2 = stencil(x[p], origin, cell, shape)
        if not inside:
            health[1] += 1.0
        else:
            elastic, tau = hencky_return(e[p], mu, bulk, limit)
            e[p] = elastic
            affine = (-dt * volume * 4.0 / cell) * full(tau) + (mass * cell) * c[p]
            momentum = mass * v[p] - affine @ fx
            q = vec4(momentum[0], momentum[1], momentum[2], mass)
            ax = vec4(affine[0, 0], affine[1, 0], affine[2, 0], 0.0)
            ay = vec4(affine[0, 1], affine[1, 1], affine[2, 1], 0.0)
            az = vec4(affine[0, 2], affine[1, 2], affine[2, 2], 0.0)
            w = ti.Matrix.cols([w0, w1, w2])
            for i, j in ti.static(ti.ndrange(3, 3)):
                qij = q + ax * float(i) + ay * float(j)
                wij = w[0, i] * w[1, j]
                for k in ti.static(range(3)):
                    node = base + ti.Vector([i, j, k])
                    grid[node] = grid[node] + (wij * w[2, k]) * (qij + az * float(k))


@ti.func
def grid_to_particles(
    x: ti.template(), v: ti.template(), c: ti.template(), e: ti.template(), grid: ti.template(),
    origin, cell, dt, health: ti.template(),
):  # fmt: skip
    """Velocity and affine velocity back to the particles; strain and position follow. Returns the sum of velocities."""
    shape = vec3(grid.shape[0], grid.shape[1], grid.shape[2])
    total = vec3(0.0)
    for p in range(x.shape[0]):
        inside, base, fx, w0, w1, w2 = stencil(x[p], origin, cell, shape)
        if inside:
            w = ti.Matrix.cols([w0, w1, w2])
            velocity, cx, cy, cz = vec3(0.0), vec3(0.0), vec3(0.0), vec3(0.0)
            for i in ti.static(range(3)):
                vi, yi, zi = vec3(0.0), vec3(0.0), vec3(0.0)
                for j in ti.static(range(3)):
                    vj, zj = vec3(0.0), vec3(0.0)
                    for k in ti.static(range(3)):
                        q = grid[base + ti.Vector([i, j, k])]
                        gv = vec3(q[0], q[1], q[2]) * w[2, k]
                        vj += gv
                        zj += gv * float(k)
                    vi += w[1, j] * vj
                    yi += (w[1, j] * float(j)) * vj
                    zi += w[1, j] * zj
                velocity += w[0, i] * vi
                cx += (w[0, i] * float(i)) * vi
                cy += w[0, i] * yi
                cz += w[0, i] * zi
            affine = (4.0 / cell) * (ti.Matrix.cols([cx, cy, cz]) - velocity.outer_product(fx))
            step = dt * affine
            health[2] = ti.min(health[2], (mat3([[1, 0, 0], [0, 1, 0], [0, 0, 1]]) + step).determinant())
            health[3] = ti.max(health[3], ti.max(ti.abs(velocity[0]), ti.abs(velocity[1]), ti.abs(velocity[2])))
            e[p] = convect(e[p], step)
            v[p] = velocity
            c[p] = affine
            x[p] = x[p] + dt * velocity
            total += velocity
    return total


@ti.func
def convect_planes(planes: ti.template(), c: ti.template(), dt):
    """Tangent planes of the body's surface go with the material, as F^-T does: m' = -C^T m. m = 0 stays 0."""
    for p in range(planes.shape[0]):
        planes[p] = planes[p] - dt * (c[p].transpose() @ planes[p])
