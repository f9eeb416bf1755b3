"""Clocks of rigs with hardware: the wall clock, and lock step for mock rigs. Both count time.monotonic()."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping

import numpy as np

from robot.arm.ur import URArm
from robot.camera.camera import Camera
from robot.errors import DeviceError
from robot.mock.cell.cell import MockCell
from tacsim.interface import Pose

ARRIVE = 10.0  # longest way of a control period in lock step [s]
NEAR, TURN = 2e-6, 2e-5  # of the target: there [m, rad]
LOOK = 4e-3  # between two looks at arms on their way [s]
SETTLED = 10e-3  # so long after a controller was given a force, its packages tell of it [s]


class Driven:
    """An arm of the rig and where it was last asked to go."""

    def __init__(self, arm: URArm) -> None:
        self.arm = arm
        self.target: Pose | None = None

    def keep_going(self) -> bool:
        """Repeats the last command, so that it is not taken for stale; True once the arm rests there."""
        if self.target is None:
            return self.arm.at_rest()
        if self.arm.arrived(self.target, within=NEAR, turn=TURN):
            return True
        self.arm.command(self.target)
        return False


def drive(arms: Mapping[str, Driven], timeout: float) -> None:
    """Waits until all arms rest at their targets. Raises DeviceError after `timeout` [s], and what stops an arm."""
    deadline = time.monotonic() + timeout
    while waiting := [name for name, driven in arms.items() if not driven.keep_going()]:
        if time.monotonic() > deadline:
            name = waiting[0]
            raise DeviceError(
                f"arm '{name}' did not come to its target within {timeout:g} s; it {arms[name].arm.explain()}"
            )
        time.sleep(LOOK)


class WallClock:
    """Ticks at a fixed rate. A period that is missed is not made up for, but counted.

    catch_up: waits until what is simulated, if anything is, has seen where the arms are now.
    """

    def __init__(self, period: float, catch_up: Callable[[], None] | None = None) -> None:
        self._period, self._catch_up = period, catch_up
        self._deadline: float | None = None
        self.periods: list[float] = []  # of the last ticks [s]
        self.late = 0
        self._last: float | None = None

    @property
    def period(self) -> float:
        return self._period

    def now(self) -> float:
        return time.monotonic()

    def tick(self) -> None:
        now = time.monotonic()
        if self._deadline is None or now > self._deadline + self._period:
            self.late += self._deadline is not None
            self._deadline = now
        self._deadline += self._period
        time.sleep(max(0.0, self._deadline - time.monotonic()))
        beat = time.monotonic()
        if self._last is not None:
            self.periods = [*self.periods[-9999:], beat - self._last]
        self._last = beat

    def look(self) -> None:
        """Lets packages and pictures of what just happened arrive: one period, at least 0.1 s."""
        if self._catch_up is not None:
            self._catch_up()
        time.sleep(max(0.1, self._period))

    def restart(self) -> None:
        """The next tick ends one period from then."""
        self._deadline = self._last = None

    def diagnostics(self) -> dict[str, float]:
        if not self.periods:
            return {}
        median, p99, longest = np.percentile(self.periods, [50, 99, 100])
        return {"period_median": median, "period_p99": p99, "period_max": longest, "periods_late": float(self.late)}


class LockStep:
    """A period ends when the arms rest at their targets and the cell has drawn the pictures of just that pose."""

    def __init__(
        self, period: float, arms: Mapping[str, Driven], cameras: Mapping[str, Camera], cell: MockCell
    ) -> None:
        self._period, self._arms, self._cameras, self._cell = period, arms, cameras, cell

    @property
    def period(self) -> float:
        return self._period

    def now(self) -> float:
        return time.monotonic()

    def tick(self) -> None:
        """Raises DeviceError: an arm does not arrive or is stopped, the cell fails, a picture does not come."""
        drive(self._arms, ARRIVE)
        self.look()

    def look(self) -> None:
        """Lets the cell follow, and waits until forces and pictures have arrived over the wire."""
        for name, number in self._cell.step(pause=SETTLED).items():
            self._cameras[name].wait_for(number, timeout=5.0)

    def restart(self) -> None:
        """Nothing runs between ticks."""

    def diagnostics(self) -> dict[str, float]:
        return {}
