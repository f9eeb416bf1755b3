"""The judgement of one period, without sockets and clocks: targets, walls, speeds, late commands."""

from __future__ import annotations

import dataclasses
import json
import math

import numpy as np
import pytest

from robot.arm.channel import CommandKind, Partner, WorkerConfig, command_record
from robot.arm.status import ArmStatus
from robot.arm.trajectory import PERIOD
from robot.common.kinematics import MAX_SINGULAR_VALUE_RATE, rotation
from tacsim.limits import box_region
from tests.robot.arm.servo_bench import KINEMATICS, Bench, shifted, worker_config


def test_nothing_is_sent_before_the_first_command() -> None:
    bench = Bench()
    bench.run(10)
    assert bench.sent == []
    assert bench.servo.status == ArmStatus.HOLD


def test_it_goes_to_its_target_and_stays() -> None:
    bench = Bench(action_timeout=60.0)
    target = shifted(bench.at, 0.03, -0.02, 0.01)
    bench.ask(target)
    bench.run(800)
    assert bench.servo.status == ArmStatus.OK
    assert bench.servo.resting
    assert np.allclose(bench.at.position, target.position, atol=1e-9)


def test_the_calibration_of_a_true_arm_does_not_move_the_target() -> None:
    """The controller's flange lies 1.5 mm and 4 mrad from the nominal one; poses are still met."""
    off = np.eye(4)
    off[:3, :3], off[:3, 3] = rotation([2e-3, -3e-3, 1e-3]), [1e-3, -1e-3, 0.5e-3]
    bench = Bench(calibration=off, action_timeout=60.0)
    target = shifted(bench.at, 0.03, 0.03, -0.05)
    bench.ask(target)
    bench.run(1500)
    assert np.allclose(bench.at.position, target.position, atol=1e-8)


@pytest.mark.promise(2)
@pytest.mark.parametrize(
    "row",
    [
        np.full(7, np.nan),
        np.array([0.0, 0.0, np.inf, 0.0, 0.0, 0.0, 1.0]),
        np.array([-0.4, 0.0, 0.4, 0.0, 0.0, 0.0, 0.0]),
        np.array([-0.4, 0.0, 0.4, 1e200, 0.0, 0.0, 1e200]),
        np.array([1e9, 0.0, 0.4, 0.0, 0.0, 0.0, 1.0]),
    ],
)
def test_what_is_no_pose_makes_it_hold(row: np.ndarray) -> None:
    bench = Bench(action_timeout=60.0)
    bench.ask(shifted(bench.at, 0.1))
    bench.run(60)
    bench.ask(row)
    bench.run(200)
    assert bench.servo.rejected == 1
    assert bench.servo.status == ArmStatus.HOLD
    assert bench.servo.resting
    assert np.isfinite(bench.sent).all()


def test_each_command_is_taken_once() -> None:
    bench = Bench(action_timeout=60.0)
    bench.ask(np.full(7, np.nan))
    record = command_record(0.0, CommandKind.TARGET, np.full(7, np.nan))
    for _ in range(5):
        bench.servo.on_command(bench.number, record)
    assert bench.servo.rejected == 1


def test_a_target_outside_is_cut_at_the_wall_and_counted() -> None:
    bench = Bench(action_timeout=60.0)
    bench.ask(shifted(bench.at, 0.0, 0.0, -1.0))
    bench.run(1500)
    assert bench.servo.shortened == 1
    assert bench.path()[:, 2].min() == pytest.approx(0.3, abs=1e-8)


@pytest.mark.parametrize(("asked", "wanted"), [(2e-3, 2e-3), (math.inf, 0.05), (1.0, 0.05)])
def test_a_command_may_ask_for_less_than_the_speed_limit_never_for_more(asked: float, wanted: float) -> None:
    bench = Bench(action_timeout=60.0, speed=0.05)
    bench.ask(shifted(bench.at, 0.1), speed=asked)
    bench.run(300)
    speeds = np.linalg.norm(np.diff(bench.path(), axis=0), axis=1) / PERIOD
    assert speeds[150:].max() == pytest.approx(wanted, rel=1e-3)
    assert speeds.max() <= wanted * (1 + 1e-3)


