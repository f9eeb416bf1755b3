"""Clocks of rigs with hardware, on a time of the tests' own."""

from __future__ import annotations

import threading
from typing import Any

import numpy as np
import pytest

from robot.errors import DeviceError, ProtectiveStop
from robot.mock.cell.cell import MockCell
from robot.rig import commanded_arm
from robot.rig import hardware_rig as clocks
from robot.rig.commanded_arm import CommandedArm, wait_for_arrival
from robot.rig.hardware_rig import LockStep, WallClock
from tacsim.interface import Pose

PERIOD = 0.1  # [s]


class Time:
    """Passes only in sleep, or in work."""

    def __init__(self) -> None:
        self.now = 100.0

    def monotonic(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        assert seconds >= 0.0
        self.now += seconds


@pytest.fixture
def time(monkeypatch: pytest.MonkeyPatch) -> Time:
    made = Time()
    monkeypatch.setattr(clocks, "time", made)
    monkeypatch.setattr(commanded_arm, "time", made)
    return made


class StubArm:
    """Needs some commands to get there."""

    def __init__(self, needs: int = 3, error: Exception | None = None) -> None:
        self.commands: list[Pose] = []
        self._needs, self._error = needs, error

    def at_rest(self) -> bool:
        return True

    def arrived(self, target: Pose, **within: float) -> bool:
        return len(self.commands) >= self._needs

    def command(self, target: Pose, speed: float | None = None) -> Pose:
        if self._error is not None:
            raise self._error
        self.commands.append(target)
        return target

    def explain(self) -> str:
        return "arm 'right' follows its target"


def commanded(arm: StubArm, target: Pose | None = None) -> CommandedArm:
    made = CommandedArm(arm)  # type: ignore[arg-type]
    made.target = target
    return made


def test_wall_clock_ticks_keep_period(time: Time) -> None:
    clock = WallClock(PERIOD)
    ends = []
    for work in (0.0, 0.03, 0.09, 0.05):
        time.now += work
        clock.tick()
        ends.append(clock.now())
    assert np.diff(ends) == pytest.approx([PERIOD] * 3)
    assert clock.diagnostics()["period_median"] == pytest.approx(PERIOD)
    assert clock.late == 0


def test_wall_clock_missed_period_is_counted_and_skipped(time: Time) -> None:
    clock = WallClock(PERIOD)
    clock.tick()
    time.now += 0.35
    before = clock.now()
    clock.tick()
    clock.tick()
    assert clock.now() - before == pytest.approx(2 * PERIOD)  # no burst of short periods
    assert clock.late == 1
    assert clock.diagnostics()["period_max"] == pytest.approx(0.45)


def test_wall_clock_restart_ignores_reset_time(time: Time) -> None:
    clock = WallClock(PERIOD)
    clock.tick()
    time.now += 30.0
    clock.restart()
    before = clock.now()
    clock.tick()
    assert clock.now() - before == pytest.approx(PERIOD)
    assert clock.late == 0 and clock.periods == []


def test_wall_clock_waits_at_least_100_ms_for_data(time: Time) -> None:
    for period, wanted in ((0.02, 0.1), (0.5, 0.5)):
        before = time.now
        WallClock(period).wait_for_data()
        assert time.now - before == pytest.approx(wanted)


def test_wait_for_arrival_repeats_command_until_arrival(time: Time) -> None:
    arms = {"left": StubArm(3), "right": StubArm(7)}
    target = Pose(np.array([1.0, 2.0, 3.0]))
    wait_for_arrival({name: commanded(arm, target) for name, arm in arms.items()}, timeout=1.0)
    assert [len(arm.commands) for arm in arms.values()] == [3, 7]
    assert all(sent is target for arm in arms.values() for sent in arm.commands)


def test_wait_for_arrival_without_target_sends_nothing(time: Time) -> None:
    arm = StubArm()
    wait_for_arrival({"left": commanded(arm)}, timeout=1.0)
    assert arm.commands == []


def test_wait_for_arrival_timeout_names_arm(time: Time) -> None:
    arms = {"left": commanded(StubArm(0), Pose()), "right": commanded(StubArm(10**9), Pose())}
    before = time.now
    with pytest.raises(
        DeviceError, match=r"arm 'right' did not reach its target within 2 s: arm 'right' follows its target"
    ):
        wait_for_arrival(arms, timeout=2.0)
    assert time.now - before == pytest.approx(2.0, abs=0.02)


def test_wait_for_arrival_raises_stop_of_arm(time: Time) -> None:
    with pytest.raises(ProtectiveStop):
        wait_for_arrival({"left": commanded(StubArm(error=ProtectiveStop("stopped")), Pose())}, timeout=2.0)


def test_lock_step_waits_for_arms_then_forces_then_images(time: Time) -> None:
    log: list[object] = []

    class Cell:
        def step(self, pause: float) -> dict[str, int]:
            log.append(("step", len(arm.commands), pause))
            return {"finger": 17}

    class StubCamera:
        def wait_for(self, number: int, timeout: float) -> None:
            log.append(("picture", number))

    arm = StubArm(4)
    stubs: Any = ({"left": commanded(arm, Pose())}, {"finger": StubCamera()}, Cell())
    clock = LockStep(PERIOD, *stubs, late_images=2)
    clock.tick()
    step = [("step", 4, clocks.FORCE_DELAY), ("picture", 17)]
    assert log == step
    clock.wait_for_data()  # outside an episode also of late images
    assert log == 4 * step
    assert clock.period == PERIOD and clock.diagnostics() == {}


def test_wall_clock_waits_for_simulator_first() -> None:
    """Else an approach would go on while the simulator is busy with the first touch."""
    seen: list[str] = []
    WallClock(PERIOD, lambda: seen.append("caught up")).wait_for_data()
    assert seen == ["caught up"]


def test_wait_for_fresh_step_needs_later_step_and_raises_failure() -> None:
    cell = object.__new__(MockCell)
    cell._steps, cell._failure = 5, None

    def step() -> None:
        cell._steps += 1

    timers = [threading.Timer(0.05 * k, step) for k in (1, 2)]
    for timer in timers:
        timer.start()
    cell.wait_for_fresh_step()
    assert cell._steps == 7
    cell._failure = RuntimeError("no more")
    with pytest.raises(DeviceError, match="no more"):
        cell.wait_for_fresh_step()
