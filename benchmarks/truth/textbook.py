"""MLS-MPM as in textbooks (benchmarks/truth/mls_mpm.py), on all cores: a cube between two frictionless plates, which
are planes of grid nodes. Units: mm, N, MPa, wave speed 1."""

from functools import partial

import numpy as np

from benchmarks.harness.measure import Measurement, step_cost, timed
from benchmarks.truth.clay import CLAY, COURANT, uniaxial_stress
from benchmarks.truth.mls_mpm import (
    GridScalars,
    GridVectors,
    Material,
    clear,
    grid_to_particles,
    particles_to_grid,
)
from tacsim.compute.runtime import start_taichi, ti

Force = ti.types.ndarray(dtype=ti.f32, ndim=1)

SHORTENED = 0.1
MACH = 0.02  # maximum of each plate; without damping, a faster plate excites oscillations
HOLD = 400  # substeps after the motion; the force is the mean over the second half of them


@ti.kernel
def update_between_plates(
    momentum: GridVectors, mass: GridScalars, dx: ti.f32, dt: ti.f32, low: ti.f32, high: ti.f32, speed: ti.f32,
    force: Force,
):  # fmt: skip
    force[0] = 0.0
    for i, j, k in mass:
        if mass[i, j, k] > 0.0:
            velocity = momentum[i, j, k] / mass[i, j, k]
            if k * dx <= low or k * dx >= high:
                plate = speed if k * dx <= low else -speed
                ti.atomic_add(force[0], 0.5 * ti.abs(mass[i, j, k] * (velocity[2] - plate) / dt))
                velocity[2] = plate
            momentum[i, j, k] = velocity


class Cube:
    """A cube of side [mm] at the centre of a dense grid, in contact with its plates."""

    def __init__(self, side: float, spacing: float) -> None:
        from tacsim.geometry.shapes import lattice_particles
        from tacsim.models.scene import Box
        from tacsim.physics.body.plasticine import body_params

        params = body_params(CLAY, spacing * 1e-3)
        self.dx, self.dt, self.side = params.cell, COURANT * params.cell, side
        self.material = Material(  # type: ignore[call-arg]  # a Taichi dataclass
            mass=params.particle_mass, volume=params.spacing**3, mu=params.mu, lam=params.bulk - 2 * params.mu / 3,
            limit=params.limit,
        )  # fmt: skip
        room = 3 * self.dx + 0.2 * side
        cells = round((side + 2 * room) / self.dx) + 1
        cube = lattice_particles(Box(size=(side * 1e-3,) * 3), spacing * 1e-3) * 1e3
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
        """Both plates move by `speed`; returns the mean force on them [N]."""
        dx, dt = self.dx, self.dt
        clear(self.momentum, self.mass)
        particles_to_grid(self.x, self.v, self.c, self.f, self.momentum, self.mass, dx, dt, self.material)
        update_between_plates(self.momentum, self.mass, dx, dt, self.low, self.high, speed, self.force)
        grid_to_particles(self.x, self.v, self.c, self.momentum, dx, dt)
        self.low, self.high = self.low + dt * speed, self.high - dt * speed
        return float(self.force[0])


def compress(side: float, spacing: float) -> tuple[Cube, float, int]:
    """The cube after a compression by 10 %, the force on the plates [N], and the number of substeps."""
    cube = Cube(side, spacing)
    moving = round(SHORTENED * side / 2 / (MACH * cube.dt))
    speed = SHORTENED * side / 2 / (moving * cube.dt)
    for _ in range(moving):
        cube.substep(speed)
    forces = [cube.substep(0.0) for _ in range(HOLD)]
    return cube, float(np.mean(forces[HOLD // 2 :])), moving + HOLD


def yield_plateau(side: float, spacing: float, repeat: int) -> list[Measurement]:
    """A cube compressed by 10 %; side and spacing [mm]."""
    start_taichi()
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
