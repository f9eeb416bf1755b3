"""An arm of hardware as a rig has it: it remembers where it was sent, and counts the limits that it hit."""

from __future__ import annotations

import time
from collections.abc import Mapping

from robot.errors import DeviceError
from tacsim import pose as se3
from tacsim.interface import ArmState, HardwareArm, Pose
from tacsim.limits import ActionError


class CommandedArm:
    """Implements tacsim.interface.Arm; the target it was sent last is what the clock waits for.

    dry_run: no motion is ever sent.
    """

    def __init__(self, driver: HardwareArm, *, dry_run: bool = False) -> None:
        self.driver, self._dry_run = driver, dry_run
        self.target: Pose | None = None
        self.limits_hit = 0  # targets that were shortened or refused

    def state(self, at: float | None = None) -> ArmState:
        """Raises DeviceError for a moment that no state covers."""
        return self.driver.state(at)

    def command(self, target: Pose | None) -> Pose | None:
        """In a dry run nothing is sent, and None says so."""
        max_shift = 1e-7  # a target that was changed by more counts as shortened [m, rad]
        if self._dry_run:
            return None
        try:
            sent = self.send(target)
        except ActionError:
            self.limits_hit += 1
            raise
        self.limits_hit += target is not None and sent is not None and max(se3.pose_distance(target, sent)) > max_shift
        return sent

    def send(self, target: Pose | None, speed: float | None = None) -> Pose | None:
        """`command` for motions of a reset, which count no limits, at most at `speed` [m/s]."""
        self.target = self.driver.command(target, speed)
        return self.target

    def advance(self) -> bool:
        """Repeats the last command, so that it does not time out; True once the arm rests at its target."""
        if self.at_target():
            return True
        if self.target is not None:
            self.driver.command(self.target)
        return False

    def at_target(self) -> bool:
        """True once the arm rests at its target; without one, once it rests."""
        max_distance, max_angle = 2e-6, 2e-5  # an arm this near to its target has arrived [m, rad]
        if self.target is None:
            return self.driver.at_rest()
        return self.driver.arrived(self.target, within=max_distance, turn=max_angle)

    def suspend_tactile_guard(self) -> None:
        """For motions that no observation decides: depth, shear and the age of observations are not guarded until the
        next observation is made."""
        self.driver.report_tactile(None)

    def stop(self) -> None:
        self.target = None
        self.driver.stop()

    def recover(self) -> None:
        self.target = None
        self.driver.recover()

    def close(self) -> None:
        self.driver.close()


def wait_for_arrival(arms: Mapping[str, CommandedArm], timeout: float) -> None:
    """Waits until all arms rest at their targets. Raises DeviceError after `timeout` [s], and what stops an arm."""
    poll_interval = 4e-3  # between two looks at moving arms [s]
    deadline = time.monotonic() + timeout
    while moving := [name for name, arm in arms.items() if not arm.advance()]:
        if time.monotonic() > deadline:
            name = moving[0]
            raise DeviceError(
                f"arm '{name}' did not come to its target within {timeout:g} s: {arms[name].driver.explain()}"
            )
        time.sleep(poll_interval)
