"""What the arm itself does when its worker misses periods: suspended, paged out, late. No sockets and no clock.

While no target comes, the controller lets the arm run out towards the last one by its own law, with a deceleration of
speed / lookahead; that part is not ours. From the first new target on, speed and acceleration of the arm are within the
limits again, which is what is judged here: at the arm, not at the targets.
"""

from __future__ import annotations

import numpy as np
import pytest

from robot.arm.channel import Partner
from robot.arm.status import ArmStatus
from robot.arm.trajectory import PERIOD
from robot.arm.tuning import MAX_STALL_PERIODS
from robot.arm.worker import MAX_MISSED_PACKAGES
from robot.common.kinematics import rotation
from tacsim import pose as se3
from tests.robot.arm.servo_bench import OnController, shifted

SETTLING = 5  # periods in which the joints of the mock follow a change of their target


STALLS = (1, 3, 10, 20, 45)  # periods: 90 ms are just below the controller's watchdog


def moving(**changes: object) -> OnController:
    """At full speed, with some decimetres to go."""
    arm = OnController(action_timeout=60.0, lower=[-1.0, -1.0, 0.0], upper=[1.0, 1.0, 1.5], **changes)
    arm.ask(shifted(arm.at, 0.0, 0.4))
    at_full_speed(arm)
    return arm


def at_full_speed(arm: OnController, late: int = 1) -> None:
    config = arm.servo.config
    for _ in range(int((config.speed / config.acceleration + 5.0 * config.lookahead) / PERIOD)):
        arm.period(late)
    assert np.linalg.norm(arm.twists[-1][:3]) > 0.99 * config.speed


def ours(arm: OnController) -> np.ndarray:
    """(n,) True for the periods whose change of the arm's speed is judged: targets came in all that it answers to."""
    new = np.array(arm.ours) | np.array([not twist.any() for twist in arm.twists])
    counted = np.array([new[max(0, k - SETTLING) : k + 1].all() for k in range(len(new))])
    return counted[1:]


def shares(arm: OnController) -> tuple[float, float]:
    """Largest speed and acceleration of the arm itself, in parts of the limits."""
    twists, config = np.array(arm.twists), arm.servo.config
    speed = max(
        np.linalg.norm(twists[:, :3], axis=1).max() / config.speed,
        np.linalg.norm(twists[:, 3:], axis=1).max() / config.turn_rate,
    )
    change = np.diff(twists, axis=0)[ours(arm)] / PERIOD
    acceleration = max(
        np.linalg.norm(change[:, :3], axis=1).max() / config.acceleration,
        np.linalg.norm(change[:, 3:], axis=1).max() / config.turn_acceleration,
    )
    return float(speed), float(acceleration)


@pytest.mark.promise(2)
@pytest.mark.parametrize(
    ("speed", "acceleration", "lookahead", "late"),
    [(0.1, 0.5, 0.03, 1), (0.1, 0.5, 0.03, 3), (0.02, 0.2, 0.03, 0), (0.1, 1.0, 0.1, 1)],
)
def test_servo_after_stall_keeps_limits(speed: float, acceleration: float, lookahead: float, late: int) -> None:
    arm = moving(speed=speed, acceleration=acceleration, lookahead=lookahead)
    for stall, backlog in zip(STALLS, (0, 1, 2, 3, 3), strict=True):
        arm.stall(stall)
        for old in range(backlog):  # packages from before the stall come first
            arm.period(late=stall + old + late)
        at_full_speed(arm, late)  # it continues
    assert shares(arm)[0] <= 1.01
    assert shares(arm)[1] <= 1.03


def test_servo_after_stall_without_restart_breaks_limits(monkeypatch: pytest.MonkeyPatch) -> None:
    """Guards the test above."""
    arm = moving()
    monkeypatch.setattr(arm.servo, "_is_waiting_for_package", lambda time, measured: False)
    arm.stall(40)
    for _ in range(50):
        arm.period()
    assert shares(arm)[1] > 3.0


