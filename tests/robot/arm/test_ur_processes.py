"""The driver of a UR arm: processes that die, other programs, closing, and a second arm."""

from __future__ import annotations

import gc
import os
import signal
import subprocess
import sys
import textwrap
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from robot.arm import shared_ring, ur
from robot.arm.channel import HISTORY, ArmStatus
from robot.arm.ur import URArm
from robot.errors import (
    DeviceAlreadyConnectedError,
    DeviceBusyError,
    DeviceNotConnectedError,
    SafetyViolation,
)
from robot.mock import MockUR
from tests.robot.arm.mocked import (
    BASE,
    OTHER,
    PATIENCE,
    config,
    go,
    in_motion,
    leftovers,
    moved,
    until,
)

# -- death -----------------------------------------------------------------------------------------------------------


def test_a_killed_worker_is_told_and_replaced(mock: MockUR) -> None:
    with URArm(config(watchdog=10.0), "left") as arm:
        start = arm.state().pose
        in_motion(arm, moved(start, x=0.1))
        assert arm._process is not None
        os.kill(arm._process.pid, signal.SIGKILL)
        until(lambda: arm.status() == ArmStatus.WORKER_DEAD, "death")
        with pytest.raises(DeviceNotConnectedError, match="lost its worker process"):
            arm.command(start)
        with pytest.raises(DeviceNotConnectedError):
            arm.state()
        until(lambda: mock.faults.state().rests and not mock.faults.state().program, "the watchdog's stop")
        assert "watchdog" in mock.faults.state().stop_reason.lower()
        arm.recover()
        assert arm.status() == ArmStatus.HOLD
        go(arm, start)


def test_a_stopped_worker_is_a_lost_link_and_can_be_replaced(mock: MockUR) -> None:
    with URArm(config(watchdog=10.0, link_timeout=0.5), "left") as arm:
        start = arm.state().pose
        assert arm._process is not None
        os.kill(arm._process.pid, signal.SIGSTOP)
        until(lambda: arm.status() == ArmStatus.LINK_LOST, "lost link")
        arm.recover()  # SIGKILL ends even a stopped process
        go(arm, moved(start, x=0.01))


POLICY = """
    import sys, time
    from robot.arm.ur import URArm
    from tacsim.models.hardware import UrArmConfig
    from tacsim.interface import Pose
    config = UrArmConfig.model_validate_json(sys.argv[1])
    arm = URArm(config, "policy")
    start = arm.state().pose
    arm.command(Pose(start.position + [0.12, 0.0, 0.0], start.quaternion))
    while abs(arm.state().pose.position[0] - start.position[0]) < 0.02:
        time.sleep(0.001)
    print(arm._segment.name, arm._process.pid, flush=True)
    time.sleep(60)
"""


