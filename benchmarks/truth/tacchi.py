"""A press with the numbers that Tacchi publishes (Chen et al., RA-L 2023, and its repository): the gel as elastic
particles on an MLS-MPM grid, the indenter as kinematic particles, contact through the grid alone.

The kernels are this module's own, since those of tacsim.physics.seed.kernels cannot run these numbers: there two gels,
neo-Hookean and with a sensor each, close on a body; the grid is stretched so that their backings are on its nodes;
all motion is driven by those backings, damped, and has a scaled density. Here one gel of another law (fixed
corotated), its lowest particles frozen, contacts particles with a given velocity, undamped. The same in both: APIC
with quadratic B-splines, F <- (I + dt C) F, bodies that stick to each other through the one grid.

The numbers are theirs: units mm and s, rho 1, E 1.45e5, nu 0.45, fixed corotated, dt 1e-4, dx 33/256, gel 101 x 101 x
21 particles 0.2 mm apart, lowest three layers frozen, indenter at 200 mm/s from 1 mm above the gel, stop at a depth of
the top layer of 1 mm. One difference is in their favour: the grid covers only the gel instead of a cube of 256^3
nodes. Of the published densities of indenter points we use the middle one, whose contact fits best.
"""

import math

import numpy as np
from scipy.interpolate import RegularGridInterpolator

from benchmarks.harness.measure import Measurement, timed
from benchmarks.truth.limit import DEPTH, GRID_HALF, LIMIT, RADIUS, load_limit, rms
from benchmarks.truth.mls_mpm import GridScalars, GridVectors, Matrices, Vectors, clear, mat3, vec3
from tacsim.compute.runtime import start_taichi, ti

f32 = ti.f32

DX, DT = 33.0 / 256.0, 1e-4
SPACING, COUNT = 0.2, (101, 101, 21)
MODULUS, POISSON = 1.45e5, 0.45
VOLUME = (DX / 2) ** 2  # as published; it cancels, because the mass has the same factor
FROZEN = 3  # layers
SPEED = -200.0
GAP = 1.0  # between indenter and gel at the start
CAP_HEIGHT = 2.0  # of the ball's cap of particles, from its tip
POINTS_PER_AREA = 60.0  # on the indenter's surface [1/mm^2]: 2,211 points on their ball's cap
MARGIN = 2.0  # of the grid around the gel
MAX_SUBSTEPS = 400  # the published runs end after 96 to 173


@ti.kernel
def particle_to_grid(
    gel: ti.i32, x: Vectors, v: Vectors, c: Matrices, deformation: Matrices, momentum: GridVectors, mass: GridScalars,
    dx: f32, dt: f32, mu: f32, lam: f32, volume: f32,
):  # fmt: skip
    for p in x:
        affine = mat3(0.0)
        if p < gel:
            f = (ti.Matrix.identity(f32, 3) + dt * c[p]) @ deformation[p]
            deformation[p] = f
            u, sigma, w = ti.svd(f)
            j = sigma[0, 0] * sigma[1, 1] * sigma[2, 2]
            stress = 2.0 * mu * (f - u @ w.transpose()) @ f.transpose()
            stress += ti.Matrix.identity(f32, 3) * (lam * j * (j - 1.0))
            affine = (-dt * volume * 4.0 / (dx * dx)) * stress + volume * c[p]
        base = ti.floor(x[p] / dx - 0.5).cast(ti.i32)
        fx = x[p] / dx - base.cast(f32)
        weight = [0.5 * (1.5 - fx) ** 2, 0.75 - (fx - 1.0) ** 2, 0.5 * (fx - 0.5) ** 2]
        for i, j, k in ti.static(ti.ndrange(3, 3, 3)):
            offset = ti.Vector([i, j, k])
            share = weight[i][0] * weight[j][1] * weight[k][2]
            momentum[base + offset] += share * (volume * v[p] + affine @ ((offset.cast(f32) - fx) * dx))
            mass[base + offset] += share * volume


@ti.kernel
def grid_to_particle(
    gel: ti.i32, frozen: f32, x: Vectors, v: Vectors, c: Matrices, momentum: GridVectors, mass: GridScalars,
    dx: f32, dt: f32,
):  # fmt: skip
    for p in x:
        if p < gel:
            base = ti.floor(x[p] / dx - 0.5).cast(ti.i32)
            fx = x[p] / dx - base.cast(f32)
            weight = [0.5 * (1.5 - fx) ** 2, 0.75 - (fx - 1.0) ** 2, 0.5 * (fx - 0.5) ** 2]
            new, affine = vec3(0.0), mat3(0.0)
            for i, j, k in ti.static(ti.ndrange(3, 3, 3)):
                offset = ti.Vector([i, j, k])
                node = base + offset
                share = weight[i][0] * weight[j][1] * weight[k][2]
                if mass[node] > 0.0:
                    at = momentum[node] / mass[node]
                    new += share * at
                    affine += (4.0 / dx) * share * at.outer_product(offset.cast(f32) - fx)
            if x[p][2] < frozen:
                new = vec3(0.0)
            v[p], c[p] = new, affine
        x[p] = x[p] + dt * v[p]


