"""Speed and acceleration of the arm itself, as an observer of its own process sees it, when its controller slows it
down, stops, stalls, or cannot move it. An arm that does not follow is a fault, and moves again only after recover().

Targets and control periods are not in step: one target more or less in a period is a step of the arm's speed, whatever
the worker does. So accelerations are taken over WINDOW, and one target more is allowed in it. Only windows in
which both processes kept their periods are judged: on a busy machine there are few. Deceleration between a stop and the
first standstill after it is the controller's, or that of a fault, and is not judged; nor is that of an arm that runs
out to its last target while no new one comes.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from robot.arm.status import ArmStatus
from robot.arm.trajectory import PERIOD
from robot.arm.ur import URArm
from robot.arm.worker import MAX_MISSED_PACKAGES
from robot.mock import FaultClient, MockUR
from tacsim.interface import Pose
from tests.promises import Record
from tests.robot.arm.mocked import at_full_speed, config, moved, servo_ticks
from tests.robot.waiting import PATIENCE, until
from tests.stops import observer
from tests.stops.test_ends_and_stops import pendant

ROOT = Path(__file__).resolve().parents[2]
WINDOW, BEFORE = 20, 6  # periods that are judged, and before them those in which targets must have come, too
SETTLES = 50e-6  # an arm slower than 1 mm/s settles to less [m]
RELEASED = 0.3  # how long it is watched before recover() [s]


def slide(*fractions: float) -> Callable[[FaultClient], None]:
    def work(faults: FaultClient) -> None:
        for fraction in fractions:
            faults.slider(fraction)
            time.sleep(0.8)

    return work


def hold(faults: FaultClient) -> None:
    faults.hold()
    time.sleep(0.5)
    faults.hold(False)


def lag(faults: FaultClient) -> None:
    faults.joint_lag(0, 0.2)
    time.sleep(0.5)
    faults.joint_lag(0, 4e-3)


@dataclass(frozen=True)
class Event:
    """What happens to an arm at full speed, and what its status then is."""

    work: Callable[[FaultClient], None]
    status: ArmStatus
    runs_out: float = 0.0  # so long no new target may come, and the arm runs out to the last one by servoj's law [s]


EVENTS = {
    "slider 100, 0, 100 %": Event(slide(0.0, 1.0), ArmStatus.OK),
    "slider 100, 10, 100 %": Event(slide(0.1, 1.0), ArmStatus.OK),
    # The targets sent during the stall all arrive in one period, and each adds to the speed of the arm.
    "controller stalled for 80 ms": Event(lambda faults: faults.tick_overrun(0.08), ArmStatus.OK, runs_out=0.06),
    "pause, play after 40 ms": Event(lambda faults: pendant(faults, "pause", "play"), ArmStatus.PROGRAM_STOPPED),
    "protective stop": Event(lambda faults: faults.protective_stop(), ArmStatus.PROTECTIVE_STOP),
    "tool held for 0.5 s": Event(hold, ArmStatus.NOT_FOLLOWING),
    "a joint that lags by 0.2 s": Event(lag, ArmStatus.NOT_FOLLOWING),
}
STANDARD = ("slider 100, 0, 100 %", "tool held for 0.5 s")  # what every run of the tests sees


@contextmanager
def observed(mock: MockUR, file: Path) -> Iterator[None]:
    words = [sys.executable, observer.__file__, mock.host, str(file)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment) as process:
        assert process.stdout is not None and process.stdout.readline() == "ready\n"
        yield
        process.communicate(timeout=PATIENCE)


def recover_and_move(arm: URArm, mock: MockUR, start: Pose) -> tuple[float, float]:
    """Waits for rest, and goes on by recover(). Returns when the arm rested and when it was recovered, by the
    controller's clock [s]."""
    until(lambda: mock.faults.state().rests, "rest")
    rested = mock.faults.state().time
    time.sleep(RELEASED)
    until(lambda: mock.faults.state().time > rested + RELEASED, "the watch")
    recovered = mock.faults.state().time
    arm.recover()
    at_full_speed(arm, moved(start, x=-0.1))
    return rested, recovered


