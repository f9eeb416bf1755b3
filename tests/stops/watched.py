"""A user's program that moves an arm through a network that fails, and an observer of what the arm then does."""

from __future__ import annotations

import contextlib
import json
import os
import queue
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np

from robot.arm.status import ArmStatus
from robot.arm.trajectory import PERIOD
from robot.mock import MockUR
from tests.promises import Record
from tests.robot.arm.mocked import config
from tests.robot.waiting import PATIENCE, until
from tests.stops.observer import PACKAGE

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
PROXY = f"127.24.{os.getpid() >> 8 & 255}.{os.getpid() & 255}"
LINK_TIMEOUT = 1.0  # of a patient arm [s]
GOES = 0.28  # how far the arm is sent [m]
BEGINS = 20.0  # it is under way after so long, if the machine lets it [s]
BEFORE = 0.08  # it has gone so far when something happens [m]
FAST, BUSY_FAST = 0.08, 0.02  # and goes faster than that [m/s]: measured; on a machine so busy that it slows the arm
STILL, PACKAGES = 1e-3, 5  # the tool stands that is slower [m/s] for so many packages of 2 ms
PLAYING = 2  # runtime_state: a program runs
PORTS = {"RTDE": (30004,), "script": (30003,), "dashboard": (29999,), "all": (29999, 30001, 30002, 30003, 30004)}


@dataclass(frozen=True)
class Outcome:
    """What an observer saw of one event. Times since the event [s], by the controller's clock."""

    still: float  # first standstill
    path: float  # covered until then [m]
    moved: float  # farthest from there that it was later [m]
    ended: float | None  # when the program had ended for good; None: it runs at the end of the watch
    reported: float | None  # when the user's program saw another status; None: it never did
    statuses: tuple[str, ...]  # that it saw


class Trial:
    """The processes of one trial. `policy` is the user's program, `worker` the process id of its arm's worker."""

    def __init__(self, mock: MockUR, folder: Path, *, measuring: bool) -> None:
        # Measured are the time-outs as shipped; otherwise such that a busy machine is no fault.
        waits = (
            {"link_timeout": 0.05, "action_timeout": 0.2, "watchdog": 10.0}
            if measuring
            else {"link_timeout": LINK_TIMEOUT}
        )
        limits = {"workspace": {"lower": (-0.4, -0.9, 0.1), "upper": (0.4, -0.1, 0.9)}, "speed": 0.1}
        wanted = config(PROXY, realtime=measuring, **waits).model_dump()
        wanted["limits"] |= limits
        self.mock, self.file = mock, folder / "seen.npy"
        self.fast = FAST if measuring else BUSY_FAST
        self.lines: queue.Queue[str] = queue.Queue()
        self.worker: int | None = None
        self.start = np.array(mock.faults.state().pose[:3])  # read before a program can move the arm from there
        self.proxy = _start("proxy.py", PROXY, mock.host)
        self.observer = _start("observer.py", mock.host, str(self.file))
        assert _line(self.proxy) == _line(self.observer) == "ready"  # what a program connects to is there before it
        self.policy = _start("policy.py", json.dumps(wanted), str(GOES), start_new_session=True)
        self.reader = threading.Thread(target=self._read, daemon=True)
        self.reader.start()

    def begin(self) -> str | None:
        """Waits until the arm is on its way at full speed. What it does instead, if the driver has stopped it before
        that, it has come to its end, or it creeps, as happens on a machine that is too busy; else None."""
        faults = self.mock.faults
        self.worker = int(json.loads(self.lines.get(timeout=PATIENCE))["worker"])
        deadline = time.monotonic() + BEGINS
        while not self._faulted() and time.monotonic() < deadline:
            state = faults.state()
            far = float(np.linalg.norm(state.pose[:3] - self.start))
            if far > BEFORE and np.linalg.norm(state.tcp_speed[:3]) > self.fast:
                return None
            if far > 0.8 * GOES:
                break
            time.sleep(1e-3)
        return f"{faults.state()}; the program said {list(self.lines.queue)}"

    def _faulted(self) -> bool:
        return any(ArmStatus[json.loads(line)["status"]].is_fault for line in list(self.lines.queue))

    def network(self, **wish: Any) -> float:
        """Breaks the network (proxy.py says how); returns when."""
        assert self.proxy.stdin is not None
        self.proxy.stdin.write(json.dumps(wish) + "\n")
        self.proxy.stdin.flush()
        return float(_line(self.proxy))

    def cut(self, ports: tuple[int, ...]) -> float:
        """The controller itself resets all connections to these ports, and takes new ones at once."""
        now = time.monotonic()
        self.mock.faults.cut(ports, reset=True)
        return now

    def signal(self, process: int | None, number: signal.Signals, *, group: bool = False) -> float:
        assert process is not None
        now = time.monotonic()
        (os.killpg if group else os.kill)(process, number)
        return now

    def watch(self, event: float, seconds: float) -> Outcome:
        """What happened since the time `event` until now, and `seconds` [s] of the controller more after the first
        standstill."""
        until(lambda: self.mock.faults.state().rests, "rest", pause=0.05)
        end = self.mock.faults.state().tick + seconds / PERIOD
        self.watch_until(lambda: self.mock.faults.state().tick >= end)
        return outcome(self.seen(), event, self.reports(event))

    def watch_until(self, done: Callable[[], bool]) -> None:
        """Ends the observer when `done`."""
        until(done, "end of the watch", pause=0.05)
        assert self.observer.stdin is not None
        self.observer.stdin.close()
        assert self.observer.wait(PATIENCE) == 0

    def seen(self) -> np.ndarray:
        """PACKAGE (n,): what the observer saw, once it has ended."""
        return np.load(self.file)

    def reports(self, event: float) -> list[dict[str, Any]]:
        """What the user's program has said since the time `event` [s]."""
        said = [json.loads(line) for line in self._said()]
        return [each for each in said if each["time"] > event]

    def close(self) -> None:
        processes = (self.policy, self.proxy, self.observer)
        for pid in (*(process.pid for process in processes), self.worker):
            with contextlib.suppress(ProcessLookupError):
                if pid is not None:
                    os.kill(pid, signal.SIGKILL)  # also ends one that is stopped
        for process in processes:
            with process:  # closes its pipes
                process.wait()
        self.reader.join()

    def _said(self) -> Iterator[str]:
        while not self.lines.empty():
            yield self.lines.get()

    def _read(self) -> None:
        assert self.policy.stdout is not None
        for line in self.policy.stdout:
            self.lines.put(line)