def ball_cap() -> np.ndarray:
    """Points distributed evenly (Fibonacci) on the cap of the ball, tip at the origin [mm]."""
    radius = RADIUS * 1e3
    count = round(POINTS_PER_AREA * 2 * math.pi * radius * CAP_HEIGHT)
    z = (np.arange(count) + 0.5) / count * CAP_HEIGHT
    angle = np.arange(count) * math.pi * (3 - math.sqrt(5))
    across = np.sqrt(radius**2 - (radius - z) ** 2)
    return np.stack([across * np.cos(angle), across * np.sin(angle), z], axis=-1)


class TacchiPress:
    """Gel and ball at the start; z = 0 is the grid's lower face."""

    def __init__(self) -> None:
        axes = [np.arange(n) * SPACING for n in COUNT]
        self.rest = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3) + MARGIN
        self.gel = len(self.rest)
        side, self.top = (COUNT[0] - 1) * SPACING, MARGIN + (COUNT[2] - 1) * SPACING
        ball = ball_cap() + [MARGIN + side / 2, MARGIN + side / 2, self.top + GAP]
        self.x = np.ascontiguousarray(np.concatenate([self.rest, ball]), np.float32)
        self.v = np.zeros_like(self.x)
        self.v[self.gel :, 2] = SPEED
        self.c = np.zeros((len(self.x), 3, 3), np.float32)
        self.f = np.tile(np.eye(3, dtype=np.float32), (len(self.x), 1, 1))
        size = [side + 2 * MARGIN, side + 2 * MARGIN, self.top + GAP + CAP_HEIGHT + 4 * DX]
        nodes = [math.ceil(length / DX) for length in size]
        self.momentum = np.zeros((*nodes, 3), np.float32)
        self.mass = np.zeros(nodes, np.float32)
        self.surface = np.isclose(self.rest[:, 2], self.top)

    def substep(self) -> None:
        mu = MODULUS / (2 * (1 + POISSON))
        lam = MODULUS * POISSON / ((1 + POISSON) * (1 - 2 * POISSON))
        clear(self.momentum, self.mass)
        particle_to_grid(
            self.gel, self.x, self.v, self.c, self.f, self.momentum, self.mass, DX, DT, mu, lam, VOLUME
        )  # fmt: skip
        frozen = MARGIN + (FROZEN - 0.5) * SPACING
        grid_to_particle(self.gel, frozen, self.x, self.v, self.c, self.momentum, self.mass, DX, DT)

    @property
    def penetration(self) -> float:
        """Depth of the lowest particle of the top layer below the undeformed surface [mm]."""
        return self.top - float(self.x[: self.gel, 2][self.surface].min())


def run() -> tuple[TacchiPress, int]:
    """Presses until the top layer has a depth of 1 mm. Raises RuntimeError if it does not reach it."""
    press = TacchiPress()
    for step in range(1, MAX_SUBSTEPS + 1):
        press.substep()
        if press.penetration >= DEPTH * 1e3:
            return press, step
    raise RuntimeError(f"the top layer has a depth of only {press.penetration:.3f} mm after {MAX_SUBSTEPS} substeps")


def sphere_press(repeat: int) -> list[Measurement]:
    """The surface at the end of the published run, against the limit of fine meshes."""
    start_taichi()
    timing, (press, substeps) = timed(run, repeat, lambda: TacchiPress().substep())
    at = press.rest[press.surface]
    found = (press.x[: press.gel, 2][press.surface] - press.top).astype(np.float64) * 1e-3
    line = np.linspace(-GRID_HALF, GRID_HALF, load_limit().profile.shape[0])
    centre = MARGIN + (COUNT[0] - 1) * SPACING / 2
    truth = RegularGridInterpolator((line, line), load_limit().profile, method="cubic")
    difference = found - truth(np.clip((at[:, :2] - centre) * 1e-3, line[0], line[-1]))
    tip = float(press.x[press.gel :, 2].min()) - press.top
    figures = {
        "largest_um": float(np.abs(difference).max()) * 1e6,
        "tip_mm": tip,
        "wall_per_particle_substep_ns": timing.median * 1e9 / (substeps * len(press.x)),
        "cpu_per_particle_substep_ns": timing.processor * 1e9 / (substeps * len(press.x)),
    }
    return [
        Measurement(timing, rms(difference) * 1e6, "µm rms", LIMIT, substeps=substeps, figures=figures,
                    note="grid cropped to the gel (published: 256^3); 60 indenter points per mm^2")
    ]  # fmt: skip