def judged(seen: np.ndarray, ticks: np.ndarray, ahead: int) -> np.ndarray:
    """(n,) packages with which a window begins in which each control period had its target, one more or less."""
    at = np.round(seen["timestamp"] / PERIOD).astype(int) + ahead
    first = min(at[0], ticks[0]) - WINDOW
    surplus = np.cumsum(np.bincount(ticks - first, minlength=max(at[-1], ticks[-1]) - first + 1) - 1)
    whole = np.flatnonzero(at[WINDOW:] - at[:-WINDOW] == WINDOW)
    return np.array(
        [k for k in whole if np.ptp(surplus[at[k] - first - BEFORE : at[k] - first + WINDOW]) <= 1], dtype=int
    )


def largest_heap(ticks: np.ndarray) -> int:
    """How many targets more than control periods have arrived within WINDOW periods, at most. Each of them adds to the
    speed of the arm as much as one target more in a period."""
    surplus = np.cumsum(np.bincount(ticks - ticks[0]) - 1)
    before = np.lib.stride_tricks.sliding_window_view(np.pad(surplus, (WINDOW, 0), mode="edge"), WINDOW + 1)
    return int((surplus - before.min(axis=1)).max())


@pytest.mark.slow
@pytest.mark.promise(2)
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name in STANDARD else pytest.mark.deep) for name in EVENTS]
)
def test_the_measured_arm_stays_within_its_limits(
    controller: MockUR, measuring: bool, name: str, figure: Record, tmp_path: Path
) -> None:
    event, file = EVENTS[name], tmp_path / "seen.npy"
    controller.faults.reset()
    with URArm(config(realtime=measuring), "left") as arm, observed(controller, file):
        limits, start = arm.config.limits, arm.state().pose
        state, since = controller.faults.state(), controller.faults.received().last
        at_full_speed(arm, moved(start, x=0.12))
        began = controller.faults.state().time
        event.work(controller.faults)
        if event.status.is_fault:
            until(lambda: arm.status().is_fault, "fault")
            assert arm.status() == event.status, arm.explain()
            rested, recovered = recover_and_move(arm, controller, start)
        else:
            until(lambda: arm.arrived(moved(start, x=0.12)), "arrival", why=arm.explain)
            assert arm.status() == event.status
            rested = recovered = began + event.runs_out
        sent = controller.faults.received(since)
    assert sent.lost == 0
    seen = np.load(file)
    stamps, speed = seen["timestamp"], np.linalg.norm(seen["velocity"], axis=1)
    quiet = (stamps >= rested) & (stamps <= recovered)
    assert not event.status.is_fault or np.linalg.norm(np.ptp(seen["position"][quiet], axis=0)) <= SETTLES
    begin = judged(seen, servo_ticks(sent.entries), state.tick - round(state.time / PERIOD))
    braked = (stamps[begin + WINDOW] > began) & (stamps[begin] < rested)
    one_target = limits.speed * PERIOD / arm.config.lookahead  # [m/s]
    if not len(begin):
        return  # on a machine that is too busy targets come in heaps, and the arm follows those
    fastest = float(speed.max() if event.runs_out else speed[begin].max()) / limits.speed
    heap = largest_heap(servo_ticks(sent.entries)) if event.runs_out else 1
    most = 1.0 + heap * one_target / limits.speed
    begin = begin[~braked]
    change = np.linalg.norm(seen["velocity"][begin + WINDOW] - seen["velocity"][begin], axis=1) / (WINDOW * PERIOD)
    hardest = float(change.max()) / limits.acceleration
    margin = one_target / (WINDOW * PERIOD) / limits.acceleration
    figure(f"measured speed, of the limit: {name}", 100 * fastest, "%", at_most=100 * most)
    figure(f"measured acceleration over 40 ms, of the limit: {name}", 100 * hardest, "%", at_most=100 * (1.05 + margin))
    assert heap <= 3 * MAX_MISSED_PACKAGES  # the worker stops sending when no package comes; a busy machine is late
    assert fastest <= most
    assert hardest <= 1.05 + margin