def test_servo_stall_without_package_restarts_from_rest() -> None:
    """The controller's clock has jumped back in between: no package seems to be newer than the stall."""
    arm = moving()
    arm.jump = -100 * PERIOD
    arm.stall(20)
    target = arm.joints
    for _ in range(MAX_STALL_PERIODS - 1):
        arm.period()
        assert arm.joints is target
    for _ in range(500):
        arm.period()
    assert np.linalg.norm(arm.twists[-1][:3]) > 0.99 * arm.servo.config.speed
    assert shares(arm)[1] <= 1.03


def way_after_a_fault(speed: float, stalls: tuple[int, ...] = ()) -> tuple[float, float]:
    """How far the arm goes after a fault at `speed` [m/s], and its top speed once it has been braked [m/s]."""
    arm = moving(speed=speed, acceleration=3.0)
    begun, count = arm.at.position, len(arm.twists)
    arm.servo.enter_fault(ArmStatus.FORCE_LIMIT)
    arm.period(late=0)  # it begins to brake
    for length in stalls:
        arm.stall(length)
        arm.period()
    for _ in range(150):
        arm.period()
    assert arm.servo.is_at_rest
    assert np.linalg.norm(arm.twists[-1][:3]) < 1e-4
    gone = max(float(np.linalg.norm(package.sensor[:3, 3] - begun)) for package in arm.packages[count:])
    return gone, float(np.linalg.norm(np.array(arm.twists)[count + 15 :, :3], axis=1).max())


@pytest.mark.promise(3)
@pytest.mark.parametrize("speed", [0.05, 0.1, 0.3])
def test_servo_fault_does_not_pull_arm_on(speed: float) -> None:
    """A target that brakes far ahead of an arm that stands already would make it move again; so would one that went on
    at its old speed after a stall."""
    way, later = way_after_a_fault(speed)
    assert way <= speed * 12e-3
    assert later <= 0.15 * speed
    for stalls in ((1, 2, 5), (4,), (40,)):
        stalled, later = way_after_a_fault(speed, stalls)
        assert stalled <= 1.02 * way
        assert later <= 0.25 * speed


def way_back(arm: OnController, silent: int, fault: int, backlog: int = 0) -> float:
    """How far the arm goes back [m] when no package comes for `silent` periods, but `backlog` old ones when it is over,
    and in period number `fault` the other arm stops."""
    old, begin = arm.packages[-2], len(arm.packages)
    for k in range(silent + backlog):
        if k == fault:
            arm.partners = [None]
        arm.servo.check_faults(old, arm.partners)
        loop_goes_on = k < MAX_MISSED_PACKAGES or k >= silent
        arm.run(arm.servo.step(arm.time, old, arm.partners) if loop_goes_on else None)
    arm.partners = [None]
    for _ in range(300):
        arm.period()
    assert arm.servo.status == ArmStatus.PARTNER_STOPPED and arm.servo.is_at_rest
    along = np.array([package.sensor[1, 3] for package in arm.packages[begin:]])
    return float(along.max() - along[-1])


@pytest.mark.slow
@pytest.mark.promise(3)
@pytest.mark.parametrize(("speed", "lookahead"), [(0.1, 0.03), (0.1, 0.1), (0.3, 0.03)])
def test_servo_fault_on_old_package_does_not_pull_arm_back(speed: float, lookahead: float) -> None:
    """The arm has gone on since that package: to where it was then would lead back. (An arm that is stopped as hard as
    it can swings back a little, with fresh packages too.)"""
    changes = {"speed": speed, "lookahead": lookahead, "acceleration": 2.0, "partners": [Partner(-1, 0.05)]}
    usual = way_back(moving(**changes), 0, 0)
    for silent, fault, backlog in (
        (3, 2, 0),
        (20, 0, 0),
        (20, 4, 0),
        (20, 15, 0),
        (20, 20, 2),
        (45, 44, 0),
        (45, 45, 3),
    ):
        back = way_back(moving(**changes), silent, fault, backlog)
        assert back <= usual + 0.2e-3, (silent, fault, backlog)


