"""The driver of a UR arm: what stops it, how it says so, and what only `recover` ends."""

from __future__ import annotations

import os
import signal
import time

import numpy as np
import pytest

from robot.arm.status import ArmStatus
from robot.arm.trajectory import PERIOD
from robot.arm.tuning import FAULT_DECELERATION
from robot.arm.ur import URArm
from robot.errors import (
    DeviceError,
    EmergencyStop,
    ProtectiveStop,
    SafetyViolation,
)
from robot.mock import MockUR
from tacsim import pose as se3
from tacsim.interface import GelReading
from tests.promises import Record
from tests.robot.arm.mocked import (
    HOST,
    STILL,
    at_full_speed,
    check_path,
    config,
    go,
    heights_in_a_fault,
    in_motion,
    leftovers,
    moved,
    records,
    sensor_path,
    servo_targets,
    servo_ticks,
)
from tests.robot.waiting import until

# -- force -----------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.promise(3)
def test_arm_force_limit_stops_in_same_period(mock: MockUR, measuring: bool, figure: Record) -> None:
    stiffness, limit, speed = 2000.0, 20.0, 0.05
    with URArm(config(realtime=measuring, limits={"force": limit, "speed": speed}), "left") as arm:
        start, state = arm.state().pose, mock.faults.state()
        ahead = state.tick - round(state.time / PERIOD)  # the mock's count of periods, against its clock
        mock.faults.wall(state.pose[2] - 0.02, stiffness)
        since = mock.faults.received().last
        arm.command(moved(start, z=-0.1))
        until(lambda: arm.status() == ArmStatus.FORCE_LIMIT, "force limit")
        until(lambda: arm._channel.states.latest()["resting"] == 1, "rest")  # type: ignore[index]
        until(lambda: bool(np.linalg.norm(arm._channel.states.latest()["tcp_speed"][:3]) < STILL), "standstill")  # type: ignore[index]
        seen, sent = records(arm), mock.faults.received(since).entries
        felt = np.linalg.norm(seen["tcp_force"][:, :3], axis=1)
        first = seen[felt > limit][0]
        told = seen[seen["status"] == ArmStatus.FORCE_LIMIT][0]
        slow = np.linalg.norm(seen["tcp_speed"][:, :3], axis=1) < STILL
        rest = seen[slow & (seen["stamp"] >= first["stamp"])][0]
        # No further approach: after the fault the target lies no deeper than the arm's own braking path.
        height, ticks = sensor_path(arm, servo_targets(sent))[:, 2, 3], servo_ticks(sent)
        late = ticks > round(float(first["stamp"]) / PERIOD) + ahead  # a period after that package was sent
        braking = float(np.sum(first["tcp_speed"][:3] ** 2)) / (2 * FAULT_DECELERATION)
        deeper = height[late] < float(first["position"][2]) - braking - 1e-5
        figure("approach commands later than 2 ms after the package", deeper.sum())
        figure("standstill, from 50 mm/s", 1e3 * float(rest["stamp"] - first["stamp"]), "ms", at_most=150)
        figure("status published", 1e3 * float(told["written"] - first["time"]), "ms", at_most=4)
        over = max(0.0, float(felt.max()) - limit)
        figure("force beyond the limit, wall of 2 N/mm at 50 mm/s", over, "N", at_most=2)
        of_that_package = seen[seen["stamp"] == first["stamp"]]
        assert (of_that_package["status"] == ArmStatus.FORCE_LIMIT).any()  # published before the next package
        lowest, lowest_led_back = heights_in_a_fault(arm, ArmStatus.FORCE_LIMIT)
        assert (height >= lowest - 1e-5).all()
        jump = int(np.argmax(np.diff(height)))  # where the target is led back to the arm
        assert (height[jump + 1 :] >= lowest_led_back - 1e-5).all()
        assert felt.max() <= float(np.linalg.norm(first["tcp_force"][:3])) + stiffness * speed * 0.2  # ten times 20 ms
        with pytest.raises(SafetyViolation, match=r"exceeded limits.force.* of 20 N"):
            arm.command(start)
        assert mock.faults.state().program  # the controller itself saw nothing wrong
        mock.faults.no_wall()
        arm.recover()
        assert arm.status() == ArmStatus.HOLD
        go(arm, start)


