"""Reliability cases of an arm and others: a second driver, peers that do not answer, a second arm."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial

import numpy as np

from benchmarks.harness.measure import Measurement
from benchmarks.reliability.rehearsal import (
    BASE,
    Watcher,
    config,
    driven,
    host,
    mock_arm,
    moved,
    still,
    under_way,
    until,
)
from benchmarks.reliability.repeated import COUNT, Figure, repeated
from robot.arm.channel import ArmStatus
from robot.arm.ur import URArm
from robot.errors import DeviceBusyError, DeviceError
from robot.mock import FaultClient, MockUR

WINDOW = 1.02  # the worker's statistics are of 500 periods [s]
KEEP_OUT = 0.04  # of two arms that begin 60 mm apart [m]


def second_commander(repeat: int) -> list[Measurement]:
    """A second driver for an arm that is under way with the first."""
    there = False

    def once() -> dict[str, float]:
        nonlocal there
        target = moved(start, x=0.0 if there else 0.1)
        there = not there
        under_way(arm, target)
        asked = time.monotonic()
        try:
            URArm(config(mock.host), "second").close()
            raise RuntimeError("a second driver was let in")
        except DeviceBusyError:
            told = time.monotonic()
        records = watcher.records()
        disturbed = bool((records["status"][records["written"] > asked] != ArmStatus.OK).any())
        until(lambda: arm.arrived(target), "arrival")
        return {"told": told - asked, "disturbed": float(disturbed)}

    with mock_arm() as mock, driven(mock) as (arm, watcher):
        start = arm.state().pose
        return repeated(
            repeat,
            once,
            [
                Figure("told", "s", "DeviceBusyError after the call"),
                Figure("disturbed", COUNT, "first drivers that did not go on under way"),
            ],
        )


@contextmanager
def heartbeat() -> Iterator[Callable[[], float]]:
    """How long another thread of this process had to wait for its turn at most, beyond its own millisecond [s]."""
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
    try:
        yield lambda: max(gaps)
    finally:
        over.set()
        thread.join()


def connecting(repeat: int) -> list[Measurement]:
    """Connecting to a peer that refuses, swallows everything, or never sends a package, while a thread beats time."""
    timeout = 0.6

    def once(peer: str, fault: Callable[[FaultClient], None] | None) -> dict[str, float]:
        mock.faults.reset()
        if fault is not None:
            fault(mock.faults)
        with heartbeat() as gap:
            asked = time.monotonic()
            try:
                URArm(config(host(1 if fault else 9)), "nobody", timeout=timeout).close()
                raise RuntimeError(f"connected to a peer that is {peer}")
            except DeviceError:
                ended = time.monotonic()
            return {f"{peer}: blocked": 1e3 * gap(), f"{peer}: told": 1e3 * max(0.0, ended - asked - timeout)}

    peers: dict[str, Callable[[FaultClient], None] | None] = {
        "silent": lambda faults: faults.silence(True),
        "refusing": None,
        "black hole": lambda faults: faults.black_hole(True),
    }
    rows = []
    with mock_arm() as mock:
        for peer, fault in peers.items():
            against = f"a thread that wakes each millisecond; time-out {timeout:g} s"
            told = Figure(f"{peer}: told", "ms", "the time-out; the error comes so much later")
            rows += repeated(repeat, partial(once, peer, fault), [Figure(f"{peer}: blocked", "ms", against), told])
    return rows


@contextmanager
def two_arms(speed: float) -> Iterator[tuple[URArm, URArm, Watcher, Watcher, MockUR, MockUR]]:
    """Two arms whose sensors are 60 mm apart along x and must stay KEEP_OUT apart."""
    shifted = BASE.model_copy(update={"position": (BASE.position[0] + 0.06, *BASE.position[1:])})
    with ExitStack() as stack:
        left_mock, right_mock = stack.enter_context(mock_arm(1)), stack.enter_context(mock_arm(2))
        limits = {"speed": speed}
        left = stack.enter_context(URArm(config(left_mock.host, limits), "left", keep_out={"right": KEEP_OUT}))
        right_facts = config(right_mock.host, limits, world_from_base=shifted)
        right = stack.enter_context(URArm(right_facts, "right", keep_out={"left": KEEP_OUT}))
        until(lambda: left.status() == right.status() == ArmStatus.HOLD, "each arm to see the other")
        watchers = stack.enter_context(Watcher("left")), stack.enter_context(Watcher("right"))
        yield left, right, *watchers, left_mock, right_mock


EMPTY = """
import time
import numpy as np
from robot.common.realtime import WORKER, ask_for_realtime
ask_for_realtime(WORKER)
beats = [time.monotonic()]
deadline = beats[0] + 2e-3
while len(beats) <= 500:
    time.sleep(max(0.0, deadline - time.monotonic()))
    beats.append(time.monotonic())
    deadline = max(deadline + 2e-3, beats[-1])
