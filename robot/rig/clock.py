"""Clocks of rigs with hardware: the wall clock, and lock step for mock rigs. Both count time.monotonic()."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Protocol, cast

import numpy as np

from robot.rig.commanded_arm import CommandedArm, wait_for_arrival
from tacsim.interface import TactileFrame, TactileSource
from tacsim.models.driver import Companion

SETTLED = 10e-3  # a force given to a mock controller is in its packages after this time [s]


class _MonotonicClock:
    def __init__(self, period: float) -> None:
        self.period = period  # [s]

    def now(self) -> float:
        return time.monotonic()


class WallClock(_MonotonicClock):
    """Ticks at a fixed rate. Missed periods are skipped, and counted.

    catch_up: waits until the simulation of a mock cell, if there is one, has followed the arms.
    real_time: pictures and forces come as things happen; a simulation may be slower.
    """

    def __init__(self, period: float, catch_up: Callable[[], None] | None = None, *, real_time: bool = True) -> None:
        super().__init__(period)
        self._catch_up, self.real_time = catch_up, real_time
        self._deadline: float | None = None
        self.periods: list[float] = []  # of the last ticks [s]
        self.late = 0
        self._last: float | None = None

    def tick(self) -> None:
        now = time.monotonic()
        if self._deadline is None or now > self._deadline + self.period:
            self.late += self._deadline is not None
            self._deadline = now
        self._deadline += self.period
        time.sleep(max(0.0, self._deadline - time.monotonic()))
        beat = time.monotonic()
        if self._last is not None:
            self.periods = [*self.periods[-9999:], beat - self._last]
        self._last = beat

    def wait_for_data(self) -> None:
        """Waits until packages and pictures of what just happened have arrived: one period, at least 0.1 s."""
        if self._catch_up is not None:
            self._catch_up()
        time.sleep(max(0.1, self.period))

    def restart(self) -> None:
        """The next tick ends one period from then."""
        self._deadline = self._last = None

    def diagnostics(self) -> dict[str, float]:
        if not self.periods:
            return {}
        median, p99, longest = np.percentile(self.periods, [50, 99, 100])
        return {"period_median": median, "period_p99": p99, "period_max": longest, "periods_late": float(self.late)}


class NumberedSource(Protocol):
    """A sensor whose pictures carry the numbers that a companion gives them."""

    def wait_for(self, image_number: int, timeout: float) -> TactileFrame: ...


class LockStep(_MonotonicClock):
    """A period ends when the arms rest at their targets and the cell has drawn the pictures of just that pose."""

    real_time = False

    def __init__(
        self,
        period: float,
        arms: Mapping[str, CommandedArm],
        sensors: Mapping[str, TactileSource],
        companion: Companion,
    ) -> None:
        """sensors: those whose pictures the companion makes; each is a NumberedSource."""
        super().__init__(period)
        self._arms, self._companion = arms, companion
        self._sensors = {name: cast(NumberedSource, sensor) for name, sensor in sensors.items()}

    def tick(self) -> None:
        """Raises DeviceError: an arm does not arrive or is stopped, the cell fails, a picture does not come."""
        arrival_timeout = 10.0  # longest motion of a control period in lock step [s]
        wait_for_arrival(self._arms, arrival_timeout)
        self.wait_for_data()

    def wait_for_data(self) -> None:
        """Lets the cell follow, and waits until forces and pictures have arrived over the wire."""
        for name, number in self._companion.step(pause=SETTLED).items():
            self._sensors[name].wait_for(number, timeout=5.0)

    def restart(self) -> None:
        """Nothing runs between ticks."""

    def diagnostics(self) -> dict[str, float]:
        return {}