def test_arm_gel_limit_stops_pressing_arm(mock: MockUR) -> None:
    with URArm(config(limits={"depth": 1e-3, "speed": 0.05}), "left") as arm:
        start = arm.state().pose
        arm.report_tactile(GelReading(time.monotonic(), depth=0.9e-3))
        in_motion(arm, moved(start, z=-0.1))
        since = mock.faults.received().last
        arm.report_tactile(GelReading(time.monotonic(), depth=1.1e-3))
        until(lambda: arm.status() == ArmStatus.GEL_LIMIT, "gel limit")
        until(lambda: arm._channel.states.latest()["resting"] == 1, "rest")  # type: ignore[index]
        lowest, lowest_led_back = heights_in_a_fault(arm, ArmStatus.GEL_LIMIT)
        height = sensor_path(arm, servo_targets(mock.faults.received(since).entries))[:, 2, 3]
        assert (height >= lowest - 1e-5).all()
        assert height[-1] >= lowest_led_back - 1e-5
        with pytest.raises(SafetyViolation, match=r"limits.depth or limits.shear and stopped"):
            arm.command(start)
        arm.recover()
        go(arm, start)  # what the last worker was shown is not held against this one


@pytest.mark.slow
def test_arm_without_new_observation_holds(mock: MockUR) -> None:
    with URArm(config(observation_timeout=0.5), "left") as arm:
        start = arm.state().pose
        far = moved(start, x=0.12)

        def under_way() -> bool:
            arm.report_tactile(GelReading(time.monotonic()))
            arm.command(far)
            return se3.pose_distance(start, arm.state().pose)[0] > 2e-3

        until(under_way, "motion", pause=0.02)
        until(lambda: arm.status() == ArmStatus.OBSERVATION_STALE, "blind")
        until(arm.at_rest, "rest")
        held = arm.state().pose
        assert se3.pose_distance(start, held)[0] < 0.1
        arm.command(far)  # commanded again, without a new observation
        since = mock.faults.received().last
        until(lambda: len(servo_targets(mock.faults.received(since).entries)) > 50, "held targets")
        assert np.ptp(servo_targets(mock.faults.received(since).entries), axis=0).max() < 1e-9
        arm.report_tactile(None)  # the guard is off
        go(arm, far)


# -- time-outs -------------------------------------------------------------------------------------------------------


@pytest.mark.promise(5)
def test_arm_without_action_holds_and_continues(mock: MockUR, measuring: bool, figure: Record) -> None:
    timeout = 0.2 if measuring else 0.3
    with URArm(config(realtime=measuring, action_timeout=timeout), "left") as arm:
        start, limits = arm.state().pose, arm.config.limits
        far = moved(start, x=0.12)
        asked = in_motion(arm, far)
        until(lambda: arm.status() == ArmStatus.HOLD, "hold")
        seen = records(arm)
        held_at = seen[(seen["status"] == ArmStatus.HOLD) & (seen["written"] > asked + 0.5 * timeout)][0]["written"]
        figure("hold reported after the last action (time-out 200 ms)", 1e3 * float(held_at - asked), "ms", at_most=210)
        until(arm.at_rest, "rest")
        held = arm.state().pose
        assert 2e-3 < se3.pose_distance(start, held)[0] < 0.1  # stopped on its path
        since = mock.faults.received().last
        until(lambda: len(servo_targets(mock.faults.received(since).entries)) > 20, "held targets")
        assert np.ptp(servo_targets(mock.faults.received(since).entries), axis=0).max() < 1e-12
        mark = mock.faults.received().last
        in_motion(arm, far)
        sent = servo_targets(mock.faults.received(mark).entries)
        path = sensor_path(arm, sent)[:, :3, 3]
        steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
        first = float(steps[steps > 1e-9][0]) / (limits.acceleration * PERIOD**2)
        figure("first step when it goes on, of one period's limit", 100 * first, "%", at_most=101)
        assert np.linalg.norm(path[0] - held.position) <= limits.acceleration * PERIOD**2 + 60e-6
        check_path(arm, sent)


@pytest.mark.slow
@pytest.mark.promise(5)
def test_arm_after_last_action_stops_within_timeout_distance(mock: MockUR, measuring: bool, figure: Record) -> None:
    """A policy that hangs in full motion, its target far away."""
    timeout = 0.2 if measuring else 0.3
    with URArm(config(realtime=measuring, action_timeout=timeout), "left") as arm:
        start, limits = arm.state().pose, arm.config.limits
        far = moved(start, x=0.14)

        def under_way() -> bool:
            arm.command(far)
            return float(np.linalg.norm(arm.state().pose.position - start.position)) > 0.04

        until(under_way, "motion", pause=0.02)
        asked = arm._channel.commands.count
        until(lambda: arm.status() == ArmStatus.HOLD, "hold")
        until(arm.at_rest, "rest")
        seen = records(arm)
        last = seen[seen["commands_read"] == asked][0]
        gone = float(np.linalg.norm(arm.state().pose.position - last["position"]))
        allowed = limits.speed * (timeout + arm.config.lookahead + 10e-3)  # the arm lags by those
        figure("way after the last action, at 0.1 m/s (time-out 200 ms)", 1e3 * gone, "mm", at_most=1e3 * allowed)
        # An arm whose controller came late may have lagged more than that; its target goes no farther in any case.
        left = float(np.linalg.norm(arm.state().pose.position - last["target"]))
        assert left <= limits.speed * timeout + 60e-6


