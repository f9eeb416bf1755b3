"""What stops the robot behind the sockets, in simulated time: safety states, limits, forces on the tool."""

from __future__ import annotations

import math

import numpy as np
import pytest

from robot.common.kinematics import displacement, matrix
from robot.mock.ur.machine.arm import PERIOD
from robot.mock.ur.machine.forces import GRAVITY, Mass, Wall
from robot.mock.ur.machine.state import Mode, Runtime, Safety
from tests.robot.mock.machine_bench import Bench
from tests.robot.mock.wire_client import control_script


def test_watchdog_stops_only_silent_client(bench: Bench) -> None:
    bench.call(35, [10.0])
    bench.call(10, [0, 0, -0.02, 0, 0, 0, 0.5, 0])
    for _ in range(20):
        bench.tick(40)
        bench.machine.on_int_register(0)
    assert bench.machine.program is not None
    ticks = bench.until(lambda: bench.machine.program is None)
    assert ticks * PERIOD == pytest.approx(0.1, abs=2 * PERIOD)
    assert "watchdog" in bench.machine.stop_reason
    bench.until(lambda: bench.arm.rests, limit=0.2)


def test_protective_stop_brakes_and_needs_unlock(bench: Bench) -> None:
    bench.call(10, [0, 0, -0.2, 0, 0, 0, 1.0, 0])
    bench.tick(200)
    bench.machine.protective_stop("test")
    assert bench.machine.program is None and bench.machine.safety_status_bits == 1 << 2 | 1 << 10
    bench.until(lambda: bench.arm.rests, limit=0.2)
    assert not bench.machine.start(control_script())
    assert bench.machine.unlock() and bench.machine.start(control_script())


def test_unlock_delay_refuses_early_unlock(bench: Bench) -> None:
    bench.machine.unlock_delay = 5.0
    bench.machine.protective_stop("test")
    assert not bench.machine.unlock()
    bench.tick(2501)
    assert bench.machine.unlock()


def test_emergency_stop_removes_power_until_restart(bench: Bench) -> None:
    machine = bench.machine
    bench.call(10, [0, 0, -0.2, 0, 0, 0, 1.0, 0])
    bench.tick(200)
    machine.emergency_stop()
    assert machine.mode is Mode.RUNNING and not bench.arm.rests  # it brakes first
    bench.until(lambda: machine.mode is Mode.POWER_OFF, limit=0.3)
    assert machine.status_bits & 1 == 0
    machine.power_on()
    assert machine.mode is Mode.POWER_OFF  # the button is still in
    machine.release_emergency_stop()
    machine.power_on()
    bench.until(lambda: machine.mode is Mode.IDLE, limit=1)
    assert not machine.start(control_script())
    machine.release_brakes()
    bench.until(lambda: machine.mode is Mode.RUNNING, limit=1)
    assert machine.start(control_script())


def test_safeguard_stop_pauses_and_motion_continues(bench: Bench) -> None:
    goal = bench.shifted(0, 0, -0.1)
    bench.write(3, [*goal, 0.1, 0.5])
    bench.tick(200)
    bench.machine.safeguard_stop(True)
    assert bench.machine.runtime is Runtime.PAUSING
    bench.until(lambda: bench.machine.runtime is Runtime.PAUSED, limit=1)
    where = bench.arm.target_q.copy()
    bench.tick(500)
    np.testing.assert_array_equal(bench.arm.target_q, where)
    bench.machine.safeguard_stop(False)
    bench.until(lambda: bench.machine.out_int[0] == 2)
    assert float(np.abs(bench.arm.target_qdd).max()) < 40  # no jump where it went on
    np.testing.assert_allclose(displacement(bench.arm.target_frame, matrix(goal)), 0, atol=1e-8)


