"""The driver of a UR arm: what stops it, how it says so, and what only `recover` ends."""

from __future__ import annotations

import time

import numpy as np
import pytest

from robot.arm.channel import HISTORY, ArmStatus
from robot.arm.trajectory import PERIOD
from robot.arm.ur import URArm
from robot.errors import (
    DeviceError,
    EmergencyStop,
    ProtectiveStop,
    SafetyViolation,
)
from robot.mock import MockUR
from tacsim import pose as se3
from tacsim.control.gel_monitor import GelReading
from tests.robot.arm.mocked import (
    HOST,
    check_path,
    config,
    go,
    in_motion,
    leftovers,
    moved,
    sensor_path,
    servo_targets,
    until,
)

# -- force -----------------------------------------------------------------------------------------------------------


def test_force_limit_stops_in_the_period_of_its_package(mock: MockUR) -> None:
    stiffness, limit, speed = 2000.0, 20.0, 0.05
    with URArm(config(limits={"force": limit, "speed": speed}), "left") as arm:
        start = arm.state().pose
        mock.faults.wall(mock.faults.state().pose[2] - 0.02, stiffness)
        since = mock.faults.received().last
        arm.command(moved(start, z=-0.1))
        until(lambda: arm.status() == ArmStatus.FORCE_LIMIT, "force limit")
        until(lambda: arm._channel.states.latest()["resting"] == 1, "rest")  # type: ignore[index]
        records = arm._channel.states.recent(HISTORY)
        over = np.linalg.norm(records["tcp_force"][:, :3], axis=1) > limit
        first = records[over][0]
        of_that_package = records[records["stamp"] == first["stamp"]]
        assert (of_that_package["status"] == ArmStatus.FORCE_LIMIT).any()  # published before the next package
        # No further approach: after the fault the target lies no deeper than the arm's own braking way.
        path = sensor_path(arm, servo_targets(mock.faults.received(since).entries))[:, 2, 3]
        deepest_allowed = float(first["position"][2]) - speed**2 / (2 * 5.0) - 1e-5
        assert path[-1] >= deepest_allowed
        jump = int(np.argmax(np.diff(path)))  # where the target is drawn back to the arm
        assert (path[jump + 1 :] >= deepest_allowed).all()
        peak = float(np.linalg.norm(records["tcp_force"][:, :3], axis=1).max())
        assert peak <= float(np.linalg.norm(first["tcp_force"][:3])) + stiffness * speed * 0.2  # ten times 20 ms
        with pytest.raises(SafetyViolation, match=r"felt more than limits.force.* of 20 N"):
            arm.command(start)
        assert mock.faults.state().program  # the controller itself saw nothing wrong
        mock.faults.no_wall()
        arm.recover()
        assert arm.status() == ArmStatus.HOLD
        go(arm, start)


def test_a_gel_pressed_too_far_stops_the_arm_that_presses_it(mock: MockUR) -> None:
    with URArm(config(limits={"depth": 1e-3, "speed": 0.05}), "left") as arm:
        start = arm.state().pose
        arm.report_tactile(GelReading(time.monotonic(), depth=0.9e-3))
        in_motion(arm, moved(start, z=-0.1))
        since = mock.faults.received().last
        arm.report_tactile(GelReading(time.monotonic(), depth=1.1e-3))
        until(lambda: arm.status() == ArmStatus.GEL_LIMIT, "gel limit")
        until(lambda: arm._channel.states.latest()["resting"] == 1, "rest")  # type: ignore[index]
        records = arm._channel.states.recent(HISTORY)
        first = records[records["status"] == ArmStatus.GEL_LIMIT][0]
        path = sensor_path(arm, servo_targets(mock.faults.received(since).entries))[:, 2, 3]
        assert path[-1] >= float(first["position"][2]) - 0.05**2 / (2 * 5.0) - 1e-5
        with pytest.raises(SafetyViolation, match=r"limits.depth or limits.shear and stopped"):
            arm.command(start)
        arm.recover()
        go(arm, start)  # what the last worker was shown is not held against this one


def test_an_arm_whose_sensors_are_not_seen_any_more_stands(mock: MockUR) -> None:
    with URArm(config(observation_timeout=0.5), "left") as arm:
        start = arm.state().pose
        far = moved(start, x=0.12)
        arm.report_tactile(GelReading(time.monotonic()))
        in_motion(arm, far)
        until(lambda: arm.status() == ArmStatus.OBSERVATION_STALE, "blind")
        until(arm.at_rest, "rest")
        held = arm.state().pose
        assert se3.distance(start, held)[0] < 0.1
        arm.command(far)  # asked again, but nobody has seen anything since
        since = mock.faults.received().last
        until(lambda: len(servo_targets(mock.faults.received(since).entries)) > 50, "held targets")
        assert np.ptp(servo_targets(mock.faults.received(since).entries), axis=0).max() < 1e-9
        arm.report_tactile(None)  # nobody looks by now: the rule ends
        go(arm, far)


