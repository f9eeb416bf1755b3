"""The robot behind the sockets, in simulated time: motions against theory, stops, limits, commands."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import pytest

from robot.common.kinematics import displacement, matrix, pose
from robot.mock.ur.machine.arm import PERIOD, Arm
from robot.mock.ur.machine.load import GRAVITY, Wall
from robot.mock.ur.machine.machine import Machine, Mode, Runtime, Safety
from robot.mock.ur.machine.registry import COMMANDS
from tacsim.interface import FloatArray
from tests.robot.mock.wire_client import control_script

DOWN = (-0.4, -0.2, 0.3, 0.0, math.pi, 0.0)


class Bench:
    """A machine that runs the control script, and its client."""

    def __init__(self, script: str | None = None) -> None:
        self.machine = Machine()
        self.arm: Arm = self.machine.arm
        assert self.machine.start(script or control_script())
        self.tick()

    def tick(self, count: int = 1) -> None:
        for _ in range(count):
            self.machine.tick()

    def until(self, done: Callable[[], bool], limit: float = 20.0) -> int:
        """Ticks until it holds."""
        for count in range(round(limit / PERIOD)):
            if done():
                return count
            self.machine.tick()
        raise AssertionError(f"not within {limit} s; log: {list(self.machine.log)}")

    def write(self, command: int, doubles: Sequence[float] = (), integers: Sequence[int] = ()) -> None:
        self.machine.in_int[: 1 + len(integers)] = [command, *integers]
        self.machine.in_double[: len(doubles)] = [float(value) for value in doubles]
        self.machine.on_int_register(0)

    def call(self, command: int, doubles: Sequence[float] = (), integers: Sequence[int] = ()) -> int:
        """One command to its end; ticks it took."""
        self.write(command, doubles, integers)
        if COMMANDS[command].every_cycle:
            self.tick()
            return 1
        count = self.until(lambda: self.machine.out_int[0] == 2 or self.machine.program is None)
        self.write(0)
        self.tick()
        return count

    @property
    def answer(self) -> FloatArray:
        return np.array(self.machine.out_double[:6])

    @property
    def integer(self) -> int:
        return self.machine.out_int[1]

    def shifted(self, *step: float) -> list[float]:
        """The pose of the TCP, moved by so much."""
        return list(pose(self.arm.target_frame) + np.array([*step, *[0.0] * (6 - len(step))]))


@pytest.fixture
def bench() -> Bench:
    return Bench()


@pytest.mark.parametrize(("length", "speed", "acceleration"), [(0.1, 0.25, 1.2), (0.02, 0.25, 1.2), (0.15, 0.05, 0.5)])
def test_movel_takes_the_time_of_its_trapezoid(bench: Bench, length: float, speed: float, acceleration: float) -> None:
    goal = bench.shifted(0, 0, -length)
    ticks = bench.call(3, [*goal, speed, acceleration])
    reaches_speed = length > speed**2 / acceleration
    theory = length / speed + speed / acceleration if reaches_speed else 2 * math.sqrt(length / acceleration)
    assert theory <= ticks * PERIOD <= theory + 3 * PERIOD
    bench.until(lambda: bench.arm.rests)
    np.testing.assert_allclose(displacement(bench.arm.frame, matrix(goal)), 0, atol=1e-9)


def test_movel_stays_on_its_line_and_below_its_speed(bench: Bench) -> None:
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


def test_movej_takes_the_time_of_its_leading_joint(bench: Bench) -> None:
    goal = bench.arm.target_q + [0.5, -0.1, 0.2, 0, 0, 0.3]
    ticks = bench.call(1, [*goal, 1.05, 1.4])
    theory = 2 * math.sqrt(0.5 / 1.4)
    assert theory <= ticks * PERIOD <= theory + 3 * PERIOD
    bench.until(lambda: bench.arm.rests)
    np.testing.assert_allclose(bench.arm.q, goal, atol=1e-12)


def test_actual_trails_target_and_both_speeds_agree(bench: Bench) -> None:
    bench.write(10, [0, 0, -0.05, 0, 0, 0.1, 0.5, 0.0])
    bench.tick(300)
    lag = (bench.arm.target_frame[2, 3] - bench.arm.frame[2, 3]) / -0.05
    assert lag == pytest.approx(0.004, rel=0.02)
    np.testing.assert_allclose(bench.arm.twist, [0, 0, -0.05, 0, 0, 0.1], atol=1e-4)
    before = bench.arm.frame.copy()
    bench.tick()
    np.testing.assert_allclose(displacement(before, bench.arm.frame) / PERIOD, bench.arm.twist, atol=1e-4)


def test_speed_ramps_at_its_acceleration_and_goes_on_for_ever(bench: Bench) -> None:
    bench.write(10, [0.02, 0, 0, 0, 0, 0, 0.1, 0.05])  # a time of 50 ms does not end it
    bench.tick(50)
    assert bench.arm.target_twist[0] == pytest.approx(0.01, rel=1e-3)
    bench.tick(1000)
    assert bench.arm.target_twist[0] == pytest.approx(0.02, rel=1e-4)
    ticks = bench.call(15, [0.1])
    assert ticks * PERIOD == pytest.approx(0.2, abs=3 * PERIOD)


def test_servo_has_its_lag_and_does_not_overshoot(bench: Bench) -> None:
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


def test_servo_to_a_far_target_respects_joint_speed_and_acceleration(bench: Bench) -> None:
    goal = bench.arm.target_q + [2.0, 0, 0, 0, 0, 0]
    bench.write(11, [*goal, 0, 0, 0.002, 0.03, 300])
    for _ in range(1000):
        bench.tick()
        assert abs(bench.arm.target_qd[0]) <= math.pi + 1e-9
        assert abs(bench.arm.target_qdd[0]) <= 40.0 + 1e-6
        assert bench.arm.target_q[0] <= goal[0] + 1e-3
    assert bench.machine.safety is Safety.NORMAL
    np.testing.assert_allclose(bench.arm.q, goal, atol=1e-5)


@pytest.mark.parametrize("command", [11, 24])
def test_servo_with_nan_ends_the_program(bench: Bench, command: int) -> None:
    bench.write(command, [math.nan, 0, 0, 0, 0, 0, 0, 0, 0.002, 0.1, 300])
    bench.tick(2)
    assert bench.machine.program is None and "finite" in bench.machine.stop_reason
    assert np.isfinite(bench.arm.q).all()


def test_unreachable_servo_target_ends_the_program_and_a_question_does_not(bench: Bench) -> None:
    bench.call(60, [5, 0, 0, 0, 0, 0])
    assert bench.integer == 0 and bench.machine.program is not None
    bench.call(36, DOWN)
    assert bench.integer == 1
    bench.write(24, [5, 0, 0, 0, 0, 0, 0, 0, 0.002, 0.1, 300])
    bench.tick(2)
    assert bench.machine.program is None and "no solution" in bench.machine.stop_reason


def test_two_motions_at_once_end_the_program(bench: Bench) -> None:
    bench.call(10, [0.01, 0, 0, 0, 0, 0, 0.5, 0])
    bench.write(3, [*bench.shifted(0, 0, -0.05), 0.1, 0.5])
    bench.tick(5)
    assert bench.machine.program is None and "another thread" in bench.machine.stop_reason


def test_path_with_blend_does_not_stop_and_without_does() -> None:
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


def test_unknown_line_in_a_path_ends_the_program() -> None:
    bench = Bench(control_script(path=["movec(p[0,0,0,0,0,0])"]))
    bench.call(45)
    assert "movec" in bench.machine.stop_reason


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


def test_watchdog_stops_a_silent_client_only(bench: Bench) -> None:
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


def test_protective_stop_brakes_and_needs_unlocking(bench: Bench) -> None:
    bench.call(10, [0, 0, -0.2, 0, 0, 0, 1.0, 0])
    bench.tick(200)
    bench.machine.protective_stop("test")
    assert bench.machine.program is None and bench.machine.safety_status_bits == 1 << 2 | 1 << 10
    bench.until(lambda: bench.arm.rests, limit=0.2)
    assert not bench.machine.start(control_script())
    assert bench.machine.unlock() and bench.machine.start(control_script())


def test_unlocking_can_be_made_to_wait(bench: Bench) -> None:
    bench.machine.unlock_delay = 5.0
    bench.machine.protective_stop("test")
    assert not bench.machine.unlock()
    bench.tick(2501)
    assert bench.machine.unlock()


def test_emergency_stop_takes_the_power_and_returning_takes_steps(bench: Bench) -> None:
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


def test_safeguard_stop_pauses_and_the_motion_goes_on(bench: Bench) -> None:
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


def test_speed_slider_halves_the_speed(bench: Bench) -> None:
    bench.machine.set_slider(0.5)
    bench.tick(200)
    ticks = bench.call(3, [*bench.shifted(0, 0, -0.1), 0.25, 1.2])
    theory = 0.1 / 0.25 + 0.25 / 1.2
    assert 2 * theory <= ticks * PERIOD <= 2 * theory + 3 * PERIOD
    bench.machine.set_slider(1.5)
    assert bench.machine.slider == 0.5


def test_wall_pushes_up_and_zeroing_takes_it_off(bench: Bench) -> None:
    z = float(bench.arm.frame[2, 3])
    bench.machine.load.wall = Wall(z - 0.01, 1000.0)
    bench.call(3, [*bench.shifted(0, 0, -0.02), 0.1, 0.5])
    bench.tick(100)
    np.testing.assert_allclose(bench.machine.load.felt, [0, 0, 10, 0, 0, 0], atol=1e-6)
    bench.machine.load.wrench = np.array([1.0, 2, 3, 0.1, 0.2, 0.3])
    bench.tick()
    np.testing.assert_allclose(bench.machine.load.felt, [1, 2, 13, 0.1, 0.2, 0.3], atol=1e-6)
    bench.call(8)
    np.testing.assert_allclose(bench.machine.load.felt, 0, atol=1e-9)
    bench.machine.load.wrench = np.zeros(6)
    bench.tick()
    np.testing.assert_allclose(bench.machine.load.felt, [-1, -2, -3, -0.1, -0.2, -0.3], atol=1e-6)


def test_too_much_force_is_a_protective_stop(bench: Bench) -> None:
    bench.machine.load.wall = Wall(float(bench.arm.frame[2, 3]), 20e3)
    bench.call(3, [*bench.shifted(0, 0, -0.05), 0.05, 0.5])
    assert bench.machine.safety is Safety.PROTECTIVE_STOP and "force" in bench.machine.stop_reason
    assert 250 < bench.machine.load.true[2] < 262  # stopped at once, not after a way


def test_hidden_payload_weighs_and_turns_with_the_tool(bench: Bench) -> None:
    bench.machine.load.hidden_mass, bench.machine.load.hidden_centre = 2.0, np.array([0.0, 0.1, 0.0])
    bench.tick()
    weight = 2.0 * GRAVITY
    arm_of_force = bench.arm.frame[:3, 1] * 0.1
    np.testing.assert_allclose(bench.machine.load.felt[:3], [0, 0, -weight], atol=1e-9)
    np.testing.assert_allclose(bench.machine.load.felt[3:], np.cross(arm_of_force, [0, 0, -weight]), atol=1e-9)
    bench.call(1, [*(bench.arm.target_q + [0.3, 0.2, -0.4, 0.6, -0.3, 0.8]), 1.0, 1.0])
    bench.until(lambda: bench.arm.rests)
    bench.call(8)  # zeroed in this attitude, felt again in another
    np.testing.assert_allclose(bench.machine.load.felt, 0, atol=1e-9)
    axis = bench.arm.kinematics.jacobian(bench.arm.q)[3:, 4]
    sideways = math.sqrt(1 - axis[2] ** 2)  # the part of gravity across the axis of the next turn
    bench.call(1, [*(bench.arm.target_q + [0, 0, 0, 0, 0.5, 0]), 1.0, 1.0])
    bench.until(lambda: bench.arm.rests)
    assert np.linalg.norm(bench.machine.load.felt[:3]) == pytest.approx(
        2 * weight * sideways * math.sin(0.25), rel=1e-6
    )


def test_force_mode_presses_with_the_force_asked_for(bench: Bench) -> None:
    bench.machine.load.wall = Wall(float(bench.arm.frame[2, 3]) - 0.005, 2000.0)
    other = bench.arm.target_q.copy()
    bench.write(6, [0] * 6 + [0, 0, -10, 0, 0, 0] + [0.1, 0.1, 0.05, 1, 1, 1], [2, 0, 0, 1, 0, 0, 0])
    bench.tick(3000)
    assert bench.machine.load.felt[2] == pytest.approx(10.0, abs=0.05)
    np.testing.assert_allclose(bench.arm.target_frame[:2, 3], bench.arm.kinematics.forward(other)[:2, 3], atol=1e-5)
    assert not bench.machine.steady
    bench.call(7)
    assert bench.machine.program is not None


@pytest.mark.parametrize(
    ("command", "doubles", "integers", "words"),
    [
        (6, [0] * 18, [3, 0, 0, 1, 0, 0, 0], "force_mode of type 3"),
        (66, [0] * 18, [], "direct_torque"),
        (67, [0] * 6, [], "get_mass_matrix"),
        (68, [0] * 12, [], "get_coriolis"),
        (56, [0] * 7, [1], "external force sensors"),
        (3, [*DOWN, 0.0, 1.0], [], "must be positive"),
        (35, [0.0], [], "frequency"),
        (29, [math.inf, 0, 0, 0, 0, 0], [], "finite"),
    ],
)
def test_what_is_not_modelled_or_wrong_ends_the_program(
    bench: Bench, command: int, doubles: list[float], integers: list[int], words: str
) -> None:
    bench.call(command, doubles, integers)
    assert bench.machine.program is None and words in bench.machine.stop_reason


def test_commands_of_newer_controllers_do_nothing_on_older_ones() -> None:
    old = control_script().replace("get_jacobian(", "")
    bench = Bench(old)
    bench.call(70)
    assert bench.machine.program is not None and not any(bench.machine.out_double)
    marked = control_script().replace("    get_jacobian(", "$5.23 get_jacobian(")
    assert "get_jacobian(" in marked
    bench = Bench(marked)
    bench.call(70)
    assert not any(bench.machine.out_double)


def test_questions(bench: Bench) -> None:
    arm, tcp = bench.arm, [0, 0, 0.1, 0, 0, 0]
    flange = arm.frame.copy()
    bench.call(29, tcp)
    bench.call(40)
    np.testing.assert_allclose(bench.answer, tcp, atol=1e-12)
    bench.call(43)
    np.testing.assert_allclose(matrix(bench.answer), flange @ matrix(tcp), atol=1e-9)
    bench.call(58)
    np.testing.assert_allclose(matrix(bench.answer), flange, atol=1e-9)
    bench.call(44, [*arm.q, *tcp])
    np.testing.assert_allclose(matrix(bench.answer), flange @ matrix(tcp), atol=1e-9)
    bench.call(46, pose(flange @ matrix(tcp)))
    np.testing.assert_allclose(bench.answer, arm.q, atol=1e-8)
    bench.call(39, [0.1, 0, 0, 0, 0, math.pi / 2, 0.2, 0, 0, 0, 0, 0])
    np.testing.assert_allclose(bench.answer, [0.1, 0.2, 0, 0, 0, math.pi / 2], atol=1e-12)
    bench.call(37, [7.0, 0, 0, 0, 0, 0])
    assert bench.integer == 0
    bench.call(47)
    assert bench.integer == 1
    bench.call(70)
    found = np.array([*bench.machine.out_double[:24], *bench.machine.out_double[36:48]]).reshape(6, 6).T
    np.testing.assert_allclose(found, arm.kinematics.jacobian(arm.q, arm.tool), atol=1e-12)
    bench.machine.load.wrench = np.array([0.0, 0, 10, 0, 0, 0])
    bench.tick()
    bench.call(38)
    np.testing.assert_allclose(bench.answer, -10 * found[2], atol=1e-9)


def test_payload_is_read_back_and_a_zero_centre_keeps_the_old(bench: Bench) -> None:
    bench.call(65, [1.2, 0, 0, 0.05, 1, 2, 3, 4, 5, 6])
    assert bench.machine.payload == 1.2 and bench.machine.payload_inertia.tolist() == [1, 2, 3, 4, 5, 6]
    bench.call(17, [0.7, 0, 0, 0])
    assert bench.machine.payload == 0.7 and bench.machine.payload_centre.tolist() == [0, 0, 0.05]
    np.testing.assert_allclose(bench.machine.raw_wrench[:3], bench.arm.frame[:3, :3].T @ [0, 0, -0.7 * GRAVITY])


def test_contact_is_found_and_the_arm_returns_to_it(bench: Bench) -> None:
    top = float(bench.arm.frame[2, 3]) - 0.02
    bench.machine.load.wall = Wall(top, 5000.0)
    bench.call(51, [0, 0, -0.05, 0, 0, 0, 0, 0, -1, 0, 0, 0, 0.5])
    bench.until(lambda: bench.arm.rests)
    # It stops where the force began to be felt: 1 N, which is 0.2 mm deep, a period's way more or less.
    assert bench.arm.frame[2, 3] == pytest.approx(top - 0.2e-3, abs=0.15e-3)


def test_freedrive_gives_way_along_its_free_axes_only(bench: Bench) -> None:
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


def test_jog_in_tool_axes(bench: Bench) -> None:
    bench.call(41, [0, 0, 0.02, 0, 0, 0, 1, 0.5, 0, 0, 0, 0, 0, 0])
    bench.tick(200)
    np.testing.assert_allclose(bench.arm.target_twist[:3], 0.02 * bench.arm.frame[:3, 2], atol=1e-5)
    bench.call(42)
    assert not bench.arm.target_qd.any()


def test_end_of_a_joint_range_is_a_protective_stop(bench: Bench) -> None:
    bench.call(9, [0, 0, 0, 0, 0, 3.0, 10.0, 0])
    bench.until(lambda: bench.machine.safety is Safety.PROTECTIVE_STOP)
    assert "end of its range" in bench.machine.stop_reason
    bench.until(lambda: bench.arm.rests)
    assert bench.arm.q[5] < 2 * math.pi + 0.3


def test_a_joint_too_fast_is_a_protective_stop(bench: Bench) -> None:
    bench.call(9, [4.0, 0, 0, 0, 0, 0, 20.0, 0])
    bench.until(lambda: bench.machine.safety is Safety.PROTECTIVE_STOP, limit=1)
    assert "too fast" in bench.machine.stop_reason


def test_other_programs_end_at_once_and_say_so(bench: Bench) -> None:
    assert not bench.machine.start("def mine():\n  movej([0,0,0,0,0,0])\nend\n")
    assert bench.machine.program is None and "mine" in bench.machine.stop_reason


def test_what_is_no_program_disturbs_nobody(bench: Bench) -> None:
    assert not bench.machine.start("garbage\nend\n")
    assert not bench.machine.start("sec hello():\n  textmsg(1)\nend\n")
    assert bench.machine.program is not None