def outcome(seen: np.ndarray, event: float, said: list[dict[str, Any]]) -> Outcome:
    """seen: PACKAGE (n,); event: monotonic [s]; said: what the user's program said after it."""
    assert seen.dtype == PACKAGE
    stamps = stamps_since(seen, event)
    assert np.diff(stamps).max() < 0.5, "the observer itself missed packages"
    speeds = np.linalg.norm(seen["velocity"], axis=1)
    now = int(np.searchsorted(stamps, 0.0))
    slow = np.convolve(speeds[now:] < STILL, np.ones(PACKAGES), "valid") == PACKAGES
    assert slow.any(), "the arm never stood"
    first = now + int(slow.argmax())
    rest = seen["position"][first + PACKAGES - 1]
    runs = np.flatnonzero(seen["runtime_state"] == PLAYING)
    return Outcome(
        still=float(stamps[first]),
        path=float(np.linalg.norm(np.diff(seen["position"][now : first + 1], axis=0), axis=1).sum()),
        moved=float(np.linalg.norm(seen["position"][first + PACKAGES - 1 :] - rest, axis=1).max()),
        ended=None if runs[-1] == len(seen) - 1 else float(max(stamps[runs[-1]], 0.0)),
        reported=said[0]["time"] - event if said else None,
        statuses=tuple(each["status"] for each in said),
    )


def stamps_since(seen: np.ndarray, event: float) -> np.ndarray:
    """(n,) times of packages (n,) since `event` (monotonic [s]), by the controller's clock [s]."""
    # The package that was on its way for the shortest time tells how the clocks stand to each other: of the last before
    # the event, because a mock on a busy machine leaves periods out.
    before = seen[seen["received"] <= event][-25:]
    return np.asarray(seen["timestamp"] - (event - (before["received"] - before["timestamp"]).min()))


SETTLES = 50e-6  # an arm slower than 1 mm/s settles to less [m]


def judge(event: str, seen: Outcome, figure: Record, *, goes_on: bool = False) -> None:
    """Records a row of the table of events, and checks what must hold on any machine.

    goes_on: the program may run on: the driver holds the arm, or was not disturbed at all."""
    if seen.reported is None and goes_on:
        figure(f"{event} · goes on", 1, "", at_most=None)
        return
    figure(f"{event} · still after", 1e3 * seen.still, "ms", at_most=None)
    figure(f"{event} · path", 1e3 * seen.path, "mm", at_most=None)
    if seen.reported is not None:
        figure(f"{event} · reported after", 1e3 * seen.reported, "ms", at_most=None)
    figure(f"{event} · moved after standstill", 1e3 * seen.moved, "mm", at_most=1e3 * SETTLES)
    figure(f"{event} · programs left running", float(seen.ended is None and not goes_on))
    assert seen.moved <= SETTLES, seen
    assert seen.ended is not None or goes_on, f"the program runs on: {seen}"


def _start(script: str, *words: str, start_new_session: bool = False) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, str(HERE / script), *words],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        start_new_session=start_new_session,
        text=True,
    )


def _line(process: subprocess.Popen[str]) -> str:
    stream: IO[str] | None = process.stdout
    assert stream is not None
    return stream.readline().strip()
