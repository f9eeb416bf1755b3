"""An arm that is slowed, held or moved by others: limits of the arm itself, and what is reported. No sockets, no clock.

Judged is the mock's own arm: its servoj, its joints, its speed scaling. A falling scaling is the controller's own
braking, at speed x 5 /s; at the speeds here that is within the limits, unless a test says otherwise.
"""

from __future__ import annotations

import numpy as np
import pytest

from robot.arm.status import ArmStatus
from robot.arm.trajectory import PERIOD
from robot.common.kinematics import rotation
from robot.mock.ur.machine.motion import movej, speedj
from tacsim import pose as se3
from tacsim.interface import FloatArray, Pose
from tacsim.models.limits import ArmLimits, Workspace
from tests.robot.arm.servo_bench import OnController, shifted

WIDE = {"action_timeout": 60.0, "lower": [-1.0, -1.0, 0.0], "upper": [1.0, 1.0, 1.5]}
MARGIN = 1.05  # of a limit, for the arm itself: its joints have a dynamics of their own
STILL = 1e-3  # [m/s]


def run(arm: OnController, seconds: float, late: int = 1) -> None:
    for _ in range(round(seconds / PERIOD)):
        arm.period(late)


def moving(**changes: object) -> OnController:
    """At full speed, with some decimetres to go."""
    arm = OnController(**{**WIDE, **changes})
    arm.ask(shifted(arm.at, 0.0, 0.4))
    run(arm, arm.servo.config.speed / arm.servo.config.acceleration + 5.0 * arm.servo.config.lookahead)
    assert speeds(arm)[-1] > 0.98 * arm.servo.config.speed
    return arm


def speeds(arm: OnController, begin: int = 0) -> FloatArray:
    """(n,) of the sensor itself [m/s]."""
    return np.linalg.norm(np.array(arm.twists)[begin:, :3], axis=1)


def shares(arm: OnController, begin: int = 0) -> tuple[float, float]:
    """Largest speed and acceleration of the arm itself from period `begin` on, in parts of the limits."""
    change = np.linalg.norm(np.diff(np.array(arm.twists)[begin:, :3], axis=0), axis=1) / PERIOD
    config = arm.servo.config
    return float(speeds(arm, begin).max()) / config.speed, float(change.max()) / config.acceleration


def random_pose(random: np.random.Generator, start: Pose) -> Pose:
    turned = se3.from_matrix(np.block([[rotation(random.uniform(-0.3, 0.3, 3)), np.zeros((3, 1))], [0, 0, 0, 1]]))
    return se3.compose(shifted(start, *random.uniform(-0.15, 0.15, 3)), turned)


@pytest.mark.promise(2)
@pytest.mark.parametrize(
    ("speed", "low", "lookahead"),
    [(0.05, 0.0, 0.03), (0.1, 0.0, 0.03), (0.1, 0.1, 0.03), (0.1, 0.5, 0.03), (0.1, 0.0, 0.1)],
)
def test_servo_changed_slider_keeps_arm_limits(speed: float, low: float, lookahead: float) -> None:
    arm = moving(speed=speed, lookahead=lookahead)
    arm.slider = low
    run(arm, 0.6)
    assert speeds(arm)[-1] == pytest.approx(low * speed, rel=0.02, abs=1e-6)
    arm.slider = 1.0
    run(arm, 0.8)
    assert arm.servo.status == ArmStatus.OK
    assert speeds(arm)[-1] > 0.95 * speed
    assert max(shares(arm)) <= MARGIN


@pytest.mark.promise(2)
def test_servo_ignored_slider_breaks_arm_limits(monkeypatch: pytest.MonkeyPatch) -> None:
    """Guards the test above; and an arm that is slowed without a word does not follow."""
    arm = moving()
    monkeypatch.setattr(arm.servo, "on_speed_scaling", lambda reported: None)
    arm.slider = 0.0
    run(arm, 0.5)
    assert arm.servo.status == ArmStatus.NOT_FOLLOWING
    monkeypatch.setattr(arm.servo, "check_following", lambda *seen: None)
    blind = moving()
    monkeypatch.setattr(blind.servo, "on_speed_scaling", lambda reported: None)
    monkeypatch.setattr(blind.servo, "check_following", lambda *seen: None)
    blind.slider = 0.0
    run(blind, 0.5)
    blind.slider = 1.0
    run(blind, 0.3)
    assert shares(blind)[0] > 2.0 and shares(blind)[1] > 5.0


@pytest.mark.promise(2)
@pytest.mark.parametrize("low", [0.0, 0.1])
def test_servo_rising_slider_keeps_limits_of_fast_arm(low: float) -> None:
    """Its controller slows it down harder than its limit; what comes afterwards is judged."""
    arm = moving(speed=0.3)
    arm.slider = low
    run(arm, 1.0)
    begin = len(arm.twists)
    arm.slider = 1.0
    run(arm, 0.8)
    assert arm.servo.status == ArmStatus.OK and speeds(arm, begin).max() > 0.28
    assert max(shares(arm, begin)) <= MARGIN


