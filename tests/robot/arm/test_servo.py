"""The judgement of one period, without sockets and clocks: an arm that follows its joints with a lag."""

from __future__ import annotations

import dataclasses
import json
import math

import numpy as np
import pytest

from robot.arm.channel import STATE, ArmStatus, CommandKind, Partner, WorkerConfig, command_record, tactile_record
from robot.arm.servo import HARD, STEEPEST, Servo
from robot.arm.shared_ring import Record
from robot.arm.trajectory import PERIOD
from robot.common.kinematics import Kinematics, pose, rotation
from robot.common.tcp import pose_of
from tacsim.interface import FloatArray, Pose
from tacsim.limits import region

HOME = np.array([0.0, -math.pi / 2, math.pi / 2, -math.pi / 2, -math.pi / 2, 0.0])
KINEMATICS = Kinematics("ur5e")
EYE = np.eye(4).tolist()


def worker_config(**changes: object) -> WorkerConfig:
    sensor = np.eye(4)
    sensor[:3, :3], sensor[:3, 3] = rotation([0.0, 0.0, 0.4]), [0.0, 0.01, 0.05]
    plain: dict[str, object] = {
        "name": "left",
        "host": "127.0.0.2",
        "model": "ur5e",
        "refused_serial": None,
        "realtime": False,
        "parent": 1,
        "segment": "none",
        "world_from_base": EYE,
        "flange_from_tool": EYE,
        "tool_from_sensor": sensor.tolist(),
        "tcp": [0.0] * 6,
        "mass": 0.0,
        "mass_centre": [0.0] * 3,
        "lower": [-0.6, -0.3, 0.3],
        "upper": [-0.3, 0.1, 0.6],
        "planes": [],
        "speed": 0.1,
        "turn_rate": 0.5,
        "acceleration": 0.5,
        "turn_acceleration": 5.0,
        "joint_speed": 1.0,
        "force": 30.0,
        "torque": 3.0,
        "depth": None,
        "shear": None,
        "link_timeout": 0.05,
        "action_timeout": 0.2,
        "observation_timeout": 0.5,
        "watchdog": 10.0,
        "lookahead": 0.03,
        "gain": 600.0,
        "partners": [],
    }
    return WorkerConfig(**{**plain, **changes})  # type: ignore[arg-type]


class Bench:
    """A servo and an arm whose joints make up a part of their error in each period."""

    def __init__(self, calibration: FloatArray | None = None, **changes: object) -> None:
        self.servo = Servo(worker_config(**changes))
        self.q, self.time, self.number = HOME.copy(), 0.0, 0
        self.calibration = np.eye(4) if calibration is None else calibration  # the true flange, seen from the nominal
        self.record: Record = np.zeros((), STATE)
        self.partners: list[Record | None] = [None] * len(self.servo.config.partners)
        self.sent: list[FloatArray] = []
        self.look()

    def look(self, force: tuple[float, ...] = (0.0,) * 6) -> None:
        before = self.record["tcp_pose"].copy()
        self.record["joints"] = self.q
        self.record["tcp_pose"] = pose(KINEMATICS.forward(self.q) @ self.calibration)
        if before.any():
            self.record["tcp_speed"][:3] = (self.record["tcp_pose"][:3] - before[:3]) / PERIOD
        self.record["tcp_force"] = force
        self.now = self.servo.frames.measure(self.record)

    @property
    def at(self) -> Pose:
        return pose_of(self.now.sensor)

    def ask(self, target: Pose | np.ndarray, kind: CommandKind = CommandKind.TARGET) -> None:
        row = target if isinstance(target, np.ndarray) else np.array([*target.position, *target.quaternion])
        self.number += 1
        self.servo.on_command(self.number, command_record(self.time, kind, row))

    def run(self, periods: int, force: tuple[float, ...] = (0.0,) * 6) -> None:
        for _ in range(periods):
            self.time += PERIOD
            self.servo.check_faults(self.now, self.partners)
            joints = self.servo.step(self.time, self.now, self.partners)
            if joints is not None:
                self.sent.append(joints)
                self.q = self.q + 0.2 * (joints - self.q)
            self.look(force)

    def path(self) -> FloatArray:
        """(n, 3) origins of the sensor at the joints that were sent."""
        frames = [KINEMATICS.forward(q) @ self.calibration @ self.servo.frames.tool_from_sensor for q in self.sent]
        return np.array([frame[:3, 3] for frame in frames])


def shifted(start: Pose, x: float, y: float = 0.0, z: float = 0.0) -> Pose:
    return Pose(start.position + [x, y, z], start.quaternion)


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


def test_a_turn_at_full_speed_close_to_a_wall_does_not_bulge_out() -> None:
    """Each target lies inside; the way between them would not, if the old speed were not braked first."""
    bench = Bench(action_timeout=60.0, speed=0.2)
    start = bench.at
    floor = float(start.position[2]) - 0.1
    bench.servo.region = region([-1.0, -1.0, floor], [1.0, 1.0, 1.0])
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
    assert after.min() >= here - 0.12**2 / (2 * HARD) - 1e-6
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


