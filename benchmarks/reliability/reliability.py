"""What is promised of arms and cameras, as figures: the true drivers against mock hardware, on the real wire.

The logic of the promises is tested with generous bounds (benchmarks.reliability.promises names the tests); here stands
how late, how far, how often. Seconds are what one repetition of the case took, the error is the figure itself. What
dies, ends and comes back is in benchmarks.reliability.survival.
"""

from __future__ import annotations

import time

import numpy as np

from benchmarks.harness.measure import Measurement
from benchmarks.harness.runner import Case
from benchmarks.reliability import peers, survival
from benchmarks.reliability.rehearsal import (
    KINEMATICS,
    SLOPE,
    START,
    STILL,
    TOOL,
    config,
    driven,
    host,
    hostile,
    mock_arm,
    moved,
    sensor_path,
    servo_targets,
    sound,
    under_way,
    until,
)
from benchmarks.reliability.repeated import COUNT, Disturbed, Figure, repeated
from robot.arm.channel import STATE, ArmStatus, CommandKind, command_record
from robot.arm.servo import HARD
from robot.arm.trajectory import PERIOD
from robot.common.kinematics import matrix
from robot.errors import ProtectiveStop, StaleObservationError
from tacsim import pose as se3
from tacsim.limits import ROUNDING, finite_targets, fractions_inside

GUARDED = 1_000_000  # hostile actions through the guard
WIRED = 5_000  # and over the wire
READS = 100_000


def box_guard(repeat: int) -> list[Measurement]:
    """A million random, infinite, huge and broken actions through the guard: is it a pose, how far may it go."""

    def once() -> dict[str, float]:
        rng = np.random.default_rng(5)
        inside = config(host(1), {"planes": (SLOPE,)}).limits.region
        rows = hostile(rng, GUARDED)
        ends = rows[finite_targets(rows), :3]
        begins = START + rng.uniform(-0.03, 0.03, ends.shape)
        allowed = begins + fractions_inside(begins, ends, inside)[:, None] * (ends - begins)
        return {"outside": float((~(inside.excess(allowed) <= ROUNDING)).sum())}

    return repeated(1, once, [Figure("outside", COUNT, f"box and sloped plane, {GUARDED:,} actions")])


def box_wire(repeat: int) -> list[Measurement]:
    """Five thousand hostile targets written past the driver: what the controller received, by forward kinematics."""

    def once() -> dict[str, float]:
        given = config(mock.host, {"planes": (SLOPE,), "speed": 0.5, "acceleration": 5.0})
        with driven(mock, given) as (arm, watcher):
            assert watcher.link is not None
            since = mock.faults.received().last
            for row in hostile(np.random.default_rng(7), WIRED, bad=0.02, run=500):
                watcher.link.commands.write(command_record(time.monotonic(), CommandKind.TARGET, row))
                time.sleep(5e-4)
            watcher.link.commands.write(command_record(time.monotonic(), CommandKind.HOLD))
            until(lambda: sound(arm) and arm.at_rest(), "rest")
            page = mock.faults.received(since)
        if page.lost:
            raise Disturbed(f"the mock forgot {page.lost} packages before they were looked at")
        _, joints = servo_targets(page.entries)
        path, limits = sensor_path(joints), given.limits
        speeds = np.diff(path, axis=0) / PERIOD
        accelerations = np.diff(speeds, axis=0) / PERIOD
        return {
            "outside": float((~(given.limits.region.excess(path) <= 1e-8)).sum()),
            "speed": 100 * float(np.linalg.norm(speeds, axis=1).max()) / limits.speed,
            "acceleration": 100 * float(np.linalg.norm(accelerations, axis=1).max()) / limits.acceleration,
            "joint step": 100 * float(np.abs(np.diff(joints, axis=0)).max()) / (limits.joint_speed * PERIOD),
        }

    with mock_arm() as mock:
        return repeated(
            1,
            once,
            [
                Figure("outside", COUNT, f"box and sloped plane, servo targets received during {WIRED:,} actions"),
                Figure("speed", "%", "limits.speed, fastest of the targets received"),
                Figure("acceleration", "%", "limits.acceleration, largest of the targets received"),
                Figure("joint step", "%", "limits.joint_speed times the period, largest of the targets received"),
            ],
        )


