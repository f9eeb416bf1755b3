"""The driver of a UR arm: processes that die, other programs, and closing."""

from __future__ import annotations

import gc
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from robot.arm import ur
from robot.arm.status import ArmStatus
from robot.arm.trajectory import PERIOD
from robot.arm.ur import URArm
from robot.common.process import Child
from robot.errors import (
    DeviceAlreadyConnectedError,
    DeviceBusyError,
    DeviceError,
    DeviceNotConnectedError,
)
from robot.mock import MockUR
from tests.promises import Record
from tests.robot.arm.mocked import (
    SERVO_STOP,
    ZERO,
    at_full_speed,
    check_path,
    config,
    go,
    in_motion,
    leftovers,
    moved,
    records,
    sensor_path,
    servo_targets,
    servo_ticks,
    stands,
)
from tests.robot.waiting import PATIENCE, alive, until

# -- death -----------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.promise(6)
def test_worker_killed_is_reported_and_replaced(mock: MockUR, measuring: bool, figure: Record) -> None:
    with URArm(config(realtime=measuring, watchdog=10.0 if measuring else 1.0), "left") as arm:
        start = arm.state().pose
        at_full_speed(arm, moved(start, x=0.14))
        assert arm.worker is not None
        os.kill(arm.worker.pid, signal.SIGKILL)
        killed = time.monotonic()
        stood = until(lambda: stands(mock.faults.state()), "standstill", pause=5e-4)
        figure("worker killed at 0.1 m/s: the watchdog's stop", 1e3 * (stood - killed), "ms", at_most=250)
        until(lambda: arm.status() == ArmStatus.WORKER_DEAD, "death")
        with pytest.raises(DeviceNotConnectedError, match=r"lost its worker process.*\(killed by SIGKILL"):
            arm.command(start)
        with pytest.raises(DeviceNotConnectedError):
            arm.state()
        until(lambda: mock.faults.state().rests and not mock.faults.state().program, "the watchdog's stop")
        assert "watchdog" in mock.faults.state().stop_reason.lower()
        asked = time.monotonic()
        arm.recover()
        figure("new worker, ready", time.monotonic() - asked, "s", at_most=0.5)
        assert arm.status() == ArmStatus.HOLD
        go(arm, start)


@pytest.mark.slow
@pytest.mark.promise(6)
def test_worker_stopped_is_lost_link_and_replaced(mock: MockUR) -> None:
    with URArm(config(link_timeout=0.5), "left") as arm:
        start = arm.state().pose
        assert arm.worker is not None
        os.kill(arm.worker.pid, signal.SIGSTOP)
        until(lambda: arm.status() == ArmStatus.LINK_LOST, "lost link")
        arm.recover()  # SIGKILL ends even a stopped process
        go(arm, moved(start, x=0.01))


POLICY = """
import signal, sys, time
from robot.arm.ur import URArm
from tacsim.models.hardware import UrArmConfig
from tests.robot.arm.mocked import at_full_speed, moved
signal.signal(signal.SIGINT, signal.default_int_handler)  # also if the test runner ignores it
arm = URArm(UrArmConfig.model_validate_json(sys.argv[1]), "policy")
at_full_speed(arm, moved(arm.state().pose, x=0.14))
print(arm.worker.pid, flush=True)
time.sleep(60)
"""


@pytest.mark.slow
@pytest.mark.promise(6, 14)
@pytest.mark.parametrize("number", [signal.SIGKILL, pytest.param(signal.SIGINT, marks=pytest.mark.deep)])
def test_driver_killed_leaves_arm_at_rest(mock: MockUR, number: int, measuring: bool, figure: Record) -> None:
    words = [
        sys.executable,
        "-c",
        POLICY,
        config(realtime=measuring, watchdog=10.0 if measuring else 1.0).model_dump_json(),
    ]
    path = str(Path(ur.__file__).parents[2])
    with subprocess.Popen(words, env={**os.environ, "PYTHONPATH": path}, stdout=subprocess.PIPE, text=True) as policy:
        assert policy.stdout is not None
        worker = policy.stdout.readline()
        before, killed = mock.faults.state(), time.monotonic()
        policy.send_signal(number)
        stood = until(lambda: stands(mock.faults.state()), "standstill", pause=5e-4)
        until(lambda: mock.faults.state().rests, "rest")
        after = mock.faults.state()
    assert not before.rests
    if number == signal.SIGKILL:  # an interrupted program ends as fast as the machine lets it
        went = float(np.linalg.norm(np.subtract(after.pose[:3], before.pose[:3])))
        figure("policy killed at 0.1 m/s: standstill", 1e3 * (stood - killed), "ms", at_most=200)
        figure("policy killed at 0.1 m/s: path", 1e3 * went, "mm", at_most=5)
        assert went < 0.05  # ten times 5 mm
    until(lambda: not mock.faults.state().program, "end of the program")
    until(lambda: 30004 not in mock.faults.state().clients, "closed sockets")
    until(lambda: not alive(int(worker)), "end of the worker")
    figure("processes, sockets left by a killed policy", 0, promise=14)  # else one of these waits failed


