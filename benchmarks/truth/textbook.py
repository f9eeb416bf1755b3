"""The method as textbooks print it: one material, MLS-MPM with a singular value decomposition for every particle in
every substep, particle adds by atomics (Hu et al. 2018; Jiang et al. 2015). A cube between two frictionless plates,
which are planes of grid nodes. All cores at once; nothing tuned. Units: mm, N, MPa, wave speed 1."""

from functools import partial

import numpy as np

from benchmarks.harness.measure import Measurement, step_cost, timed
from benchmarks.truth.clay import CLAY, COURANT, uniaxial_stress
from tacsim.compute.runtime import start, ti

f32 = ti.f32
vec3 = ti.types.vector(3, f32)
mat3 = ti.types.matrix(3, 3, f32)
Vectors = ti.types.ndarray(dtype=vec3, ndim=1)
Matrices = ti.types.ndarray(dtype=mat3, ndim=1)
GridVectors = ti.types.ndarray(dtype=vec3, ndim=3)
GridScalars = ti.types.ndarray(dtype=f32, ndim=3)
Force = ti.types.ndarray(dtype=f32, ndim=1)

SHORTENED = 0.1
MACH = 0.02  # of each plate at most; without damping a faster one rings
HOLD = 400  # substeps after the motion; the force is the mean over the second half of them


@ti.kernel
def clear(momentum: GridVectors, mass: GridScalars):
    for node in ti.grouped(mass):
        momentum[node] = vec3(0.0)
        mass[node] = 0.0


@ti.kernel
def particle_to_grid(
    x: Vectors, v: Vectors, c: Matrices, deformation: Matrices, momentum: GridVectors, mass: GridScalars,
    dx: f32, dt: f32, mu: f32, lam: f32, limit: f32, particle_mass: f32, volume: f32,
):  # fmt: skip
    for p in x:
        trial = (ti.Matrix.identity(f32, 3) + dt * c[p]) @ deformation[p]
        u, sigma, w = ti.svd(trial)
        strain = vec3(ti.log(sigma[0, 0]), ti.log(sigma[1, 1]), ti.log(sigma[2, 2]))
        mean = strain.sum() / 3.0
        deviator = strain - mean
        norm = deviator.norm()
        if norm > limit:  # von Mises return
            deviator *= limit / norm
            strain = deviator + mean
            stretch = ti.exp(strain)
            trial = u @ mat3([[stretch[0], 0, 0], [0, stretch[1], 0], [0, 0, stretch[2]]]) @ w.transpose()
        deformation[p] = trial
        tau = 2.0 * mu * strain + 3.0 * lam * mean
        stress = u @ mat3([[tau[0], 0, 0], [0, tau[1], 0], [0, 0, tau[2]]]) @ u.transpose()
        affine = (-dt * volume * 4.0 / (dx * dx)) * stress + particle_mass * c[p]
        base = ti.floor(x[p] / dx - 0.5).cast(ti.i32)
        fx = x[p] / dx - base.cast(f32)
        weight = [0.5 * (1.5 - fx) ** 2, 0.75 - (fx - 1.0) ** 2, 0.5 * (fx - 0.5) ** 2]
        for i, j, k in ti.static(ti.ndrange(3, 3, 3)):
            offset = ti.Vector([i, j, k])
            share = weight[i][0] * weight[j][1] * weight[k][2]
            momentum[base + offset] += share * (particle_mass * v[p] + affine @ ((offset.cast(f32) - fx) * dx))
            mass[base + offset] += share * particle_mass


@ti.kernel
def update_grid(
    momentum: GridVectors, mass: GridScalars, dx: f32, dt: f32, low: f32, high: f32, speed: f32, force: Force
):
    force[0] = 0.0
    for i, j, k in mass:
        if mass[i, j, k] > 0.0:
            velocity = momentum[i, j, k] / mass[i, j, k]
            if k * dx <= low or k * dx >= high:
                plate = speed if k * dx <= low else -speed
                ti.atomic_add(force[0], 0.5 * ti.abs(mass[i, j, k] * (velocity[2] - plate) / dt))
                velocity[2] = plate
            momentum[i, j, k] = velocity


