"""The driver of an arm that is led to its start, on a mock controller."""

from __future__ import annotations

import time

import numpy as np
import pytest

from robot.arm.start_servo import distance_from_path
from robot.arm.status import ArmStatus
from robot.arm.trajectory import PERIOD
from robot.arm.tuning import JOINT_SPEED
from robot.arm.ur import URArm
from robot.errors import DeviceError, SafetyViolation
from robot.mock import MockUR
from robot.procedures.to_start import StartArm
from tacsim.models.hardware import UrArmConfig
from tacsim.models.limits import Workspace
from tests.robot.arm.mocked import config, moved, servo_targets
from tests.robot.waiting import until

TURN = np.array([0.06, 0.0, 0.0, 0.0, 0.0, 0.05])
ELSEWHERE = Workspace(lower=(1.0, 1.0, 1.0), upper=(1.1, 1.1, 1.1))


def away() -> UrArmConfig:
    """An arm that stands far outside its box."""
    return config(limits={"workspace": ELSEWHERE, "speed": 0.1})


@pytest.mark.slow
def test_an_arm_outside_its_box_goes_to_its_start_and_nowhere_else(mock: MockUR) -> None:
    with pytest.raises(SafetyViolation, match=r"outside its workspace.*`tacsim start FILE` moves it"):
        URArm(away(), "left")
    here, before = np.array(mock.faults.state().joints), mock.faults.received().last
    with StartArm(away(), "left", here, here + TURN) as arm:
        assert arm.status() == ArmStatus.HOLD
        with pytest.raises(DeviceError, match="follows no targets"):
            arm.command(moved(arm.state().pose, 1e-3))

        def there(share: float) -> bool:
            arm.continue_to(share)
            return arm.has_reached(share)

        until(lambda: there(0.5), "half of the way")
        assert np.allclose(mock.faults.state().joints, here + 0.5 * TURN, atol=4e-3)
        until(lambda: there(1.0), "the start")
    assert np.allclose(mock.faults.state().joints, here + TURN, atol=4e-3)
    sent = servo_targets(mock.faults.received(before).entries)
    assert len(sent) > 100 and np.abs(np.diff(sent, axis=0)).max() <= JOINT_SPEED * PERIOD
    assert max(distance_from_path(joints, here, here + TURN) for joints in sent) < 1e-5


def test_an_arm_that_stands_off_its_way_is_refused(mock: MockUR) -> None:
    here = np.array(mock.faults.state().joints) + [0.0, 0.1, 0.0, 0.0, 0.0, 0.0]
    with pytest.raises(SafetyViolation, match="left its path to the start"):
        StartArm(away(), "left", here, here + TURN)


@pytest.mark.slow
def test_a_sensor_that_is_far_off_is_zeroed_first(mock: MockUR) -> None:
    mock.faults.wrench([0.0, 0.0, 34.0, 0.0, 0.0, 0.0])
    with pytest.raises(SafetyViolation, match=r"`tacsim doctor --rig FILE` shows.*`tacsim start FILE` zeroes"):
        URArm(config(), "left")
    here = np.array(mock.faults.state().joints)
    with StartArm(away(), "left", here, here + TURN) as arm:
        assert arm.status() == ArmStatus.FORCE_LIMIT
        with pytest.raises(SafetyViolation):
            arm.continue_to(1.0)
        time.sleep(0.05)
        assert np.allclose(mock.faults.state().joints, here, atol=1e-6)
        arm.zero_wrench()
        arm.recover()
        assert arm.status() == ArmStatus.HOLD
        assert float(np.linalg.norm(arm.state().wrench[:3])) < 0.1
