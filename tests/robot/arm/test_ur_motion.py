"""The driver of a UR arm: its state in the right frames, and the limits of all that is sent."""

from __future__ import annotations

import time

import numpy as np
import pytest

from robot.arm.channel import HISTORY, STATE, CommandKind, make_command_record
from robot.arm.status import ArmStatus
from robot.arm.trajectory import PERIOD
from robot.arm.ur import URArm
from robot.common.kinematics import matrix
from robot.errors import (
    SafetyViolation,
)
from robot.mock import MockUR
from tacsim import pose as se3
from tacsim.interface import Pose
from tacsim.limits import ActionError
from tacsim.models.limits import ArmLimits, Plane, Workspace
from tests.promises import Record
from tests.robot.arm.mocked import (
    KINEMATICS,
    START,
    TOOL_FROM_SENSOR,
    check_path,
    config,
    go,
    leftovers,
    moved,
    of_limits,
    outside,
    records,
    restarts,
    servo_targets,
    servo_ticks,
)
from tests.robot.waiting import until

LOOKS = 100_000


# -- one package, the right frames -----------------------------------------------------------------------------------


def test_state_pose_is_sensor_in_world(arm: URArm, mock: MockUR) -> None:
    there = mock.faults.state()
    expected = se3.compose(
        arm.config.world_from_base.pose, se3.compose(se3.from_matrix(matrix(there.pose)), TOOL_FROM_SENSOR.pose)
    )
    state = arm.state()
    assert max(se3.pose_distance(state.pose, expected)) < 1e-9
    assert state.joints is not None and np.allclose(state.joints, there.joints)
    assert there.payload == pytest.approx(0.4)
    assert there.watchdog
    go(arm, moved(state.pose, z=-0.01))
    assert arm.state().pose.position[2] == pytest.approx(state.pose.position[2] - 0.01, abs=60e-6)


def test_state_wrench_is_load_on_sensor(arm: URArm, mock: MockUR) -> None:
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


def test_state_twist_is_rate_of_pose(arm: URArm) -> None:
    start = arm.state().pose
    turned = se3.compose(moved(start, x=0.05), se3.from_rotation_vector([0, 0, 0], [0.2, 0.0, 0.3]))
    go(arm, turned)
    states = arm.history()
    speed_ratios = []
    turning = 0
    for a, b, c in zip(states, states[1:], states[2:], strict=False):
        if 0.0 < c.time - a.time < 0.1 and float(np.linalg.norm(b.twist[:3])) > 0.02:
            path = se3.pose_difference(a.pose, c.pose)
            assert path[:3] @ b.twist[:3] > 0.9 * np.linalg.norm(path[:3]) * np.linalg.norm(b.twist[:3])
            if float(np.linalg.norm(b.twist[3:])) > 0.02:  # it turns already, or still
                assert path[3:] @ b.twist[3:] > 0.9 * np.linalg.norm(path[3:]) * np.linalg.norm(b.twist[3:])
                turning += 1
            speed_ratios.append(np.linalg.norm(path) / (c.time - a.time) / np.linalg.norm(b.twist))
    assert len(speed_ratios) > 5 and turning > 5
    # A late package spoils a ratio of its own: a controller that missed its period meets several targets in the next.
    assert 0.8 < np.median(speed_ratios) < 1.25