COMMAND = """
import os, sys, time
from robot.arm.ur import URArm
from robot.cli.terminal import Interrupt
from tacsim.models.hardware import UrArmConfig
from tests.robot.arm.mocked import at_full_speed, moved
with Interrupt() as stop:
    with URArm(UrArmConfig.model_validate_json(sys.argv[1]), "policy") as arm:
        at_full_speed(arm, moved(arm.state().pose, x=0.14))
        stop()
        print(arm.worker.pid, flush=True)
        while not stop():
            time.sleep(0.01)
    sys.exit(stop.exit_code)
"""


@pytest.mark.slow
@pytest.mark.promise(6, 14)
@pytest.mark.parametrize(
    ("program", "number"),
    [
        (POLICY, signal.SIGTERM),
        pytest.param(POLICY, signal.SIGHUP, marks=pytest.mark.deep),
        pytest.param(COMMAND, signal.SIGTERM, marks=pytest.mark.deep),
        (COMMAND, signal.SIGHUP),
    ],
)
def test_worker_signal_brakes_before_exit(mock: MockUR, program: str, number: signal.Signals) -> None:
    """A lost terminal, `kill -- -GROUP`, `systemctl stop`. A command brakes within its limits; the arm of a script that
    handles no signal, and ends at once, as after a fault."""
    given = config()
    words, path = [sys.executable, "-c", program, given.model_dump_json()], str(Path(ur.__file__).parents[2])
    since = mock.faults.received().last
    with subprocess.Popen(
        words, env={**os.environ, "PYTHONPATH": path}, stdout=subprocess.PIPE, text=True, start_new_session=True
    ) as policy:
        assert policy.stdout is not None
        worker = int(policy.stdout.readline())
        assert not mock.faults.state().rests
        os.kill(worker, number)
        os.killpg(policy.pid, number)
        assert policy.wait(PATIENCE) == (128 + number if program == COMMAND else -number)
    until(lambda: not alive(worker), "end of the worker")
    until(lambda: not mock.faults.state().program, "end of the program")
    assert "watchdog" not in mock.faults.state().stop_reason.lower()
    entries = mock.faults.received(since).entries
    sent, ticks = servo_targets(entries), servo_ticks(entries)
    arm = cast("URArm", SimpleNamespace(config=given))
    if program == COMMAND:
        check_path(arm, sent)
    speed = np.diff(sensor_path(arm, sent)[:, 0, 3]) / PERIOD  # towards its goal; an arm in a fault is led back, too
    ended = min(entry.tick for entry in entries if entry.values.get("input_int_register_0") == SERVO_STOP)
    # A worker that was held up longer than it may brake finds an arm that stands: the last target is an old one.
    assert speed[-1] < 0.05 * given.limits.speed or ended - ticks[-1] > 100


def test_zero_wrench_failed_is_not_repeated(mock: MockUR) -> None:
    with URArm(config(watchdog=0.2, link_timeout=0.5), "left") as arm:
        assert arm.worker is not None
        os.kill(arm.worker.pid, signal.SIGSTOP)
        with pytest.raises(DeviceError, match=r"link_timeout|does not answer; its controller"):
            arm.zero_wrench()
        mark = mock.faults.received().last
        os.kill(arm.worker.pid, signal.SIGCONT)
        until(lambda: arm.status() == ArmStatus.HOLD or not arm.worker.running, "end of the stop")  # type: ignore[union-attr]
        time.sleep(0.2)
        asked = [entry.values.get("input_int_register_0") for entry in mock.faults.received(mark).entries]
        assert ZERO not in asked


# -- one commander ---------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.promise(8)
def test_connect_second_driver_raises_and_first_continues(arm: URArm, mock: MockUR, figure: Record) -> None:
    start = arm.state().pose
    at_full_speed(arm, moved(start, x=0.1))
    asked = time.monotonic()
    with pytest.raises(DeviceBusyError, match="controlled by another program"):
        URArm(config(), "second").close()
    figure("DeviceBusyError", time.monotonic() - asked, "s", at_most=1)
    seen = records(arm)
    figure("first drivers that were disturbed", (seen["status"][seen["written"] > asked] != ArmStatus.OK).any())
    assert leftovers() == 1
    assert arm.status() == ArmStatus.OK
    go(arm, start)
    with pytest.raises(DeviceAlreadyConnectedError, match="open already"):
        URArm(config(), "left").close()
    go(arm, moved(start, x=0.01))


@pytest.mark.promise(8)
def test_connect_registers_in_use_raises_busy(mock: MockUR) -> None:
    mock.faults.claim(["input_int_register_0"])
    with pytest.raises(DeviceBusyError):
        URArm(config(), "left").close()


# -- closing ---------------------------------------------------------------------------------------------------------


def open_files() -> int:
    gc.collect()
    return len(list(Path("/proc/self/fd").iterdir()))


