"""Light nodes of the body's grid: which they are, that linear motions are met, and that momentum stays."""

import numpy as np
import pytest

from tacsim.compute.runtime import start_taichi, ti
from tacsim.geometry.sampling import body_points
from tacsim.models.scene import Body as BodyModel
from tacsim.models.scene import Box, Cylinder, Shape, Sphere
from tacsim.physics.body.grid_motion import Drive, grid_update
from tacsim.physics.body.mass import grid_changes
from tacsim.physics.body.plasticine import BodyState, bounds_of_points, grid_around
from tacsim.physics.body.tied_node_kernels import Ends, set_tied_velocities, transfer_impulses
from tacsim.physics.body.tied_nodes import node_masses, tie_light_nodes, tied_node_links
from tacsim.physics.body.transfers import Body, Strips
from tacsim.physics.body.tuning import MAX_TIED_NODE_MASS, STENCIL_REACH
from tacsim.physics.exec import layout
from tacsim.physics.exec.environment import Counts, Environment, Floats, Params, Partial
from tacsim.physics.exec.lanes import COPIES, NODES, PARTS

SPACING = 0.5  # of particles [mm]
CELL = 2 * SPACING
GRAVITY = np.array([0.001, -0.002, -0.01])  # [1/mm]
SHAPES = {
    "box": Box(size=(4e-3, 3e-3, 5e-3)),
    "cylinder": Cylinder(radius=3e-3, height=4e-3),
    "ball": Sphere(radius=2.7e-3),
}


def points_of(shape: Shape, sampling: str) -> np.ndarray:
    body = BodyModel.model_validate({"geometry": shape, "sampling": sampling})
    points: np.ndarray = (body_points(body, SPACING * 1e-3) * 1e3).astype(np.float32)
    return points