@ti.kernel
def grid_to_particle(x: Vectors, v: Vectors, c: Matrices, velocity: GridVectors, dx: f32, dt: f32):
    for p in x:
        base = ti.floor(x[p] / dx - 0.5).cast(ti.i32)
        fx = x[p] / dx - base.cast(f32)
        weight = [0.5 * (1.5 - fx) ** 2, 0.75 - (fx - 1.0) ** 2, 0.5 * (fx - 0.5) ** 2]
        new, affine = vec3(0.0), mat3(0.0)
        for i, j, k in ti.static(ti.ndrange(3, 3, 3)):
            offset = ti.Vector([i, j, k])
            share = weight[i][0] * weight[j][1] * weight[k][2]
            at = velocity[base + offset]
            new += share * at
            affine += (4.0 / dx) * share * at.outer_product(offset.cast(f32) - fx)
        v[p], c[p] = new, affine
        x[p] = x[p] + dt * new


class Cube:
    """A cube of side [mm] in the middle of a dense grid, its plates touching it."""

    def __init__(self, side: float, spacing: float) -> None:
        from tacsim.geometry.shapes import particles
        from tacsim.models.scene import Box
        from tacsim.physics.body.plasticine import body_params

        self.config = config = body_params(CLAY, spacing * 1e-3)
        self.dx, self.dt, self.side = config.cell, COURANT * config.cell, side
        room = 3 * self.dx + 0.2 * side
        cells = round((side + 2 * room) / self.dx) + 1
        cube = particles(Box(size=(side * 1e-3,) * 3), spacing * 1e-3) * 1e3
        points = cube - cube.min(axis=0) + spacing / 2 + room
        self.x = np.ascontiguousarray(points, np.float32)
        self.v = np.zeros_like(self.x)
        self.c = np.zeros((len(self.x), 3, 3), np.float32)
        self.f = np.tile(np.eye(3, dtype=np.float32), (len(self.x), 1, 1))
        self.momentum = np.zeros((cells, cells, cells, 3), np.float32)
        self.mass = np.zeros((cells, cells, cells), np.float32)
        self.force = np.zeros(1, np.float32)
        self.low, self.high = room, room + side

    def substep(self, speed: float) -> float:
        """Plates close with `speed` each; returns the mean force on them [N]."""
        config, dx, dt = self.config, self.dx, self.dt
        lam = config.bulk - 2 * config.mu / 3
        clear(self.momentum, self.mass)
        particle_to_grid(
            self.x, self.v, self.c, self.f, self.momentum, self.mass, dx, dt, config.mu, lam, config.limit,
            config.particle_mass, config.spacing**3,
        )  # fmt: skip
        update_grid(self.momentum, self.mass, dx, dt, self.low, self.high, speed, self.force)
        grid_to_particle(self.x, self.v, self.c, self.momentum, dx, dt)
        self.low, self.high = self.low + dt * speed, self.high - dt * speed
        return float(self.force[0])


def compress(side: float, spacing: float) -> tuple[Cube, float, int]:
    """The cube after it was shortened by 10 %, the force on the plates [N], and the substeps it took."""
    cube = Cube(side, spacing)
    moving = round(SHORTENED * side / 2 / (MACH * cube.dt))
    speed = SHORTENED * side / 2 / (moving * cube.dt)
    for _ in range(moving):
        cube.substep(speed)
    forces = [cube.substep(0.0) for _ in range(HOLD)]
    return cube, float(np.mean(forces[HOLD // 2 :])), moving + HOLD


def yield_plateau(side: float, spacing: float, repeat: int) -> list[Measurement]:
    """Side and spacing [mm]."""
    start()
    timing, (cube, force, substeps) = timed(partial(compress, side, spacing), repeat, lambda: _first(side, spacing))
    stress = uniaxial_stress(force, (side * 1e-3) ** 3, (cube.high - cube.low) * 1e-3)
    assert CLAY.yield_stress is not None
    return [
        Measurement(
            timing, abs(stress / CLAY.yield_stress - 1) * 100, "%", "F/A = yield stress", "cube shortened by 10 %",
            substeps, {**step_cost(timing, substeps, len(cube.x), "particle"), "stress_pa": stress},
            "plates are planes of grid nodes; no damping",
        )
    ]  # fmt: skip


def _first(side: float, spacing: float) -> None:
    Cube(side, spacing).substep(0.0)