# -- time-outs -------------------------------------------------------------------------------------------------------


def test_without_actions_the_arm_holds_and_goes_on_from_there(mock: MockUR) -> None:
    with URArm(config(action_timeout=0.3), "left") as arm:
        start = arm.state().pose
        far = moved(start, x=0.12)
        in_motion(arm, far)
        until(lambda: arm.status() == ArmStatus.HOLD, "hold")
        until(arm.at_rest, "rest")
        held = arm.state().pose
        assert 2e-3 < se3.distance(start, held)[0] < 0.1  # stopped on the way
        since = mock.faults.received().last
        until(lambda: len(servo_targets(mock.faults.received(since).entries)) > 20, "held targets")
        assert np.ptp(servo_targets(mock.faults.received(since).entries), axis=0).max() < 1e-12
        mark = mock.faults.received().last
        in_motion(arm, far)
        sent = servo_targets(mock.faults.received(mark).entries)
        first = sensor_path(arm, sent)[:, :3, 3]
        limits = arm.config.limits
        assert np.linalg.norm(first[0] - held.position) <= limits.acceleration * PERIOD**2 + 60e-6
        check_path(arm, sent)


# -- stops of the controller -----------------------------------------------------------------------------------------


def test_a_protective_stop_is_told_and_only_recover_ends_it(arm: URArm, mock: MockUR) -> None:
    start = arm.state().pose
    in_motion(arm, moved(start, x=0.1))
    mock.faults.protective_stop()
    until(lambda: arm.status() == ArmStatus.PROTECTIVE_STOP, "protective stop")
    with pytest.raises(ProtectiveStop, match="protective stop; look why, then recover"):
        arm.command(start)
    until(lambda: mock.faults.state().rests, "rest")
    where, mark = mock.faults.state().joints, mock.faults.received().last
    time.sleep(0.3)
    assert arm.status() == ArmStatus.PROTECTIVE_STOP
    assert arm.state().time > 0.0  # it can still be looked at
    assert mock.faults.received(mark).entries == ()
    arm.recover()
    assert arm.status() == ArmStatus.HOLD
    time.sleep(0.3)
    assert servo_targets(mock.faults.received(mark).entries).size == 0  # nothing old is asked again
    assert np.allclose(mock.faults.state().joints, where, atol=1e-9)
    mark = mock.faults.received().last
    go(arm, start)
    check_path(arm, servo_targets(mock.faults.received(mark).entries))


def test_an_emergency_stop_waits_for_a_person(arm: URArm, mock: MockUR) -> None:
    start = arm.state().pose
    in_motion(arm, moved(start, x=0.1))
    mock.faults.estop()
    until(lambda: arm.status() == ArmStatus.EMERGENCY_STOP, "emergency stop")
    for _ in range(2):
        with pytest.raises(EmergencyStop, match="person must release it"):
            arm.recover()
        assert arm.status() == ArmStatus.EMERGENCY_STOP
    with pytest.raises(EmergencyStop):
        arm.command(start)
    assert mock.faults.state().safety == "ROBOT_EMERGENCY_STOP"
    mock.faults.release()
    with pytest.raises(DeviceError, match="power it on"):
        arm.recover()
    mock.faults.recover()
    arm.recover()
    go(arm, start)


def test_a_program_stopped_from_outside_is_told(arm: URArm, mock: MockUR) -> None:
    from robot.arm.dashboard import Dashboard

    in_motion(arm, moved(arm.state().pose, x=0.1))
    with Dashboard(HOST) as dashboard:
        dashboard.ask("stop")
    until(lambda: arm.status() == ArmStatus.PROGRAM_STOPPED, "stopped program")
    with pytest.raises(ProtectiveStop, match="no running program"):
        arm.command(arm.state().pose)
    arm.recover()
    assert arm.status() == ArmStatus.HOLD


def test_connecting_to_a_stopped_arm_says_so(mock: MockUR) -> None:
    mock.faults.protective_stop()
    with pytest.raises(ProtectiveStop, match="arm 'left': protective stop"):
        URArm(config(), "left").close()
    mock.faults.estop()
    with pytest.raises(EmergencyStop, match="person must release it"):
        URArm(config(), "left").close()
    mock.faults.reset()
    mock.faults.remote_control(False)
    with pytest.raises(DeviceError, match="remote control"):
        URArm(config(), "left").close()
    mock.faults.remote_control(True)
    assert leftovers("left") == []
