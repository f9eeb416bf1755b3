"""Random lives of a servo: commands good and bad, old packages, stalls, faults, other arms that come and go, pictures
that stop, a controller's clock that jumps. In all cases an arm that should stand still does not move."""

from __future__ import annotations

import math

import numpy as np
import pytest

from robot.arm.channel import CommandKind, Partner, make_command_record, make_tactile_record
from robot.arm.servo import Servo
from robot.arm.status import ArmStatus
from robot.arm.trajectory import PERIOD
from robot.common.tcp import Measured
from tests.robot.arm.servo_bench import OnController, other, shifted

OBSERVATION_TIMEOUT = 0.15
STANDING = (ArmStatus.HOLD, ArmStatus.WAITING, ArmStatus.OBSERVATION_STALE)
HARD = 1.01  # rounding


class Life:
    """One arm, what happens to it, and what it may do in each period."""

    def __init__(self, seed: int) -> None:
        self.random = np.random.default_rng(seed)
        self.config = {
            "action_timeout": float(self.random.choice([0.1, 1.0])),
            "observation_timeout": OBSERVATION_TIMEOUT,
            "depth": 1e-3,
            "speed": float(self.random.choice([0.02, 0.1, 0.25])),
            "partners": [Partner(-1, 0.05)] * int(self.random.integers(0, 2)),
        }
        self.arm = OnController(**self.config)
        self.start = self.arm.at
        self.reports, self.exposed = 0, math.nan
        self.asked = -math.inf  # of the newest target that may be followed
        self.fault: ArmStatus | None = None
        self.moved = 0  # periods in which the target moved
        self.seen: set[ArmStatus] = set()

    def chance(self, share: float) -> bool:
        return bool(self.random.random() < share)

    def period(self) -> None:
        random, arm = self.random, self.arm
        if arm.servo.config.partners:
            self._partner()
        if self.chance(5e-3):
            arm.stall(int(random.integers(1, 70)))
        if self.chance(2e-3):
            arm.jump += float(random.uniform(-5.0, 5.0))  # of the controller's clock
        arm.force = 40.0 if self.chance(2e-3) else 0.0
        known = arm.packages[-1 - min(len(arm.packages) - 1, int(random.integers(0, 4)))]
        servo, before = arm.servo, arm.servo.motion
        rested = servo.is_at_rest
        servo.check_faults(known, arm.partners)
        self._report(known)
        new = self._command()
        joints = servo.step(arm.time, known, arm.partners)
        self._judge(before, rested, new, joints)
        arm.run(joints)
        assert float(servo.region.excess(arm.packages[-1].sensor[:3, 3])) < 1e-3
        if servo.status.is_fault and self.chance(0.1):  # a person recovers it
            arm.servo = Servo(servo.config, commands_read=arm.number, tactile_read=self.reports)
            arm.joints, self.fault, self.asked, self.exposed = None, None, -math.inf, math.nan

    def _partner(self) -> None:
        if not self.arm.partners or self.chance(0.02):
            away = list(self.arm.at.position + self.random.uniform(-1.0, 1.0, 3) * 0.3)
            kinds = [ArmStatus.OK] * 12 + [ArmStatus.PROTECTIVE_STOP, ArmStatus.CONNECTING, None]
            kind = kinds[int(self.random.integers(len(kinds)))]
            self.arm.partners = [None if kind is None else other(away, status=kind)]

    def _report(self, known: Measured) -> None:
        if self.chance(0.03):
            self.reports += 1
            self.exposed = math.nan if self.chance(0.2) else self.arm.time - float(self.random.uniform(0.0, 0.1))
            depth = 2e-3 if self.chance(0.005) else 0.0
            self.arm.servo.on_tactile(self.reports, make_tactile_record(self.exposed, depth, 0.0))

    def _command(self) -> bool:
        """True for a target that may be followed, were it not for the arm's status."""
        random, arm, servo = self.random, self.arm, self.arm.servo
        if not self.chance(0.1):
            return False
        arm.number += 1
        kind = random.choice([CommandKind.TARGET] * 12 + [CommandKind.HOLD, CommandKind.ZERO_WRENCH])
        target = shifted(self.start, *random.uniform(-0.3, 0.3, 3))
        pose = np.array([*target.position, *target.quaternion])
        if spoilt := self.chance(0.05):
            pose[random.integers(7)] = random.choice([math.nan, math.inf, 1e300])
        speed = float(random.choice([math.inf, 0.05, 1e-3, 0.0, -1.0, math.nan], p=[0.75, 0.1, 0.06, 0.03, 0.03, 0.03]))
        age = float(random.choice([0.0, 0.05, 0.09, 0.11, 5.0], p=[0.8, 0.05, 0.05, 0.05, 0.05]))
        arm.servo.on_command(arm.number, make_command_record(arm.time - age, CommandKind(int(kind)), pose, speed))
        stands = arm.servo.status.is_fault or arm.servo.status == ArmStatus.WAITING
        if kind != CommandKind.TARGET or spoilt or not speed > 0.0:
            self.asked = -math.inf
        elif not stands:
            self.asked = arm.time - age
            return age <= servo.config.action_timeout
        return False

    def _judge(self, before: object, rested: bool, new: bool, joints: np.ndarray | None) -> None:
        arm, servo = self.arm, self.arm.servo
        then = before if before is not None else None
        now, config, status = servo.motion, servo.config, servo.status
        self.seen.add(status)
        speed_then = 0.0 if then is None else float(np.linalg.norm(then.velocity))  # type: ignore[attr-defined]
        speed = 0.0 if now is None else float(np.linalg.norm(now.velocity))
        self.moved += speed > 0.0
        # The first cause is kept; a fault is no place to speed up in.
        tripped = status.is_fault and self.fault is None
        if status.is_fault:
            assert tripped or status == self.fault
            assert rested is False or speed == 0.0
            assert speed <= (max(speed_then, 1.1 * config.speed) if tripped else speed_then)
            self.fault = status
            return
        assert self.fault is None
        # Old targets, and targets without an observation, are not followed.
        blind = arm.time - self.exposed > OBSERVATION_TIMEOUT
        if blind or status == ArmStatus.WAITING:
            self.asked = -math.inf
        if arm.time - self.asked > config.action_timeout + 1e-9:
            assert (
                speed <= max(0.0, speed_then - 0.9 * config.acceleration * PERIOD)
                or speed == speed_then == 0.0
                or (joints is arm.joints)
            )
            if rested:
                assert joints is arm.joints
        # Within its limits, or slowed down by a stall.
        if then is not None and now is not None:
            velocity = then.velocity  # type: ignore[attr-defined]
            share = 1.0 if speed_then == 0.0 else float(np.clip(now.velocity @ velocity / speed_then**2, 0.0, 1.0))
            assert np.linalg.norm(now.velocity - share * velocity) <= HARD * config.acceleration * PERIOD
        assert speed <= HARD * config.speed
        if now is not None:
            assert float(servo.region.excess(now.position)) <= 1e-8


@pytest.mark.slow
@pytest.mark.promise(1, 2, 5)
@pytest.mark.parametrize("seed", [*range(3), *(pytest.param(seed, marks=pytest.mark.deep) for seed in range(3, 20))])
def test_servo_random_events_keep_stopped_arm_at_rest(seed: int) -> None:
    life = Life(seed)
    for _ in range(2000):
        life.period()
    assert life.moved > 30
    assert {ArmStatus.OK, ArmStatus.HOLD} <= life.seen
