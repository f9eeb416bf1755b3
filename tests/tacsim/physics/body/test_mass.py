"""Filter of the body's grid and motion of its nodes, against the same formulas for single nodes in float64."""

import numpy as np
import pytest

from tacsim.compute.runtime import start_taichi, ti
from tacsim.physics.body.grid_motion import Drive, grid_update
from tacsim.physics.body.mass import CHANGE, SECOND, cell_means, second_changes
from tacsim.physics.body.transfers import Body, Strips
from tacsim.physics.body.tuning import ROTATION_BOOST
from tacsim.physics.exec import layout
from tacsim.physics.exec.environment import Counts, Environment, Floats, Params, Partial
from tacsim.physics.exec.lanes import NODES, PARTS, aligned_zeros

SHAPE = (7, 6, 8)  # nodes; strips are whole
INSIDE = (slice(1, -1),) * 3  # nodes at the border have no mass
OWN, FILTERED, STEP, DAMPING, MASS_SCALE, PARTICLES = 1 / 3, 2 / 3, 0.2, 0.7, 0.4, 5


@ti.kernel
def substep(drive: Drive, velocities: Strips, changes: Floats, params: Params, counts: Counts, partial: Partial):
    ti.loop_config(serialize=True)
    for stage, part in ti.ndrange(4, PARTS):
        env = ti.static(Environment(0, params, counts, partial))
        body = ti.static(Body(None, None, velocities, changes))
        if stage == 0:
            cell_means(env, part, CHANGE, body)
        elif stage == 1:
            second_changes(env, part, body)
        elif stage == 2:
            cell_means(env, part, SECOND, body)
        else:
            grid_update(env, part, 1, drive, body)


def corner_sums(a: np.ndarray) -> np.ndarray:
    """Sums over the eight corners of each cell."""
    for axis in range(3):
        a = np.take(a, range(a.shape[axis] - 1), axis) + np.take(a, range(1, a.shape[axis]), axis)
    return a


def mean_around(momentum: np.ndarray, mass: np.ndarray) -> np.ndarray:
    """S: mean of the eight cells around each inner node, each with the mass-weighted mean of its nodes."""
    sums, masses = corner_sums(momentum), corner_sums(mass)[..., None]
    cells = np.divide(sums, masses, out=np.zeros_like(sums), where=masses > 0.0)
    found = np.zeros_like(momentum)
    found[INSIDE] = corner_sums(cells) / 8
    return found


def expected_velocities(
    old: np.ndarray, momentum: np.ndarray, mass: np.ndarray, drive: np.ndarray, p: np.ndarray, partial: np.ndarray
) -> np.ndarray:
    """Velocities after the substep, node by node; p: `params` of the environment."""
    second = 4 * mass[..., None] * mean_around(momentum, mass) - momentum
    filtered = 4 * mean_around(second, mass) - second / np.maximum(mass, 1e-9)[..., None]
    change = OWN * momentum / np.maximum(mass, 1e-9)[..., None] + FILTERED * filtered
    sums = partial.sum(axis=0)
    rotations, (p0, p1), (v0, v1), (w0, w1) = drive[:, :3], drive[:, 3], drive[:, 4], drive[:, 5]
    centre, gravity = p[layout.CENTRE : layout.CENTRE + 3], p[layout.GRAVITY : layout.GRAVITY + 3]
    push, torque = p[layout.BODY_MASS] * PARTICLES * gravity, np.zeros(3)
    touches = []
    for g, origin in enumerate((p0, p1)):
        force, moment = sums[layout.FORCE + 6 * g :][:3], sums[layout.FORCE + 6 * g + 3 :][:3]
        push = push - rotations[g] @ force
        torque = torque - rotations[g] @ moment - np.cross(origin - centre, rotations[g] @ force)
        touches.append(bool(force.any()))
    boost = (MASS_SCALE - 1) * STEP / (p[layout.BODY_MASS] * PARTICLES) * push
    xx, yy, zz, xy, xz, yz = p[layout.INVERSE_INERTIA : layout.INVERSE_INERTIA + 6]
    turn = ROTATION_BOOST * (MASS_SCALE - 1) * STEP * np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ torque
    axis, mean = p1 - p0, sums[layout.VELOCITY_SUM : layout.VELOCITY_SUM + 3] / PARTICLES
    axis_share = np.outer(axis, axis) / (axis @ axis)
    carried = np.eye(3) + p[layout.MEAN_GRADIENT : layout.MEAN_GRADIENT + 9].reshape(3, 3)
    found = np.zeros_like(old)
    for node in np.argwhere(mass > 0.0):
        arm = p[layout.ORIGIN : layout.ORIGIN + 3] + p[layout.BODY_CELL] * node
        x = centre + carried @ (arm - p[layout.REFERENCE_CENTRE : layout.REFERENCE_CENTRE + 3])
        velocity = old[tuple(node)] + change[tuple(node)] + boost + np.cross(turn, x - centre)
        t = np.clip((x - p0) @ axis / (axis @ axis), 0.0, 1.0) if all(touches) else float(touches[1])
        imposed = (1 - t) * (v0 + np.cross(w0, x - p0)) + t * (v1 + np.cross(w1, x - p1))
        if drive[:, 4:].any():
            imposed = axis_share @ imposed + mean - axis_share @ mean
        found[tuple(node)] = velocity - DAMPING * STEP * (velocity - imposed)
    return found


