"""The driver of a UR arm: two arms that keep apart, stop together, and keep their rate."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from robot.arm.status import ArmStatus
from robot.arm.ur import URArm
from robot.errors import (
    SafetyViolation,
)
from robot.mock import MockUR
from tacsim.models.limits import Workspace
from tests.promises import Record
from tests.robot.arm.mocked import BASE, CARRIED, OTHER, config, go, in_motion, leftovers, moved, records
from tests.robot.waiting import PATIENCE, until

KEEP_OUT = 0.04  # of two arms that begin 60 mm apart [m]
ROOT = Path(__file__).resolve().parents[3]
Pair = tuple[URArm, URArm, MockUR]


@pytest.fixture
def pair(mock: MockUR, measuring: bool) -> Iterator[Pair]:
    """Two arms whose sensors are 60 mm apart along x, and must stay KEEP_OUT apart."""
    shifted = BASE.model_copy(update={"position": (BASE.position[0] + 0.06, *BASE.position[1:])})
    slow = {"speed": 0.05 if measuring else 0.02}
    given = config(realtime=measuring, limits=slow)
    beside = config(OTHER, realtime=measuring, limits=slow, world_from_base=shifted)
    with (
        MockUR(OTHER, realtime=measuring, payload=CARRIED) as other,
        URArm(given, "left", keep_out={"right": KEEP_OUT}) as left,
        URArm(beside, "right", keep_out={"left": KEEP_OUT}) as right,
    ):
        yield left, right, other


def apart(left: URArm, right: URArm) -> float:
    return float(np.linalg.norm(left.state().pose.position - right.state().pose.position))


@pytest.mark.slow
@pytest.mark.promise(15)
def test_pair_keep_out_holds_for_either_moving_arm(pair: Pair, figure: Record) -> None:
    left, right, _ = pair
    a, b = left.state().pose, right.state().pose
    assert apart(left, right) == pytest.approx(0.06, abs=1e-6)
    least, end = 1.0, time.monotonic() + 0.8
    while time.monotonic() < end or least > 0.055:  # head on, until they are nearer
        assert time.monotonic() < end + PATIENCE
        left.command(moved(a, x=0.05))
        right.command(moved(b, x=-0.05))
        time.sleep(5e-3)
        least = min(least, apart(left, right))
    figure("nearer than the keep-out, head on, measured", 1e3 * max(0.0, KEEP_OUT - least), "mm", at_most=1)
    assert least > KEEP_OUT - 1e-3
    assert not left.status().is_fault and not right.status().is_fault
    go(right, moved(b, x=0.02))  # away is always free
    go(left, a)


@pytest.mark.slow
def test_pair_reaches_the_targets_that_the_keep_out_shortens(pair: Pair) -> None:
    """Head on, both come to rest at what `command` returns: a rig in lock step waits for that."""
    left, right, _ = pair
    ahead, against = moved(left.state().pose, x=0.05), moved(right.state().pose, x=-0.05)

    def have_arrived() -> bool:
        sent = left.command(ahead), right.command(against)
        return all(to is not None and arm.arrived(to, within=2e-6) for arm, to in zip((left, right), sent, strict=True))

    until(have_arrived)
    assert KEEP_OUT < apart(left, right) < KEEP_OUT + 1e-3


@pytest.mark.promise(15)
def test_pair_arm_waits_for_missing_partner(mock: MockUR) -> None:
    with URArm(config(), "left", keep_out={"right": 0.04}) as arm:
        until(lambda: arm.status() == ArmStatus.WAITING, "waiting")
        with pytest.raises(SafetyViolation, match="other arm of a keep-out is not connected"):
            arm.command(moved(arm.state().pose, x=0.01))


@pytest.mark.slow
@pytest.mark.promise(15)
def test_pair_fault_of_one_arm_stops_both(pair: Pair, figure: Record) -> None:
    left, right, other = pair
    a, b = left.state().pose, right.state().pose
    in_motion(left, moved(a, x=-0.1))
    other.faults.protective_stop()
    until(lambda: left.status() == ArmStatus.PARTNER_STOPPED, "the other arm's stop")
    until(lambda: right.status() == ArmStatus.PROTECTIVE_STOP, "protective stop")
    with pytest.raises(SafetyViolation, match=r"the other arm stopped.*arm 'right' made a protective stop"):
        left.command(a)
    until(left.at_rest, "rest")
    # Within two periods of the stop's publication, as the loop of the arm that hears of it counts them.
    told, heard = records(right), records(left)
    stop = told[told["status"] == ArmStatus.PROTECTIVE_STOP][0]["written"]
    after = heard[heard["status"] == ArmStatus.PARTNER_STOPPED][0]
    figure("the second stop after the first", 1e3 * max(0.0, float(after["written"] - stop)), "ms", at_most=4)
    assert after["cycles"] - heard[heard["written"] < stop][-1]["cycles"] <= 2
    right.recover()
    left.recover()
    go(left, a)
    go(right, moved(b, x=0.01))


@pytest.mark.slow
@pytest.mark.promise(15)
def test_pair_recover_of_faulty_arm_first_restores_both(pair: Pair, figure: Record) -> None:
    left, right, other = pair
    a, b = left.state().pose, right.state().pose
    in_motion(left, moved(a, x=-0.1))
    in_motion(right, moved(b, x=0.1))
    other.faults.wrench([0.0, 0.0, 40.0, 0.0, 0.0, 0.0])
    until(lambda: left.status() == ArmStatus.PARTNER_STOPPED, "the other arm's stop")
    until(left.at_rest, "rest")
    until(right.at_rest, "rest")
    stopped = records(right)
    told = set(stopped["status"][stopped["status"] >= ArmStatus.FORCE_LIMIT].tolist())
    figure("causes that were replaced by their consequence", len(told - {ArmStatus.FORCE_LIMIT}))
    assert told == {ArmStatus.FORCE_LIMIT}
    with pytest.raises(SafetyViolation, match=r"exceeded limits.force.*now 4.* of 30 N"):
        right.recover()  # it is still pressed: it stands in its fault, and says why
    left.recover()
    assert left.status() == ArmStatus.WAITING
    other.faults.wrench([0.0] * 6)
    right.recover()
    until(lambda: {left.status(), right.status()} == {ArmStatus.HOLD}, "both back")
    go(left, moved(left.state().pose, x=0.01))
    go(right, moved(right.state().pose, x=-0.01))


@pytest.mark.slow
@pytest.mark.promise(1, 15)
def test_pair_connect_with_fault_raises(mock: MockUR) -> None:
    """The other arm waits, without a stop or a fault."""
    elsewhere = {"workspace": Workspace(lower=(2.0, 2.0, 2.0), upper=(3.0, 3.0, 3.0))}
    with MockUR(OTHER, payload=CARRIED) as other, URArm(config(), "left", keep_out={"right": KEEP_OUT}) as left:
        with pytest.raises(SafetyViolation, match=r"arm 'right' is outside its workspace.*mm beyond"):
            URArm(config(OTHER, limits=elsewhere), "right", keep_out={"left": KEEP_OUT}).close()
        other.faults.wrench([0.0, 0.0, 40.0, 0.0, 0.0, 0.0])
        with pytest.raises(SafetyViolation, match=r"arm 'right' exceeded limits.force.*now 4.* of 30 N"):
            URArm(config(OTHER), "right", keep_out={"left": KEEP_OUT}).close()
        assert left.status() == ArmStatus.WAITING
    assert leftovers() == 0


@pytest.mark.slow
@pytest.mark.promise(15)
def test_pair_dead_worker_stops_moving_arm(pair: Pair) -> None:
    """The other arm counts as dead after link_timeout, 1 s here; this one moves for much longer."""
    left, right, _ = pair
    in_motion(left, moved(left.state().pose, x=-0.14))
    assert right.worker is not None
    os.kill(right.worker.pid, signal.SIGKILL)
    until(lambda: left.status() == ArmStatus.PARTNER_STOPPED, "stop")


EMPTY = """
import time
import numpy as np
from robot.common import WORKER_PRIORITY, request_realtime
request_realtime(WORKER_PRIORITY)
beats = [time.monotonic()]
deadline = beats[0] + 2e-3
while len(beats) <= 500:
    time.sleep(max(0.0, deadline - time.monotonic()))
    beats.append(time.monotonic())
    deadline = max(deadline + 2e-3, beats[-1])
print(1e3 * np.percentile(np.diff(beats), 99))
"""


@pytest.mark.deep
@pytest.mark.promise(13)
def test_pair_moving_arms_keep_loop_rate(pair: Pair, figure: Record) -> None:
    """And a loop that does nothing, as privileged as a worker: no loop on this machine keeps better time."""
    left, right, _ = pair
    left.command(moved(left.state().pose, x=-0.04, z=0.04))
    right.command(moved(right.state().pose, x=0.04, z=0.04))
    time.sleep(1.02)  # the statistics are of 500 periods
    both = left.timing(), right.timing()
    words = [sys.executable, "-c", EMPTY]
    done = subprocess.run(words, capture_output=True, text=True, timeout=30, check=True, cwd=ROOT)
    figure("99th percentile of the period, two arms", 1e3 * max(each.p99 for each in both), "ms", at_most=4)
    figure("... of a loop that does nothing, in the same run", float(done.stdout), "ms", at_most=None)
    assert min(each.cycles for each in both) > 100
