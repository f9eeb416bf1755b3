"""The robot behind the sockets, in simulated time: motions against theory, commands, questions."""

from __future__ import annotations

import math

import numpy as np
import pytest

from robot.common.kinematics import displacement, matrix, pose
from robot.mock.ur.fields import OUTPUTS
from robot.mock.ur.machine.arm import PERIOD
from robot.mock.ur.machine.forces import Mass
from robot.mock.ur.machine.machine import Machine
from robot.mock.ur.machine.state import Safety
from tacsim.interface import FloatArray
from tests.robot.mock.machine_bench import DOWN, Bench
from tests.robot.mock.wire_client import control_script


@pytest.mark.parametrize(("length", "speed", "acceleration"), [(0.1, 0.25, 1.2), (0.02, 0.25, 1.2), (0.15, 0.05, 0.5)])
def test_movel_duration_equals_trapezoid(bench: Bench, length: float, speed: float, acceleration: float) -> None:
    goal = bench.shifted(0, 0, -length)
    ticks = bench.call(3, [*goal, speed, acceleration])
    reaches_speed = length > speed**2 / acceleration
    theory = length / speed + speed / acceleration if reaches_speed else 2 * math.sqrt(length / acceleration)
    assert theory <= ticks * PERIOD <= theory + 3 * PERIOD
    bench.until(lambda: bench.arm.rests)
    np.testing.assert_allclose(displacement(bench.arm.frame, matrix(goal)), 0, atol=1e-9)


def test_movel_keeps_line_and_speed_limit(bench: Bench) -> None:
    start = bench.arm.target_frame[:3, 3].copy()
    bench.write(3, [*bench.shifted(0.06, 0.08, 0), 0.1, 0.5])
    fastest = steepest = before = 0.0
    for _ in range(700):
        bench.tick()
        path_length = bench.arm.target_frame[:3, 3] - start
        off = np.linalg.norm(np.cross(path_length, [0.6, 0.8, 0.0]))
        assert off < 1e-8
        speed = float(np.linalg.norm(bench.arm.target_twist[:3]))
        fastest, steepest, before = max(fastest, speed), max(steepest, abs(speed - before) / PERIOD), speed
    assert 0.0999 < fastest < 0.1001
    assert steepest < 0.51
    assert path_length @ [0.6, 0.8, 0.0] == pytest.approx(0.1, abs=1e-9)


def test_movej_duration_equals_leading_joint(bench: Bench) -> None:
    goal = bench.arm.target_q + [0.5, -0.1, 0.2, 0, 0, 0.3]
    ticks = bench.call(1, [*goal, 1.05, 1.4])
    theory = 2 * math.sqrt(0.5 / 1.4)
    assert theory <= ticks * PERIOD <= theory + 3 * PERIOD
    bench.until(lambda: bench.arm.rests)
    np.testing.assert_allclose(bench.arm.q, goal, atol=1e-12)


def test_actual_joints_lag_target_at_equal_speed(bench: Bench) -> None:
    bench.write(10, [0, 0, -0.05, 0, 0, 0.1, 0.5, 0.0])
    bench.tick(300)
    lag = (bench.arm.target_frame[2, 3] - bench.arm.frame[2, 3]) / -0.05
    assert lag == pytest.approx(0.004, rel=0.02)
    np.testing.assert_allclose(bench.arm.twist, [0, 0, -0.05, 0, 0, 0.1], atol=1e-4)
    before = bench.arm.frame.copy()
    bench.tick()
    np.testing.assert_allclose(displacement(before, bench.arm.frame) / PERIOD, bench.arm.twist, atol=1e-4)


def test_tcp_acceleration_equals_change_of_speed(bench: Bench) -> None:
    bench.call(10, [0.1, 0, 0, 0, 0, 0, 0.5, 0])
    read = {name: OUTPUTS[name].read for name in ("actual_TCP_speed", "actual_TCP_acceleration")}
    target = {name: OUTPUTS[name].read for name in ("target_TCP_speed", "target_TCP_acceleration")}
    for speed, acceleration in (read.values(), target.values()):
        bench.tick(10)
        before = np.array(speed(bench.machine))
        bench.tick()
        change = (np.array(speed(bench.machine)) - before) / PERIOD
        np.testing.assert_allclose(np.array(acceleration(bench.machine)), change, atol=1e-9)
        assert change[0] > 0.1


def test_elbow_velocity_equals_change_of_position(bench: Bench) -> None:
    bench.write(9, [0.3, -0.2, 0.4, 0, 0, 0, 5.0, 0.0])
    bench.tick(300)
    before = np.array(OUTPUTS["elbow_position"].read(bench.machine))
    bench.tick()
    moved = np.array(OUTPUTS["elbow_position"].read(bench.machine)) - before
    np.testing.assert_allclose(moved / PERIOD, OUTPUTS["elbow_velocity"].read(bench.machine), atol=1e-3)
    assert np.linalg.norm(moved) > 1e-4