@pytest.mark.promise(10)
def test_state_fields_are_of_one_package(arm: URArm) -> None:
    """Forward kinematics of the joints is the pose, in motion, in every record the worker ever wrote."""
    start = arm.state().pose
    flange_from_tool = se3.to_matrix(arm.config.flange_from_tool.pose)
    torn = seen = 0
    last = 0.0
    for k in range(12):
        arm.command(moved(start, x=0.03 * (-1) ** k, z=0.02 * (-1) ** (k // 2)))
        time.sleep(0.1)
        for record in arm._package_records(HISTORY):
            if record["time"] > last:
                last = float(record["time"])
                seen += 1
                expected = KINEMATICS.forward(record["joints"], flange_from_tool)
                torn += float(np.abs(expected - matrix(record["tcp_pose"])).max()) > 1e-9
    assert seen > 100
    assert torn == 0


@pytest.mark.deep
@pytest.mark.promise(10, 13)
@pytest.mark.timeout(600)
def test_state_100000_reads_have_no_torn_record(arm: URArm, figure: Record) -> None:
    """Repeated reads in motion, as by a policy: each result is of one package."""
    start, states = arm.state().pose, arm._channel.states
    seen, times = np.zeros(0, STATE), np.zeros(0)
    while len(seen) < LOOKS or len(np.unique(seen["stamp"])) <= 100:  # a fast machine looks more often at each package
        arm.command(moved(start, x=0.1 * (1 - len(seen) // (LOOKS // 4) % 2)))  # a new target, so that it never rests
        records, took = np.zeros(LOOKS // 4, STATE), np.zeros(LOOKS // 4)
        for look in range(len(records)):
            begun = time.perf_counter_ns()
            record = states.latest()
            took[look] = time.perf_counter_ns() - begun
            records[look] = record
        seen, times = np.concatenate((seen, records)), np.concatenate((times, took))
    _, first, of = np.unique(seen["stamp"], return_index=True, return_inverse=True)
    flange_from_tool = se3.to_matrix(arm.config.flange_from_tool.pose)
    apart = [
        np.abs(KINEMATICS.forward(record["joints"], flange_from_tool) - matrix(record["tcp_pose"])).max()
        for record in seen[first]
    ]
    torn = ~(np.array(apart) <= 1e-9)[of]
    for field in ("joints", "joint_speeds", "tcp_pose", "tcp_speed", "tcp_force", "position"):
        torn |= (seen[field] != seen[field][first][of]).any(axis=1)  # against another look at the same package
    figure("torn records in 100,000 looks", torn.sum())
    figure("one look at the state", np.median(times) / 1e3, "µs", at_most=5, promise=13)
    assert not torn.any()


# -- limits on the wire ----------------------------------------------------------------------------------------------


SLOPED = {"planes": (Plane(point=tuple(START - [0.0, 0.0, 0.05]), normal=(0.3, 0.0, 1.0)),)}


def hostile(number: int, bad: float, run: int) -> np.ndarray:
    """(number, 7) targets up to 0.4 m away; a share `bad` of them with a number that is NaN, infinite or huge. `run` of
    them in a row lie in one place, so that an arm gets there."""
    rng = np.random.default_rng(5)
    rows = np.empty((number, 7))
    rows[:, :3] = (START + rng.uniform(-0.4, 0.4, (-(-number // run), 3))).repeat(run, axis=0)[:number]
    turns = rng.normal(size=(number, 4)) * (1.0 if run == 1 else 0.1) + [1.0, 0.0, 0.0, 0.0]
    rows[:, 3:] = turns / np.linalg.norm(turns, axis=1, keepdims=True)
    spoilt = np.flatnonzero(rng.random(number) < bad)
    rows[spoilt, rng.integers(0, 7, len(spoilt))] = rng.choice([np.nan, np.inf, -np.inf, 1e308, -1e9, 5.0], len(spoilt))
    return rows


def test_hostile_targets_leave_limits_without_guard() -> None:
    rows = hostile(10_000, 0.4, 1)
    assert 0.15 < (~np.isfinite(rows).all(axis=1)).mean() < 0.35
    assert (config().limits.region.excess(np.nan_to_num(rows[:, :3])) > 0).mean() > 0.5
    assert len(np.unique(hostile(1_000, 0.0, 100)[:, :3], axis=0)) == 10


def send_hostile(arm: URArm, mock: MockUR, targets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Joints (n, 6) that the controller was really sent, and the control periods (n,) in which they arrived. The first
    row is where the arm rested before: the first target is already one period of motion away from it."""
    since, rest = mock.faults.received().last, mock.faults.state()
    joints, ticks = [np.array([rest.joints])], [np.array([rest.tick])]
    for k, target in enumerate(targets):
        # Past the guards of the driver: the worker must stand alone.
        arm._channel.commands.write(make_command_record(time.monotonic(), CommandKind.TARGET, target))
        time.sleep(0.0005)
        if k % 2000 == 1999:
            page = mock.faults.received(since)
            assert page.lost == 0
            since = page.last
            joints.append(servo_targets(page.entries))
            ticks.append(servo_ticks(page.entries))
    arm.stop()
    until(arm.at_rest, "rest")
    last = mock.faults.received(since).entries
    sent = np.concatenate([*joints, servo_targets(last)])
    record = arm._channel.states.latest()
    assert record is not None and record["rejected"] > 0 and record["clipped"] > 0
    assert len(sent) > len(targets) / 100
    assert np.isfinite(sent).all()
    assert not arm.status().is_fault
    assert mock.faults.state().program
    return sent, np.concatenate([*ticks, servo_ticks(last)])


@pytest.mark.slow
@pytest.mark.promise(1, 2)
def test_command_hostile_targets_keep_limits(mock: MockUR, measuring: bool, figure: Record) -> None:
    given = config(realtime=measuring, limits={**SLOPED, "speed": 0.5, "acceleration": 5.0})
    with URArm(given, "left") as arm:
        sent, ticks = send_hostile(arm, mock, hostile(5_000, 0.02, 500) if measuring else hostile(1_000, 0.2, 200))
        share = of_limits(arm, sent)
        figure("of 5,000 hostile actions over the wire, received targets outside", outside(arm, sent))
        figure("fastest received target, of the limit", 100 * share["speed"], "%", at_most=101, promise=2)
        figure("largest acceleration received, of the limit", 100 * share["acceleration"], "%", at_most=101, promise=2)
        figure("largest joint step received, of the limit", 100 * share["joint step"], "%", at_most=100.1, promise=2)
        check_path(arm, sent)
        assert restarts(arm, sent, ticks) <= arm.timing().overruns


@pytest.mark.deep
@pytest.mark.timeout(900)
def test_command_100000_hostile_targets_keep_limits(mock: MockUR) -> None:
    with URArm(config(limits={**SLOPED, "speed": 0.5, "acceleration": 5.0}), "left") as arm:
        sent, ticks = send_hostile(arm, mock, hostile(100_000, 0.4, 1))
        check_path(arm, sent)
        assert restarts(arm, sent, ticks) <= arm.timing().overruns


@pytest.mark.slow
@pytest.mark.promise(1)
def test_command_hostile_targets_keep_measured_arm_inside(mock: MockUR, measuring: bool, figure: Record) -> None:
    given = config(realtime=measuring, limits={"speed": 1.0, "acceleration": 10.0, "joint_speed": 3.0})
    with URArm(given, "left") as arm:
        start, rng = arm.state().pose, np.random.default_rng(1)
        for pause in (0.3, 0.3, 0.3, *[0.03] * 20):
            arm.command(moved(start, *rng.uniform(-0.5, 0.5, 3)))
            time.sleep(pause)
        beyond = float(given.limits.region.excess(records(arm)["position"][1:]).max())
        figure("measured tool beyond the box, at 1 m/s", 1e3 * max(0.0, beyond), "mm", at_most=1)
        assert beyond <= 1e-3
        assert not arm.status().is_fault


@pytest.mark.slow
def test_command_clipped_target_is_returned(arm: URArm) -> None:
    start = arm.state().pose
    beyond = moved(start, z=-1.0)
    sent = arm.command(beyond)
    assert sent is not None and sent is not beyond
    assert sent.position[2] == pytest.approx(arm.config.limits.workspace.lower[2])
    until(lambda: arm.arrived(sent), "the floor")
    inside = moved(start, z=0.01)
    assert arm.command(inside) is inside
    assert arm.command(None) is None


@pytest.mark.promise(2)
def test_command_invalid_target_raises(arm: URArm) -> None:
    for bad in ("up", 3, [0.0] * 7, np.zeros(7)):
        with pytest.raises(ActionError):
            arm.command(bad)  # type: ignore[arg-type]
    with pytest.raises(ActionError, match="more than 1000 m"):
        arm.command(Pose(np.array([0.0, 0.0, 1e5])))
    assert arm.status() == ArmStatus.HOLD


@pytest.mark.slow
def test_command_target_out_of_reach_raises_and_program_runs(mock: MockUR) -> None:
    wide = {"workspace": Workspace(lower=(-3.0, -3.0, -1.0), upper=(3.0, 3.0, 3.0))}
    with URArm(config(limits=wide), "left") as arm:
        with pytest.raises(ActionError, match="out of reach"):
            arm.command(moved(arm.state().pose, z=2.0))
        # Without the driver's check: the worker stops at limits of joints and joint speed and at singularities.
        far = moved(arm.state().pose, z=2.0)
        since = mock.faults.received().last
        arm._channel.commands.write(
            make_command_record(time.monotonic(), CommandKind.TARGET, np.array([*far.position, *far.quaternion]))
        )
        until(lambda: arm.status() == ArmStatus.OUT_OF_REACH, "out of reach")
        time.sleep(0.5)
        assert mock.faults.state().program
        sent = servo_targets(mock.faults.received(since).entries)
        assert np.abs(np.diff(sent, axis=0)).max() <= arm.config.limits.joint_speed * PERIOD * (1 + 1e-9)
        arm.stop()
        until(lambda: arm.status() == ArmStatus.HOLD and arm.at_rest(), "rest")
        go(arm, moved(arm.state().pose, z=-0.02))  # no rotation, which may be impossible near a singularity


@pytest.mark.promise(1)
def test_limits_without_workspace_are_refused() -> None:
    with pytest.raises(ValueError, match="workspace"):
        ArmLimits()  # type: ignore[call-arg]


@pytest.mark.slow
@pytest.mark.promise(1)
def test_connect_outside_workspace_raises(mock: MockUR) -> None:
    elsewhere = {"workspace": Workspace(lower=(2.0, 2.0, 2.0), upper=(3.0, 3.0, 3.0))}
    with pytest.raises(SafetyViolation, match=r"outside its workspace.*mm beyond the workspace's lower"):
        URArm(config(limits=elsewhere), "left").close()
    assert leftovers() == 0


@pytest.mark.promise(13)
def test_timing_counts_periods(arm: URArm, mock: MockUR) -> None:
    until(lambda: arm.timing().cycles > 600, "cycles")
    timing = arm.timing()
    assert 0.5 * PERIOD < timing.median <= timing.p99 <= timing.max_period
    assert timing.overruns >= 0
