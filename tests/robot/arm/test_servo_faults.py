"""What makes the servo stop, wait or refuse: force, the box, partners, the gel, observations that are old."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from robot.arm.channel import CommandKind, Partner, make_tactile_record
from robot.arm.servo import Servo
from robot.arm.status import ArmStatus
from robot.arm.trajectory import PERIOD
from robot.arm.tuning import FAULT_DECELERATION, ZERO_REQUEST_TIMEOUT
from tests.robot.arm.servo_bench import Bench, other, shifted, worker_config


@pytest.mark.promise(3)
def test_servo_excess_force_brakes_from_measured_pose() -> None:
    bench = Bench(action_timeout=60.0)
    bench.ask(shifted(bench.at, 0.0, 0.0, -0.1))
    bench.run(150)
    lag = bench.at.position[2] - bench.path()[-1][2]
    assert lag > 0.5e-3  # the target runs ahead
    here = bench.at.position[2]
    bench.look(force=(0.0, 0.0, 31.0, 0.0, 0.0, 0.0))
    count = len(bench.sent)
    bench.run(100, force=(0.0, 0.0, 31.0, 0.0, 0.0, 0.0))
    after = bench.path()[count:, 2]
    assert bench.servo.status == ArmStatus.FORCE_LIMIT
    assert after.min() >= here - 0.12**2 / (2 * FAULT_DECELERATION) - 1e-6
    assert bench.servo.is_at_rest
    bench.ask(shifted(bench.at, 0.0, 0.0, -0.1))
    bench.run(50)  # the force has ended, the fault remains
    assert np.ptp(bench.path()[-40:, 2]) < 1e-9


@pytest.mark.promise(3)
def test_servo_nan_force_is_force_limit() -> None:
    bench = Bench()
    bench.look(force=(math.nan,) * 6)
    bench.servo.check_faults(bench.now, [])
    assert bench.servo.status == ArmStatus.FORCE_LIMIT


def test_servo_arm_pushed_outside_region_is_workspace_limit() -> None:
    bench = Bench(action_timeout=60.0, lower=[-0.6, -0.3, 0.43])
    bench.ask(shifted(bench.at, 0.02))
    bench.run(50)
    bench.q = bench.q + [0.0, 0.05, 0.0, 0.0, 0.0, 0.0]
    bench.look()
    bench.run(3)
    assert bench.servo.status == ArmStatus.WORKSPACE_LIMIT


@pytest.mark.promise(15)
def test_servo_keep_out_stops_approach_and_allows_retreat() -> None:
    bench = Bench(action_timeout=60.0, partners=[Partner(-1, 0.05)])
    start = bench.at
    bench.partners = [other(list(start.position + [0.1, 0.0, 0.0]))]
    bench.ask(shifted(start, 0.15))
    bench.run(1000)
    gap = np.linalg.norm(bench.at.position - bench.partners[0]["position"])  # type: ignore[index]
    assert 0.05 <= gap < 0.052
    assert bench.servo.status == ArmStatus.OK
    bench.ask(start)
    bench.run(1000)
    assert np.allclose(bench.at.position, start.position, atol=1e-9)


@pytest.mark.promise(15)
def test_servo_keep_out_includes_braking_path_of_other_arm() -> None:
    bench = Bench(action_timeout=60.0, partners=[Partner(-1, 0.05)])
    start = bench.at
    bench.partners = [other(list(start.position + [0.2, 0, 0]), list(start.position + [0.08, 0, 0]))]
    bench.ask(shifted(start, 0.1))
    bench.run(1000)
    assert bench.at.position[0] <= start.position[0] + 0.03


@pytest.mark.parametrize("partner", [None, ArmStatus.PROTECTIVE_STOP, ArmStatus.CONNECTING])
def test_servo_unhealthy_partner_waits_at_rest_and_stops_in_motion(partner: ArmStatus | None) -> None:
    bench = Bench(action_timeout=60.0, partners=[Partner(-1, 0.05)])
    start = bench.at
    sound = other(list(start.position + [0.3, 0, 0]))
    lost = None if partner is None else other(list(start.position + [0.3, 0, 0]), status=partner)
    bench.partners = [lost]
    bench.run(2)
    assert bench.servo.status == ArmStatus.WAITING
    bench.ask(shifted(start, 0.05))
    bench.run(2)
    assert bench.sent == []
    bench.partners = [sound]
    bench.run(5)
    assert bench.servo.status == ArmStatus.HOLD  # the command sent in between is dropped
    bench.ask(shifted(start, 0.05))
    bench.run(50)
    assert bench.servo.status == ArmStatus.OK
    bench.partners = [lost]
    bench.run(1)
    assert bench.servo.status == ArmStatus.PARTNER_STOPPED
    bench.run(100)
    assert bench.servo.is_at_rest


@pytest.mark.promise(7)
def test_servo_fault_is_replaced_only_by_controller_stop() -> None:
    """A stop of the controller needs more to recover from, so it is reported; a worse stop replaces a lesser one."""
    bench = Bench()
    for status, kept in (
        (ArmStatus.FORCE_LIMIT, ArmStatus.FORCE_LIMIT),
        (ArmStatus.WORKSPACE_LIMIT, ArmStatus.FORCE_LIMIT),
        (ArmStatus.PARTNER_STOPPED, ArmStatus.FORCE_LIMIT),
        (ArmStatus.GEL_LIMIT, ArmStatus.FORCE_LIMIT),
        (ArmStatus.PROGRAM_STOPPED, ArmStatus.PROGRAM_STOPPED),
        (ArmStatus.PROTECTIVE_STOP, ArmStatus.PROTECTIVE_STOP),
        (ArmStatus.FORCE_LIMIT, ArmStatus.PROTECTIVE_STOP),
        (ArmStatus.EMERGENCY_STOP, ArmStatus.EMERGENCY_STOP),
        (ArmStatus.PROGRAM_STOPPED, ArmStatus.EMERGENCY_STOP),
    ):
        bench.servo.enter_fault(status)
        assert bench.servo.status == kept


def test_servo_gel_beyond_limit_is_gel_limit() -> None:
    for shown, stops in (
        ((0.9e-3, 0.4e-3), False),
        ((1.1e-3, 0.0), True),
        ((0.0, 0.6e-3), True),
        ((math.nan, 0), True),
    ):
        bench = Bench(action_timeout=60.0, depth=1e-3, shear=0.5e-3)
        bench.ask(shifted(bench.at, 0.0, 0.0, -0.05))
        bench.run(100)
        bench.servo.on_tactile(1, make_tactile_record(bench.time, *shown))
        here = bench.at.position[2]
        bench.run(100)
        assert (bench.servo.status == ArmStatus.GEL_LIMIT) == stops
        assert (bench.at.position[2] < here - 0.12**2 / (2 * FAULT_DECELERATION) - 1e-4) == (not stops)


def test_servo_status_before_first_check_is_connecting() -> None:
    """The first published fault is that of the first check: the worker also publishes `status` before it."""
    for changes, found in (({}, ArmStatus.HOLD), ({"lower": [2.0] * 3, "upper": [3.0] * 3}, ArmStatus.WORKSPACE_LIMIT)):
        bench = Bench(**changes)
        assert bench.servo.status == ArmStatus.CONNECTING
        bench.servo.on_tactile(1, make_tactile_record(0.0, 0.0, 0.0))
        assert bench.servo.status == ArmStatus.CONNECTING
        bench.servo.check_faults(bench.now, bench.partners)
        assert bench.servo.status == found


def test_servo_tactile_report_of_former_worker_is_ignored() -> None:
    servo = Servo(worker_config(depth=1e-3), tactile_read=7)
    servo.on_tactile(7, make_tactile_record(0.0, 2e-3, 0.0))
    assert not servo.status.is_fault
    servo.on_tactile(8, make_tactile_record(math.nan, 2e-3, 0.0))  # the guard is off
    assert not servo.status.is_fault
    servo.on_tactile(9, make_tactile_record(0.0, 2e-3, 0.0))
    assert servo.status == ArmStatus.GEL_LIMIT


def test_servo_old_observation_holds_until_next_command() -> None:
    bench = Bench(action_timeout=60.0, observation_timeout=0.5)
    bench.ask(shifted(bench.at, 0.02))
    bench.run(20)
    bench.servo.on_tactile(1, make_tactile_record(bench.time, math.nan, math.nan))
    bench.run(200)
    assert bench.servo.status == ArmStatus.OK
    bench.run(100)  # 0.6 s without another picture
    assert bench.servo.status == ArmStatus.OBSERVATION_STALE
    bench.run(200)
    held = bench.at.position.copy()
    bench.ask(shifted(bench.at, 0.02))
    bench.run(100)
    assert np.abs(bench.at.position - held).max() < 1e-5
    bench.servo.on_tactile(2, make_tactile_record(bench.time, math.nan, math.nan))
    bench.run(100)  # new pictures alone start no motion: the command in between was decided without pictures
    assert bench.servo.status == ArmStatus.HOLD
    assert np.abs(bench.at.position - held).max() < 1e-5
    bench.ask(shifted(bench.at, 0.02))
    bench.run(100)
    assert bench.servo.status == ArmStatus.OK
    assert bench.at.position[0] - held[0] > 5e-3


@pytest.mark.promise(15)
@pytest.mark.parametrize("moving", [False, True])
def test_servo_first_fault_is_kept_when_partner_stops(moving: bool) -> None:
    """Two arms of one keep-out: one exceeds its force limit, the other stops because of it. Neither changes its
    status because of the other's fault."""
    bench = Bench(action_timeout=60.0, partners=[Partner("none", 0.05)])
    away = list(bench.at.position + [0.3, 0, 0])
    bench.partners = [other(away)]
    if moving:
        bench.ask(shifted(bench.at, 0.05))
    bench.run(50)
    bench.look(force=(0.0, 0.0, 31.0, 0.0, 0.0, 0.0))
    bench.run(1, force=(0.0, 0.0, 31.0, 0.0, 0.0, 0.0))
    assert bench.servo.status == ArmStatus.FORCE_LIMIT
    bench.partners = [other(away, status=ArmStatus.PARTNER_STOPPED)]
    bench.run(50, force=(0.0, 0.0, 31.0, 0.0, 0.0, 0.0))
    assert bench.servo.status == ArmStatus.FORCE_LIMIT


