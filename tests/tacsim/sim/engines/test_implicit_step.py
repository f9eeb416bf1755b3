"""One implicit step of MuJoCo with a spring in the place of a gel, against closed forms."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tacsim.sim.engines.implicit_step import MAX_SOLUTIONS, constraint_hessian, inertia, step_with_wrenches
from tacsim.sim.engines.mujoco_module import load_mujoco
from tests.tacsim.sim.engines.gripper import load

# a thing on a vertical slide, above it a finger on another; a table below; gravity off unless given
SCENE = """<mujoco><option timestep="{dt}" integrator="{integrator}" gravity="0 0 {g}"/><worldbody>
  {table}
  <body name="thing"><joint type="slide" axis="0 0 1" damping="{damping}"/>
    <geom type="sphere" size=".01" mass="{mass}"/></body>
  <body name="finger" pos="0 0 .05"><joint type="slide" axis="0 0 1"/>
    <geom type="sphere" size=".01" mass="{finger}" contype="0" conaffinity="0"/></body></worldbody></mujoco>"""
TABLE = '<geom type="plane" size="1 1 1" pos="0 0 -.01"/>'


def scene(
    dt: float = 1e-3, mass: float = 0.005, finger: float = 0.1, g: float = 0.0, table: bool = False,
    damping: float = 0.0, integrator: str = "implicitfast",
) -> tuple[Any, Any]:  # fmt: skip
    given = {"dt": dt, "mass": mass, "finger": finger, "g": g, "damping": damping, "integrator": integrator}
    return load(SCENE.format(table=TABLE if table else "", **given))


class Spring:
    """A wrench of one number: `force` now, and a stiffness."""

    def __init__(self, force: float, stiffness: float) -> None:
        self.force, self.stiffness = force, stiffness

    def after(self, motions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        along = np.zeros((1, 6, 6))
        along[0, 0, 0] = self.stiffness
        return np.array([self.force, 0, 0, 0, 0, 0]) + motions @ along[0], along


JACOBIAN = np.array([[1.0, -1.0], *[[0.0, 0.0]] * 5])  # motion of the thing relative to the finger


def step(model: Any, data: Any, spring: float) -> int:
    """With a spring between both bodies."""
    load_mujoco().mj_step1(model, data)
    return step_with_wrenches(model, data, JACOBIAN, Spring(spring * (data.qpos[0] - data.qpos[1]), spring))


@pytest.mark.parametrize("integrator", ["Euler", "implicit", "implicitfast"])
def test_a_step_solves_the_implicit_equation_of_both_bodies(integrator: str) -> None:
    model, data = scene(integrator=integrator, damping=0.7)
    data.qpos[:], data.qvel[:] = [1e-4, 0.0], [0.02, -0.01]
    data.qfrc_applied[:] = [0.1, -0.2]
    spring, dt, mass = 40e3, 1e-3, np.diag([0.005, 0.1])
    before, velocity = data.qpos.copy(), data.qvel.copy()
    matrix = mass + dt * np.diag([0.7, 0.0]) + dt * dt * spring * JACOBIAN.T @ JACOBIAN
    pushed = mass @ velocity + dt * (data.qfrc_applied - spring * JACOBIAN.T @ JACOBIAN @ before)
    assert step(model, data, spring) <= 2
    assert data.qvel == pytest.approx(np.linalg.solve(matrix, pushed), rel=1e-6)
    assert data.qpos == pytest.approx(before + dt * data.qvel)
    assert data.qfrc_applied.tolist() == [0.1, -0.2]


@pytest.mark.parametrize("dt", [0.5e-3, 1e-3, 2e-3])
@pytest.mark.parametrize("mass", [0.005, 0.5])
def test_a_stiff_spring_between_two_bodies_never_gains_energy(dt: float, mass: float) -> None:
    model, data = scene(dt=dt, mass=mass, finger=0.05)
    data.qpos[0], spring = 1e-4, 400e3
    energy = [0.5 * spring * 1e-8]
    for _ in range(200):
        step(model, data, spring)
        energy.append(
            0.5 * spring * (data.qpos[0] - data.qpos[1]) ** 2
            + 0.5 * mass * data.qvel[0] ** 2
            + 0.025 * data.qvel[1] ** 2
        )
    assert max(energy) <= energy[0] * (1 + 1e-9) and energy[-1] < 1e-3 * energy[0]
    assert mass * data.qvel[0] + 0.05 * data.qvel[1] == pytest.approx(0.0, abs=1e-9)  # momentum


def test_what_presses_a_light_thing_on_a_table_presses_with_its_whole_force() -> None:
    """A step that foresaw the thing falling through the table would press with a sixth of the force."""
    model, data = scene(mass=0.005, table=True)
    data.qfrc_applied[1] = -3.0  # what presses the finger
    for _ in range(300):
        load_mujoco().mj_step1(model, data)
        solutions = step_with_wrenches(model, data, JACOBIAN, Spring(3.0, 40e3))
        assert abs(data.qfrc_constraint[0]) < 20.0
    assert solutions < MAX_SOLUTIONS
    assert data.qfrc_constraint[0] == pytest.approx(3.0, rel=1e-3)


def test_the_hessian_of_active_constraints_is_that_of_the_solver() -> None:
    """Where a contact is active, the acceleration changes with the force by 1 / (M + J^T D J)."""
    model, data = scene(mass=0.05, table=True, g=-9.81)
    mujoco = load_mujoco()
    for _ in range(200):
        mujoco.mj_step(model, data)
    mujoco.mj_forward(model, data)
    before = data.qacc.copy()
    stiff = inertia(model, data) + constraint_hessian(model, data)
    data.qfrc_applied[0] = 1e-4
    mujoco.mj_forward(model, data)
    assert data.qacc - before == pytest.approx(np.linalg.solve(stiff, [1e-4, 0.0]), rel=1e-3, abs=1e-9)


def test_constraints_that_a_push_releases_are_not_in_the_hessian() -> None:
    """A box slides: half of the edges of each friction pyramid carry nothing. MuJoCo solves by islands here."""
    model, data = load("""<mujoco><option timestep=".001" integrator="implicitfast"/><worldbody>
      <geom type="plane" size="1 1 1"/><body pos="0 0 .02"><freejoint/>
      <geom type="box" size=".01 .01 .02" mass=".05" friction=".3"/></body></worldbody></mujoco>""")
    mujoco = load_mujoco()
    for _ in range(300):
        mujoco.mj_step(model, data)
    data.qfrc_applied[0] = 0.25  # [N]; it slides from 0.15 N on
    mujoco.mj_forward(model, data)
    assert 0 < np.count_nonzero(data.efc_force) < data.nefc and data.nisland > 0
    before = data.qacc.copy()
    stiff = inertia(model, data) + constraint_hessian(model, data)
    push = np.array([1e-5, 0.0, 2e-5, 0.0, 1e-7, 0.0])
    data.qfrc_applied[:] += push
    mujoco.mj_forward(model, data)
    assert data.qacc - before == pytest.approx(np.linalg.solve(stiff, push), rel=1e-2, abs=1e-5)
