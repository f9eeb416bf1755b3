"""Every package once, and what is missing counted."""

from __future__ import annotations

import time
from dataclasses import fields

import numpy as np
import pytest

from robot.arm.channel import STATE, Ring, create_segment
from robot.arm.status import PackageLog
from robot.arm.ur import URArm
from tests.robot.waiting import until

PERIOD = 2e-3


@pytest.fixture
def ring() -> Ring:
    return Ring(create_segment(Ring.size(STATE, 64)).memory, STATE, 64)


def write(ring: Ring, stamp: float, read: float, status: int = 1) -> None:
    record = np.zeros((), STATE)
    record["stamp"], record["time"], record["status"], record["joints"] = stamp, read, status, np.arange(6) + stamp
    ring.write(record)


def test_package_log_repeated_record_returns_package_once(ring: Ring) -> None:
    write(ring, 99.998, 9.998)  # before the log
    log = PackageLog(ring)
    assert len(log.take().stamp) == 0
    for k in range(5):
        write(ring, 100 + k * PERIOD, 10 + k * PERIOD)
    write(ring, 100 + 4 * PERIOD, 10 + 4 * PERIOD, status=10)  # a fault was found in it
    first = log.take()
    assert first.stamp.tolist() == pytest.approx([100 + k * PERIOD for k in range(5)])
    np.testing.assert_array_equal(first.joints, first.stamp[:, None] + np.arange(6))
    write(ring, 100 + 4 * PERIOD, 10 + 4 * PERIOD, status=10)  # and once more, after the look
    write(ring, 100 + 5 * PERIOD, 10 + 5 * PERIOD, status=10)
    second = log.take()
    assert second.stamp.tolist() == pytest.approx([100 + 5 * PERIOD]) and second.status.tolist() == [10]
    assert (first.lost, second.lost, log.take().lost) == (0, 0, 0)


def test_package_log_gap_is_counted(ring: Ring) -> None:
    log = PackageLog(ring)
    for k in (0, 1, 4):  # two never came
        write(ring, 100 + k * PERIOD, 10 + k * PERIOD)
    assert log.take().lost == 2
    for k in range(5, 205):  # more than the ring keeps
        write(ring, 100 + k * PERIOD, 10 + k * PERIOD)
    taken = log.take()
    assert len(taken.stamp) + taken.lost == 200 and taken.lost > 100
    write(ring, 1.0, 11.0)  # the controller was restarted: its clock restarts
    assert (log.take().lost, len(log.take().stamp)) == (0, 0)


def test_package_log_record_without_package_is_skipped(ring: Ring) -> None:
    log = PackageLog(ring)
    write(ring, 0.0, 0.0, status=0)  # connecting
    write(ring, 100.0, 10.0)
    assert log.take().stamp.tolist() == [100.0]


def test_package_log_arm_at_rest_returns_all_packages(arm: URArm) -> None:
    """In the order of the controller's own clock, each once, for any number of calls; gaps are reported."""
    log, parts = arm.package_log(), []
    joints = arm.state().joints

    def enough() -> bool:
        parts.append(log.take())
        time.sleep(0.01 * (len(parts) % 5))
        return sum(len(part.stamp) for part in parts) >= 300

    until(enough, "300 packages")
    stamps = np.concatenate([part.stamp for part in parts])
    steps = np.round(np.diff(stamps) / PERIOD)
    assert len(stamps) >= 300 and (steps >= 1).all()
    assert sum(part.lost for part in parts) == int((steps - 1).sum())
    told = np.concatenate([part.joints for part in parts])
    np.testing.assert_allclose(told, np.broadcast_to(joints, told.shape), atol=1e-6)
    assert all(len(getattr(part, each.name)) == len(part.stamp) for part in parts for each in fields(part)[:-1])
    assert set(np.concatenate([part.runtime_state for part in parts])) == {2}
