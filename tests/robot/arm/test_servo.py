"""The judgement of one period, without sockets and clocks: targets, walls, speeds, late commands."""

from __future__ import annotations

import dataclasses
import json
import math

import numpy as np
import pytest

from robot.arm.channel import CommandKind, Partner, WorkerConfig, make_command_record
from robot.arm.status import ArmStatus
from robot.arm.trajectory import PERIOD
from robot.common.kinematics import MAX_SINGULAR_VALUE_RATE, rotation
from tacsim.limits import box_region
from tests.robot.arm.servo_bench import KINEMATICS, Bench, shifted, worker_config


def test_servo_without_command_sends_nothing() -> None:
    bench = Bench()
    bench.run(10)
    assert bench.sent == []
    assert bench.servo.status == ArmStatus.HOLD


def test_servo_target_is_reached_and_held() -> None:
    bench = Bench(action_timeout=60.0)
    target = shifted(bench.at, 0.03, -0.02, 0.01)
    bench.ask(target)
    bench.run(800)
    assert bench.servo.status == ArmStatus.OK
    assert bench.servo.is_at_rest
    assert np.allclose(bench.at.position, target.position, atol=1e-9)


def test_servo_calibrated_arm_reaches_target() -> None:
    """The controller's flange lies 1.5 mm and 4 mrad from the nominal one; poses are still reached."""
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
def test_servo_invalid_target_is_rejected_and_arm_holds(row: np.ndarray) -> None:
    bench = Bench(action_timeout=60.0)
    bench.ask(shifted(bench.at, 0.1))
    bench.run(60)
    bench.ask(row)
    bench.run(200)
    assert bench.servo.rejected == 1
    assert bench.servo.status == ArmStatus.HOLD
    assert bench.servo.is_at_rest
    assert np.isfinite(bench.sent).all()


def test_servo_repeated_command_is_read_once() -> None:
    bench = Bench(action_timeout=60.0)
    bench.ask(np.full(7, np.nan))
    record = make_command_record(0.0, CommandKind.TARGET, np.full(7, np.nan))
    for _ in range(5):
        bench.servo.on_command(bench.number, record)
    assert bench.servo.rejected == 1


def test_servo_target_outside_region_is_clipped_and_counted() -> None:
    bench = Bench(action_timeout=60.0)
    bench.ask(shifted(bench.at, 0.0, 0.0, -1.0))
    bench.run(1500)
    assert bench.servo.clipped == 1
    assert bench.path()[:, 2].min() == pytest.approx(0.3, abs=1e-8)


@pytest.mark.parametrize(("asked", "wanted"), [(2e-3, 2e-3), (math.inf, 0.05), (1.0, 0.05)])
def test_servo_commanded_speed_is_limited(asked: float, wanted: float) -> None:
    bench = Bench(action_timeout=60.0, speed=0.05)
    bench.ask(shifted(bench.at, 0.1), speed=asked)
    bench.run(300)
    speeds = np.linalg.norm(np.diff(bench.path(), axis=0), axis=1) / PERIOD
    assert speeds[150:].max() == pytest.approx(wanted, rel=1e-3)
    assert speeds.max() <= wanted * (1 + 1e-3)


def test_servo_turn_near_wall_stays_inside_region() -> None:
    """Each target is inside; without braking the old speed first, the path between them would not be."""
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
def test_servo_command_after_timeout_brakes_to_hold() -> None:
    bench = Bench()
    bench.ask(shifted(bench.at, 0.1))
    bench.run(99)
    assert bench.servo.status == ArmStatus.OK
    bench.run(10)  # 0.2 s are over
    assert bench.servo.status == ArmStatus.HOLD
    bench.run(150)
    assert bench.servo.is_at_rest
    steps = np.linalg.norm(np.diff(bench.path(), n=2, axis=0), axis=1)
    assert steps.max() <= 0.5 * PERIOD**2 * (1 + 1e-4)
    here = bench.path()[-1]
    bench.time += 10.0
    bench.servo.on_command(
        bench.number, make_command_record(0.0, CommandKind.TARGET, np.zeros(7))
    )  # the same command once more
    bench.run(5)
    assert np.allclose(bench.path()[-1], here, atol=1e-9)


@pytest.mark.promise(5)
def test_servo_command_after_push_starts_at_measured_pose() -> None:
    bench = Bench()
    start = bench.at
    bench.ask(shifted(start, 0.02))
    bench.run(400)
    assert bench.servo.status == ArmStatus.HOLD and bench.servo.is_at_rest
    bench.q = bench.q + [0.05, 0.0, 0.0, 0.0, 0.0, 0.0]  # it was pushed
    bench.look()
    bench.look()
    count, here = len(bench.sent), bench.at.position
    bench.ask(shifted(start, 0.03))
    bench.run(1)
    first = bench.path()[count]
    assert np.linalg.norm(first - here) <= 0.5 * PERIOD**2 * (1 + 1e-6)


@pytest.mark.slow
@pytest.mark.promise(2)
def test_servo_singular_target_limits_joint_steps() -> None:
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


def test_worker_config_json_round_trip_is_equal() -> None:
    given = worker_config(partners=[Partner(-1, 0.1)], planes=[[[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]]])
    assert WorkerConfig.from_dict(json.loads(json.dumps(dataclasses.asdict(given)))) == given


def test_singular_value_rate_is_within_bound() -> None:
    random = np.random.default_rng(3)
    for _ in range(300):
        q = random.uniform(-np.pi, np.pi, 6)
        turned = random.normal(0.0, 10.0 ** random.uniform(-3, 0), 6)
        change = abs(KINEMATICS.singularity(q + turned) - KINEMATICS.singularity(q))
        assert change <= MAX_SINGULAR_VALUE_RATE * np.abs(turned).sum()
