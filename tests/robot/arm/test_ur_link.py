"""The driver of a UR arm: links that are silent, cut, late or never there."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest

from robot.arm import ur
from robot.arm.status import ArmStatus
from robot.arm.ur import URArm
from robot.arm.worker import MAX_MISSED_PACKAGES
from robot.errors import (
    DeviceError,
    DeviceNotConnectedError,
    LinkLost,
    StaleObservationError,
)
from robot.mock import MOCK_SERIAL, MockUR
from tests.promises import Record
from tests.robot.arm.mocked import (
    HOST,
    OTHER,
    at_full_speed,
    config,
    go,
    in_motion,
    leftovers,
    moved,
    servo_targets,
    stands,
)
from tests.robot.waiting import PATIENCE, until


@pytest.mark.slow
@pytest.mark.promise(4)
def test_arm_silent_link_raises_link_lost_in_time(mock: MockUR, measuring: bool, figure: Record) -> None:
    timeout = 0.05 if measuring else 0.5
    with URArm(config(realtime=measuring, link_timeout=timeout), "left") as arm:
        start = arm.state().pose
        at_full_speed(arm, moved(start, x=0.12))
        mock.faults.silence(True)
        last = mock.faults.received().last
        reported = until(lambda: arm.status() == ArmStatus.LINK_LOST, "lost link", pause=2e-4)
        newest = float(arm._channel.states.latest()["time"])  # type: ignore[index]
        figure("silent link reported (link_timeout 50 ms)", 1e3 * (reported - newest), "ms", at_most=60)
        with pytest.raises(StaleObservationError, match=rf"the link is lost.*link_timeout = {1e3 * timeout:g} ms"):
            arm.state()
        with pytest.raises(LinkLost, match="does not answer; its controller"):
            arm.command(start)
        assert (
            len(servo_targets(mock.faults.received(last).entries)) <= 3 * MAX_MISSED_PACKAGES
        )  # then it sends no more
        until(lambda: mock.faults.state().rests, "rest by the controller's watchdog")
        figure("processes that did not outlive it", len(arm.history()) <= 5)
        assert len(arm.history()) > 5  # what was known stays known
        mock.faults.silence(False)
        mark = mock.faults.received().last
        arm.recover()
        time.sleep(0.2)
        assert len(servo_targets(mock.faults.received(mark).entries)) == 0  # no old command is sent again
        go(arm, start)


@pytest.mark.slow
@pytest.mark.promise(4)
@pytest.mark.parametrize(
    ("ports", "reset"), [(None, True), pytest.param([30004], True, marks=pytest.mark.deep), ([30004], False)]
)
def test_arm_cut_link_is_lost_until_recover(mock: MockUR, ports: list[int] | None, reset: bool) -> None:
    """Without the limits ur_rtde reconnects 0.1 s later, starts its program again, and the arm moves on."""
    with URArm(config(link_timeout=0.5), "left") as arm:
        start = arm.state().pose
        in_motion(arm, moved(start, x=0.1))
        mock.faults.cut(ports, reset=reset)
        until(lambda: stands(mock.faults.state()), "standstill")
        first = last = mock.faults.state()
        farthest, programs, clients = 0.0, [], set()
        while last.tick < first.tick + 500 or (last.program and last.tick < first.tick + 5000):
            last = mock.faults.state()
            farthest = max(farthest, float(np.linalg.norm(np.subtract(last.pose[:3], first.pose[:3]))))
            programs.append(last.program)
            clients |= set(last.clients)
            time.sleep(1e-3)
        assert farthest < 50e-6  # it settles to less
        assert programs == sorted(programs, reverse=True) and not last.program  # it ended, and none began
        assert clients <= {30020} | (set() if ports is None else {29999, 30003})
        assert arm.status() == ArmStatus.LINK_LOST  # also where ur_rtde crashes of it
        with pytest.raises(LinkLost, match="does not answer; its controller"):
            arm.command(start)
        arm.recover()
        go(arm, start)


@pytest.mark.parametrize("port", [29999, 30003])
def test_arm_unused_connection_may_close(mock: MockUR, port: int) -> None:
    with URArm(config(), "left") as arm:
        start = arm.state().pose
        in_motion(arm, moved(start, x=0.05))
        assert mock.faults.cut([port], reset=True) == 1
        go(arm, moved(start, x=0.05))
    until(lambda: not mock.faults.state().program, "end of the program")


@pytest.mark.slow
@pytest.mark.promise(4, 9)
def test_arm_stopped_controller_is_lost_link(mock: MockUR) -> None:
    with URArm(config(link_timeout=0.5), "left") as arm:
        start = arm.state().pose
        os.kill(mock.pid, signal.SIGSTOP)
        try:
            until(lambda: arm.status() == ArmStatus.LINK_LOST, "lost link")
            assert arm.worker is not None
            until(lambda: not arm.worker.running, "end of the worker")  # type: ignore[union-attr]
            assert arm.status() == ArmStatus.LINK_LOST  # also where it was ended in the middle of a command
            begun = time.monotonic()
            with pytest.raises(DeviceError):
                URArm(config(OTHER), "nobody", timeout=2.0).close()
            assert time.monotonic() - begun < PATIENCE
        finally:
            os.kill(mock.pid, signal.SIGCONT)
        until(lambda: mock.faults.state().rests, "rest")
        arm.recover()
        go(arm, moved(start, x=0.01))


@pytest.mark.slow
@pytest.mark.promise(4)
def test_arm_package_with_nan_is_ignored(mock: MockUR) -> None:
    with URArm(config(link_timeout=0.5), "left") as arm:
        in_motion(arm, moved(arm.state().pose, x=0.1))
        mock.faults.nan_state(True)
        until(lambda: arm.status() == ArmStatus.LINK_LOST, "lost link")
        until(lambda: mock.faults.state().rests, "rest")
        mock.faults.nan_state(False)
        arm.recover()
        assert np.isfinite(arm.state().pose.position).all()


@pytest.mark.parametrize("jump", [100.0, pytest.param(-100.0, marks=pytest.mark.deep)])
def test_arm_clock_jump_keeps_motion(arm: URArm, mock: MockUR, jump: float) -> None:
    start = arm.state().pose
    in_motion(arm, moved(start, x=0.05))
    mock.faults.clock_jump(jump)
    go(arm, start)
    assert arm.status() == ArmStatus.OK


def test_arm_late_and_lost_packages_keep_motion(arm: URArm, mock: MockUR) -> None:
    start = arm.state().pose
    mock.faults.drop(0.3, seed=1)
    mock.faults.delay(0.02)
    go(arm, moved(start, x=0.02))
    mock.faults.delay(0.0)
    mock.faults.drop(0.0)
    go(arm, start)


# -- connecting ------------------------------------------------------------------------------------------------------


@pytest.fixture
def gaps() -> Iterator[list[float]]:
    """How long another thread of this process had to wait for its turn, each time, beyond its own millisecond [s]."""
    gaps, over = [0.0], threading.Event()

    def beat() -> None:
        last = time.monotonic()
        while not over.is_set():
            time.sleep(1e-3)
            now = time.monotonic()
            gaps.append(now - last - 1e-3)
            last = now

    thread = threading.Thread(target=beat)
    thread.start()
    yield gaps
    over.set()
    thread.join()


@pytest.mark.slow
@pytest.mark.promise(9)
@pytest.mark.parametrize("fault", ["silent", "refusing", "black hole", "mute dashboard"])
def test_connect_without_controller_raises_in_time(
    mock: MockUR, gaps: list[float], fault: str, measuring: bool, figure: Record
) -> None:
    faults, host, timeout = mock.faults, HOST, 0.6 if measuring else 1.0
    if fault == "black hole":
        faults.black_hole(True)
    elif fault == "mute dashboard":
        faults.dashboard_mute(True)
    elif fault == "silent":
        faults.silence(True)
    else:
        host = OTHER  # no server there
    begun = time.monotonic()
    with pytest.raises(DeviceNotConnectedError):
        URArm(config(host, realtime=measuring), "left", timeout=timeout).close()
    assert time.monotonic() - begun < timeout + PATIENCE
    turns = list(gaps)
    figure(f"interpreter blocked, {fault} peer", 1e3 * max(turns), "ms", at_most=50)
    assert len(turns) > 20  # the library would have blocked them until the end
    assert leftovers() == 0
    faults.reset()
    with URArm(config(), "left") as arm:
        assert arm.status() == ArmStatus.HOLD


def test_connect_wrong_model_raises(mock: MockUR) -> None:
    with pytest.raises(DeviceNotConnectedError, match="arm 'left' is a UR5, but its file says model: ur10e"):
        URArm(config().model_copy(update={"model": "ur10e"}), "left").close()


def test_connect_mock_as_real_raises(mock: MockUR, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(DeviceNotConnectedError, match="outside this machine"):
        URArm(config("192.0.2.7"), "left").close()
    for host in (HOST, "localhost", "127.0.0.1", "::1"):
        with pytest.raises(DeviceNotConnectedError, match="is this machine"):
            URArm(config(host, mock=None), "left").close()
    with pytest.raises(DeviceNotConnectedError, match=r"`simulator: true`.*outside this machine"):
        URArm(config("192.0.2.7", mock=None, simulator=True), "left").close()
    with pytest.raises(DeviceNotConnectedError, match="is a mock controller"):  # no simulator of the maker
        URArm(config(mock=None, simulator=True), "left").close()
    assert MOCK_SERIAL  # a mock that is reached under another address gives itself away
    monkeypatch.setattr(ur, "check_host", lambda *_: None)
    with pytest.raises(DeviceNotConnectedError, match="is a mock controller"):
        URArm(config(mock=None), "left").close()
