"""What makes the servo stop, wait or refuse: force, the box, partners, the gel, observations that are old."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from robot.arm.channel import CommandKind, Partner, tactile_record
from robot.arm.servo import Servo
from robot.arm.status import ArmStatus
from robot.arm.trajectory import PERIOD
from robot.arm.tuning import FAULT_DECELERATION, MAX_ZERO_AGE
from tests.robot.arm.servo_bench import Bench, other, shifted, worker_config


@pytest.mark.promise(3)
def test_too_much_force_stops_from_the_measured_pose() -> None:
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
    assert bench.servo.resting
    bench.ask(shifted(bench.at, 0.0, 0.0, -0.1))
    bench.run(50)  # the force is gone, the fault is not
    assert np.ptp(bench.path()[-40:, 2]) < 1e-9


@pytest.mark.promise(3)
def test_a_force_that_is_no_number_is_too_much() -> None:
    bench = Bench()
    bench.look(force=(math.nan,) * 6)
    bench.servo.check_faults(bench.now, [])
    assert bench.servo.status == ArmStatus.FORCE_LIMIT


def test_an_arm_that_is_pushed_out_of_its_box_stops() -> None:
    bench = Bench(action_timeout=60.0, lower=[-0.6, -0.3, 0.43])
    bench.ask(shifted(bench.at, 0.02))
    bench.run(50)
    bench.q = bench.q + [0.0, 0.05, 0.0, 0.0, 0.0, 0.0]
    bench.look()
    bench.run(3)
    assert bench.servo.status == ArmStatus.WORKSPACE_LIMIT


@pytest.mark.promise(15)
def test_another_arm_is_not_come_near_and_parting_is_free() -> None:
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
def test_the_braking_way_of_the_other_arm_counts() -> None:
    bench = Bench(action_timeout=60.0, partners=[Partner(-1, 0.05)])
    start = bench.at
    bench.partners = [other(list(start.position + [0.2, 0, 0]), list(start.position + [0.08, 0, 0]))]
    bench.ask(shifted(start, 0.1))
    bench.run(1000)
    assert bench.at.position[0] <= start.position[0] + 0.03


@pytest.mark.parametrize("partner", [None, ArmStatus.PROTECTIVE_STOP, ArmStatus.CONNECTING])
def test_without_a_sound_partner_it_waits_and_a_moving_arm_stops(partner: ArmStatus | None) -> None:
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
    assert bench.servo.status == ArmStatus.HOLD  # what was asked meanwhile is forgotten
    bench.ask(shifted(start, 0.05))
    bench.run(50)
    assert bench.servo.status == ArmStatus.OK
    bench.partners = [lost]
    bench.run(1)
    assert bench.servo.status == ArmStatus.PARTNER_STOPPED
    bench.run(100)
    assert bench.servo.resting


@pytest.mark.promise(7)
def test_a_fault_stays_and_only_a_stop_of_the_controller_replaces_it() -> None:
    """A stop of the controller takes more to recover from, so it must be told; a worse one replaces a lesser one."""
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
        bench.servo.trip(status)
        assert bench.servo.status == kept


def test_a_gel_pressed_or_dragged_too_far_stops_the_arm() -> None:
    for shown, stops in (
        ((0.9e-3, 0.4e-3), False),
        ((1.1e-3, 0.0), True),
        ((0.0, 0.6e-3), True),
        ((math.nan, 0), True),
    ):
        bench = Bench(action_timeout=60.0, depth=1e-3, shear=0.5e-3)
        bench.ask(shifted(bench.at, 0.0, 0.0, -0.05))
        bench.run(100)
        bench.servo.on_tactile(1, tactile_record(bench.time, *shown))
        here = bench.at.position[2]
        bench.run(100)
        assert (bench.servo.status == ArmStatus.GEL_LIMIT) == stops
        assert (bench.at.position[2] < here - 0.12**2 / (2 * FAULT_DECELERATION) - 1e-4) == (not stops)


def test_an_arm_is_not_called_well_before_it_was_looked_at() -> None:
    """What the first look finds is the first that anybody hears: the worker publishes `status` before it too."""
    for changes, found in (({}, ArmStatus.HOLD), ({"lower": [2.0] * 3, "upper": [3.0] * 3}, ArmStatus.WORKSPACE_LIMIT)):
        bench = Bench(**changes)
        assert bench.servo.status == ArmStatus.CONNECTING
        bench.servo.on_tactile(1, tactile_record(0.0, 0.0, 0.0))
        assert bench.servo.status == ArmStatus.CONNECTING
        bench.servo.check_faults(bench.now, bench.partners)
        assert bench.servo.status == found


def test_what_was_shown_to_a_worker_before_is_not_held_against_this_one() -> None:
    servo = Servo(worker_config(depth=1e-3), tactile_read=7)
    servo.on_tactile(7, tactile_record(0.0, 2e-3, 0.0))
    assert not servo.status.is_fault
    servo.on_tactile(8, tactile_record(math.nan, 2e-3, 0.0))  # nobody looks by now
    assert not servo.status.is_fault
    servo.on_tactile(9, tactile_record(0.0, 2e-3, 0.0))
    assert servo.status == ArmStatus.GEL_LIMIT


def test_no_action_is_followed_on_an_old_observation() -> None:
    bench = Bench(action_timeout=60.0, observation_timeout=0.5)
    bench.ask(shifted(bench.at, 0.02))
    bench.run(20)
    bench.servo.on_tactile(1, tactile_record(bench.time, math.nan, math.nan))
    bench.run(200)
    assert bench.servo.status == ArmStatus.OK
    bench.run(100)  # 0.6 s without another picture
    assert bench.servo.status == ArmStatus.OBSERVATION_STALE
    bench.run(200)
    held = bench.at.position.copy()
    bench.ask(shifted(bench.at, 0.02))
    bench.run(100)
    assert np.abs(bench.at.position - held).max() < 1e-5
    bench.servo.on_tactile(2, tactile_record(bench.time, math.nan, math.nan))
    bench.run(100)  # it sees again, and does nothing by itself: what was asked meanwhile was decided without seeing
    assert bench.servo.status == ArmStatus.HOLD
    assert np.abs(bench.at.position - held).max() < 1e-5
    bench.ask(shifted(bench.at, 0.02))
    bench.run(100)
    assert bench.servo.status == ArmStatus.OK
    assert bench.at.position[0] - held[0] > 5e-3


@pytest.mark.promise(15)
@pytest.mark.parametrize("moving", [False, True])
def test_the_first_cause_is_kept_when_the_other_arm_stops_over_it(moving: bool) -> None:
    """Two arms that watch each other: one feels too much, the other stops because of that one. Neither changes its
    mind when it sees the other's fault."""
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
    "a fault": lambda bench: bench.servo.trip(ArmStatus.GEL_LIMIT),
    "a controller's stop": lambda bench: bench.servo.trip(ArmStatus.PROTECTIVE_STOP),
    "time": lambda bench: bench.run(round(MAX_ZERO_AGE / PERIOD) + 1),
}


@pytest.mark.parametrize("name", DROPS)
def test_a_wish_to_zero_the_wrench_is_dropped_by_whatever_comes_between(name: str) -> None:
    bench = Bench()
    bench.ask(bench.at, CommandKind.ZERO_WRENCH)
    DROPS[name](bench)
    for _ in range(500):
        bench.run(1)
        assert not bench.servo.zero_due(bench.time)


def test_the_wrench_is_zeroed_once_also_after_too_much_force() -> None:
    bench = Bench()
    bench.run(2, force=(0.0, 0.0, 40.0, 0.0, 0.0, 0.0))
    assert bench.servo.status == ArmStatus.FORCE_LIMIT
    bench.ask(bench.at, CommandKind.ZERO_WRENCH)
    bench.run(1, force=(0.0, 0.0, 40.0, 0.0, 0.0, 0.0))
    assert [bench.servo.zero_due(bench.time) for _ in range(3)] == [True, False, False]
