"""The driver against a mock controller, over the wire: what is promised of it, in the logic of packages and ticks.

Times are bounded generously: they catch what hangs, not what is slow.
"""

from __future__ import annotations

import gc
import os
import signal
import subprocess
import sys
import textwrap
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from robot.arm import shared_ring, ur
from robot.arm.channel import HISTORY, ArmStatus, Kind, command
from robot.arm.trajectory import PERIOD
from robot.arm.ur import URArm
from robot.common.kinematics import Kinematics, matrix
from robot.errors import (
    DeviceAlreadyConnectedError,
    DeviceBusyError,
    DeviceError,
    DeviceNotConnectedError,
    EmergencyStop,
    LinkLost,
    ProtectiveStop,
    SafetyViolation,
    StaleObservationError,
)
from robot.mock import MOCK_SERIAL, Input, MockUR
from tacsim import pose as se3
from tacsim.control.gel_monitor import Touch
from tacsim.interface import Pose
from tacsim.limits import ActionError, region
from tacsim.models.hardware import ArmLimits, MockArmConfig, Payload, Placement, Plane, UrArmConfig, Workspace

pytest.importorskip("rtde_control", reason="ur_rtde has no wheel for this Python")

HOST, OTHER = (f"127.{net}.{os.getpid() >> 8 & 255}.{os.getpid() & 255}" for net in (23, 123))
PATIENCE = 20.0  # for anything that has to happen [s]
KINEMATICS = Kinematics("ur5e")
TOOL_FROM_SENSOR = Placement(position=(0.01, 0.0, 0.05), rotation=(0.0, 0.0, 0.3))
BASE = Placement(position=(0.2, -0.1, 0.05), rotation=(0.0, 0.0, 0.5))
START = np.array([-0.1, -0.43, 0.48])  # about where the sensor is at the mock's power-on [m]


def config(host: str = HOST, **changes: object) -> UrArmConfig:
    """Patient facts: no time-out of them depends on how busy the machine is. Tests of a time-out name their own."""
    limits = {"workspace": Workspace(lower=tuple(START - 0.15), upper=tuple(START + 0.15)), "speed": 0.1}
    limits |= dict(changes.pop("limits", {}))  # type: ignore[call-overload]
    made = UrArmConfig(
        driver="ur",
        host=host,
        world_from_base=BASE,
        flange_from_tool=Placement(position=(0.0, 0.0, 0.03), rotation=(0.1, 0.0, 0.0)),
        tool_from_sensor=TOOL_FROM_SENSOR,
        payload=Payload(mass=0.4, centre=(0.0, 0.0, 0.04)),
        limits=ArmLimits(**limits),  # type: ignore[arg-type]
        link_timeout=1.0,
        action_timeout=30.0,
        mock=MockArmConfig(),
    )
    # model_copy does not validate: a watchdog of 1 Hz leaves the worker a second of starvation.
    return made.model_copy(update={"watchdog": 1.0, **changes})


@pytest.fixture(scope="module")
def controller() -> Iterator[MockUR]:
    with MockUR(HOST) as mock:
        yield mock


@pytest.fixture
def mock(controller: MockUR) -> MockUR:
    """One as at power-on."""
    controller.door.reset()
    return controller


@pytest.fixture
def arm(mock: MockUR) -> Iterator[URArm]:
    with URArm(config(), "left") as opened:
        yield opened


def until(done: Callable[[], bool], what: str) -> None:
    deadline = time.monotonic() + PATIENCE
    while not done():
        assert time.monotonic() < deadline, f"{what}: not within {PATIENCE} s"
        time.sleep(1e-3)


