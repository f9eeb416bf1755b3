"""An arm that is led to its start goes along one way, within all limits, and nowhere else."""

from __future__ import annotations

import numpy as np
import pytest

from robot.arm.channel import STATE, CommandKind, Partner, make_command_record
from robot.arm.start_servo import distance_from_path
from robot.arm.status import ArmStatus
from robot.arm.trajectory import PERIOD
from robot.arm.tuning import JOINT_SPEED, OFF_PATH
from tests.robot.arm.servo_bench import HOME, Bench, other, shifted

FAR = {"lower": [1.0, 1.0, 1.0], "upper": [1.1, 1.1, 1.1]}  # a box in which the arm does not stand
END = HOME + [0.3, -0.1, 0.2, 0.0, 0.1, -0.2]


def bench(**changes: object) -> Bench:
    made = Bench(**{**FAR, "start_path": [HOME.tolist(), END.tolist()], **changes})
    made.run(1)
    return made


def go(made: Bench, share: float, periods: int) -> None:
    """As a driver does, every tenth of a second."""
    for _ in range(periods // 50):
        made.number += 1
        made.servo.on_command(
            made.number, make_command_record(made.time, CommandKind.CONTINUE_TO_START, fraction=share)
        )
        made.run(50)


@pytest.mark.slow
def test_it_reaches_its_start_straight_and_slowly_from_outside_its_box() -> None:
    made = bench()
    assert made.servo.status == ArmStatus.HOLD and not made.sent
    go(made, 0.1, 1000)
    assert np.abs(made.q - (HOME + 0.1 * (END - HOME))).max() < 1e-4 and made.servo.is_at_rest
    go(made, 1.0, 4000)
    assert np.array_equal(made.sent[-1], END) and made.servo.is_at_rest and made.servo.status == ArmStatus.OK
    sent = np.array(made.sent)
    rates = np.diff(sent, axis=0) / PERIOD
    assert np.abs(rates).max() <= JOINT_SPEED
    assert max(distance_from_path(q, HOME, END) for q in sent) < 1e-9
    velocity = np.diff(made.path(), axis=0) / PERIOD
    assert np.linalg.norm(velocity, axis=1).max() <= made.servo.config.speed
    assert np.linalg.norm(np.diff(velocity, axis=0), axis=1).max() / PERIOD <= made.servo.config.acceleration


def test_slower_limits_of_the_file_hold_for_the_sensor() -> None:
    made = bench(speed=0.02, acceleration=0.1)
    go(made, 1.0, 2000)
    velocity = np.diff(made.path(), axis=0) / PERIOD
    speed = np.linalg.norm(velocity, axis=1)
    assert 0.01 < speed.max() <= 0.02
    assert np.linalg.norm(np.diff(velocity, axis=0), axis=1).max() / PERIOD <= 0.1 * 1.01


def test_it_brakes_when_nobody_repeats_the_command() -> None:
    made = bench()
    go(made, 1.0, 500)
    made.run(400)
    assert made.servo.is_at_rest and made.servo.status == ArmStatus.HOLD
    stood = made.q.copy()
    made.run(400)
    assert np.abs(made.q - stood).max() < 1e-9 and np.abs(END - stood).max() > 0.1


def test_hold_brakes_within_the_limits_at_once() -> None:
    made = bench()
    go(made, 1.0, 500)
    before = len(made.sent)
    made.ask(np.zeros(7), CommandKind.HOLD)
    made.run(200)
    assert made.servo.is_at_rest
    rates = np.linalg.norm(np.diff(np.array(made.sent[before - 1 :]), axis=0), axis=1)
    assert (np.diff(rates) <= 1e-12).all()  # ever slower


def test_no_target_moves_it_and_its_command_moves_no_other_arm() -> None:
    made = bench()
    made.ask(shifted(made.at, 5e-3))
    made.run(200)
    assert not made.sent and made.servo.rejected == 1
    ordinary = Bench()
    ordinary.run(1)
    go(ordinary, 1.0, 200)
    assert not ordinary.sent and np.array_equal(ordinary.q, HOME)


@pytest.mark.parametrize("share", [-0.1, 1.1, np.nan, np.inf])
def test_a_share_that_is_none_moves_nothing(share: float) -> None:
    made = bench()
    go(made, share, 200)
    assert not made.sent


def test_an_arm_off_its_way_is_stopped() -> None:
    made = bench()
    go(made, 1.0, 300)
    made.q = made.q + [0.0, 0.0, 0.0, 1.5 * OFF_PATH, 0.0, 0.0]
    made.look()
    made.run(1)
    assert made.servo.status == ArmStatus.OFF_PATH
    made.run(300)
    stood = made.q.copy()
    go(made, 1.0, 300)
    assert np.abs(made.q - stood).max() < 1e-9


def test_a_force_beyond_its_limit_stops_it() -> None:
    made = bench()
    go(made, 1.0, 300)
    made.look((40.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    made.run(1)
    assert made.servo.status == ArmStatus.FORCE_LIMIT
    made.run(300)
    stood = made.q.copy()
    go(made, 1.0, 300)
    assert made.servo.is_at_rest and np.abs(made.q - stood).max() < 1e-9


def test_it_waits_for_an_arm_that_lags() -> None:
    """Such as one whose speed slider is low: the target never runs ahead."""
    made = bench()
    for _ in range(40):
        made.number += 1
        made.servo.on_command(made.number, make_command_record(made.time, CommandKind.CONTINUE_TO_START, fraction=1.0))
        for _ in range(25):
            made.time += PERIOD
            made.servo.check_faults(made.now, [])
            joints = made.servo.step(made.time, made.now, [])
            assert joints is not None
            assert np.abs(joints - made.q).max() < 1.5 * OFF_PATH
            made.q = made.q + np.clip(joints - made.q, -1e-5, 1e-5)  # 5 mrad/s
            made.look()
    assert not made.servo.status.is_fault and made.q[0] - HOME[0] > 1e-3


def test_what_was_asked_before_it_waited_is_forgotten() -> None:
    made = bench(partners=[Partner(-1, 0.05)])
    sound = other([9.0, 9.0, 9.0])
    for asked_first in (True, False):
        made.partners = [sound]
        made.run(1)
        made.partners = [None] if not asked_first else made.partners
        made.run(1)
        made.number += 1
        made.servo.on_command(made.number, make_command_record(made.time, CommandKind.CONTINUE_TO_START, fraction=1.0))
        made.partners = [None]
        made.servo.check_faults(made.now, made.partners)
        assert made.servo.status == ArmStatus.WAITING
        made.partners = [sound]
        made.run(50)
        assert not made.sent and made.servo.status == ArmStatus.HOLD


@pytest.mark.parametrize("status", [ArmStatus.PARTNER_STOPPED, ArmStatus.OFF_PATH])
def test_a_fault_found_on_an_old_package_does_not_draw_it_back(status: ArmStatus) -> None:
    made = bench(speed=0.1)
    go(made, 1.0, 500)
    old = made.now
    for _ in range(20):  # no packages come; the arm runs out towards the last target
        made.q = made.q + 0.2 * (made.sent[-1] - made.q)
        made.time += PERIOD
        made.look()
    made.servo.enter_fault(status)
    there = made.q.copy()
    for _ in range(3):
        made.time += PERIOD
        joints = made.servo.step(made.time, old, [])
        assert joints is made.sent[-1]
    made.look()
    made.run(200)
    assert made.servo.is_at_rest and (made.q - there) @ (END - HOME) > -1e-6


@pytest.mark.slow
def test_it_stops_before_the_other_arm() -> None:
    made = bench(partners=[Partner(-1, 0.05)])
    other = np.zeros((), STATE)
    other["status"] = ArmStatus.HOLD
    ahead = Bench(**{**FAR, "start_path": [HOME.tolist(), END.tolist()]})
    go(ahead, 1.0, 4000)
    other["position"] = other["stopping_point"] = ahead.path()[-1]
    made.partners = [other]
    made.run(1)
    go(made, 1.0, 4000)
    gap = np.linalg.norm(made.path() - other["position"], axis=1).min()
    assert 0.05 <= gap < 0.06 and not made.servo.status.is_fault
