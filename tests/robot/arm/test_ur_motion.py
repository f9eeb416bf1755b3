"""The driver of a UR arm: its state in the right frames, and the limits of all that is sent."""

from __future__ import annotations

import time

import numpy as np
import pytest

from robot.arm.channel import HISTORY, ArmStatus, CommandKind, command_record
from robot.arm.trajectory import PERIOD
from robot.arm.ur import URArm
from robot.common.kinematics import matrix
from robot.errors import (
    SafetyViolation,
)
from robot.mock import MockUR
from tacsim import pose as se3
from tacsim.interface import Pose
from tacsim.limits import ActionError, region
from tacsim.models.hardware import ArmLimits, Plane, Workspace
from tests.robot.arm.mocked import (
    KINEMATICS,
    START,
    TOOL_FROM_SENSOR,
    check_path,
    config,
    go,
    in_motion,
    leftovers,
    moved,
    servo_targets,
    until,
)

# -- one package, the right frames -----------------------------------------------------------------------------------


def test_state_speaks_of_the_sensor_in_the_world(arm: URArm, mock: MockUR) -> None:
    there = mock.faults.state()
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
    mock.faults.wrench([*force, *torque])
    until(lambda: abs(float(np.linalg.norm(arm.state().wrench[:3])) - np.linalg.norm(force)) < 1e-6, "force")
    state = arm.state()
    base_from_tool = se3.from_matrix(matrix(mock.faults.state().pose))
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
        record = arm._channel.states.latest()
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
    since = mock.faults.received().last
    joints = []
    for k in range(number):
        # Past the guards of the driver: the worker must stand alone.
        arm._channel.commands.write(command_record(time.monotonic(), CommandKind.TARGET, hostile(rng, start)))
        time.sleep(0.0005)
        if k % 2000 == 1999:
            page = mock.faults.received(since)
            assert page.lost == 0
            since = page.last
            joints.append(servo_targets(page.entries))
    arm.stop()
    until(arm.at_rest, "rest")
    sent = np.concatenate([*joints, servo_targets(mock.faults.received(since).entries)])
    assert len(sent) > number / 100
    assert np.isfinite(sent).all()
    check_path(arm, sent)
    record = arm._channel.states.latest()
    assert record is not None and record["rejected"] > 0 and record["shortened"] > 0
    assert not arm.status().is_fault
    assert mock.faults.state().program


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
        since = mock.faults.received().last
        arm._channel.commands.write(
            command_record(time.monotonic(), CommandKind.TARGET, np.array([*far.position, *far.quaternion]))
        )
        until(lambda: arm.status() == ArmStatus.OUT_OF_REACH, "out of reach")
        time.sleep(0.5)
        assert mock.faults.state().program
        sent = servo_targets(mock.faults.received(since).entries)
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


def test_the_loop_counts_its_periods(arm: URArm, mock: MockUR) -> None:
    until(lambda: arm.timing().cycles > 1100, "cycles")
    timing = arm.timing()
    assert 0.5 * PERIOD < timing.median <= timing.p99 <= timing.longest
    assert timing.overruns >= 0