def test_a_turn_at_full_speed_close_to_a_wall_does_not_bulge_out() -> None:
    """Each target lies inside; the way between them would not, if the old speed were not braked first."""
    bench = Bench(action_timeout=60.0, speed=0.2)
    start = bench.at
    floor = float(start.position[2]) - 0.1
    bench.servo.region = box_region([-1.0, -1.0, floor], [1.0, 1.0, 1.0])
    bench.ask(shifted(start, 0.0, 0.0, -0.1))
    bench.run(280)
    bench.ask(shifted(start, 0.1, 0.1, -0.1))
    bench.run(1000)
    assert bench.path()[:, 2].min() >= floor - 1e-8
    assert np.allclose(bench.at.position, start.position + [0.1, 0.1, -0.1], atol=1e-8)


@pytest.mark.promise(5)
def test_an_old_command_is_not_followed_and_a_late_one_brakes() -> None:
    bench = Bench()
    bench.ask(shifted(bench.at, 0.1))
    bench.run(99)
    assert bench.servo.status == ArmStatus.OK
    bench.run(10)  # 0.2 s are over
    assert bench.servo.status == ArmStatus.HOLD
    bench.run(150)
    assert bench.servo.resting
    steps = np.linalg.norm(np.diff(bench.path(), n=2, axis=0), axis=1)
    assert steps.max() <= 0.5 * PERIOD**2 * (1 + 1e-4)
    here = bench.path()[-1]
    bench.time += 10.0
    bench.servo.on_command(
        bench.number, command_record(0.0, CommandKind.TARGET, np.zeros(7))
    )  # the same command once more
    bench.run(5)
    assert np.allclose(bench.path()[-1], here, atol=1e-9)


@pytest.mark.promise(5)
def test_after_a_hold_it_goes_on_from_where_the_arm_is() -> None:
    bench = Bench()
    start = bench.at
    bench.ask(shifted(start, 0.02))
    bench.run(400)
    assert bench.servo.status == ArmStatus.HOLD and bench.servo.resting
    bench.q = bench.q + [0.05, 0.0, 0.0, 0.0, 0.0, 0.0]  # somebody pushed it
    bench.look()
    bench.look()
    count, here = len(bench.sent), bench.at.position
    bench.ask(shifted(start, 0.03))
    bench.run(1)
    first = bench.path()[count]
    assert np.linalg.norm(first - here) <= 0.5 * PERIOD**2 * (1 + 1e-6)


@pytest.mark.promise(2)
def test_joint_steps_and_singularities_slow_it_down() -> None:
    bench = Bench(action_timeout=60.0, lower=[-2.0, -2.0, -1.0], upper=[2.0, 2.0, 2.0], speed=1.0, acceleration=5.0)
    bench.ask(shifted(bench.at, 0.0, 0.0, 1.5))  # beyond its reach
    bench.run(3000)
    assert bench.servo.status == ArmStatus.OUT_OF_REACH
    assert np.abs(np.diff(bench.sent, axis=0)).max() <= 1.0 * PERIOD * (1 + 1e-9)
    assert KINEMATICS.singularity(bench.q) > 0.015
    back = shifted(bench.at, 0.0, 0.0, -0.1)
    bench.ask(back)
    bench.run(3000)
    assert np.allclose(bench.at.position, back.position, atol=1e-8)


def test_a_worker_config_travels_as_json() -> None:
    given = worker_config(partners=[Partner(-1, 0.1)], planes=[[[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]]])
    assert WorkerConfig.of(json.loads(json.dumps(dataclasses.asdict(given)))) == given


def test_a_singular_value_changes_no_faster_than_the_servo_relies_on() -> None:
    random = np.random.default_rng(3)
    for _ in range(300):
        q = random.uniform(-np.pi, np.pi, 6)
        turned = random.normal(0.0, 10.0 ** random.uniform(-3, 0), 6)
        change = abs(KINEMATICS.singularity(q + turned) - KINEMATICS.singularity(q))
        assert change <= MAX_SINGULAR_VALUE_RATE * np.abs(turned).sum()