@pytest.mark.slow
@pytest.mark.promise(2)
@pytest.mark.parametrize("seed", range(2))
def test_servo_random_slider_keeps_limits(seed: int) -> None:
    """Target and scaling rise together at the worst moments, and the margin of the acceleration is larger."""
    random = np.random.default_rng(seed)
    arm = OnController(**WIDE)
    start = arm.at
    for _ in range(15):
        arm.ask(random_pose(random, start))
        arm.slider = float(random.choice([0.0, 0.05, 0.3, 1.0]))
        run(arm, float(random.uniform(0.02, 0.5)))
    assert arm.servo.status == ArmStatus.OK
    speed, acceleration = shares(arm)
    assert speed <= MARGIN and acceleration <= 1.4


@pytest.mark.promise(2)
@pytest.mark.parametrize(
    ("speed", "acceleration", "lookahead"),
    [(0.02, 0.1, 0.03), (0.05, 0.5, 0.2), (0.1, 0.5, 0.03), (0.1, 10.0, 0.1), (1.0, 10.0, 0.03), (1.0, 2.0, 0.2)],
)
def test_servo_following_arm_has_no_fault(speed: float, acceleration: float, lookahead: float) -> None:
    random = np.random.default_rng(1)
    box = Workspace(lower=(0, 0, 0), upper=(1, 1, 1))
    limits = ArmLimits(workspace=box, speed=speed, acceleration=acceleration)
    errors = {"following_error": limits.max_following_error, "following_turn": limits.max_following_turn}
    arm = OnController(**{**WIDE, **errors}, speed=speed, acceleration=acceleration, lookahead=lookahead)
    start, largest = arm.at, 0.0
    for _ in range(15):
        arm.ask(random_pose(random, start))
        for _ in range(int(random.integers(5, 150))):
            arm.period(late=int(random.integers(0, 4)))
            largest = max(largest, arm.servo._following.error(arm.packages[-1].joints)[0])
        arm.stall(int(random.integers(0, 20)))
    assert largest <= 0.9 * limits.max_following_error
    assert not arm.servo.status.is_fault


@pytest.mark.promise(7)
@pytest.mark.parametrize("speed", [0.02, 0.1])
def test_servo_held_arm_is_not_following_and_stands_after_release(speed: float) -> None:
    arm = moving(speed=speed)
    arm.arm.held = True
    run(arm, 0.5 * arm.servo.config.lookahead + arm.servo.config.following_error / speed + 0.02)
    assert arm.servo.status == ArmStatus.NOT_FOLLOWING and arm.servo.is_at_rest
    assert arm.servo.motion is not None
    np.testing.assert_allclose(arm.servo.motion.position, arm.at.position, atol=1e-9)  # held where it is
    run(arm, 0.3)
    arm.arm.held, begin, here = False, len(arm.twists), arm.at.position
    arm.ask(shifted(arm.at, 0.0, -0.1))  # it is not heard
    run(arm, 0.3)
    assert speeds(arm, begin).max() < STILL
    assert np.linalg.norm(arm.at.position - here) < 10e-6


@pytest.mark.promise(7)
def test_servo_lagging_joint_is_not_following() -> None:
    arm = moving()
    arm.arm.servo_rates[0] = 2.0 / 0.2  # it trails by 0.2 s
    run(arm, 0.3)
    assert arm.servo.status == ArmStatus.NOT_FOLLOWING
    begin = len(arm.twists)
    run(arm, 1.0)
    assert speeds(arm)[-1] < STILL and speeds(arm, begin).max() <= MARGIN * arm.servo.config.speed


@pytest.mark.promise(7)
@pytest.mark.parametrize("acceleration", [0.2, 1.4])
def test_servo_other_program_at_rest_is_reported_within_20_ms(acceleration: float) -> None:
    arm = OnController(**WIDE)
    arm.ask(shifted(arm.at, 0.01))
    run(arm, 1.0)
    assert arm.servo.status == ArmStatus.OK and speeds(arm)[-1] < 1e-6
    begin = len(arm.twists)
    arm.foreign = movej(arm.arm, arm.arm.target_q + [0.2, 0, 0, 0, 0, 0], acceleration, 0.1)
    run(arm, 0.2)
    first = int(np.argmax(speeds(arm, begin) > STILL))
    reported = arm.statuses[-100:].index(ArmStatus.OTHER_PROGRAM)
    assert (reported - first) * PERIOD <= 20e-3


@pytest.mark.promise(7)
@pytest.mark.parametrize("joint", [1, 2])
def test_servo_other_program_in_motion_is_not_following(joint: int) -> None:
    """Without a sign of another program in motion; at rest of our own target it is distinguished from a held arm."""
    arm = moving()
    arm.foreign = speedj(arm.arm, 0.3 * np.eye(6)[joint], 4.0, 1.0)
    run(arm, 0.08)
    assert arm.servo.status == ArmStatus.NOT_FOLLOWING
    run(arm, 0.5)
    assert arm.servo.status == ArmStatus.OTHER_PROGRAM