def other(position: list[float], stop: list[float] | None = None, status: ArmStatus = ArmStatus.OK) -> Record:
    record = np.zeros((), STATE)
    record["position"], record["stopping_point"] = position, stop or position
    record["status"], record["top_speed"] = status, 0.1
    return record


@pytest.mark.promise(15)
def test_another_arm_is_not_come_near_and_parting_is_free() -> None:
    bench = Bench(action_timeout=60.0, partners=[Partner("none", 0.05)])
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
    bench = Bench(action_timeout=60.0, partners=[Partner("none", 0.05)])
    start = bench.at
    bench.partners = [other(list(start.position + [0.2, 0, 0]), list(start.position + [0.08, 0, 0]))]
    bench.ask(shifted(start, 0.1))
    bench.run(1000)
    assert bench.at.position[0] <= start.position[0] + 0.03


@pytest.mark.parametrize("partner", [None, ArmStatus.PROTECTIVE_STOP, ArmStatus.CONNECTING])
def test_without_a_sound_partner_it_waits_and_a_moving_arm_stops(partner: ArmStatus | None) -> None:
    bench = Bench(action_timeout=60.0, partners=[Partner("none", 0.05)])
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


def test_a_worse_fault_replaces_a_lesser_one() -> None:
    bench = Bench()
    for status, kept in (
        (ArmStatus.FORCE_LIMIT, ArmStatus.FORCE_LIMIT),
        (ArmStatus.EMERGENCY_STOP, ArmStatus.EMERGENCY_STOP),
        (ArmStatus.PROTECTIVE_STOP, ArmStatus.EMERGENCY_STOP),
    ):
        bench.servo.trip(status, bench.now)
        assert bench.servo.status == kept


def test_a_worker_config_travels_as_json() -> None:
    given = worker_config(partners=[Partner("a", 0.1)], planes=[[[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]]])
    assert WorkerConfig.of(json.loads(json.dumps(dataclasses.asdict(given)))) == given


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
        bench.servo.on_tactile(1, tactile_record(bench.time, *shown), bench.now)
        here = bench.at.position[2]
        bench.run(100)
        assert (bench.servo.status == ArmStatus.GEL_LIMIT) == stops
        assert (bench.at.position[2] < here - 0.12**2 / (2 * HARD) - 1e-4) == (not stops)


def test_an_arm_is_not_called_well_before_it_was_looked_at() -> None:
    """What the first look finds is the first that anybody hears: the worker publishes `status` before it too."""
    for changes, found in (({}, ArmStatus.HOLD), ({"lower": [2.0] * 3, "upper": [3.0] * 3}, ArmStatus.WORKSPACE_LIMIT)):
        bench = Bench(**changes)
        assert bench.servo.status == ArmStatus.CONNECTING
        bench.servo.on_tactile(1, tactile_record(0.0, 0.0, 0.0), bench.now)
        assert bench.servo.status == ArmStatus.CONNECTING
        bench.servo.check_faults(bench.now, bench.partners)
        assert bench.servo.status == found


def test_what_was_shown_to_a_worker_before_is_not_held_against_this_one() -> None:
    servo = Servo(worker_config(depth=1e-3), tactile_read=7)
    bench = Bench()
    servo.on_tactile(7, tactile_record(0.0, 2e-3, 0.0), bench.now)
    assert not servo.status.is_fault
    servo.on_tactile(8, tactile_record(math.nan, 2e-3, 0.0), bench.now)  # nobody looks by now
    assert not servo.status.is_fault
    servo.on_tactile(9, tactile_record(0.0, 2e-3, 0.0), bench.now)
    assert servo.status == ArmStatus.GEL_LIMIT


def test_no_action_is_followed_on_an_old_observation() -> None:
    bench = Bench(action_timeout=60.0, observation_timeout=0.5)
    bench.ask(shifted(bench.at, 0.02))
    bench.run(20)
    bench.servo.on_tactile(1, tactile_record(bench.time, math.nan, math.nan), bench.now)
    bench.run(200)
    assert bench.servo.status == ArmStatus.OK
    bench.run(100)  # 0.6 s without another picture
    assert bench.servo.status == ArmStatus.OBSERVATION_STALE
    bench.run(200)
    held = bench.at.position.copy()
    bench.ask(shifted(bench.at, 0.02))
    bench.run(100)
    assert np.abs(bench.at.position - held).max() < 1e-5
    bench.servo.on_tactile(
        2, tactile_record(bench.time, math.nan, math.nan), bench.now
    )  # it sees again, and goes on by itself
    bench.run(100)
    assert bench.servo.status == ArmStatus.OK
    assert bench.at.position[0] - held[0] > 5e-3


def test_a_singular_value_changes_no_faster_than_the_servo_relies_on() -> None:
    random = np.random.default_rng(3)
    for _ in range(300):
        q = random.uniform(-np.pi, np.pi, 6)
        turned = random.normal(0.0, 10.0 ** random.uniform(-3, 0), 6)
        change = abs(KINEMATICS.singularity(q + turned) - KINEMATICS.singularity(q))
        assert change <= STEEPEST * np.abs(turned).sum()