@pytest.mark.slow
@pytest.mark.promise(14)
@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="counts open files as Linux shows them")
def test_close_frees_all_resources(
    mock: MockUR, measuring: bool, figure: Record, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = open_files()
    if not measuring:
        monkeypatch.setattr(ur, "CLOSE_TIMEOUT", PATIENCE)
    arm = URArm(config(realtime=measuring), "left")
    at_full_speed(arm, moved(arm.state().pose, x=0.12))
    worker = arm.worker
    assert worker is not None and leftovers() == 1
    asked = time.monotonic()
    arm.close()
    figure("close() under way", time.monotonic() - asked, "s", at_most=1.5)
    arm.close()
    figure(
        "processes, shared memory, files left by close()",
        sum((alive(worker.pid), leftovers(), abs(open_files() - before))),
    )
    assert worker.exit_status == 0  # it ended by itself
    assert leftovers() == 0
    assert open_files() == before
    until(lambda: mock.faults.state().rests, "rest")
    assert not mock.faults.state().program
    until(lambda: set(mock.faults.state().clients) <= {30020}, "closed sockets")
    assert arm.status() == ArmStatus.CLOSED
    for call in (arm.state, lambda: arm.command(None), arm.recover, arm.history, arm.zero_wrench, arm.timing):
        with pytest.raises(DeviceNotConnectedError, match="is closed"):
            call()
    arm.stop()


def test_describe_status_slow_loop_names_period(mock: MockUR, monkeypatch: pytest.MonkeyPatch) -> None:
    with URArm(config(), "left") as arm:
        record = arm._channel.states.latest()
        assert record is not None
        monkeypatch.setattr(arm._channel.states, "latest", lambda: record)
        record["period"] = 1.9 * PERIOD, 9e-3, 9e-3
        assert arm._describe_status(ArmStatus.OK) == "arm 'left' follows its target"
        record["period"] = 7e-3, 9e-3, 9e-3
        assert arm._describe_status(ArmStatus.OK).endswith(
            "(slowly: its loop takes 7 ms, not 2; the machine is too busy)"
        )
        assert "slowly" not in arm._describe_status(ArmStatus.PROTECTIVE_STOP)
        monkeypatch.undo()


@pytest.mark.slow
@pytest.mark.promise(14)
@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="counts open files as Linux shows them")
def test_worker_died_frees_all_resources(mock: MockUR) -> None:
    before = open_files()
    arm = URArm(config(), "left")
    in_motion(arm, moved(arm.state().pose, x=0.1))
    worker = arm.worker
    assert worker is not None
    os.kill(worker.pid, signal.SIGALRM)  # what ends it when the library does not come back
    until(lambda: arm.status() == ArmStatus.LINK_LOST, "end of the worker")
    until(lambda: not worker.running, "end of the worker")
    assert arm.status() == ArmStatus.LINK_LOST
    assert ", a command took longer than link_timeout;" in arm.explain()
    arm.close()
    assert worker.exit_status == -signal.SIGALRM  # reaped, no zombie
    assert leftovers() == 0
    assert open_files() == before
    until(lambda: not mock.faults.state().program, "the watchdog's stop")
    until(lambda: set(mock.faults.state().clients) <= {30020}, "closed sockets")


@pytest.mark.slow
@pytest.mark.promise(14)
def test_close_blocked_worker_is_killed(mock: MockUR) -> None:
    arm = URArm(config(), "left")
    assert arm.worker is not None
    worker = arm.worker
    os.kill(worker.pid, signal.SIGSTOP)
    begun = time.monotonic()
    arm.close()
    assert time.monotonic() - begun < 15.0  # ten times the promise
    assert worker.exit_status == -signal.SIGKILL
    assert leftovers() == 0


@pytest.mark.slow
@pytest.mark.promise(14)
def test_close_during_connect_ends_worker(mock: MockUR, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C in the middle of connecting: no worker and no memory stay behind."""
    mock.faults.black_hole(True)
    workers: list[Child] = []
    true_start = URArm._start_worker

    def interrupted(self: URArm) -> None:
        threading.Timer(0.5, lambda: (workers.append(self.worker), os.kill(os.getpid(), signal.SIGINT))).start()  # type: ignore[arg-type,func-returns-value]
        true_start(self)

    monkeypatch.setattr(URArm, "_start_worker", interrupted)
    found = signal.signal(signal.SIGINT, signal.default_int_handler)  # who runs the tests may ignore it
    try:
        with pytest.raises(KeyboardInterrupt):
            URArm(config(), "left", timeout=PATIENCE).close()
    finally:
        signal.signal(signal.SIGINT, found)
    assert not workers[0].running
    assert leftovers() == 0


@pytest.mark.slow
def test_state_during_close_in_other_thread_raises_cleanly(mock: MockUR, monkeypatch: pytest.MonkeyPatch) -> None:
    arm = URArm(config(), "left")
    ended, closing = Child.exit_status.fget, iter([arm.close])

    def closed_meanwhile(worker: Child) -> int | None:
        for close in closing:
            close()
        assert ended is not None
        status: int | None = ended(worker)
        return status

    monkeypatch.setattr(Child, "exit_status", property(closed_meanwhile))
    assert arm.status() == ArmStatus.WORKER_DEAD
    assert arm.status() == ArmStatus.CLOSED
    assert leftovers() == 0
