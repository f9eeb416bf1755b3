"""Materials group: laws, elements and transfers against closed forms, and the cost of a substep."""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.cases.squeeze import close_sensors, normal_forces
from benchmarks.harness.measure import Measurement, Timing, step_cost, timed
from benchmarks.harness.runner import Case
from benchmarks.truth import laws
from benchmarks.truth.clay import CLAY, COURANT, uniaxial_stress
from tacsim.interface import FloatArray
from tacsim.models.material import BodyMaterial, GelMaterial
from tacsim.models.scene import Body, Box, Gel, Scene
from tacsim.physics.move import MoveStats

RIGID = GelMaterial(youngs_modulus=100e6, poisson_ratio=0.45)  # gels as plates: they deform by 1 um
FreeAxes = tuple[float, float, float]  # by axis: 0 forbids motion, 1 allows it
HALF_PERIODS = 4  # of a standing wave that are measured


def yield_scene(side: float, spacing: float, gel_element: float) -> Scene:
    """A cube between two frictionless plates (gels 200 times as stiff as the body)."""
    return Scene.model_validate(
        {
            "body": Body(geometry=Box(size=(side, side, side)), material=CLAY),
            "gel": Gel(size=(side + 4e-3, side + 4e-3, 2e-3), material=RIGID, housing=None),
            "friction": {"lower": 0.0, "upper": 0.0},
            "particle_spacing": spacing,
            "element_size": gel_element,
        }
    )


def yield_plateau(side: float, spacing: float, repeat: int) -> list[Measurement]:
    """A cube shortened by 10 % yields at F/A = sigma_y."""
    from tacsim.physics.worlds.hybrid import HybridWorld

    world = HybridWorld(yield_scene(side, spacing, 1e-3))
    body = world.truth()
    gap = float(world.pose("upper").position[2]) - body.height
    particles = len(body.points)
    close_sensors(world, gap)
    begin = world.snapshot()

    def run() -> MoveStats:
        world.restore(begin)
        return close_sensors(world, 0.1 * side)

    timing, stats = timed(run, repeat, warm=lambda: None)
    strain = world.snapshot()["strain"].astype(np.float64)
    jacobian = np.sqrt(np.linalg.det(symmetric_matrices(strain) + np.eye(3)))
    assert CLAY.yield_stress is not None
    # Kirchhoff stress yields: sigma = tau / J
    stress = uniaxial_stress(float(normal_forces(world).mean()), side**3, world.truth().height)
    return [
        Measurement(
            timing, abs(stress / CLAY.yield_stress - 1) * 100, "%", "F/A = yield stress", "cube shortened by 10 %",
            stats.substeps, {**step_cost(timing, stats.substeps, particles, "particle"), "stress_pa": stress,
                             "mean_j": float(jacobian.mean()), "residual": stats.residual},
            "" if stats.settled else "not settled",
        )
    ]  # fmt: skip


def plasticine_alone(side: float, spacing: float, repeat: int) -> list[Measurement]:
    """A free cube of clay, stretched until it yields: the substep of plasticine alone, without gels and contact."""
    from benchmarks.truth.blocks import BodyBlock
    from tacsim.geometry.shapes import lattice_particles
    from tacsim.physics.body.plasticine import body_params

    config = body_params(CLAY, spacing)
    rest = lattice_particles(Box(size=(side, side, side)), spacing) * 1e3
    rest -= rest.mean(axis=0)
    dt, rate, substeps = COURANT * config.cell, 2.0 * config.limit / side * 1e-3, 60

    def initial() -> BodyBlock:
        body = BodyBlock(config, rest, dt)
        body.fit(4 * config.cell)
        body.state.v()[:, 2] = 0.01 + rate * rest[:, 2]
        body.state.c()[:, 2, 2] = rate
        return body

    body = initial()
    timing, _ = timed(lambda: body.advance(substeps), repeat, lambda: body.advance(1))
    momentum = body.state.v().mean(axis=0, dtype=np.float64)
    drift = float(np.linalg.norm(momentum - [0.0, 0.0, 0.01])) / 0.01
    yielded = float((body.state.plastic_strain() > 0.0).mean())
    figures = {**step_cost(timing, substeps, len(rest), "particle"), "yielded": yielded}
    return [Measurement(timing, drift, "-", "momentum is kept", "a cube drawn apart", substeps, figures)]


def textbook_plateau(side: float, spacing: float, repeat: int) -> list[Measurement]:
    """The same cube by textbook MLS-MPM: SVD, atomics, plates of grid nodes."""
    from benchmarks.truth.textbook import yield_plateau as by_the_book  # compiles kernels when it is imported

    return by_the_book(side * 1e3, spacing * 1e3, repeat)


