"""Clocks of rigs with hardware: the wall clock, and lock step for mock rigs. Both count time.monotonic()."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Protocol, cast

import numpy as np

from robot.rig.commanded_arm import CommandedArm, wait_for_arrival
from tacsim.interface import TactileFrame, TactileSource
from tacsim.models.driver import Companion

FORCE_DELAY = 10e-3  # from setting a force of a mock controller until its packages contain it [s]


class _MonotonicClock:
    def __init__(self, period: float) -> None:
        self.period = period  # [s]

    def now(self) -> float:
        return time.monotonic()


class WallClock(_MonotonicClock):
    """Ticks at a fixed rate. Missed periods are skipped and counted.

    wait_for_fresh_step: waits until the simulation of a mock cell, if there is one, has followed the arms.
    real_time: images and forces arrive in real time; a simulation may be slower.
    """

    def __init__(
        self, period: float, wait_for_fresh_step: Callable[[], None] | None = None, *, real_time: bool = True
    ) -> None:
        super().__init__(period)
        self._wait_for_fresh_step, self.real_time = wait_for_fresh_step, real_time
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
        """Waits until packages and images of the present poses have arrived: one period, at least 0.1 s."""
        if self._wait_for_fresh_step is not None:
            self._wait_for_fresh_step()
        time.sleep(max(0.1, self.period))

    def restart(self) -> None:
        """The next tick ends one period after its call."""
        self._deadline = self._last = None

    def diagnostics(self) -> dict[str, float]:
        if not self.periods:
            return {}
        median, p99, longest = np.percentile(self.periods, [50, 99, 100])
        return {"period_median": median, "period_p99": p99, "period_max": longest, "periods_late": float(self.late)}


class NumberedSource(Protocol):
    """A sensor whose images carry the numbers that a companion assigns."""

    def wait_for(self, image_number: int, timeout: float) -> TactileFrame: ...


class LockStep(_MonotonicClock):
    """A period ends when the arms rest at their targets and the cell has rendered the images of that pose."""

    real_time = False

    def __init__(
        self,
        period: float,
        arms: Mapping[str, CommandedArm],
        sensors: Mapping[str, TactileSource],
        companion: Companion,
    ) -> None:
        """sensors: those whose images the companion renders; each is a NumberedSource."""
        super().__init__(period)
        self._arms, self._companion = arms, companion
        self._sensors = {name: cast(NumberedSource, sensor) for name, sensor in sensors.items()}

    def tick(self) -> None:
        """Raises DeviceError if an arm does not arrive or is stopped, the cell fails, or an image does not arrive."""
        arrival_timeout = 10.0  # longest motion of a control period in lock step [s]
        wait_for_arrival(self._arms, arrival_timeout)
        self.wait_for_data()

    def wait_for_data(self) -> None:
        """Moves the cell to the poses of the arms, and waits until forces and images have arrived over the wire."""
        for name, number in self._companion.step(pause=FORCE_DELAY).items():
            self._sensors[name].wait_for(number, timeout=5.0)

    def restart(self) -> None:
        """Does nothing: nothing runs between ticks."""

    def diagnostics(self) -> dict[str, float]:
        return {}