def running(process: int) -> bool:
    """False also for one that has ended and that nobody has asked for its exit status."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT])
def test_a_policy_that_dies_leaves_a_standing_arm_and_nothing_else(mock: MockUR, number: int) -> None:
    root = str(Path(ur.__file__).parents[2])
    policy = subprocess.Popen(
        [
            sys.executable,
            "-c",
            textwrap.dedent(POLICY),
            config().model_copy(update={"watchdog": 10.0}).model_dump_json(),
        ],
        env={**os.environ, "PYTHONPATH": root},
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    assert policy.stdout is not None
    segment, worker = policy.stdout.readline().split()
    before = mock.faults.state()
    assert not before.rests
    policy.send_signal(number)
    policy.communicate(timeout=PATIENCE)
    until(lambda: mock.faults.state().rests, "rest")
    after = mock.faults.state()
    if number == signal.SIGKILL:  # an interrupted program ends as fast as the machine lets it
        assert np.linalg.norm(np.array(after.pose[:3]) - before.pose[:3]) < 0.05  # ten times 5 mm
    until(lambda: not mock.faults.state().program, "end of the program")
    until(lambda: 30004 not in mock.faults.state().clients, "closed sockets")
    until(lambda: not (shared_ring.FOLDER / segment).exists(), "removed memory")
    until(lambda: not running(int(worker)), "end of the worker")


# -- one commander ---------------------------------------------------------------------------------------------------


def test_a_second_driver_is_refused_and_the_first_goes_on(arm: URArm, mock: MockUR) -> None:
    start = arm.state().pose
    in_motion(arm, moved(start, x=0.1))
    with pytest.raises(DeviceBusyError, match="controlled by another program"):
        URArm(config(), "second").close()
    assert leftovers("second") == []
    assert arm.status() == ArmStatus.OK
    go(arm, start)
    with pytest.raises(DeviceAlreadyConnectedError, match="open already"):
        URArm(config(), "left").close()
    go(arm, moved(start, x=0.01))


def test_a_field_bus_that_holds_the_registers_is_busy_too(mock: MockUR) -> None:
    mock.faults.claim(["input_int_register_0"])
    with pytest.raises(DeviceBusyError):
        URArm(config(), "left").close()


# -- closing ---------------------------------------------------------------------------------------------------------


def open_files() -> int:
    gc.collect()
    return len(list(Path("/proc/self/fd").iterdir()))


@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="counts open files as Linux shows them")
def test_nothing_is_left_after_close(mock: MockUR) -> None:
    before = open_files()
    arm = URArm(config(), "left")
    in_motion(arm, moved(arm.state().pose, x=0.1))
    worker = arm._process
    assert worker is not None and leftovers("left")
    arm.close()
    arm.close()
    assert worker.returncode == 0  # it ended by itself
    assert leftovers("left") == []
    assert open_files() == before
    until(lambda: mock.faults.state().rests, "rest")
    assert not mock.faults.state().program
    until(lambda: set(mock.faults.state().clients) <= {30020}, "closed sockets")
    assert arm.status() == ArmStatus.CLOSED
    for call in (arm.state, lambda: arm.command(None), arm.recover, arm.history, arm.zero_wrench, arm.timing):
        with pytest.raises(DeviceNotConnectedError, match="is closed"):
            call()
    arm.stop()


@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="counts open files as Linux shows them")
def test_nothing_is_left_of_a_worker_that_died(mock: MockUR) -> None:
    before = open_files()
    arm = URArm(config(watchdog=10.0), "left")
    in_motion(arm, moved(arm.state().pose, x=0.1))
    worker = arm._process
    assert worker is not None
    os.kill(worker.pid, signal.SIGKILL)
    until(lambda: arm.status() == ArmStatus.WORKER_DEAD, "death")
    arm.close()
    assert worker.returncode == -signal.SIGKILL  # reaped, no zombie
    assert leftovers("left") == []
    assert open_files() == before
    until(lambda: not mock.faults.state().program, "the watchdog's stop")
    until(lambda: set(mock.faults.state().clients) <= {30020}, "closed sockets")


def test_a_wedged_worker_is_killed(mock: MockUR) -> None:
    arm = URArm(config(), "left")
    assert arm._process is not None
    worker = arm._process
    os.kill(worker.pid, signal.SIGSTOP)
    begun = time.monotonic()
    arm.close()
    assert time.monotonic() - begun < 15.0  # ten times the promise
    assert worker.returncode == -signal.SIGKILL
    assert leftovers("left") == []


def test_close_while_it_connects(mock: MockUR, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C in the middle of connecting: no worker and no memory stay behind."""
    mock.faults.black_hole(True)
    workers: list[subprocess.Popen[bytes]] = []
    true_start = URArm._start

    def interrupted(self: URArm) -> None:
        threading.Timer(0.5, lambda: (workers.append(self._process), os.kill(os.getpid(), signal.SIGINT))).start()  # type: ignore[arg-type,func-returns-value]
        true_start(self)

    monkeypatch.setattr(URArm, "_start", interrupted)
    with pytest.raises(KeyboardInterrupt):
        URArm(config(), "left", timeout=PATIENCE).close()
    assert workers[0].poll() is not None
    assert leftovers("left") == []