def gel_step(repeat: int) -> list[Measurement]:
    """Two standard gels and a very small body: 0.2 mm of motion on a tiny elastic cube."""
    from tacsim.physics.worlds.hybrid import HybridWorld

    scene = Scene.model_validate(
        {
            "preset": "standard",
            "body": Body(geometry=Box(size=(1e-3, 1e-3, 1e-3)), material=BodyMaterial()),
        }
    )
    world = HybridWorld(scene)
    body = world.truth()
    close_sensors(world, float(world.pose("upper").position[2]) - body.height)
    begin = world.snapshot()

    def run() -> MoveStats:
        world.restore(begin)
        return close_sensors(world, 0.2e-3)

    timing, stats = timed(run, repeat, warm=lambda: None)
    elements = 2 * math.prod(round(side / scene.effective_element_size) for side in scene.gel.size)
    forces = normal_forces(world)
    return [
        Measurement(
            timing, abs(float(forces[0] - forces[1])) / float(forces.mean()) * 100, "% imbalance",
            "equal forces on both sensors", f"{elements} elements, {len(body.points)} particles", stats.substeps,
            step_cost(timing, stats.substeps, elements, "element"), "" if stats.settled else "not settled",
        )
    ]  # fmt: skip


def oedometer(element: float, repeat: int) -> list[Measurement]:
    """Confined compression by 10 %: P = mu (s - 1/s) + lambda ln(s)/s at the backing."""
    from benchmarks.truth.blocks import GelBlock
    from tacsim.physics.gel.gel import gel_params

    config = gel_params(Gel(size=(4e-3, 4e-3, 4e-3), material=GelMaterial(poisson_ratio=0.45)), element)
    dt, stretch = COURANT * config.spacing, 0.9
    ramp = round(0.1 * config.thickness / (0.02 * dt))
    speed = -(1 - stretch) * config.thickness / (ramp * dt)
    hold = round(40 * config.thickness / dt)

    def run() -> GelBlock:
        gel = GelBlock(config, dt, 1.0 / config.thickness)
        for count, rate in ((ramp, speed), (hold, 0.0)):
            gel.advance(count, (0.0, 0.0, 1.0), rate)
        return gel

    timing, gel = timed(run, repeat)
    reached = 1 + float(gel.state.common_group.u[0, 0, :, :, -1, 2].mean()) / config.thickness
    stress = config.mu * (reached - 1 / reached) + config.lam * math.log(reached) / reached
    pressure = float(gel.backing[2]) / (config.elements[0] * config.elements[1] * config.spacing**2)
    error = abs(abs(pressure / stress) - 1) * 100
    figures = {"stretch": reached, "pressure_mpa": abs(pressure)}
    return [Measurement(timing, error, "%", "neo-Hookean closed form", "shortened by 10 %", ramp + hold, figures)]


def simple_shear(repeat: int) -> list[Measurement]:
    """64,000 material points sheared by 0.5: tau_xy = sigma_y / sqrt 2 (Frobenius norm of the yield stress)."""
    from benchmarks.truth.blocks import shear_points
    from tacsim.compute.runtime import start_taichi
    from tacsim.physics.body.plasticine import body_params

    start_taichi()
    config = body_params(CLAY, 0.25e-3)
    steps, increment, points = 250, 2e-3, 64_000

    def run(steps: int = steps) -> NDArray[np.float32]:
        strain, flow, tau = (np.zeros(shape, np.float32) for shape in ((points, 6), points, (points, 6)))
        shear_points(steps, increment, strain, flow, tau, config.mu, config.bulk, config.limit, config.hardening)
        return tau

    timing, tau = timed(run, 1, warm=partial(run, 1))  # these seconds are not compared
    b, flow, exact = np.eye(3), np.zeros(()), np.zeros((3, 3))
    f = np.eye(3)
    f[0, 1] = increment
    for _ in range(steps):
        b, flow, exact = laws.hencky_return(f @ b @ f.T, flow, config.mu, config.bulk, config.limit, config.hardening)
    radius = 2 * config.mu * config.limit  # sigma_y
    closed = radius / math.sqrt(2)
    off = float(np.abs(symmetric_matrices(tau.astype(np.float64)) - exact).max()) / radius * 100
    error = abs(float(tau[:, 3].mean(dtype=np.float64)) / closed - 1) * 100
    figures = {
        "against_float64_percent": off,
        "float64_against_closed_form_percent": abs(exact[0, 1] / closed - 1) * 100,
    }
    return [
        Measurement(timing, error, "%", "tau_xy = sigma_y / sqrt 2", "sheared by 0.5", steps, figures,
                    "the closed form is that of small elastic strain")
    ]  # fmt: skip


