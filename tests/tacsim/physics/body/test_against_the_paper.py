"""The product's substep of a body, laid out for vector registers, against the paper's own
(benchmarks/truth/mls_mpm.py), stage by stage, from the same state: some particles yield, some do not."""

import numpy as np
import pytest

from benchmarks.truth import mls_mpm
from tacsim.compute.runtime import start_taichi, ti
from tacsim.geometry.sampling import body_points
from tacsim.models.material import BodyMaterial
from tacsim.models.scene import Body as BodyModel
from tacsim.models.scene import Box
from tacsim.physics.body.grid_motion import Drive, grid_update
from tacsim.physics.body.mass import grid_changes
from tacsim.physics.body.plasticine import BodyState, body_params
from tacsim.physics.body.transfers import (
    Body,
    Strips,
    clear_masses,
    grid_to_particles,
    particles_to_grid,
)
from tacsim.physics.exec import layout
from tacsim.physics.exec.environment import Counts, Environment, Floats, Params, Partial
from tacsim.physics.exec.lanes import NODES, PARTS

pytestmark = pytest.mark.cpu

CLAY = BodyMaterial(youngs_modulus=0.5e6, poisson_ratio=0.45, yield_stress=30e3)
GRAVITY = np.array([0.001, -0.002, -0.01])  # [1/mm]
Pair = tuple[np.ndarray, np.ndarray]  # ours, the paper's
Stages = dict[str, Pair]


@ti.kernel
def scatter(
    particles: Floats, masses: Strips, velocities: Strips, params: Params, counts: Counts, partial: Partial
):  # fmt: skip
    ti.loop_config(serialize=True)
    for part in range(PARTS):
        env = ti.static(Environment(0, params, counts, partial))
        body = ti.static(Body(particles, masses, velocities))
        clear_masses(env, part, body)
        particles_to_grid(env, part, 0, body)


@ti.kernel
def update(
    drive: Drive, changes: Floats, particles: Floats, masses: Strips, velocities: Strips, params: Params,
    counts: Counts, partial: Partial,
):  # fmt: skip
    ti.loop_config(serialize=True)
    for part in range(PARTS):
        env = ti.static(Environment(0, params, counts, partial))
        body = ti.static(Body(particles, masses, velocities, changes))
        grid_changes(env, part, body)
        grid_update(env, part, 0, drive, body)


@ti.kernel
def gather(
    particles: Floats, masses: Strips, velocities: Strips, params: Params, counts: Counts, partial: Partial
):  # fmt: skip
    ti.loop_config(serialize=True)
    for part in range(PARTS):
        body = ti.static(Body(particles, masses, velocities))
        grid_to_particles(ti.static(Environment(0, params, counts, partial)), part, body)


def minus_identity(f: np.ndarray) -> np.ndarray:
    """b - I of deformation gradients (n, 3, 3): xx, yy, zz, xy, xz, yz."""
    b = f.astype(np.float64) @ np.swapaxes(f, 1, 2) - np.eye(3)
    return b[:, [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]


@pytest.fixture(scope="module")
def stages() -> Stages:
    """What both have after each stage of one substep."""
    start_taichi()
    spacing = 0.5e-3
    own = body_params(CLAY, spacing)
    dx, dt = own.cell, 0.4 * own.cell
    points = body_points(BodyModel(geometry=Box(size=(4e-3, 3e-3, 5e-3)), material=CLAY), spacing) * 1e3
    points += np.random.default_rng(0).uniform(-0.2, 0.2, points.shape) * own.spacing
    rng, n = np.random.default_rng(1), len(points)
    f = (np.eye(3) + rng.normal(size=(n, 3, 3)) * rng.uniform(0.0, 0.06, (n, 1, 1))).astype(np.float32)
    c = rng.normal(scale=0.02, size=(n, 3, 3)).astype(np.float32)
    v = rng.normal(scale=0.01, size=(n, 3)).astype(np.float32)

    state = BodyState([points])
    params = np.zeros((1, layout.PARAMS), np.float32)
    counts, partial = np.zeros((1, layout.COUNTS), np.int32), np.zeros((1, PARTS, layout.NUMBERS), np.float32)
    for name, value in {**own.params(), layout.STEP: dt, layout.RIGID_MASS_SCALE: 1.0}.items():
        params[0, name] = value
    params[0, layout.GRAVITY : layout.GRAVITY + 3] = GRAVITY
    state.fit_grid(0, dx, 2 * dx, params, counts)
    trial = (np.eye(3) + dt * c) @ f  # the product keeps what the paper forms at the start of the next substep
    state.v()[:], state.c()[:], state.e()[:] = v, c, minus_identity(trial)
    arrays, numbers = state.arguments(), (params, counts, partial)

    shape = tuple(counts[0, layout.GRID : layout.GRID + 3])
    x = state.x() - params[0, layout.ORIGIN : layout.ORIGIN + 3]
    momentum, mass = np.zeros((*shape, 3), np.float32), np.zeros(shape, np.float32)
    material = mls_mpm.Material(
        mass=own.particle_mass, volume=own.volume, mu=own.mu, lam=own.bulk - 2 * own.mu / 3, limit=own.limit
    )

    found: Stages = {}
    scatter(*arrays, *numbers)
    mls_mpm.particles_to_grid(x, v, c, f, momentum, mass, dx, dt, material)
    used = np.prod(shape) // NODES
    sums = state.masses[0, :, :used].sum(axis=0, dtype=np.float64).reshape(*shape, 4)
    found["mass"], found["momentum"] = (sums[..., 3], mass.copy()), (sums[..., :3], momentum.copy())
    found["elastic strain"] = state.e().copy(), minus_identity(f)
    found["trial strain"] = minus_identity(trial), minus_identity(f)

    update(np.zeros((1, 1, 2, 6, 3), np.float32), state.changes.reshape(-1), *arrays, *numbers)
    mls_mpm.grid_update(momentum, mass, dt, GRAVITY.astype(np.float32))
    velocities = state.velocities[0, :used].reshape(*shape, 4)[..., :3]
    heavy = mass > 1e-3 * mass.max()  # a node that hardly anything reaches divides rounding by rounding
    found["velocity of nodes"] = velocities[heavy], momentum[heavy]

    gather(*arrays, *numbers)
    mls_mpm.grid_to_particles(x, v, c, momentum, dx, dt)
    found["velocity"], found["affine velocity"] = (state.v(), v), (state.c(), c)
    found["position"] = state.x() - params[0, layout.ORIGIN : layout.ORIGIN + 3], x
    found["next trial strain"] = state.e(), minus_identity((np.eye(3) + dt * c) @ f)
    return found


@pytest.mark.parametrize(
    ("name", "error"),
    [
        ("mass", 1e-6),
        ("momentum", 1e-5),
        ("elastic strain", 1e-5),
        ("velocity of nodes", 3e-5),
        ("velocity", 3e-5),
        ("affine velocity", 3e-5),
        ("position", 1e-6),
        ("next trial strain", 1e-5),
    ],
)
def test_each_stage_is_that_of_the_paper(stages: Stages, name: str, error: float) -> None:
    """Within the rounding of float32, of the largest."""
    ours, paper = stages[name]
    assert np.abs(paper).max() > 0
    assert np.abs(ours - paper).max() / np.abs(paper).max() < error


def test_some_particles_yield_and_some_do_not(stages: Stages) -> None:
    before, after = stages["trial strain"]
    yields = np.abs(before - after).max(axis=1) > 1e-4
    assert 0.2 < yields.mean() < 0.8
