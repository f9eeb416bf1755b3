"""The driver of a UR arm whose worker is suspended in motion: what the arm itself does, as an observer sees it.

While no target comes, the controller lets the arm run out by its own law; what is judged begins with the first new
target. Targets and control periods are not in step: one target more or less in a period is a step of the arm's speed,
whatever the worker does, so accelerations are taken over WINDOW, and so much is allowed at its begin and end.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from robot.arm.trajectory import PERIOD
from robot.arm.ur import URArm
from robot.mock import MockUR
from tests.promises import Record
from tests.robot.arm.mocked import at_full_speed, config, moved, sensor_path, servo_targets, servo_ticks
from tests.robot.waiting import PATIENCE, until
from tests.stops import observer

WINDOW = 20  # periods
BEFORE = 6  # periods before it in which targets came, too: so long the joints of the mock take to follow
LONG = 20  # periods without a target after which an arm has lost more than half of its speed
MEMORY = 45  # periods that several targets in one of them (the controller's process was late) change the arm's speed
ROOT = Path(__file__).resolve().parents[3]


def judged(seen: np.ndarray, joints: np.ndarray, ticks: np.ndarray, ahead: int) -> np.ndarray:
    """(n,) packages with which a window begins that can be judged: in each of its control periods, and of those before,
    a new target came, one more or less; and in none of the periods longer before were there several."""
    at = np.round(seen["timestamp"] / PERIOD).astype(int) + ahead
    new = ticks[1:][(joints[1:] != joints[:-1]).any(axis=1)]
    first = min(at[0], new[0]) - MEMORY
    surplus = np.cumsum(np.bincount(new - first, minlength=max(at[-1], new[-1]) - first + 1) - 1)
    found = []
    for k in np.flatnonzero(at[WINDOW:] - at[:-WINDOW] == WINDOW):
        begin = at[k] - first
        there, before = surplus[begin - BEFORE : begin + WINDOW], surplus[max(0, begin - MEMORY) : begin]
        if np.ptp(there) <= 1 and (before - np.minimum.accumulate(before)).max() <= 1:
            found.append(k)
    return np.array(found)


@pytest.mark.slow
@pytest.mark.promise(2)
@pytest.mark.parametrize(
    "stalls", [(0.08,), pytest.param((0.02, 0.03, 0.05, 0.07, 0.09), marks=pytest.mark.deep)], ids=["80 ms", "several"]
)
def test_worker_after_stall_keeps_arm_limits(
    mock: MockUR, measuring: bool, figure: Record, tmp_path: Path, stalls: tuple[float, ...]
) -> None:
    file = tmp_path / "seen.npy"
    words = [sys.executable, observer.__file__, mock.host, str(file)]
    with (
        URArm(config(realtime=measuring), "left") as arm,
        subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=ROOT) as watching,
    ):
        assert watching.stdout is not None and watching.stdout.readline() == "ready\n"
        limits, start = arm.config.limits, arm.state().pose
        state = mock.faults.state()
        ahead, since = state.tick - round(state.time / PERIOD), mock.faults.received().last
        assert arm.worker is not None
        for k, stall in enumerate(stalls):
            at_full_speed(arm, moved(start, x=-0.12 * (-1) ** k))
            os.kill(arm.worker.pid, signal.SIGSTOP)
            time.sleep(stall)
            os.kill(arm.worker.pid, signal.SIGCONT)
            time.sleep(0.3)  # until it is at full speed again
        arm.stop()
        until(arm.at_rest, "rest")
        sent = mock.faults.received(since)
        left_out = mock.faults.state().overruns - state.overruns  # control periods, by a machine that is too busy
        watching.communicate(timeout=PATIENCE)
        assert not arm.status().is_fault
    assert sent.lost == 0
    joints, ticks = servo_targets(sent.entries), servo_ticks(sent.entries)
    path = sensor_path(arm, joints)[:, :3, 3]
    steps = np.linalg.norm(np.diff(path, axis=0), axis=1)  # of target k + 1
    long = np.flatnonzero(np.diff(ticks) >= LONG)
    assert len(long) >= sum(stall >= 2 * LONG * PERIOD for stall in stalls) or left_out > 0
    for k in long[steps[long - 1] > 0.5 * limits.speed * PERIOD]:
        # The speed is that of the arm; one target may have been in transit when the process was stopped.
        new = steps[k:][steps[k:] > 0.0]
        assert min(new[:2]) < 0.5 * steps[k - 1]
    seen = np.load(file)
    begin = judged(seen, joints, ticks, ahead)
    if not len(begin):
        return  # on a machine that is too busy targets come in heaps, and the arm follows those
    velocity = seen["velocity"]
    found = np.linalg.norm(velocity[begin + WINDOW] - velocity[begin], axis=1).max() / (WINDOW * PERIOD)
    one_target = limits.speed * PERIOD / arm.config.lookahead  # [m/s]
    allowed = 1.05 * limits.acceleration + 2.0 * one_target / (WINDOW * PERIOD)
    figure("acceleration of the arm itself, over 40 ms, with a stalled worker", found, "m/s²", at_most=allowed)
    assert found <= allowed
    assert np.linalg.norm(velocity[begin], axis=1).max() <= limits.speed + one_target