def gel_wave(element: float, repeat: int) -> list[Measurement]:
    """Standing quarter wave in a layer, pressure and shear: frequency c / 4H."""
    from benchmarks.truth.blocks import GelBlock
    from tacsim.physics.gel.gel import gel_params

    config = gel_params(Gel(size=(4e-3, 4e-3, 4e-3), material=GelMaterial(poisson_ratio=0.45)), element)
    dt, height = COURANT * config.spacing, config.thickness
    depth = np.arange(config.elements[2] + 1) * config.spacing
    shape = np.sin(np.pi * depth / (2 * height))
    rows = []
    for name, axis, speed in (("pressure wave", 2, 1.0), ("shear wave", 0, math.sqrt(config.mu / config.density))):
        free = (float(axis == 0), 0.0, float(axis == 2))
        count = math.ceil((HALF_PERIODS + 1) * 2 * height / (speed * dt))

        def run(axis: int = axis, free: FreeAxes = free, count: int = count) -> FloatArray:
            gel = GelBlock(config, dt, 0.0)
            velocity = gel.state.common_group.v[0, 0, ..., axis]
            velocity[:] = 1e-3 * shape
            signal = np.empty(count)
            for step in range(count):
                signal[step] = velocity[1, 1] @ shape
                gel.advance(1, free)
            return signal

        timing, signal = timed(run, 1)
        rows.append(_wave_row(timing, half_period(signal) * dt, 2 * height / speed, f"gel, {name}", count))
    return rows


def body_wave(spacing: float, repeat: int) -> list[Measurement]:
    """Standing half wave in a free block, with the other directions fixed: frequency c / 2L."""
    from benchmarks.truth.blocks import BodyBlock
    from tacsim.geometry.shapes import lattice_particles
    from tacsim.physics.body.plasticine import body_params

    config = body_params(BodyMaterial(youngs_modulus=0.5e6, poisson_ratio=0.45), spacing)
    dt, length = COURANT * config.cell, 8.0
    rest = lattice_particles(Box(size=(4e-3, 4e-3, 8e-3)), spacing) * 1e3
    phase = np.pi * (rest[:, 2] - rest[:, 2].min() + config.spacing / 2) / length
    rows = []
    for name, axis, speed in (("pressure wave", 2, 1.0), ("shear wave", 0, math.sqrt(config.mu / config.density))):
        free = (float(axis == 0), 0.0, float(axis == 2))
        count = math.ceil((HALF_PERIODS + 1) * length / (speed * dt))

        def run(count: int = count, axis: int = axis, free: FreeAxes = free) -> FloatArray:
            body = BodyBlock(config, rest, dt)
            body.fit(2 * config.cell)
            velocity = body.state.v()[:, axis]
            velocity[:] = 1e-3 * np.cos(phase)
            body.state.c()[:, axis, 2] = -1e-3 * np.pi / length * np.sin(phase)
            signal = np.empty(count)
            for step in range(count):
                signal[step] = velocity @ np.cos(phase)
                body.advance(1, free)
            return signal

        timing, signal = timed(run, 1, warm=partial(run, 1))  # these seconds are not compared
        rows.append(_wave_row(timing, half_period(signal) * dt, length / speed, f"plasticine, {name}", count))
    return rows


def half_period(signal: FloatArray) -> float:
    """Mean distance of the first zero crossings of a signal [samples]. Raises ValueError if there are too few."""
    at = np.flatnonzero(np.sign(signal[:-1]) * np.sign(signal[1:]) < 0)
    if len(at) <= HALF_PERIODS:
        raise ValueError(f"the wave crossed zero {len(at)} times, {HALF_PERIODS + 1} are needed: it does not oscillate")
    crossing = at + signal[at] / (signal[at] - signal[at + 1])
    return float(crossing[HALF_PERIODS] - crossing[0]) / HALF_PERIODS


def _wave_row(timing: Timing, found: float, truth: float, variant: str, count: int) -> Measurement:
    figures = {"half_period": found, "half_period_truth": truth}
    return Measurement(
        timing, abs(truth / found - 1) * 100, "%", "wave speed of the continuum", variant, count, figures
    )