@pytest.mark.cpu
@pytest.mark.parametrize("case", ["between moving sensors", "on the upper sensor", "between sensors at rest"])
def test_strips_of_nodes_move_as_single_nodes_do(case: str) -> None:
    start_taichi()
    rng, capacity = np.random.default_rng(5), int(np.prod(SHAPE)) // NODES
    mass, momentum, old = np.zeros(SHAPE), np.zeros((*SHAPE, 3)), rng.normal(size=(*SHAPE, 3))
    mass[INSIDE] = rng.uniform(0.1, 2.0, mass[INSIDE].shape) * (rng.uniform(size=mass[INSIDE].shape) > 0.3)
    momentum[INSIDE] = mass[INSIDE][..., None] * rng.normal(size=(*mass[INSIDE].shape, 3))
    params, counts = np.zeros((1, layout.PARAMS), np.float32), np.zeros((1, layout.COUNTS), np.int32)
    params[0] = rng.normal(scale=0.3, size=layout.PARAMS)
    numbers = {
        layout.STEP: STEP, layout.BODY_CELL: 0.8, layout.BODY_DAMPING: DAMPING, layout.OWN_WEIGHT: OWN,
        layout.FILTERED_WEIGHT: FILTERED, layout.RIGID_MASS_SCALE: MASS_SCALE, layout.BODY_MASS: 0.5,
    }  # fmt: skip
    params[0, list(numbers)] = list(numbers.values())
    counts[0, layout.GRID : layout.GRID + 3], counts[0, layout.CAPACITY] = SHAPE, capacity
    counts[0, layout.PARTICLES] = PARTICLES
    partial = rng.normal(size=(1, PARTS, layout.NUMBERS)).astype(np.float32)
    drive = np.zeros((1, 2, 2, 6, 3), np.float32)
    drive[0, 1, :, :3] = np.linalg.qr(rng.normal(size=(2, 3, 3)))[0]
    drive[0, 1, :, 3] = [[0.1, 0.0, -1.0], [0.0, 0.2, 3.0]]
    if case == "between moving sensors":
        drive[0, 1, :, 4:] = rng.normal(size=(2, 2, 3))
    if case == "on the upper sensor":
        partial[0, :, layout.FORCE : layout.FORCE + 6] = 0.0
    changes = np.full((3, *SHAPE, 4), np.nan, np.float32)  # what is not written must not be read
    changes[CHANGE, ..., :3], changes[CHANGE, ..., 3] = momentum, mass
    velocities = aligned_zeros(capacity, 4 * NODES)
    velocities.reshape(*SHAPE, 4)[..., :3] = old
    substep(drive, velocities, changes.reshape(-1), params, counts, partial)
    wanted = expected_velocities(
        old, momentum, mass, drive[0, 1].astype(float), params[0].astype(float), partial[0].astype(float)
    )
    assert velocities.reshape(*SHAPE, 4)[..., :3] == pytest.approx(wanted, abs=3e-5 * np.abs(wanted).max())
    assert not velocities.reshape(*SHAPE, 4)[..., 3].any()