DROPS: dict[str, Callable[[Bench], None]] = {
    "a newer target": lambda bench: bench.ask(shifted(bench.at, 0.01)),
    "a stop": lambda bench: bench.ask(bench.at, CommandKind.HOLD),
    "a fault": lambda bench: bench.servo.enter_fault(ArmStatus.GEL_LIMIT),
    "a controller's stop": lambda bench: bench.servo.enter_fault(ArmStatus.PROTECTIVE_STOP),
    "time": lambda bench: bench.run(round(ZERO_REQUEST_TIMEOUT / PERIOD) + 1),
}


@pytest.mark.parametrize("name", DROPS)
def test_servo_zero_request_is_dropped_by_later_event(name: str) -> None:
    bench = Bench()
    bench.ask(bench.at, CommandKind.ZERO_WRENCH)
    DROPS[name](bench)
    for _ in range(500):
        bench.run(1)
        assert not bench.servo.take_zero_request(bench.time)


def test_servo_zero_request_after_force_limit_is_taken_once() -> None:
    bench = Bench()
    bench.run(2, force=(0.0, 0.0, 40.0, 0.0, 0.0, 0.0))
    assert bench.servo.status == ArmStatus.FORCE_LIMIT
    bench.ask(bench.at, CommandKind.ZERO_WRENCH)
    bench.run(1, force=(0.0, 0.0, 40.0, 0.0, 0.0, 0.0))
    assert [bench.servo.take_zero_request(bench.time) for _ in range(3)] == [True, False, False]
