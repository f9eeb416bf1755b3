"""Force mode in simulated time: giving way against the closed solutions of its model, task frames, motion besides."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest

from robot.common.kinematics import displacement, matrix, pose, rotation
from robot.mock.ur.machine.arm import PERIOD
from robot.mock.ur.machine.forces import FULL_DAMPING, MASS, Wall
from robot.mock.ur.machine.state import Runtime, Safety
from tacsim.interface import FloatArray
from tests.robot.mock.machine_bench import Bench

FAST = (0.5, 0.5, 0.5, 2, 2, 2)
Z = (0, 0, 1, 0, 0, 0)
GAIN, DAMPING = 0.5, 0.025


def begin(
    bench: Bench,
    force: Sequence[float],
    free: Sequence[int] = Z,
    *,
    kind: int = 2,
    frame: Sequence[float] | FloatArray = (0.0,) * 6,
    limits: Sequence[float] = FAST,
) -> None:
    bench.write(6, [*frame, *force, *[0.0] * (6 - len(force)), *limits], [kind, *free])
    bench.tick()


def set_response(bench: Bench, gain: float = GAIN, damping: float = DAMPING) -> None:
    bench.call(20, [damping])
    bench.call(21, [gain])


def test_force_mode_free_tool_accelerates_like_damped_mass(bench: Bench) -> None:
    set_response(bench, damping=1e-3)
    begin(bench, (5, 0, 0), (1, 0, 0, 0, 0, 0))
    damping = 1e-3 * FULL_DAMPING[0]
    speeds, begun = [], bench.machine.ticks - 1
    for _ in range(5):
        bench.tick(50)
        time = (bench.machine.ticks - begun) * PERIOD - 0.004  # the servos trail by 4 ms
        speeds.append(GAIN * 5 / damping * (1 - math.exp(-damping * time / MASS[0])))
        assert bench.arm.twist[0] == pytest.approx(speeds[-1], rel=0.02)
    assert speeds[0] < 0.5 * speeds[-1]


@pytest.mark.parametrize(("damping", "left"), [(0.0, 1.0), (1.0, 0.0)])
def test_force_mode_damping_sets_coasting(bench: Bench, damping: float, left: float) -> None:
    set_response(bench, damping=0.0)
    begin(bench, (0, 0, 0), (1, 1, 1, 0, 0, 0))
    bench.machine.load.wrench[:2] = [3.0, 4.0]
    bench.tick(50)
    bench.machine.load.wrench[:2] = 0.0
    bench.tick(20)
    speed = bench.arm.twist[:2].copy()
    np.testing.assert_allclose(speed, GAIN * np.array([3.0, 4.0]) * 0.1 / MASS[0], rtol=0.05)
    set_response(bench, damping=damping)
    begin(bench, (0, 0, 0), (1, 1, 1, 0, 0, 0))
    bench.tick(50)
    np.testing.assert_allclose(bench.arm.twist[:2], left * speed, atol=1e-3)


def test_force_mode_compliant_speed_is_limited(bench: Bench) -> None:
    begin(bench, (0, 0, -200), limits=(1, 1, 0.03, 1, 1, 1))
    bench.tick(300)
    np.testing.assert_allclose(bench.arm.twist, [0, 0, -0.03, 0, 0, 0], atol=1e-6)


@pytest.mark.slow
def test_force_mode_on_spring_follows_differential_equation(bench: Bench) -> None:
    stiffness, force = 200.0, 10.0
    top = float(bench.arm.frame[2, 3])
    bench.machine.load.wall = Wall(top, stiffness)
    begin(bench, (0, 0, -force))
    damping = DAMPING * FULL_DAMPING[2]
    roots = np.roots([MASS[2], damping, GAIN * stiffness])
    for _ in range(6):
        bench.tick(500)
        time = bench.machine.ticks * PERIOD
        share = (roots[1] * np.exp(roots[0] * time) - roots[0] * np.exp(roots[1] * time)) / (roots[0] - roots[1])
        assert bench.machine.load.zeroed_wrench[2] == pytest.approx(force * (1 + share), rel=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("stiffness", [1e3, 10e3, 50e3])
def test_force_mode_reaches_desired_force(bench: Bench, stiffness: float) -> None:
    start = bench.arm.target_frame.copy()
    bench.machine.load.wall = Wall(float(start[2, 3]) - 0.005, stiffness)
    begin(bench, (0, 0, -10), limits=(0.1, 0.1, 0.05, 1, 1, 1))
    bench.tick(3000)
    assert bench.machine.load.zeroed_wrench[2] == pytest.approx(10.0, abs=0.01)
    moved = displacement(start, bench.arm.frame)
    np.testing.assert_allclose(np.delete(moved, 2), 0, atol=1e-7)
    assert not bench.machine.steady
    bench.call(7)
    bench.until(lambda: bench.machine.steady)
    np.testing.assert_allclose(displacement(bench.arm.target_frame, bench.arm.frame), 0, atol=1e-9)


def test_force_mode_torque_rotates_tool_about_tcp(bench: Bench) -> None:
    bench.call(29, [0, 0, 0.1, 0, 0, 0])
    start = bench.arm.frame.copy()
    begin(bench, (0, 0, 0, 0, 0, 0.3), (0, 0, 0, 0, 0, 1))
    bench.tick(500)
    moved = displacement(start, bench.arm.frame)
    speed = GAIN * 0.3 / (DAMPING * FULL_DAMPING[5])
    assert moved[5] == pytest.approx(speed, rel=0.02)
    np.testing.assert_allclose(moved[:5], 0, atol=1e-6)


MOTIONS = {
    "moveL": (3, lambda goal: [*goal, 0.1, 0.5], 1),
    "moveJ_IK": (2, lambda goal: [*goal, 0.5, 1.0], 1),
    "servoL": (24, lambda goal: [*goal, 0, 0, 0.002, 0.1, 300], 0),
    "speedL": (10, lambda goal: [0.05, 0.02, 0, 0, 0, 0, 0.5, 0.0], 0),
}


@pytest.mark.slow
@pytest.mark.parametrize("motion", MOTIONS)
def test_force_mode_other_axes_follow_motion_at_constant_force(bench: Bench, motion: str) -> None:
    """Sideways along a table, while it is pressed with 10 N."""
    start = bench.arm.target_frame.copy()
    bench.machine.load.wall = Wall(float(start[2, 3]), 10e3)
    begin(bench, (0, 0, -10))
    bench.tick(1000)
    command, doubles, asynchronous = MOTIONS[motion]
    goal = pose(start) + [0.08, 0.03, 0, 0, 0, 0]
    bench.write(command, doubles(goal), [asynchronous])
    forces, off = [], []
    for _ in range(900):
        bench.tick()
        forces.append(bench.machine.load.zeroed_wrench[2])
        step = displacement(bench.arm.target_frame, bench.arm.kinematics.forward(bench.arm.set_q, bench.arm.tool))
        off.append(np.abs(np.delete(step, 2)).max())
    assert bench.machine.program is not None, bench.machine.stop_reason
    assert max(off) < 1e-7
    assert min(forces) > 9.5 and max(forces) < 10.5
    if motion == "speedL":
        np.testing.assert_allclose(bench.arm.twist[:3], [0.05, 0.02, 0], atol=1e-5)
    else:
        np.testing.assert_allclose(bench.arm.frame[:2, 3], goal[:2], atol=1e-5)
    assert bench.arm.frame[2, 3] == pytest.approx(start[2, 3] - 1e-3, abs=1e-5)


def test_force_mode_ignores_motion_along_compliant_axis(bench: Bench) -> None:
    z = float(bench.arm.frame[2, 3])
    begin(bench, (0, 0, 0))
    bench.write(3, [*bench.shifted(0.05, 0, -0.05), 0.1, 0.5], [1])
    bench.tick(800)
    assert bench.arm.frame[2, 3] == pytest.approx(z, abs=1e-6)


@pytest.mark.slow
def test_force_mode_type_1_presses_towards_point(bench: Bench) -> None:
    """y of the task frame points from the TCP to the point, wherever the TCP is."""
    point = bench.arm.frame[:3, 3] + [0.2, 0.1, -0.1]
    begin(bench, (0, 10, 0), (0, 1, 0, 0, 0, 0), kind=1, frame=[*point, 0.3, -0.2, 0.5])
    bench.tick(200)
    for _ in range(2):
        towards = point - bench.arm.frame[:3, 3]
        speed = GAIN * 10 / (DAMPING * FULL_DAMPING[1])
        wanted = speed * towards / np.linalg.norm(towards)
        np.testing.assert_allclose(bench.arm.twist[:3], wanted, atol=2e-4)
        np.testing.assert_allclose(bench.arm.twist[3:], 0, atol=1e-9)
        begin(bench, (0, 0, 0), (0, 0, 0, 0, 0, 0), kind=1, frame=[*point, 0.3, -0.2, 0.5])
        bench.call(3, [*bench.shifted(0.1, -0.1, 0), 0.2, 1.0], [0])
        begin(bench, (0, 10, 0), (0, 1, 0, 0, 0, 0), kind=1, frame=[*point, 0.3, -0.2, 0.5])
        bench.tick(200)
    begin(bench, (0, 100, 0), (0, 1, 0, 0, 0, 0), kind=1, frame=[*point, 0.3, -0.2, 0.5])
    bench.until(lambda: bench.machine.program is None)
    assert "10 mm" in bench.machine.stop_reason and bench.machine.force_mode is None


def test_force_mode_type_3_presses_across_motion(bench: Bench) -> None:
    """x of the task frame is the TCP's motion in the frame's x-y plane; standing still from the beginning nothing gives
    way, standing still again the frame stays (UR5e user manual, force mode "Motion")."""
    frame = [0, 0, 0, 0, 0, 0.7]
    turn = rotation(frame[3:])
    begin(bench, (0, 10, 0), (0, 1, 0, 0, 0, 0), kind=3, frame=frame)
    start = bench.arm.frame.copy()
    bench.tick(200)
    np.testing.assert_allclose(displacement(start, bench.arm.frame), 0, atol=1e-12)
    sideways = GAIN * 10 / (DAMPING * FULL_DAMPING[1])
    for angle in (0.4, 1.9):
        along = turn @ [math.cos(angle), math.sin(angle), 0.0]
        across = turn @ [-math.sin(angle), math.cos(angle), 0.0]
        bench.write(10, [*(0.03 * along), 0, 0, 0, 0.5, 0.0])
        bench.tick(200)
        np.testing.assert_allclose(bench.arm.twist[:3], 0.03 * along + sideways * across, atol=2e-4)
    bench.call(15, [5.0])
    bench.tick(200)
    np.testing.assert_allclose(bench.arm.twist[:3], sideways * across, atol=2e-4)


def test_force_mode_pause_holds_and_play_continues(bench: Bench) -> None:
    begin(bench, (0, 0, -10))
    bench.tick(100)
    bench.machine.safeguard_stop(True)
    bench.until(lambda: bench.machine.runtime is Runtime.PAUSED, limit=1)
    held = bench.arm.q.copy()
    bench.tick(300)
    np.testing.assert_allclose(bench.arm.q, held, atol=1e-9)
    bench.machine.safeguard_stop(False)
    bench.tick(300)
    assert bench.arm.twist[2] == pytest.approx(-GAIN * 10 / (DAMPING * FULL_DAMPING[2]), rel=0.01)


@pytest.mark.parametrize("end", ["protective stop", "program"])
def test_force_mode_ends_with_program(bench: Bench, end: str) -> None:
    begin(bench, (0, 0, -100))
    bench.write(10, [0.1, 0, 0, 0, 0, 0, 0.5, 0.0])
    bench.tick(200)
    if end == "program":
        bench.machine.stop("test")
    else:
        bench.machine.protective_stop("test")
    assert bench.machine.force_mode is None
    begun = bench.arm.frame.copy()
    bench.until(lambda: bench.arm.rests, limit=0.5)
    assert np.linalg.norm(displacement(begun, bench.arm.frame)[:3]) < 0.02
    rest = bench.arm.q.copy()
    bench.tick(200)
    np.testing.assert_allclose(bench.arm.q, rest, atol=1e-9)


def test_force_mode_out_of_reach_ends_program_only(bench: Bench) -> None:
    begin(bench, (-100, 0, 0), (1, 0, 0, 0, 0, 0))
    bench.until(lambda: bench.machine.program is None)
    bench.until(lambda: bench.arm.rests)
    assert "out of reach" in bench.machine.stop_reason or bench.machine.safety is Safety.PROTECTIVE_STOP


@pytest.mark.parametrize(
    ("doubles", "integers"),
    [
        ([0.0] * 18, [4, *Z]),
        ([0.0] * 18, [0, *Z]),
        ([math.nan, *[0.0] * 17], [2, *Z]),
        ([*[0.0] * 8, math.inf, *[0.0] * 9], [2, *Z]),
        ([*[0.0] * 17, math.nan], [2, *Z]),
    ],
)
def test_force_mode_invalid_arguments_end_program(bench: Bench, doubles: list[float], integers: list[int]) -> None:
    bench.write(6, doubles, integers)
    bench.tick(2)
    assert bench.machine.program is None and bench.machine.force_mode is None
    np.testing.assert_allclose(displacement(bench.arm.frame, matrix(bench.arm.pose)), 0, atol=1e-9)