def momentum(repeat: int) -> list[Measurement]:
    """A free body that spins, stretches and yields over 5,000 substeps."""
    from benchmarks.truth.blocks import BodyBlock
    from tacsim.geometry.shapes import lattice_particles
    from tacsim.physics.body.plasticine import body_params

    spacing, steps, batch = 0.5e-3, 5000, 20
    config = body_params(CLAY, spacing)
    dt = COURANT * config.cell
    rest = lattice_particles(Box(size=(4e-3, 3e-3, 5e-3)), spacing) * 1e3
    gradient = np.array([[0.02, -0.02, 0.0], [0.03, -0.02, 0.01], [0.0, -0.01, 0.01]]) * 0.5
    drift = np.array([0.004, -0.002, 0.003])

    def initial() -> BodyBlock:
        body = BodyBlock(config, rest, dt)
        body.state.v()[:] = rest @ gradient.T + drift
        body.state.c()[:] = gradient
        return body

    def run(steps: int = steps) -> BodyBlock:
        body = initial()
        for _ in range(0, steps, batch):
            body.fit(2 * config.cell + 2 * batch * dt * float(np.abs(body.state.v()).max()))
            body.advance(batch)
        return body

    timing, body = timed(run, 1, warm=partial(run, 1))
    before, after = (momenta(b.x(), b.v(), b.spin_matrices(), config.cell) for b in (initial().state, body.state))
    linear, angular = (float(np.linalg.norm(b - a) / scale) for a, b, scale in zip(
        before[:2], after[:2], before[2:], strict=True))  # fmt: skip
    return [
        Measurement(timing, max(linear, angular), "relative drift", "conservation of momentum and angular momentum",
                    f"{len(rest)} particles", steps, {"momentum": linear, "angular_momentum": angular})
    ]  # fmt: skip


def momenta(
    x: NDArray[Any], v: NDArray[Any], c: NDArray[Any], cell: float
) -> tuple[FloatArray, FloatArray, float, float]:
    """Linear and angular momentum of particles (n) of mass 1, the affine part included, and their scales.

    L = sum x cross v + dx^2/4 skew(C F^T) (Jiang et al. 2015, eq. 10, where F = I); `c` is C F^T. The scales are
    sum |v| and sum |x - mean| |v|.
    """
    x, v, c = (np.asarray(a, np.float64) for a in (x, v, c))
    skew = np.stack([c[:, 2, 1] - c[:, 1, 2], c[:, 0, 2] - c[:, 2, 0], c[:, 1, 0] - c[:, 0, 1]], axis=1)
    angular = (np.cross(x, v) + cell**2 / 4 * skew).sum(axis=0)
    speed = np.linalg.norm(v, axis=1)
    arm = np.linalg.norm(x - x.mean(axis=0), axis=1)
    return v.sum(axis=0), angular, float(speed.sum()), float((arm * speed).sum())


def symmetric_matrices(s: FloatArray) -> FloatArray:
    """(n, 6) as symmetric (n, 3, 3)."""
    return s[:, [0, 3, 4, 3, 1, 5, 4, 5, 2]].reshape(-1, 3, 3)


CUBES = (  # side, spacing [m]
    ("yield_plateau", "dx 0.5 mm", 4e-3, 0.25e-3),
    ("yield_plateau", "dx 0.25 mm", 4e-3, 0.125e-3),
    ("plasticine_step", "dx 0.5 mm, 64000 particles", 10e-3, 0.25e-3),
)

CASES = (
    Case("materials", "oedometer", "tacsim", "h 1 mm", partial(oedometer, 1e-3), cpu=True),
    Case("materials", "oedometer", "tacsim", "h 0.5 mm", partial(oedometer, 0.5e-3), cpu=True),
    Case("materials", "simple_shear", "tacsim", "64000 points", simple_shear),
    Case("materials", "wave_speed", "tacsim", "h 0.5 mm", partial(gel_wave, 0.5e-3), cpu=True),
    Case("materials", "wave_speed", "tacsim", "dx 0.5 mm", partial(body_wave, 0.25e-3), cpu=True),
    Case("materials", "momentum", "tacsim", "dx 1 mm", momentum, cpu=True),
    *(Case("materials", name, "tacsim", at, partial(yield_plateau, side, fine)) for name, at, side, fine in CUBES),
    *(
        Case("materials", name, "textbook", at, partial(textbook_plateau, side, fine), baseline=True)
        for name, at, side, fine in CUBES
    ),
    Case(
        "materials",
        "plasticine_alone",
        "tacsim",
        "dx 0.5 mm, 64000 particles",
        partial(plasticine_alone, 10e-3, 0.25e-3),
        cpu=True,
    ),
    Case("materials", "gel_step", "tacsim", "h 0.5 mm", gel_step),
)