def test_servo_fault_without_package_stands() -> None:
    """No package from after the missed periods comes at all."""
    arm = moving(partners=[Partner(-1, 0.05)])
    old = len(arm.packages) - 1
    assert way_back(arm, 20, 10, backlog=300) == 0.0
    assert arm.packages[-1].sensor[1, 3] > arm.packages[old].sensor[1, 3]


def test_servo_undo_last_step_restores_state() -> None:
    arm = moving()
    before = arm.servo.motion
    arm.servo.step(arm.time, arm.packages[-1], [])
    assert arm.servo.motion is not before
    arm.servo.undo_last_step()
    assert arm.servo.motion is before
    arm.stall(40)  # it was suspended in between
    for _ in range(300):
        arm.period()
    assert shares(arm)[1] <= 1.03


@pytest.mark.promise(1, 2)
@pytest.mark.parametrize("seed", range(3))
def test_servo_random_paths_and_stalls_keep_limits(seed: int) -> None:
    random = np.random.default_rng(seed)
    arm = OnController(action_timeout=60.0)
    start = arm.at
    for _ in range(16):
        turned = se3.from_matrix(np.block([[rotation(random.uniform(-0.3, 0.3, 3)), np.zeros((3, 1))], [0, 0, 0, 1]]))
        target = se3.compose(shifted(start, *random.uniform(-0.15, 0.15, 3)), turned)
        arm.ask(target)
        for _ in range(int(random.integers(5, 100))):
            arm.period(late=int(random.integers(0, 2)))
        arm.stall(int(random.integers(0, 46)))
    speed, acceleration = shares(arm)
    assert speed <= 1.02
    assert acceleration <= 1.05
    places = np.array([package.sensor[:3, 3] for package in arm.packages])
    assert arm.servo.region.excess(places).max() <= 1e-6


@pytest.mark.promise(5)
@pytest.mark.parametrize(("speed", "acceleration"), [(0.1, 0.5), (0.02, 0.2), (0.05, 0.5)])
def test_arm_after_last_action_stops_within_timeout_distance(speed: float, acceleration: float) -> None:
    """And a policy that keeps its control period, half of the time-out, is not slowed down by that."""
    arm = OnController(
        lower=[-1.0, -1.0, 0.0], upper=[1.0, 1.0, 1.5], speed=speed, acceleration=acceleration, action_timeout=0.2
    )
    start = arm.at
    for _ in range(8):
        arm.ask(shifted(start, 0.0, 0.5))
        for _ in range(50):
            arm.period()
    steady = np.linalg.norm(np.array(arm.twists)[-100:, :3], axis=1)
    assert steady.min() > 0.98 * speed
    arm.ask(shifted(start, 0.0, 0.5))
    begun = arm.at.position
    for _ in range(400):
        arm.period()
    gone = float(np.linalg.norm(arm.at.position - begun))
    lag = arm.servo.config.lookahead + SETTLING * PERIOD
    assert 0.8 * speed * 0.2 < gone <= speed * (0.2 + lag)
    assert arm.servo.status == ArmStatus.HOLD and shares(arm)[1] <= 1.03


@pytest.mark.promise(2)
@pytest.mark.parametrize("late", [0, 5, 20, 40])
def test_servo_package_before_short_motion_keeps_held_target(late: int) -> None:
    """Ten periods towards a goal, then a hold: the target has come to rest 1 mm on while the newest package shows the
    arm at rest where it began. The next goal begins at the target; a step back would be a speed of 0.5 m/s."""
    arm = OnController(action_timeout=60.0, speed=0.5, acceleration=5.0)
    start, targets = arm.at, []
    for _ in range(5):
        arm.ask(shifted(start, 0.0, 0.05))
        for period in range(25):
            if period == 10:
                arm.hold()
            arm.period(late)
            targets.append(arm.target)
    velocity = np.diff(targets, axis=0) / PERIOD
    assert np.abs(velocity).max() > 0.05
    assert np.linalg.norm(np.diff(velocity, axis=0), axis=1).max() <= 5.0 * PERIOD * (1 + 1e-6)