def laid(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Places of the nodes of the grid round points (n, 3), and particle masses on them."""
    origin, shape = grid_around(*bounds_of_points(points), CELL, STENCIL_REACH * CELL)
    places = origin + CELL * np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1)
    return places.reshape(-1, 3), node_masses(points, origin, CELL, shape)


def spline(s: np.ndarray) -> np.ndarray:
    """The quadratic B-spline about 0 (Steffen et al. 2008)."""
    a = np.abs(s)
    return np.where(a < 0.5, 0.75 - a**2, np.where(a < 1.5, 0.5 * (1.5 - a) ** 2, 0.0))


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("sampling", ["lattice", "random"])
def test_what_follows_is_light_and_meets_linear_fields(shape: str, sampling: str) -> None:
    points = points_of(SHAPES[shape], sampling)
    places, masses = laid(points)
    expected = spline((points[:, None] - places) / CELL).prod(axis=2).sum(axis=0)
    assert masses.ravel() == pytest.approx(expected, abs=2e-5)
    follower, leader, share = tie_light_nodes(masses)
    light = np.flatnonzero((masses.ravel() > 0.0) & (masses.ravel() < MAX_TIED_NODE_MASS))
    assert len(light) and set(light) <= set(follower) and not set(follower) & set(leader)
    assert (masses.ravel()[leader] >= MAX_TIED_NODE_MASS).all()
    carried = masses.ravel().copy()
    np.add.at(carried, leader, share * carried[follower])
    assert carried[leader].min() > MAX_TIED_NODE_MASS / 2
    field = 0.3 + places @ [0.2, -0.7, 0.4]
    value = np.bincount(follower, share * field[leader], len(field))[light]
    assert value == pytest.approx(field[light], abs=1e-6)
    assert np.linalg.norm(places[leader] - places[follower], axis=1).max() <= 3 * CELL + 1e-5


def test_leaders_in_a_plane_give_their_mean_across_it() -> None:
    """A sheet tells no slope across itself: what is off it moves as it does, whatever its distance."""
    masses = np.zeros((9, 9, 9))
    masses[3:6, 3:6, 3], masses[4, 4, 5] = 8.0, MAX_TIED_NODE_MASS / 2
    follower, leader, share = tie_light_nodes(masses)
    x, y, _ = np.unravel_index(leader, masses.shape)
    assert set(follower) == {np.ravel_multi_index((4, 4, 5), masses.shape)}
    assert share.sum() == pytest.approx(1.0, abs=1e-6)
    assert share @ (2.0 + x - 3.0 * y) == pytest.approx(2.0 + 4.0 - 3.0 * 4.0, abs=1e-6)


def test_full_node_left_without_mass_is_tied() -> None:
    """Shares of leaders beyond the nearest are negative: nine light nodes take more from one that is hardly heavy."""
    masses = np.zeros((11, 9, 9))
    masses[3, 4, 4], masses[4, 4, 4] = MAX_TIED_NODE_MASS, 8.0
    masses[5, 3:6, 3:6] = 0.99 * MAX_TIED_NODE_MASS
    follower, leader, share = tie_light_nodes(masses)
    hardly = np.ravel_multi_index((3, 4, 4), masses.shape)
    assert hardly in follower and hardly not in leader
    assert set(leader) == {np.ravel_multi_index((4, 4, 4), masses.shape)}
    assert np.bincount(follower, share)[follower] == pytest.approx(1.0, abs=1e-6)


@ti.kernel
def substep(
    drive: Drive, particles: Floats, masses: Strips, velocities: Strips, changes: Floats, ends: Ends, shares: Floats,
    params: Params, counts: Counts, partial: Partial,
):  # fmt: skip
    ti.loop_config(serialize=True)
    for stage, part in ti.ndrange(3, PARTS):
        env = ti.static(Environment(0, params, counts, partial))
        body = ti.static(Body(particles, masses, velocities, changes, ends, shares))
        if stage == 0:
            grid_changes(env, part, body)
            transfer_impulses(env, part, body)
        elif stage == 1:
            grid_update(env, part, 0, drive, body)
        else:
            set_tied_velocities(env, part, body)


@pytest.mark.cpu
@pytest.mark.parametrize("shape", SHAPES)
def test_momentum_and_angular_momentum_stay(shape: str) -> None:
    """Whatever the nodes bring: their motion afterwards has it, with light ones that move as their leaders do."""
    start_taichi()
    points = points_of(SHAPES[shape], "random")
    places, mass = laid(points)
    state = BodyState([points])
    params = np.zeros((1, layout.PARAMS), np.float32)
    counts, partial = np.zeros((1, layout.COUNTS), np.int32), np.zeros((1, PARTS, layout.NUMBERS), np.float32)
    params[0, layout.BODY_CELL], params[0, layout.STEP], params[0, layout.RIGID_MASS_SCALE] = CELL, 0.4, 1.0
    params[0, layout.GRAVITY : layout.GRAVITY + 3] = GRAVITY
    params[0, layout.BODY_MASS] = 1.0
    state.fit_grid(0, CELL, STENCIL_REACH * CELL, params, counts)
    nx, ny, nz = counts[0, layout.GRID : layout.GRID + 3]
    assert (nx, ny, nz) == mass.shape
    rng, used = np.random.default_rng(3), nx * ny * nz // NODES
    momentum = mass.ravel()[:, None] * rng.normal(scale=0.01, size=(mass.size, 3))
    brought = np.concatenate([momentum, mass.reshape(-1, 1)], axis=1).astype(np.float32).reshape(used, -1)
    copy = counts[0, layout.SLAB : layout.SLAB + 2 * COPIES : 2].argmin()  # one whose slab holds plane 0 ...
    counts[0, layout.SLAB + 2 * copy : layout.SLAB + 2 * copy + 2] = 0, nx  # ... and now all of them
    state.masses[0, copy, :used] = brought
    drive = np.zeros((1, 1, 2, 6, 3), np.float32)
    substep(drive, *state.arguments(), state.changes.reshape(-1), *state.links(), params, counts, partial)
    velocity = state.velocities[0, :used].reshape(-1, 4)[:, :3].astype(np.float64)
    pushed = momentum + 0.4 * mass.reshape(-1, 1) * GRAVITY
    moved = mass.reshape(-1, 1) * velocity
    assert moved.sum(axis=0) == pytest.approx(pushed.sum(axis=0), abs=1e-5 * np.abs(pushed).sum())
    turning = np.cross(places, pushed).sum(axis=0)
    assert np.cross(places, moved).sum(axis=0) == pytest.approx(turning, abs=1e-5 * np.abs(places).max() * mass.sum())
    found = tied_node_links(mass)
    (light, heavy), share = found.ends[1], found.shares[1]
    told = np.stack([np.bincount(light, share * velocity[heavy, d], mass.size) for d in range(3)], axis=1)
    assert velocity[light] == pytest.approx(told[light], abs=1e-6)
    assert np.abs(velocity[light]).max() > 1e-3


def test_links_are_kept_between_launches_and_found_again_for_new_grid() -> None:
    points = points_of(SHAPES["cylinder"], "lattice")
    state = BodyState([points, points])
    params, counts = np.zeros((2, layout.PARAMS), np.float32), np.zeros((2, layout.COUNTS), np.int32)

    def fit(environment: int) -> np.ndarray:
        state.fit_grid(environment, CELL, STENCIL_REACH * CELL, params, counts)
        return counts[environment, layout.IMPULSE_LINKS : layout.COUNTS].copy()

    first, known = fit(1), state._linked[1]
    assert (fit(1) == first).all() and state._linked[1] is known
    state.x(1)[:] = points_of(SHAPES["ball"], "lattice")[: len(points)].mean(axis=0)
    state.x(1)[:, 2] += np.linspace(0.0, 9.0, len(points))
    assert state._linked[1] is known  # particles move on a grid that stays
    state.move_reference(1)
    assert (fit(1) != first).any()
    assert counts[1, layout.LINKS] == counts[0, layout.LINKS] == state.shares.shape[2]
    number = counts[1, layout.IMPULSE_LINKS + PARTS]
    assert (state.ends[1, :, :, :number] < np.prod(counts[1, layout.GRID : layout.GRID + 3])).all()