def test_speed_command_ramps_and_continues(bench: Bench) -> None:
    bench.write(10, [0.02, 0, 0, 0, 0, 0, 0.1, 0.05])  # a time of 50 ms does not end it
    bench.tick(50)
    assert bench.arm.target_twist[0] == pytest.approx(0.01, rel=1e-3)
    bench.tick(1000)
    assert bench.arm.target_twist[0] == pytest.approx(0.02, rel=1e-4)
    ticks = bench.call(15, [0.1])
    assert ticks * PERIOD == pytest.approx(0.2, abs=3 * PERIOD)


def test_servoj_has_its_lag_without_overshoot(bench: Bench) -> None:
    start, lookahead = bench.arm.target_q.copy(), 0.1
    goal = start + [0.01, 0, 0, 0, 0, 0]
    bench.write(11, [*goal, 0, 0, 0.002, lookahead, 300])
    bench.tick(50)
    left = (goal - bench.arm.target_q)[0] / 0.01
    assert left == pytest.approx(math.exp(-1.0), abs=0.05)
    for _ in range(500):
        bench.tick()
        assert bench.arm.target_q[0] <= goal[0] + 1e-12
    np.testing.assert_allclose(bench.arm.q, goal, atol=1e-5)


def test_servoj_far_target_keeps_joint_limits(bench: Bench) -> None:
    goal = bench.arm.target_q + [2.0, 0, 0, 0, 0, 0]
    bench.write(11, [*goal, 0, 0, 0.002, 0.03, 300])
    for _ in range(1000):
        bench.tick()
        assert abs(bench.arm.target_qd[0]) <= math.pi + 1e-9
        assert abs(bench.arm.target_qdd[0]) <= 40.0 + 1e-6
        assert bench.arm.target_q[0] <= goal[0] + 1e-3
    assert bench.machine.safety is Safety.NORMAL
    np.testing.assert_allclose(bench.arm.q, goal, atol=1e-5)


def test_servoj_follows_speed_slider(bench: Bench) -> None:
    """At half the slider its time runs at half the speed: twice the lag behind a steady motion, half the top speed."""
    bench.machine.set_slider(0.5)
    bench.tick(200)
    start, lookahead, speed = bench.arm.target_q.copy(), 0.1, 0.2

    def follow(seconds: float) -> FloatArray:
        for tick in range(round(seconds / PERIOD)):
            goal = start + [speed * tick * PERIOD, 0, 0, 0, 0, 0]
            bench.write(11, [*goal, 0, 0, 0.002, lookahead, 300])
            bench.tick()
        return goal

    goal = follow(2.0)
    assert bench.arm.target_qd[0] == pytest.approx(speed, rel=1e-3)
    assert (goal - bench.arm.target_q)[0] == pytest.approx(speed * lookahead / 0.5, rel=0.02)
    bench.write(11, [*(start + [3.0, 0, 0, 0, 0, 0]), 0, 0, 0.002, 0.03, 300])
    bench.tick(150)
    assert bench.arm.target_qd[0] == pytest.approx(0.5 * bench.arm.kinematics.joint_speeds[0], rel=1e-3)
    bench.machine.set_slider(0.0)
    bench.tick(300)
    assert bench.arm.rests and bench.machine.program is not None


@pytest.mark.parametrize("command", [11, 24])
def test_servoj_nan_ends_program(bench: Bench, command: int) -> None:
    bench.write(command, [math.nan, 0, 0, 0, 0, 0, 0, 0, 0.002, 0.1, 300])
    bench.tick(2)
    assert bench.machine.program is None and "finite" in bench.machine.stop_reason
    assert np.isfinite(bench.arm.q).all()


def test_unreachable_servo_target_ends_program_but_query_does_not(bench: Bench) -> None:
    bench.call(60, [5, 0, 0, 0, 0, 0])
    assert bench.integer == 0 and bench.machine.program is not None
    bench.call(36, DOWN)
    assert bench.integer == 1
    bench.write(24, [5, 0, 0, 0, 0, 0, 0, 0, 0.002, 0.1, 300])
    bench.tick(2)
    assert bench.machine.program is None and "no solution" in bench.machine.stop_reason


def test_two_motions_at_once_end_program(bench: Bench) -> None:
    bench.call(10, [0.01, 0, 0, 0, 0, 0, 0.5, 0])
    bench.write(3, [*bench.shifted(0, 0, -0.05), 0.1, 0.5])
    bench.tick(5)
    assert bench.machine.program is None and "another thread" in bench.machine.stop_reason