def moved(pose: Pose, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Pose:
    return Pose(pose.position + [x, y, z], pose.quaternion)


def go(arm: URArm, target: Pose) -> None:
    sent = arm.command(target)
    assert sent is not None

    def there() -> bool:
        assert not arm.status().is_fault, arm.explain()
        return arm.arrived(sent)

    until(there, "arrival")


def in_motion(arm: URArm, target: Pose) -> None:
    """Commands `target` and comes back when the arm is on its way."""
    start = arm.state().pose.position
    arm.command(target)
    until(lambda: float(np.linalg.norm(arm.state().pose.position - start)) > 2e-3, "motion")


def servo_targets(entries: tuple[Input, ...]) -> np.ndarray:
    """Joints (n, 6) of the servoJ calls among the received packages."""
    rows = [
        [entry.values[f"input_double_register_{k}"] for k in range(6)]
        for entry in entries
        if entry.values.get("input_int_register_0") == 11
    ]
    return np.array(rows, dtype=np.float64).reshape(-1, 6)


def sensor_path(arm: URArm, joints: np.ndarray) -> np.ndarray:
    """world_from_sensor (n, 4, 4) of joint targets, by forward kinematics alone."""
    flange_from_sensor = se3.to_matrix(se3.compose(arm.config.flange_from_tool.pose, arm.config.tool_from_sensor.pose))
    base = se3.to_matrix(arm.config.world_from_base.pose)
    return np.array([base @ KINEMATICS.forward(q) @ flange_from_sensor for q in joints])


def check_path(arm: URArm, joints: np.ndarray) -> None:
    """Box, planes, speed, acceleration and joint steps of what was really sent."""
    limits = arm.config.limits
    path = sensor_path(arm, joints)
    walls = region(limits.workspace.lower, limits.workspace.upper, [(p.point, p.normal) for p in limits.planes])
    assert walls.excess(path[:, :3, 3]).max() <= 1e-8
    assert np.abs(np.diff(joints, axis=0)).max() <= limits.joint_speed * PERIOD * (1 + 1e-9)
    velocity = np.diff(path[:, :3, 3], axis=0) / PERIOD
    assert np.linalg.norm(velocity, axis=1).max() <= limits.speed * (1 + 1e-4)
    change = np.diff(velocity, axis=0) / PERIOD
    assert np.linalg.norm(change, axis=1).max() <= limits.acceleration * (1 + 1e-2)


# -- one package, the right frames -----------------------------------------------------------------------------------


def test_state_speaks_of_the_sensor_in_the_world(arm: URArm, mock: MockUR) -> None:
    there = mock.door.state()
    expected = se3.compose(
        arm.config.world_from_base.pose, se3.compose(se3.from_matrix(matrix(there.pose)), TOOL_FROM_SENSOR.pose)
    )
    state = arm.state()
    assert max(se3.distance(state.pose, expected)) < 1e-9
    assert state.joints is not None and np.allclose(state.joints, there.joints)
    assert there.payload == pytest.approx(0.4)
    assert there.watchdog
    go(arm, moved(state.pose, z=-0.01))
    assert arm.state().pose.position[2] == pytest.approx(state.pose.position[2] - 0.01, abs=60e-6)


def test_wrench_is_what_the_object_does_to_the_sensor(arm: URArm, mock: MockUR) -> None:
    force, torque = np.array([3.0, -2.0, 12.0]), np.array([0.1, 0.2, -0.05])
    mock.door.wrench([*force, *torque])
    until(lambda: abs(float(np.linalg.norm(arm.state().wrench[:3])) - np.linalg.norm(force)) < 1e-6, "force")
    state = arm.state()
    base_from_tool = se3.from_matrix(matrix(mock.door.state().pose))
    at_tool = np.concatenate([se3.rotate(se3.inverse(base_from_tool), v) for v in (force, torque)])
    assert np.allclose(state.wrench, se3.transform_wrench(se3.inverse(TOOL_FROM_SENSOR.pose), at_tool), atol=1e-6)
    # The sensor looks down at what pushes up: pressing is a negative force along its z.
    assert state.wrench[2] < -10.0
    arm.zero_wrench()
    until(lambda: float(np.abs(arm.state().wrench).max()) < 1e-6, "zero wrench")


def test_twist_is_the_change_of_the_pose(arm: URArm) -> None:
    start = arm.state().pose
    turned = se3.compose(moved(start, x=0.05), se3.from_rotation_vector([0, 0, 0], [0.2, 0.0, 0.3]))
    in_motion(arm, turned)
    time.sleep(0.2)
    states = arm.history()
    checked = 0
    for a, b, c in zip(states, states[1:], states[2:], strict=False):
        if 0.0 < c.time - a.time < 0.1 and float(np.linalg.norm(b.twist[:3])) > 0.02:
            checked += 1
            # Packages may be skipped or late, so the way is compared by direction, and the speed by its limits.
            way = se3.difference(a.pose, c.pose)
            assert way[:3] @ b.twist[:3] > 0.9 * np.linalg.norm(way[:3]) * np.linalg.norm(b.twist[:3])
            assert way[3:] @ b.twist[3:] > 0.9 * np.linalg.norm(way[3:]) * np.linalg.norm(b.twist[3:])
            assert np.linalg.norm(b.twist[:3]) <= arm.config.limits.speed * 1.05
    assert checked > 5


def test_all_fields_of_a_state_are_of_one_instant(arm: URArm) -> None:
    """Forward kinematics of the joints is the pose, in motion, in every record the worker ever wrote."""
    start = arm.state().pose
    flange_from_tool = se3.to_matrix(arm.config.flange_from_tool.pose)
    torn = seen = 0
    last = 0.0
    for k in range(12):
        arm.command(moved(start, x=0.03 * (-1) ** k, z=0.02 * (-1) ** (k // 2)))
        time.sleep(0.1)
        for record in arm._packages(HISTORY):
            if record["time"] > last:
                last = float(record["time"])
                seen += 1
                expected = KINEMATICS.forward(record["joints"], flange_from_tool)
                torn += float(np.abs(expected - matrix(record["tcp_pose"])).max()) > 1e-9
    assert seen > 100
    assert torn == 0


@pytest.mark.deep
@pytest.mark.timeout(600)
def test_a_hundred_thousand_looks_and_none_is_torn(arm: URArm) -> None:
    """As a policy looks, all the time and in motion: whatever is read is of one package."""
    start = arm.state().pose
    flange_from_tool = se3.to_matrix(arm.config.flange_from_tool.pose)
    packages = set()
    for look in range(100_000):
        if look % 5_000 == 0:
            arm.command(moved(start, x=0.03 * (-1) ** (look // 5_000)))
        record = arm._link.states.latest()
        assert record is not None
        packages.add(float(record["stamp"]))
        expected = KINEMATICS.forward(record["joints"], flange_from_tool)
        assert np.abs(expected - matrix(record["tcp_pose"])).max() < 1e-9
    assert len(packages) > 100


# -- limits on the wire ----------------------------------------------------------------------------------------------


def hostile(rng: np.random.Generator, start: Pose) -> np.ndarray:
    row = np.concatenate([start.position + rng.uniform(-0.4, 0.4, 3), start.quaternion])
    if rng.random() < 0.4:
        row[rng.integers(0, 7)] = rng.choice([np.nan, np.inf, -np.inf, 1e308, -1e9, 5.0])
    return row


def send_hostile(arm: URArm, mock: MockUR, number: int) -> None:
    start = arm.state().pose
    rng = np.random.default_rng(5)
    since = mock.door.received().last
    joints = []
    for k in range(number):
        # Past the guards of the driver: the worker must stand alone.
        arm._link.commands.write(command(time.monotonic(), Kind.TARGET, hostile(rng, start)))
        time.sleep(0.0005)
        if k % 2000 == 1999:
            page = mock.door.received(since)
            assert page.lost == 0
            since = page.last
            joints.append(servo_targets(page.entries))
    arm.stop()
    until(arm.at_rest, "rest")
    sent = np.concatenate([*joints, servo_targets(mock.door.received(since).entries)])
    assert len(sent) > number / 100
    assert np.isfinite(sent).all()
    check_path(arm, sent)
    record = arm._link.states.latest()
    assert record is not None and record["rejected"] > 0 and record["shortened"] > 0
    assert not arm.status().is_fault
    assert mock.door.state().program


SLOPED = {"planes": (Plane(point=tuple(START - [0.0, 0.0, 0.05]), normal=(0.3, 0.0, 1.0)),)}


def test_five_thousand_hostile_targets_leave_no_trace_beyond_the_limits(mock: MockUR) -> None:
    with URArm(config(limits=SLOPED), "left") as arm:
        send_hostile(arm, mock, 5_000)


@pytest.mark.deep
@pytest.mark.timeout(900)
def test_a_hundred_thousand_hostile_targets(mock: MockUR) -> None:
    with URArm(config(limits={**SLOPED, "speed": 0.5, "acceleration": 5.0}), "left") as arm:
        send_hostile(arm, mock, 100_000)


def test_the_measured_arm_stays_in_the_box_too(mock: MockUR) -> None:
    with URArm(config(limits={"speed": 1.0, "acceleration": 10.0, "joint_speed": 3.0}), "left") as arm:
        start, rng = arm.state().pose, np.random.default_rng(1)
        walls = region(arm.config.limits.workspace.lower, arm.config.limits.workspace.upper)
        worst = -1.0
        for _ in range(60):
            arm.command(moved(start, *rng.uniform(-0.5, 0.5, 3)))
            time.sleep(0.03)
            states = arm.history(30)
            worst = max(worst, max(float(walls.excess(state.pose.position)) for state in states))
        assert worst <= 1e-3
        assert not arm.status().is_fault


def test_what_is_shortened_is_told(arm: URArm) -> None:
    start = arm.state().pose
    beyond = moved(start, z=-1.0)
    sent = arm.command(beyond)
    assert sent is not None and sent is not beyond
    assert sent.position[2] == pytest.approx(arm.config.limits.workspace.lower[2])
    until(lambda: arm.arrived(sent), "the floor")
    inside = moved(start, z=0.01)
    assert arm.command(inside) is inside
    assert arm.command(None) is None


@pytest.mark.parametrize("bad", ["up", 3, [0.0] * 7, np.zeros(7)])
def test_what_is_no_pose_is_refused(arm: URArm, bad: object) -> None:
    with pytest.raises(ActionError):
        arm.command(bad)  # type: ignore[arg-type]
    with pytest.raises(ActionError, match="more than 1000 m"):
        arm.command(Pose(np.array([0.0, 0.0, 1e5])))
    assert arm.status() == ArmStatus.HOLD


def test_a_target_out_of_reach_is_refused_and_the_program_lives(mock: MockUR) -> None:
    wide = {"workspace": Workspace(lower=(-3.0, -3.0, -1.0), upper=(3.0, 3.0, 3.0))}
    with URArm(config(limits=wide), "left") as arm:
        with pytest.raises(ActionError, match="out of its reach"):
            arm.command(moved(arm.state().pose, z=2.0))
        # Past the driver's look: the worker stops where the joints, their speed or a singularity say so.
        far = moved(arm.state().pose, z=2.0)
        since = mock.door.received().last
        arm._link.commands.write(command(time.monotonic(), Kind.TARGET, np.array([*far.position, *far.quaternion])))
        until(lambda: arm.status() == ArmStatus.OUT_OF_REACH, "out of reach")
        time.sleep(0.5)
        assert mock.door.state().program
        sent = servo_targets(mock.door.received(since).entries)
        assert np.abs(np.diff(sent, axis=0)).max() <= arm.config.limits.joint_speed * PERIOD * (1 + 1e-9)
        go(arm, moved(arm.state().pose, z=-0.02))


def test_limits_have_no_default_workspace() -> None:
    with pytest.raises(ValueError, match="workspace"):
        ArmLimits()  # type: ignore[call-arg]


def test_an_arm_outside_its_workspace_does_not_connect(mock: MockUR) -> None:
    elsewhere = {"workspace": Workspace(lower=(2.0, 2.0, 2.0), upper=(3.0, 3.0, 3.0))}
    with pytest.raises(SafetyViolation, match=r"outside its workspace.*mm beyond the workspace's lower"):
        URArm(config(limits=elsewhere), "left").close()
    assert leftovers("left") == []


# -- force -----------------------------------------------------------------------------------------------------------


def test_force_limit_stops_in_the_period_of_its_package(mock: MockUR) -> None:
    stiffness, limit, speed = 2000.0, 20.0, 0.05
    with URArm(config(limits={"force": limit, "speed": speed}), "left") as arm:
        start = arm.state().pose
        mock.door.wall(mock.door.state().pose[2] - 0.02, stiffness)
        since = mock.door.received().last
        arm.command(moved(start, z=-0.1))
        until(lambda: arm.status() == ArmStatus.FORCE_LIMIT, "force limit")
        until(lambda: arm._link.states.latest()["resting"] == 1, "rest")  # type: ignore[index]
        records = arm._link.states.recent(HISTORY)
        over = np.linalg.norm(records["tcp_force"][:, :3], axis=1) > limit
        first = records[over][0]
        of_that_package = records[records["stamp"] == first["stamp"]]
        assert (of_that_package["status"] == ArmStatus.FORCE_LIMIT).any()  # published before the next package
        # No further approach: after the fault the target lies no deeper than the arm's own braking way.
        path = sensor_path(arm, servo_targets(mock.door.received(since).entries))[:, 2, 3]
        deepest_allowed = float(first["position"][2]) - speed**2 / (2 * 5.0) - 1e-5
        assert path[-1] >= deepest_allowed
        jump = int(np.argmax(np.diff(path)))  # where the target is drawn back to the arm
        assert (path[jump + 1 :] >= deepest_allowed).all()
        peak = float(np.linalg.norm(records["tcp_force"][:, :3], axis=1).max())
        assert peak <= float(np.linalg.norm(first["tcp_force"][:3])) + stiffness * speed * 0.2  # ten times 20 ms
        with pytest.raises(SafetyViolation, match=r"felt more than limits.force.* of 20 N"):
            arm.command(start)
        assert mock.door.state().program  # the controller itself saw nothing wrong
        mock.door.no_wall()
        arm.recover()
        assert arm.status() == ArmStatus.HOLD
        go(arm, start)


def test_a_gel_pressed_too_far_stops_the_arm_that_presses_it(mock: MockUR) -> None:
    with URArm(config(limits={"depth": 1e-3, "speed": 0.05}), "left") as arm:
        start = arm.state().pose
        arm.tell(Touch(time.monotonic(), depth=0.9e-3))
        in_motion(arm, moved(start, z=-0.1))
        since = mock.door.received().last
        arm.tell(Touch(time.monotonic(), depth=1.1e-3))
        until(lambda: arm.status() == ArmStatus.GEL_LIMIT, "gel limit")
        until(lambda: arm._link.states.latest()["resting"] == 1, "rest")  # type: ignore[index]
        records = arm._link.states.recent(HISTORY)
        first = records[records["status"] == ArmStatus.GEL_LIMIT][0]
        path = sensor_path(arm, servo_targets(mock.door.received(since).entries))[:, 2, 3]
        assert path[-1] >= float(first["position"][2]) - 0.05**2 / (2 * 5.0) - 1e-5
        with pytest.raises(SafetyViolation, match=r"limits.depth or limits.shear and stopped"):
            arm.command(start)
        arm.recover()
        go(arm, start)  # what the last worker was shown is not held against this one


def test_an_arm_whose_sensors_are_not_seen_any_more_stands(mock: MockUR) -> None:
    with URArm(config(observation_timeout=0.5), "left") as arm:
        start = arm.state().pose
        far = moved(start, x=0.12)
        arm.tell(Touch(time.monotonic()))
        in_motion(arm, far)
        until(lambda: arm.status() == ArmStatus.BLIND, "blind")
        until(arm.at_rest, "rest")
        held = arm.state().pose
        assert se3.distance(start, held)[0] < 0.1
        arm.command(far)  # asked again, but nobody has seen anything since
        since = mock.door.received().last
        until(lambda: len(servo_targets(mock.door.received(since).entries)) > 50, "held targets")
        assert np.ptp(servo_targets(mock.door.received(since).entries), axis=0).max() < 1e-9
        arm.tell(None)  # nobody looks by now: the rule ends
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
        since = mock.door.received().last
        until(lambda: len(servo_targets(mock.door.received(since).entries)) > 20, "held targets")
        assert np.ptp(servo_targets(mock.door.received(since).entries), axis=0).max() < 1e-12
        mark = mock.door.received().last
        in_motion(arm, far)
        sent = servo_targets(mock.door.received(mark).entries)
        first = sensor_path(arm, sent)[:, :3, 3]
        limits = arm.config.limits
        assert np.linalg.norm(first[0] - held.position) <= limits.acceleration * PERIOD**2 + 60e-6
        check_path(arm, sent)


def test_a_silent_link_is_lost_and_the_program_that_asks_is_not(mock: MockUR) -> None:
    with URArm(config(link_timeout=0.5), "left") as arm:
        start = arm.state().pose
        in_motion(arm, moved(start, x=0.1))
        mock.door.silence(True)
        until(lambda: arm.status() == ArmStatus.LINK_LOST, "lost link")
        with pytest.raises(StaleObservationError, match="more than link_timeout = 500 ms"):
            arm.state()
        with pytest.raises(LinkLost, match="sends no packages"):
            arm.command(start)
        until(lambda: mock.door.state().rests, "rest by the controller's watchdog")
        assert len(arm.history()) > 5  # what was known stays known
        mock.door.silence(False)
        mark = mock.door.received().last
        arm.recover()
        time.sleep(0.2)
        assert len(servo_targets(mock.door.received(mark).entries)) == 0  # nothing old is asked again
        go(arm, start)


@pytest.mark.parametrize("reset", [False, True])
def test_a_cut_link_is_lost_for_good_until_recover(mock: MockUR, reset: bool) -> None:
    with URArm(config(link_timeout=0.5), "left") as arm:
        start = arm.state().pose
        in_motion(arm, moved(start, x=0.1))
        mock.door.cut([30004], reset=reset)
        until(lambda: arm.status() in (ArmStatus.LINK_LOST, ArmStatus.WORKER_DEAD), "lost link")
        time.sleep(0.3)
        assert arm.status() in (ArmStatus.LINK_LOST, ArmStatus.WORKER_DEAD)
        until(lambda: mock.door.state().rests, "rest")
        arm.recover()
        go(arm, start)


def test_a_stopped_controller_is_a_lost_link(mock: MockUR) -> None:
    with URArm(config(link_timeout=0.5), "left") as arm:
        start = arm.state().pose
        os.kill(mock.pid, signal.SIGSTOP)
        try:
            until(lambda: arm.status() == ArmStatus.LINK_LOST, "lost link")
            begun = time.monotonic()
            with pytest.raises(DeviceError):
                URArm(config(OTHER), "nobody", timeout=2.0).close()
            assert time.monotonic() - begun < PATIENCE
        finally:
            os.kill(mock.pid, signal.SIGCONT)
        until(lambda: mock.door.state().rests, "rest")
        arm.recover()
        go(arm, moved(start, x=0.01))


def test_numbers_that_are_none_are_no_package(mock: MockUR) -> None:
    with URArm(config(link_timeout=0.5), "left") as arm:
        in_motion(arm, moved(arm.state().pose, x=0.1))
        mock.door.nan_state(True)
        until(lambda: arm.status() == ArmStatus.LINK_LOST, "lost link")
        until(lambda: mock.door.state().rests, "rest")
        mock.door.nan_state(False)
        arm.recover()
        assert np.isfinite(arm.state().pose.position).all()


@pytest.mark.parametrize("jump", [100.0, -100.0])
def test_a_clock_that_jumps_loses_nothing(arm: URArm, mock: MockUR, jump: float) -> None:
    start = arm.state().pose
    in_motion(arm, moved(start, x=0.05))
    mock.door.clock_jump(jump)
    go(arm, start)
    assert arm.status() == ArmStatus.OK


def test_late_and_lost_packages_are_lived_with(arm: URArm, mock: MockUR) -> None:
    start = arm.state().pose
    mock.door.drop(0.3, seed=1)
    mock.door.delay(0.02)
    go(arm, moved(start, x=0.02))
    mock.door.delay(0.0)
    mock.door.drop(0.0)
    go(arm, start)


# -- stops of the controller -----------------------------------------------------------------------------------------


def test_a_protective_stop_is_told_and_only_recover_ends_it(arm: URArm, mock: MockUR) -> None:
    start = arm.state().pose
    in_motion(arm, moved(start, x=0.1))
    mock.door.protective_stop()
    until(lambda: arm.status() == ArmStatus.PROTECTIVE_STOP, "protective stop")
    with pytest.raises(ProtectiveStop, match="protective stop; look why, then recover"):
        arm.command(start)
    until(lambda: mock.door.state().rests, "rest")
    where, mark = mock.door.state().joints, mock.door.received().last
    time.sleep(0.3)
    assert arm.status() == ArmStatus.PROTECTIVE_STOP
    assert arm.state().time > 0.0  # it can still be looked at
    assert mock.door.received(mark).entries == ()
    arm.recover()
    assert arm.status() == ArmStatus.HOLD
    time.sleep(0.3)
    assert servo_targets(mock.door.received(mark).entries).size == 0  # nothing old is asked again
    assert np.allclose(mock.door.state().joints, where, atol=1e-9)
    mark = mock.door.received().last
    go(arm, start)
    check_path(arm, servo_targets(mock.door.received(mark).entries))


def test_an_emergency_stop_waits_for_a_person(arm: URArm, mock: MockUR) -> None:
    start = arm.state().pose
    in_motion(arm, moved(start, x=0.1))
    mock.door.estop()
    until(lambda: arm.status() == ArmStatus.EMERGENCY_STOP, "emergency stop")
    for _ in range(2):
        with pytest.raises(EmergencyStop, match="person must release it"):
            arm.recover()
        assert arm.status() == ArmStatus.EMERGENCY_STOP
    with pytest.raises(EmergencyStop):
        arm.command(start)
    assert mock.door.state().safety == "ROBOT_EMERGENCY_STOP"
    mock.door.release()
    with pytest.raises(DeviceError, match="power it on"):
        arm.recover()
    mock.door.recover()
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
    mock.door.protective_stop()
    with pytest.raises(ProtectiveStop, match="arm 'left': protective stop"):
        URArm(config(), "left").close()
    mock.door.estop()
    with pytest.raises(EmergencyStop, match="person must release it"):
        URArm(config(), "left").close()
    mock.door.reset()
    mock.door.remote_control(False)
    with pytest.raises(DeviceError, match="remote control"):
        URArm(config(), "left").close()
    mock.door.remote_control(True)
    assert leftovers("left") == []


# -- death -----------------------------------------------------------------------------------------------------------


def test_a_killed_worker_is_told_and_replaced(mock: MockUR) -> None:
    with URArm(config(watchdog=10.0), "left") as arm:
        start = arm.state().pose
        in_motion(arm, moved(start, x=0.1))
        assert arm._process is not None
        os.kill(arm._process.pid, signal.SIGKILL)
        until(lambda: arm.status() == ArmStatus.WORKER_DEAD, "death")
        with pytest.raises(DeviceNotConnectedError, match="lost its worker process"):
            arm.command(start)
        with pytest.raises(DeviceNotConnectedError):
            arm.state()
        until(lambda: mock.door.state().rests and not mock.door.state().program, "the watchdog's stop")
        assert "watchdog" in mock.door.state().stop_reason.lower()
        arm.recover()
        assert arm.status() == ArmStatus.HOLD
        go(arm, start)


def test_a_stopped_worker_is_a_lost_link_and_can_be_replaced(mock: MockUR) -> None:
    with URArm(config(watchdog=10.0, link_timeout=0.5), "left") as arm:
        start = arm.state().pose
        assert arm._process is not None
        os.kill(arm._process.pid, signal.SIGSTOP)
        until(lambda: arm.status() == ArmStatus.LINK_LOST, "lost link")
        arm.recover()  # SIGKILL ends even a stopped process
        go(arm, moved(start, x=0.01))


POLICY = """
    import sys, time
    from robot.arm.ur import URArm
    from tacsim.models.hardware import UrArmFacts
    from tacsim.interface import Pose
    facts = UrArmFacts.model_validate_json(sys.argv[1])
    arm = URArm(facts, "policy")
    start = arm.state().pose
    arm.command(Pose(start.position + [0.12, 0.0, 0.0], start.quaternion))
    while abs(arm.state().pose.position[0] - start.position[0]) < 0.02:
        time.sleep(0.001)
    print(arm._segment.name, arm._process.pid, flush=True)
    time.sleep(60)
"""


def running(process: int) -> bool:
    """False also for one that has ended and that nobody has asked for its exit status."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT])
def test_a_policy_that_dies_leaves_a_standing_arm_and_nothing_else(mock: MockUR, number: int) -> None:
    root = str(Path(ur.__file__).parents[2])
    policy = subprocess.Popen(
        [
            sys.executable,
            "-c",
            textwrap.dedent(POLICY),
            config().model_copy(update={"watchdog": 10.0}).model_dump_json(),
        ],
        env={**os.environ, "PYTHONPATH": root},
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    assert policy.stdout is not None
    segment, worker = policy.stdout.readline().split()
    before = mock.door.state()
    assert not before.rests
    policy.send_signal(number)
    policy.communicate(timeout=PATIENCE)
    until(lambda: mock.door.state().rests, "rest")
    after = mock.door.state()
    if number == signal.SIGKILL:  # an interrupted program ends as fast as the machine lets it
        assert np.linalg.norm(np.array(after.pose[:3]) - before.pose[:3]) < 0.05  # ten times 5 mm
    until(lambda: not mock.door.state().program, "end of the program")
    until(lambda: 30004 not in mock.door.state().clients, "closed sockets")
    until(lambda: not (shared_ring.FOLDER / segment).exists(), "removed memory")
    until(lambda: not running(int(worker)), "end of the worker")


# -- one commander ---------------------------------------------------------------------------------------------------


def test_a_second_driver_is_refused_and_the_first_goes_on(arm: URArm, mock: MockUR) -> None:
    start = arm.state().pose
    in_motion(arm, moved(start, x=0.1))
    with pytest.raises(DeviceBusyError, match="controlled by another program"):
        URArm(config(), "second").close()
    assert leftovers("second") == []
    assert arm.status() == ArmStatus.OK
    go(arm, start)
    with pytest.raises(DeviceAlreadyConnectedError, match="open already"):
        URArm(config(), "left").close()
    go(arm, moved(start, x=0.01))


def test_a_field_bus_that_holds_the_registers_is_busy_too(mock: MockUR) -> None:
    mock.door.claim(["input_int_register_0"])
    with pytest.raises(DeviceBusyError):
        URArm(config(), "left").close()


# -- connecting ------------------------------------------------------------------------------------------------------


@pytest.fixture
def longest_gap() -> Iterator[Callable[[], float]]:
    """How long another thread of this process had to wait for its turn [s]."""
    gaps, over = [0.0], threading.Event()

    def beat() -> None:
        last = time.monotonic()
        while not over.wait(0.005):
            now = time.monotonic()
            gaps.append(now - last)
            last = now

    thread = threading.Thread(target=beat)
    thread.start()
    yield lambda: max(gaps)
    over.set()
    thread.join()


@pytest.mark.parametrize("fault", ["refusing", "black hole", "mute dashboard", "silent"])
def test_connecting_to_nobody_ends_in_time_and_blocks_no_thread(
    mock: MockUR, longest_gap: Callable[[], float], fault: str
) -> None:
    door, host = mock.door, HOST
    if fault == "black hole":
        door.black_hole(True)
    elif fault == "mute dashboard":
        door.dashboard_mute(True)
    elif fault == "silent":
        door.silence(True)
    else:
        host = OTHER  # nobody listens there
    begun = time.monotonic()
    with pytest.raises(DeviceNotConnectedError):
        URArm(config(host), "left", timeout=3.0).close()
    assert time.monotonic() - begun < 3.0 + PATIENCE
    assert longest_gap() < 1.0  # the library would have blocked them until the end
    assert leftovers("left") == []
    door.reset()
    with URArm(config(), "left") as arm:
        assert arm.status() == ArmStatus.HOLD


def test_the_wrong_model_does_not_connect(mock: MockUR) -> None:
    with pytest.raises(DeviceNotConnectedError, match="arm 'left' is a UR5, but its file says model: ur10e"):
        URArm(config().model_copy(update={"model": "ur10e"}), "left").close()


def test_mock_and_real_are_never_mistaken(mock: MockUR, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(DeviceNotConnectedError, match="outside this machine"):
        URArm(config("192.0.2.7"), "left").close()
    for host in (HOST, "localhost", "127.0.0.1", "::1"):
        with pytest.raises(DeviceNotConnectedError, match="is this machine"):
            URArm(config(host, mock=None), "left").close()
    assert MOCK_SERIAL  # a mock that is reached under another address gives itself away
    monkeypatch.setattr(ur, "_check_host", lambda *_: None)
    with pytest.raises(DeviceNotConnectedError, match="is a mock controller"):
        URArm(config(mock=None), "left").close()


# -- closing ---------------------------------------------------------------------------------------------------------


def leftovers(name: str) -> list[str]:
    return [path.name for path in shared_ring.FOLDER.glob(f"{shared_ring.PREFIX}-{os.getpid()}-{name}")]


def open_files() -> int:
    gc.collect()
    return len(list(Path("/proc/self/fd").iterdir()))


@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="counts open files as Linux shows them")
def test_nothing_is_left_after_close(mock: MockUR) -> None:
    before = open_files()
    arm = URArm(config(), "left")
    in_motion(arm, moved(arm.state().pose, x=0.1))
    worker = arm._process
    assert worker is not None and leftovers("left")
    arm.close()
    arm.close()
    assert worker.returncode == 0  # it ended by itself
    assert leftovers("left") == []
    assert open_files() == before
    until(lambda: mock.door.state().rests, "rest")
    assert not mock.door.state().program
    until(lambda: set(mock.door.state().clients) <= {30020}, "closed sockets")
    assert arm.status() == ArmStatus.CLOSED
    for call in (arm.state, lambda: arm.command(None), arm.recover, arm.history, arm.zero_wrench, arm.timing):
        with pytest.raises(DeviceNotConnectedError, match="is closed"):
            call()
    arm.stop()


@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="counts open files as Linux shows them")
def test_nothing_is_left_of_a_worker_that_died(mock: MockUR) -> None:
    before = open_files()
    arm = URArm(config(watchdog=10.0), "left")
    in_motion(arm, moved(arm.state().pose, x=0.1))
    worker = arm._process
    assert worker is not None
    os.kill(worker.pid, signal.SIGKILL)
    until(lambda: arm.status() == ArmStatus.WORKER_DEAD, "death")
    arm.close()
    assert worker.returncode == -signal.SIGKILL  # reaped, no zombie
    assert leftovers("left") == []
    assert open_files() == before
    until(lambda: not mock.door.state().program, "the watchdog's stop")
    until(lambda: set(mock.door.state().clients) <= {30020}, "closed sockets")


def test_a_wedged_worker_is_killed(mock: MockUR) -> None:
    arm = URArm(config(), "left")
    assert arm._process is not None
    worker = arm._process
    os.kill(worker.pid, signal.SIGSTOP)
    begun = time.monotonic()
    arm.close()
    assert time.monotonic() - begun < 15.0  # ten times the promise
    assert worker.returncode == -signal.SIGKILL
    assert leftovers("left") == []


def test_close_while_it_connects(mock: MockUR, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C in the middle of connecting: no worker and no memory stay behind."""
    mock.door.black_hole(True)
    workers: list[subprocess.Popen[bytes]] = []
    true_start = URArm._start

    def interrupted(self: URArm) -> None:
        threading.Timer(0.5, lambda: (workers.append(self._process), os.kill(os.getpid(), signal.SIGINT))).start()  # type: ignore[arg-type,func-returns-value]
        true_start(self)

    monkeypatch.setattr(URArm, "_start", interrupted)
    with pytest.raises(KeyboardInterrupt):
        URArm(config(), "left", timeout=PATIENCE).close()
    assert workers[0].poll() is not None
    assert leftovers("left") == []


# -- two arms --------------------------------------------------------------------------------------------------------


@pytest.fixture
def pair(mock: MockUR) -> Iterator[tuple[URArm, URArm, MockUR]]:
    """Two arms whose sensors are 60 mm apart along x, and must stay 40 mm apart."""
    with MockUR(OTHER) as other:
        shifted = BASE.model_copy(update={"position": (BASE.position[0] + 0.06, *BASE.position[1:])})
        slow = {"speed": 0.02}
        with (
            URArm(config(limits=slow), "left", keep_out={"right": 0.04}) as left,
            URArm(
                config(OTHER).model_copy(update={"world_from_base": shifted}), "right", keep_out={"left": 0.04}
            ) as right,
        ):
            yield left, right, other


def apart(left: URArm, right: URArm) -> float:
    return float(np.linalg.norm(left.state().pose.position - right.state().pose.position))


def test_two_arms_keep_apart_whoever_moves(pair: tuple[URArm, URArm, MockUR]) -> None:
    left, right, _ = pair
    a, b = left.state().pose, right.state().pose
    assert apart(left, right) == pytest.approx(0.06, abs=1e-6)
    least = 1.0
    for _ in range(150):  # head on
        left.command(moved(a, x=0.05))
        right.command(moved(b, x=-0.05))
        time.sleep(0.01)
        least = min(least, apart(left, right))
    assert least > 0.039
    assert least < 0.055  # they did come nearer
    assert not left.status().is_fault and not right.status().is_fault
    go(right, moved(b, x=0.05))  # away is always free
    go(left, a)


def test_an_arm_waits_for_the_other_of_its_keep_out(mock: MockUR) -> None:
    with URArm(config(), "left", keep_out={"right": 0.04}) as arm:
        until(lambda: arm.status() == ArmStatus.WAITING, "waiting")
        with pytest.raises(SafetyViolation, match="other arm of a keep-out is not connected"):
            arm.command(moved(arm.state().pose, x=0.01))


def test_both_arms_stop_when_one_does(pair: tuple[URArm, URArm, MockUR]) -> None:
    left, right, other = pair
    a, b = left.state().pose, right.state().pose
    in_motion(left, moved(a, x=-0.1))
    other.door.protective_stop()
    until(lambda: left.status() == ArmStatus.PARTNER_STOPPED, "the other arm's stop")
    until(lambda: right.status() == ArmStatus.PROTECTIVE_STOP, "protective stop")
    with pytest.raises(SafetyViolation, match="stopped because the other arm did"):
        left.command(a)
    until(left.at_rest, "rest")
    # Within two periods of the stop's publication, as the loop of the arm that hears of it counts them.
    told = right._link.states.recent(HISTORY)
    told = told[told["status"] == ArmStatus.PROTECTIVE_STOP][0]["beat"]
    heard = left._link.states.recent(HISTORY)
    before = heard[heard["beat"] < told][-1]["cycles"]
    assert heard[heard["status"] == ArmStatus.PARTNER_STOPPED][0]["cycles"] - before <= 2
    right.recover()
    left.recover()
    go(left, a)
    go(right, moved(b, x=0.01))


def test_a_dead_partner_stops_the_arm_that_moves(pair: tuple[URArm, URArm, MockUR]) -> None:
    """The other one counts as dead after link_timeout, 1 s here; this one is under way for much longer."""
    left, right, _ = pair
    in_motion(left, moved(left.state().pose, x=-0.14))
    assert right._process is not None
    os.kill(right._process.pid, signal.SIGKILL)
    until(lambda: left.status() == ArmStatus.PARTNER_STOPPED, "stop")


# -- rate ------------------------------------------------------------------------------------------------------------


def test_the_loop_counts_its_periods(arm: URArm, mock: MockUR) -> None:
    until(lambda: arm.timing().cycles > 1100, "cycles")
    timing = arm.timing()
    assert 0.5 * PERIOD < timing.median <= timing.p99 <= timing.longest
    assert timing.overruns >= 0
