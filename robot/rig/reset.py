"""The reset of a rig of hardware: retreat, references, a person's confirmation, and a slow approach until touch.

Only `Rig.reset` starts it, and nothing approaches before somebody has confirmed that the body lies where it should (on
a mock rig robot.mock.cell.cell puts it there).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Protocol

import numpy as np

from robot.rig.commanded_arm import CommandedArm, wait_for_arrival
from tacsim import pose as se3
from tacsim.control.approach import NoTouch, approach
from tacsim.interface import Pose, TactileFrame, TactileSource
from tacsim.models.hardware import ResetConfig

RETREAT = 5e-3  # along the sensor's own axis, before anything else [m]
TRAVEL = 60.0  # longest motion to the start [s]
PAUSE = 0.3  # a shaken arm comes to rest before its force is zeroed [s]


class NotConfirmed(RuntimeError):
    """Nobody confirmed that the body is in its place; the arms stand at their start."""


class ResetClock(Protocol):
    """A clock that can wait until observations belong to the present poses of the arms."""

    def wait_for_data(self) -> None: ...
    def restart(self) -> None: ...


class HardwareReset:
    """The reset of a rig with real or mock arms.

    Args:
        arms, sensors: of the rig, by name.
        start: world_from_sensor of each arm, clear of everything.
        clock: of the rig.
        config: of the approach.
        contact: how hard the gels touch, as a multiple of what counts as touch; None: no approach.
        confirm: asks a person, True to go on; on a mock rig it puts the body in its place.
        placement: the arms start at most this far aside in world x and y, drawn from the seed [m].
    """

    def __init__(
        self,
        *,
        arms: Mapping[str, CommandedArm],
        sensors: Mapping[str, TactileSource],
        start: Mapping[str, Pose],
        clock: ResetClock,
        config: ResetConfig,
        contact: Callable[[], float] | None,
        confirm: Callable[[], bool],
        placement: float = 0.0,
    ) -> None:
        self._arms, self._sensors, self._start, self._clock = arms, sensors, start, clock
        self._config, self._contact, self._confirm, self._placement = config, contact, confirm, placement
        self._begun: dict[str, Pose] = dict(start)

    def clear(self, seed: int) -> Mapping[str, TactileFrame]:
        """Raises DeviceError when an arm is stopped, or does not get there."""
        for arm in self._arms.values():
            arm.suspend_tactile_guard()
        offset = self._placement * np.random.default_rng(seed).uniform(-1.0, 1.0, size=2)
        shift = np.append(offset, 0.0)
        self._begun = {name: Pose(pose.position + shift, pose.quaternion) for name, pose in self._start.items()}
        self._go({name: se3.along_z(arm.state().pose, -RETREAT) for name, arm in self._arms.items()}, TRAVEL)
        self._go(self._begun, TRAVEL)
        if self._arms:
            time.sleep(PAUSE)
            self._clock.wait_for_data()  # the force to be zeroed is that of now, not of before the retreat
        for arm in self._arms.values():
            arm.driver.zero_wrench()
        self._clock.wait_for_data()
        return {name: sensor.read(1.0) for name, sensor in self._sensors.items()}

    def touch(self) -> None:
        """Raises NotConfirmed, and NoTouch with the arms back at their start."""
        if not self._confirm():
            raise NotConfirmed("nobody confirmed that the body is in its place; nothing approaches it")
        self._clock.wait_for_data()
        contact = self._contact
        if contact is not None and self._arms:
            advice = (
                "is the body between the sensors? The arms are back at their start (start.approach_distance in the rig "
                "file bounds the approach)"
            )
            step, longest = self._config.approach_step, self._config.approach_distance
            try:
                approach(lambda: not contact() < 1.0, self._advance, step, longest, advice)  # NaN ends it, too
            except NoTouch:
                self._go(self._begun, TRAVEL)
                raise
        self._clock.restart()

    def _advance(self, distance: float) -> None:
        """All arms `distance` [m] from their start along their sensors' axes, at the approach speed."""
        due = time.monotonic() + self._config.approach_step / self._config.approach_speed
        self._go({name: se3.along_z(pose, distance) for name, pose in self._begun.items()}, 5.0)
        time.sleep(max(0.0, due - time.monotonic()))
        self._clock.wait_for_data()

    def _go(self, targets: Mapping[str, Pose], timeout: float) -> None:
        for name, arm in self._arms.items():  # none in a dry run
            arm.send(targets[name])
        wait_for_arrival(self._arms, timeout)