def test_path_stops_only_without_blend() -> None:
    speeds = {}
    for blend in (0.0, 0.02):
        home = pose(Machine().arm.frame)
        a, b = home + [0, 0, -0.1, 0, 0, 0], home + [0.1, 0, -0.1, 0, 0, 0]
        lines = [
            f"movel(p[{','.join(map(str, point))}],a=1,v=0.1,r={radius})" for point, radius in ((a, blend), (b, 0))
        ]
        bench = Bench(control_script(path=["signal_async_progress(0)", lines[0], "signal_async_progress(1)", lines[1]]))
        bench.write(45)
        slowest, nearest = 1.0, 1.0
        while bench.machine.out_int[0] != 2:
            bench.tick()
            gone, left = (np.linalg.norm(bench.arm.target_frame[:3, 3] - point[:3]) for point in (home, b))
            nearest = min(nearest, float(np.linalg.norm(bench.arm.target_frame[:3, 3] - a[:3])))
            if gone > 0.02 and left > 0.02:
                slowest = min(slowest, float(np.linalg.norm(bench.arm.target_twist[:3])))
        speeds[blend] = slowest, nearest
        np.testing.assert_allclose(displacement(bench.arm.target_frame, matrix(b)), 0, atol=1e-8)
        assert bench.machine.out_int[2] & 0x7FFF in (0, 1)
    assert speeds[0.0][0] < 0.01 and speeds[0.0][1] < 1e-9
    # A parabola between points 20 mm from the corner passes it at 20 mm / (2 sqrt 2).
    assert speeds[0.02][0] > 0.095 and speeds[0.02][1] == pytest.approx(0.02 / (2 * math.sqrt(2)), abs=2e-4)


def test_asynchronous_word_counts_operations(bench: Bench) -> None:
    def word() -> tuple[int, bool]:
        value = bench.machine.out_int[2]
        return value >> 24 & 0x7F, bool(value >> 15 & 1)

    assert word() == (0, False)
    bench.call(3, [*bench.shifted(0, 0, -0.05), 0.1, 0.5], [1])
    assert word() == (1, True)
    assert bench.until(lambda: not word()[1]) * PERIOD == pytest.approx(0.7, abs=0.02)
    bench.call(3, [*bench.shifted(0, 0, -0.05), 0.1, 0.5], [1])
    bench.tick(100)
    bench.call(33, [2.0], [1])  # an asynchronous stop is an operation too
    assert word()[0] == 3
    bench.until(lambda: not word()[1])
    assert not bench.arm.target_qd.any()


def test_speed_slider_scales_speed(bench: Bench) -> None:
    bench.machine.set_slider(0.5)
    bench.tick(200)
    ticks = bench.call(3, [*bench.shifted(0, 0, -0.1), 0.25, 1.2])
    theory = 0.1 / 0.25 + 0.25 / 1.2
    assert 2 * theory <= ticks * PERIOD <= 2 * theory + 3 * PERIOD
    bench.machine.set_slider(1.5)
    assert bench.machine.slider == 0.5


@pytest.mark.parametrize(
    ("command", "doubles", "integers", "words"),
    [
        (66, [0] * 18, [], "direct_torque"),
        (67, [0] * 6, [], "get_mass_matrix"),
        (68, [0] * 12, [], "get_coriolis"),
        (56, [0] * 7, [1], "external force sensors"),
        (3, [*DOWN, 0.0, 1.0], [], "must be positive"),
        (35, [0.0], [], "frequency"),
        (29, [math.inf, 0, 0, 0, 0, 0], [], "finite"),
    ],
)
def test_unmodelled_or_invalid_command_ends_program(
    bench: Bench, command: int, doubles: list[float], integers: list[int], words: str
) -> None:
    bench.call(command, doubles, integers)
    assert bench.machine.program is None and words in bench.machine.stop_reason


def test_commands_of_newer_controllers_have_no_effect_on_older() -> None:
    old = control_script().replace("get_jacobian(", "")
    bench = Bench(old)
    bench.call(70)
    assert bench.machine.program is not None and not any(bench.machine.out_double)
    marked = control_script().replace("    get_jacobian(", "$5.23 get_jacobian(")
    assert "get_jacobian(" in marked
    bench = Bench(marked)
    bench.call(70)
    assert not any(bench.machine.out_double)


def test_payload_zero_centre_keeps_previous(bench: Bench) -> None:
    bench.call(65, [1.2, 0, 0, 0.05, 1, 2, 3, 4, 5, 6])
    assert bench.machine.load.configured_payload == Mass(1.2, (0, 0, 0.05))
    assert bench.machine.load.inertia.tolist() == [1, 2, 3, 4, 5, 6]
    bench.call(17, [0.7, 0, 0, 0])
    assert bench.machine.load.configured_payload == Mass(0.7, (0, 0, 0.05))


def test_invalid_program_keeps_running_program(bench: Bench) -> None:
    assert not bench.machine.start("garbage\nend\n")
    assert not bench.machine.start("sec hello():\n  textmsg(1)\nend\n")
    assert bench.machine.program is not None