def box_measured(repeat: int) -> list[Measurement]:
    """Targets far outside, at the highest speed and acceleration that may be set: where the measured tool was."""

    def once() -> dict[str, float]:
        given = config(mock.host, {"speed": 1.0, "acceleration": 10.0, "joint_speed": 3.0})
        worst = 0.0
        with driven(mock, given) as (arm, watcher):
            start = arm.state().pose
            for _ in range(3):
                if not arm.status().is_fault:  # a stop at the wall is no breach of it
                    arm.command(moved(start, *rng.uniform(-0.5, 0.5, 3)))
                    time.sleep(0.3)
            worst = float(given.limits.region.excess(watcher.records()["position"][1:]).max())
        return {"beyond": 1e3 * max(worst, 0.0)}

    rng = np.random.default_rng(1)
    with mock_arm() as mock:
        return repeated(repeat, once, [Figure("beyond", "mm", "box of 0.3 m, measured tool at 1 m/s and 10 m/s²")])


def force(repeat: int) -> list[Measurement]:
    """An arm drives into a spring at 50 mm/s until the force limit."""
    stiffness, limit, speed = 2000.0, 20.0, 0.05

    def once() -> dict[str, float]:
        with driven(mock, config(mock.host, {"force": limit, "speed": speed})) as (arm, watcher):
            start, state = arm.state().pose, mock.faults.state()
            ahead = state.tick - round(state.time / PERIOD)  # the mock's count of periods, against its clock
            mock.faults.wall(state.pose[2] - 0.02, stiffness)
            since = mock.faults.received().last
            arm.command(moved(start, z=-0.1))
            until(lambda: arm.status() == ArmStatus.FORCE_LIMIT, "force limit")
            until(lambda: bool(np.linalg.norm(watcher.newest()["tcp_speed"][:3]) < STILL), "standstill")
            records = watcher.records()
            ticks, joints = servo_targets(mock.faults.received(since).entries)
        felt = np.linalg.norm(records["tcp_force"][:, :3], axis=1)
        first = records[felt > limit][0]
        told = records[records["status"] == ArmStatus.FORCE_LIMIT][0]
        slow = np.linalg.norm(records["tcp_speed"][:, :3], axis=1) < STILL
        rest = records[slow & (records["stamp"] >= first["stamp"])][0]
        late = ticks > round(float(first["stamp"]) / PERIOD) + ahead  # a period after that package was sent
        braking_way = float(np.sum(first["tcp_speed"][:3] ** 2)) / (2 * HARD)
        deepest = float(first["position"][2]) - braking_way - 1e-5
        return {
            "approach commands": float((sensor_path(joints[late])[:, 2] < deepest).sum()),
            "standstill": 1e3 * float(rest["stamp"] - first["stamp"]),
            "status published": 1e3 * float(told["written"] - first["time"]),
            "overshoot": max(0.0, float(felt.max()) - limit),
        }

    with mock_arm() as mock:
        package = "the first package beyond the limit"
        return repeated(
            repeat,
            once,
            [
                Figure("approach commands", COUNT, f"later than 2 ms after {package}, deeper than its braking way"),
                Figure("standstill", "ms", f"{package}, by the controller's clock"),
                Figure("status published", "ms", f"{package}, when the worker saw it"),
                Figure("overshoot", "N", "limits.force, largest force of any package"),
            ],
        )


def silent_link(repeat: int) -> list[Measurement]:
    """The controller sends no more packages while the arm is under way."""

    def once() -> dict[str, float]:
        with driven(mock, config(mock.host, link_timeout=0.05)) as (arm, watcher):
            under_way(arm, moved(arm.state().pose, x=0.12))
            mock.faults.silence(True)
            told = until(lambda: arm.status() == ArmStatus.LINK_LOST, "lost link", pause=2e-4)
            last = float(watcher.newest()["time"])
            try:
                arm.state()
                survived = False
            except StaleObservationError:
                survived = len(arm.history()) > 5
        return {"reported": 1e3 * (told - last), "lost answers": float(not survived)}

    with mock_arm() as mock:
        return repeated(
            repeat,
            once,
            [
                Figure("reported", "ms", "the last package; link_timeout 50 ms"),
                Figure("lost answers", COUNT, "an error that names the age, and the history, from a live process"),
            ],
        )


def late_policy(repeat: int) -> list[Measurement]:
    """A policy that says nothing more, and then goes on."""

    def once() -> dict[str, float]:
        with driven(mock, config(mock.host, action_timeout=0.2)) as (arm, watcher):
            far = moved(arm.state().pose, x=0.12)
            arm.command(far)
            asked = time.monotonic()
            time.sleep(0.1)
            until(lambda: arm.status() == ArmStatus.HOLD, "hold")
            records = watcher.records()
            holds = records[(records["status"] == ArmStatus.HOLD) & (records["written"] > asked + 0.1)]
            until(arm.at_rest, "rest")
            time.sleep(0.1)
            mark = mock.faults.received().last
            arm.command(far)
            until(lambda: sound(arm) and len(servo_targets(mock.faults.received(mark).entries)[0]) > 60, "new targets")
            _, joints = servo_targets(mock.faults.received(mark).entries)
        steps = np.linalg.norm(np.diff(sensor_path(joints), axis=0), axis=1)
        return {
            "hold": 1e3 * (float(holds[0]["written"]) - asked),
            "first step": 100 * float(steps[steps > 1e-9][0]) / (arm.config.limits.acceleration * PERIOD**2),
        }

    with mock_arm() as mock:
        return repeated(
            repeat,
            once,
            [
                Figure("hold", "ms", "the last action; action_timeout 200 ms"),
                Figure("first step", "%", "what limits.acceleration allows in one period, when it goes on"),
            ],
        )