def test_wall_force_is_removed_by_zeroing(bench: Bench) -> None:
    z = float(bench.arm.frame[2, 3])
    bench.machine.load.wall = Wall(z - 0.01, 1000.0)
    bench.call(3, [*bench.shifted(0, 0, -0.02), 0.1, 0.5])
    bench.tick(100)
    np.testing.assert_allclose(bench.machine.load.zeroed_wrench, [0, 0, 10, 0, 0, 0], atol=1e-6)
    bench.machine.load.wrench = np.array([1.0, 2, 3, 0.1, 0.2, 0.3])
    bench.tick()
    np.testing.assert_allclose(bench.machine.load.zeroed_wrench, [1, 2, 13, 0.1, 0.2, 0.3], atol=1e-6)
    bench.call(8)
    np.testing.assert_allclose(bench.machine.load.zeroed_wrench, 0, atol=1e-9)
    bench.machine.load.wrench = np.zeros(6)
    bench.tick()
    np.testing.assert_allclose(bench.machine.load.zeroed_wrench, [-1, -2, -3, -0.1, -0.2, -0.3], atol=1e-6)


def test_force_beyond_limit_is_protective_stop(bench: Bench) -> None:
    bench.machine.load.wall = Wall(float(bench.arm.frame[2, 3]), 20e3)
    bench.call(3, [*bench.shifted(0, 0, -0.05), 0.05, 0.5])
    assert bench.machine.safety is Safety.PROTECTIVE_STOP and "force" in bench.machine.stop_reason
    assert 250 < bench.machine.load.unexplained[2] < 262  # stopped at once, not after a way


def test_hidden_payload_rotates_with_tool(bench: Bench) -> None:
    bench.machine.load.hidden = Mass(2.0, (0.0, 0.1, 0.0))
    bench.tick()
    weight = 2.0 * GRAVITY
    arm_of_force = bench.arm.frame[:3, 1] * 0.1
    np.testing.assert_allclose(bench.machine.load.zeroed_wrench[:3], [0, 0, -weight], atol=1e-9)
    np.testing.assert_allclose(bench.machine.load.zeroed_wrench[3:], np.cross(arm_of_force, [0, 0, -weight]), atol=1e-9)
    bench.call(1, [*(bench.arm.target_q + [0.3, 0.2, -0.4, 0.6, -0.3, 0.8]), 1.0, 1.0])
    bench.until(lambda: bench.arm.rests)
    bench.call(8)  # zeroed in this attitude, felt again in another
    np.testing.assert_allclose(bench.machine.load.zeroed_wrench, 0, atol=1e-9)
    axis = bench.arm.kinematics.jacobian(bench.arm.q)[3:, 4]
    sideways = math.sqrt(1 - axis[2] ** 2)  # the part of gravity across the axis of the next turn
    bench.call(1, [*(bench.arm.target_q + [0, 0, 0, 0, 0.5, 0]), 1.0, 1.0])
    bench.until(lambda: bench.arm.rests)
    assert np.linalg.norm(bench.machine.load.zeroed_wrench[:3]) == pytest.approx(
        2 * weight * sideways * math.sin(0.25), rel=1e-6
    )


def test_contact_is_detected_and_arm_returns(bench: Bench) -> None:
    top = float(bench.arm.frame[2, 3]) - 0.02
    bench.machine.load.wall = Wall(top, 5000.0)
    bench.call(51, [0, 0, -0.05, 0, 0, 0, 0, 0, -1, 0, 0, 0, 0.5])
    bench.until(lambda: bench.arm.rests)
    # It stops where the force began to be felt: 1 N, which is 0.2 mm deep, a period's way more or less.
    assert bench.arm.frame[2, 3] == pytest.approx(top - 0.2e-3, abs=0.15e-3)


def test_freedrive_moves_only_along_free_axes(bench: Bench) -> None:
    start = bench.arm.frame[:3, 3].copy()
    bench.call(52, [0] * 6, [1, 0, 1, 0, 0, 0])
    assert bench.machine.status_bits & 4
    bench.machine.load.wrench = np.array([10.0, 10.0, 0, 0, 0, 0])
    bench.tick(500)
    moved = bench.arm.frame[:3, 3] - start
    assert moved[0] > 0.02 and abs(moved[1]) < 1e-5
    bench.call(53)
    bench.until(lambda: bench.arm.rests)
    assert bench.machine.status_bits & 4 == 0