# -- stops of the controller -----------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.promise(7)
def test_arm_protective_stop_raises_until_recover(arm: URArm, mock: MockUR, figure: Record) -> None:
    start = arm.state().pose
    at_full_speed(arm, moved(start, x=0.12))
    asked = time.monotonic()
    mock.faults.protective_stop()
    reported = until(lambda: arm.status() == ArmStatus.PROTECTIVE_STOP, "protective stop", pause=2e-4)
    figure("protective stop reported", 1e3 * (reported - asked), "ms", at_most=20)
    until(lambda: mock.faults.state().rests, "rest")
    before, mark = mock.faults.state(), mock.faults.received().last
    for _ in range(20):
        with pytest.raises(ProtectiveStop, match="protective stop; find the cause, then recover"):
            arm.command(start)
        time.sleep(0.01)
    assert arm.status() == ArmStatus.PROTECTIVE_STOP
    assert arm.state().time > 0.0  # it can still be looked at
    assert mock.faults.received(mark).entries == ()
    arm.recover()
    assert arm.status() == ArmStatus.HOLD
    time.sleep(0.1)
    again, after = servo_targets(mock.faults.received(mark).entries), mock.faults.state()
    moved_by = 1e3 * float(np.linalg.norm(np.subtract(after.pose[:3], before.pose[:3])))
    figure("motion before and by recover() (it settles to less)", moved_by, "mm", at_most=1e-3)
    figure("old commands that came again", len(again))
    assert len(again) == 0  # nothing old is asked again
    assert np.allclose(after.joints, before.joints, atol=1e-9)
    mark = mock.faults.received().last
    go(arm, start)
    check_path(arm, servo_targets(mock.faults.received(mark).entries))


@pytest.mark.promise(7)
def test_recover_unreported_protective_stop_raises_before_unlock(arm: URArm, mock: MockUR) -> None:
    assert arm.worker is not None
    os.kill(arm.worker.pid, signal.SIGKILL)
    until(lambda: arm.status() == ArmStatus.WORKER_DEAD, "death")
    mock.faults.protective_stop()
    with pytest.raises(ProtectiveStop, match=r"protective stop.*next recover\(\) unlocks it"):
        arm.recover()
    assert mock.faults.state().safety == "PROTECTIVE_STOP"
    arm.recover()
    assert arm.status() == ArmStatus.HOLD


@pytest.mark.promise(7)
def test_recover_emergency_stop_raises_until_released(arm: URArm, mock: MockUR) -> None:
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


@pytest.mark.promise(7)
def test_arm_program_stopped_outside_raises(arm: URArm, mock: MockUR) -> None:
    from robot.arm.connections import Dashboard

    in_motion(arm, moved(arm.state().pose, x=0.1))
    with Dashboard(HOST) as dashboard:
        dashboard.request("stop")
    until(lambda: arm.status() == ArmStatus.PROGRAM_STOPPED, "stopped program")
    with pytest.raises(ProtectiveStop, match="no running program"):
        arm.command(arm.state().pose)
    arm.recover()
    assert arm.status() == ArmStatus.HOLD


@pytest.mark.slow
@pytest.mark.promise(7)
def test_connect_stopped_arm_raises(mock: MockUR) -> None:
    mock.faults.protective_stop()
    with pytest.raises(ProtectiveStop, match="arm 'left': protective stop") as caught:
        URArm(config(), "left").close()
    assert "recover()" not in str(caught.value)  # there is no arm to call it of
    mock.faults.estop()
    with pytest.raises(EmergencyStop, match="person must release it"):
        URArm(config(), "left").close()
    mock.faults.reset()
    mock.faults.remote_control(False)
    with pytest.raises(DeviceError, match="remote control"):
        URArm(config(), "left").close()
    mock.faults.remote_control(True)
    assert leftovers() == 0