def protective_stop(repeat: int) -> list[Measurement]:
    """A protective stop under way, commands that go on, a second of patience, recover()."""

    def once() -> dict[str, float]:
        with driven(mock) as (arm, _):
            start = arm.state().pose
            under_way(arm, moved(start, x=0.12))
            asked = time.monotonic()
            mock.faults.protective_stop()
            told = until(lambda: arm.status() == ArmStatus.PROTECTIVE_STOP, "protective stop", pause=2e-4)
            until(lambda: mock.faults.state().rests, "rest")
            before, mark = mock.faults.state(), mock.faults.received().last
            for _ in range(20):
                try:
                    arm.command(start)
                except ProtectiveStop:
                    time.sleep(0.01)
            arm.recover()
            time.sleep(0.1)
            after, (ticks, _) = mock.faults.state(), servo_targets(mock.faults.received(mark).entries)
        way = np.subtract(after.pose[:3], before.pose[:3])
        return {"status": 1e3 * (told - asked), "motion": 1e3 * float(np.linalg.norm(way)), "replayed": len(ticks)}

    with mock_arm() as mock:
        return repeated(
            repeat,
            once,
            [
                Figure("status", "ms", "the button"),
                Figure("motion", "mm", "the tool at rest, over 20 commands, recover() and 0.1 s"),
                Figure("replayed", COUNT, "servo targets received from the stop to 0.1 s after recover()"),
            ],
        )


def one_instant(repeat: int) -> list[Measurement]:
    """A hundred thousand looks at the records of an arm under way: is each of one package."""

    def once() -> dict[str, float]:
        with driven(mock) as (arm, watcher):
            start = arm.state().pose
            assert watcher.link is not None
            states, seen, times = watcher.link.states, np.zeros(READS, STATE), np.zeros(READS)
            for look in range(READS):
                if look % (READS // 4) == 0:  # a new way, so that it never rests
                    arm.command(moved(start, x=0.1 * (1 - look // (READS // 4) % 2)))
                begun = time.perf_counter_ns()
                record = states.latest()
                times[look] = time.perf_counter_ns() - begun
                seen[look] = record
        packages, first, of = np.unique(seen["stamp"], return_index=True, return_inverse=True)
        fields = ("joints", "joint_speeds", "tcp_pose", "tcp_speed", "tcp_force", "position")
        flange_from_tool = se3.to_matrix(TOOL.pose)
        apart = [
            np.abs(KINEMATICS.forward(record["joints"], flange_from_tool) - matrix(record["tcp_pose"])).max()
            for record in seen[first]
        ]
        torn = ~(np.array(apart) <= 1e-9)[of]
        for field in fields:
            torn |= (seen[field] != seen[field][first][of]).any(axis=1)
        if len(packages) < 100:
            raise Disturbed(f"only {len(packages)} packages were seen: too few to find a torn one")
        return {"torn": float(torn.sum()), "look": float(np.median(times)) / 1e3}

    with mock_arm() as mock:
        return repeated(
            1,
            once,
            [
                Figure("torn", COUNT, f"forward kinematics and other looks at the same package, {READS:,} looks"),
                Figure("look", "µs", "one look at the newest record, median"),
            ],
        )


_ARM = "mock, 500 Hz"
CASES = (
    Case("robot", "box_guard", "tacsim", "no device", box_guard),
    *(
        Case("robot", case.__name__, "tacsim", _ARM, case)
        for case in (
            box_wire,
            box_measured,
            force,
            silent_link,
            late_policy,
            survival.policy_death,
            survival.worker_death,
            protective_stop,
            peers.second_commander,
            peers.connecting,
            one_instant,
        )
    ),
    Case("robot", "camera", "tacsim", "mock, 30 Hz", survival.camera),
    Case("robot", "shutdown", "tacsim", _ARM, survival.shutdown),
    Case("robot", "rate", "tacsim", "two mocks, 500 Hz", peers.rate),
    Case("robot", "keep_out", "tacsim", "two mocks, 500 Hz", peers.keep_out),
)
