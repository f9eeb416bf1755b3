"""An arm of hardware in a rig: stores its last target and counts limited targets."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping

from robot.errors import DeviceError
from tacsim import pose as se3
from tacsim.interface import ArmState, HardwareArm, Pose
from tacsim.limits import ActionError


class ArmHalted(DeviceError):
    """A command for an arm that was halted and does not accept commands yet."""


class CommandedArm:
    """Implements tacsim.interface.Arm. The clock waits until the arm reaches the last target that was sent.

    dry_run: no motion is sent.
    """

    def __init__(self, driver: HardwareArm, *, dry_run: bool = False) -> None:
        self.driver, self._dry_run = driver, dry_run
        self.target: Pose | None = None
        self.limits_hit = 0  # targets that were shortened or refused
        self._gate = threading.Lock()  # held while a command is sent, so that none follows a halt
        self._is_halted = False

    def state(self, at: float | None = None) -> ArmState:
        """Raises DeviceError for a time without a recorded state."""
        return self.driver.state(at)

    def command(self, target: Pose | None) -> Pose | None:
        """Returns the target that was sent; None in a dry run, in which nothing is sent."""
        max_shift = 1e-7  # a target that changes by more counts as shortened [m, rad]
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
        """`command` for motions of a reset, at most at `speed` [m/s]; limited targets are not counted."""
        self._require_not_halted()  # at once, also while the driver takes long to stop
        with self._gate:
            self._require_not_halted()
            self.target = self.driver.command(target, speed)
            return self.target

    def _require_not_halted(self) -> None:
        if self._is_halted:
            raise ArmHalted("the operator has stopped the arm; start again")

    def refuse_commands(self) -> None:
        """Until `accept_commands` every command that begins from now on raises ArmHalted. Waits for nothing."""
        self._is_halted = True

    def halt(self) -> None:
        """Refuses commands, waits for one that is being sent, then brakes the arm to rest. In any thread."""
        self.refuse_commands()
        with self._gate:
            self.stop()

    def accept_commands(self) -> None:
        """Ends `halt`. Moves nothing."""
        self._is_halted = False

    @property
    def is_halted(self) -> bool:
        """Commands are refused."""
        return self._is_halted

    def advance(self) -> bool:
        """Repeats the last command before it times out; returns True once the arm rests at its target."""
        if self.at_target():
            return True
        if self.target is not None:
            self.send(self.target)
        return False

    def at_target(self) -> bool:
        """True once the arm rests at its target, or rests and has no target."""
        max_distance, max_angle = 2e-6, 2e-5  # deviation from the target of an arm that has arrived [m, rad]
        if self.target is None:
            return self.driver.at_rest()
        return self.driver.arrived(self.target, within=max_distance, turn=max_angle)

    def suspend_tactile_guard(self) -> None:
        """For motions that do not depend on observations: depth, shear and the age of observations are not checked
        until the next observation."""
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
    """Waits until all arms rest at their targets. Raises DeviceError after `timeout` [s] and if an arm stops."""
    poll_interval = 4e-3  # between two checks of moving arms [s]
    deadline = time.monotonic() + timeout
    while moving := [name for name, arm in arms.items() if not arm.advance()]:
        if time.monotonic() > deadline:
            name = moving[0]
            raise DeviceError(
                f"arm '{name}' did not reach its target within {timeout:g} s: {arms[name].driver.explain()}"
            )
        time.sleep(poll_interval)