# -- two arms --------------------------------------------------------------------------------------------------------


@pytest.fixture
def pair(mock: MockUR) -> Iterator[tuple[URArm, URArm, MockUR]]:
    """Two arms whose sensors are 60 mm apart along x, and must stay 40 mm apart."""
    with MockUR(OTHER) as other:
        shifted = BASE.model_copy(update={"position": (BASE.position[0] + 0.06, *BASE.position[1:])})
        slow = {"speed": 0.02}
        with (
            URArm(config(limits=slow), "left", keep_out={"right": 0.04}) as left,
            URArm(
                config(OTHER).model_copy(update={"world_from_base": shifted}), "right", keep_out={"left": 0.04}
            ) as right,
        ):
            yield left, right, other


def apart(left: URArm, right: URArm) -> float:
    return float(np.linalg.norm(left.state().pose.position - right.state().pose.position))


def test_two_arms_keep_apart_whoever_moves(pair: tuple[URArm, URArm, MockUR]) -> None:
    left, right, _ = pair
    a, b = left.state().pose, right.state().pose
    assert apart(left, right) == pytest.approx(0.06, abs=1e-6)
    least = 1.0
    for _ in range(150):  # head on
        left.command(moved(a, x=0.05))
        right.command(moved(b, x=-0.05))
        time.sleep(0.01)
        least = min(least, apart(left, right))
    assert least > 0.039
    assert least < 0.055  # they did come nearer
    assert not left.status().is_fault and not right.status().is_fault
    go(right, moved(b, x=0.05))  # away is always free
    go(left, a)


def test_an_arm_waits_for_the_other_of_its_keep_out(mock: MockUR) -> None:
    with URArm(config(), "left", keep_out={"right": 0.04}) as arm:
        until(lambda: arm.status() == ArmStatus.WAITING, "waiting")
        with pytest.raises(SafetyViolation, match="other arm of a keep-out is not connected"):
            arm.command(moved(arm.state().pose, x=0.01))


def test_both_arms_stop_when_one_does(pair: tuple[URArm, URArm, MockUR]) -> None:
    left, right, other = pair
    a, b = left.state().pose, right.state().pose
    in_motion(left, moved(a, x=-0.1))
    other.faults.protective_stop()
    until(lambda: left.status() == ArmStatus.PARTNER_STOPPED, "the other arm's stop")
    until(lambda: right.status() == ArmStatus.PROTECTIVE_STOP, "protective stop")
    with pytest.raises(SafetyViolation, match="stopped because the other arm did"):
        left.command(a)
    until(left.at_rest, "rest")
    # Within two periods of the stop's publication, as the loop of the arm that hears of it counts them.
    told = right._channel.states.recent(HISTORY)
    told = told[told["status"] == ArmStatus.PROTECTIVE_STOP][0]["written"]
    heard = left._channel.states.recent(HISTORY)
    before = heard[heard["written"] < told][-1]["cycles"]
    assert heard[heard["status"] == ArmStatus.PARTNER_STOPPED][0]["cycles"] - before <= 2
    right.recover()
    left.recover()
    go(left, a)
    go(right, moved(b, x=0.01))


def test_a_dead_partner_stops_the_arm_that_moves(pair: tuple[URArm, URArm, MockUR]) -> None:
    """The other one counts as dead after link_timeout, 1 s here; this one is under way for much longer."""
    left, right, _ = pair
    in_motion(left, moved(left.state().pose, x=-0.14))
    assert right._process is not None
    os.kill(right._process.pid, signal.SIGKILL)
    until(lambda: left.status() == ArmStatus.PARTNER_STOPPED, "stop")