print(1e3 * np.percentile(np.diff(beats), 99))
"""


def empty_loop() -> float:
    """99th percentile of the period [ms] of a 2 ms loop that does nothing, as privileged as a worker: no loop on this
    machine keeps better time."""
    done = subprocess.run([sys.executable, "-c", EMPTY], capture_output=True, text=True, timeout=30, check=True)
    return float(done.stdout)


def rate(repeat: int) -> list[Measurement]:
    """The 500 Hz loops of two arms that see each other and move; and a loop that does nothing, on the same machine."""
    way = 0.04

    def once() -> dict[str, float]:
        nonlocal way
        left.command(moved(a, x=-abs(way), z=way))
        right.command(moved(b, x=abs(way), z=way))
        way = -way
        time.sleep(WINDOW)
        both = left.timing(), right.timing()
        found = {"p99": 1e3 * max(each.p99 for each in both), "median": 1e3 * max(each.median for each in both)}
        return found | {"empty loop": empty_loop()}

    with two_arms(0.05) as (left, right, *_):
        a, b = left.state().pose, right.state().pose
        time.sleep(WINDOW)
        against = "2 ms; the slower of both loops, 500 periods"
        empty = Figure("empty loop", "ms", "2 ms; 99th percentile of a loop that does nothing")
        return repeated(repeat, once, [Figure("p99", "ms", against), Figure("median", "ms", against), empty])


def keep_out(repeat: int) -> list[Measurement]:
    """Two arms head on, then one of them gets a protective stop while both are under way."""

    def once() -> dict[str, float]:
        least = 1.0
        end = time.monotonic() + 0.6
        while time.monotonic() < end:
            left.command(moved(a, x=0.05))
            right.command(moved(b, x=-0.05))
            time.sleep(5e-3)
            gap = left_watcher.newest()["position"] - right_watcher.newest()["position"]
            least = min(least, float(np.linalg.norm(gap)))
        until(lambda: left.at_rest() and right.at_rest(), "rest before each other")
        right.command(moved(b, x=0.1))
        under_way(left, moved(a, x=-0.1))
        right_mock.faults.protective_stop()
        until(lambda: left.status().is_fault and right.status().is_fault, "both stops")
        faults = []
        for watcher, status in ((left_watcher, ArmStatus.PARTNER_STOPPED), (right_watcher, ArmStatus.PROTECTIVE_STOP)):
            records = watcher.records()
            faults.append(float(records[records["status"] == status][0]["written"]))
        until(lambda: still(left_mock.faults.state()) and right_mock.faults.state().rests, "rest")
        right.recover()
        left.recover()
        until(lambda: left.status() == right.status() == ArmStatus.HOLD, "each arm to see the other")
        for arm, home in ((left, a), (right, b)):
            arm.command(home)
        until(lambda: left.arrived(a) and right.arrived(b), "return")
        return {"breach": 1e3 * max(0.0, KEEP_OUT - least), "skew": 1e3 * max(0.0, faults[0] - faults[1])}

    with two_arms(0.05) as (left, right, left_watcher, right_watcher, left_mock, right_mock):
        a, b = left.state().pose, right.state().pose
        return repeated(
            repeat,
            once,
            [
                Figure("breach", "mm", f"{1e3 * KEEP_OUT:g} mm between the sensors, measured, both at 50 mm/s"),
                Figure("skew", "ms", "the stop of the one, told by its worker, until the other's worker stops"),
            ],
        )
