"""How an episode begins on hardware: retreat, fresh references, a person's word, and a slow approach until it touches.

Nothing of this happens by itself: `Rig.reset` calls it, and between references and approach somebody confirms that the
body lies where it should (robot.mock.cell.cell puts it there on a mock rig).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Protocol

import numpy as np

from robot.errors import DeviceError
from robot.rig.clock import Driven, drive
from tacsim import pose as se3
from tacsim.interface import Pose, TactileFrame, TactileSource
from tacsim.models.hardware import HardwareStart

RETREAT = 5e-3  # along the sensor's own axis, before anything else [m]
TRAVEL = 60.0  # longest way to the start [s]
PAUSE = 0.3  # a shaken arm comes to rest before its force is called zero [s]


class NotConfirmed(RuntimeError):
    """Nobody confirmed that the body is in its place; the arms stand at their start."""


class NoTouch(DeviceError):
    """The approach went all its way without feeling anything; the arms are back at their start."""


class Looking(Protocol):
    """A clock that can wait until what is seen and felt belongs to where the arms are."""

    def look(self) -> None: ...
    def restart(self) -> None: ...


class GuidedStart:
    """The start of a rig with real or mock arms.

    Args:
        arms, sensors: of the rig, by name.
        start: world_from_sensor of each arm, clear of everything.
        clock: of the rig.
        facts: of the approach.
        feel: how hard the gels touch by now, in units of what counts as touch: 1 is enough.
        confirm: asks a person, True to go on; puts the body there on a mock rig.
        placement: the arms start at most this far aside in world x and y, drawn from the seed [m].
    """

    def __init__(
        self,
        *,
        arms: Mapping[str, Driven],
        sensors: Mapping[str, TactileSource],
        start: Mapping[str, Pose],
        clock: Looking,
        config: HardwareStart,
        feel: Callable[[], float] | None,
        confirm: Callable[[], bool],
        placement: float = 0.0,
    ) -> None:
        self._arms, self._sensors, self._start, self._clock = arms, sensors, start, clock
        self._facts, self._feel, self._confirm, self._placement = config, feel, confirm, placement
        self._begun: dict[str, Pose] = dict(start)

    def clear(self, seed: int) -> Mapping[str, TactileFrame]:
        """Raises DeviceError when an arm is stopped, or does not get there."""
        for driven in self._arms.values():
            driven.arm.report_tactile(None)  # until the first observation nothing is decided by one
        aside = self._placement * np.random.default_rng(seed).uniform(-1.0, 1.0, size=2)
        shift = np.append(aside, 0.0)
        self._begun = {name: Pose(pose.position + shift, pose.quaternion) for name, pose in self._start.items()}
        back = Pose(np.array([0.0, 0.0, -RETREAT]))
        self._go({name: se3.compose(driven.arm.state().pose, back) for name, driven in self._arms.items()}, TRAVEL)
        self._go(self._begun, TRAVEL)
        if self._arms:
            time.sleep(PAUSE)
            self._clock.look()  # what is felt by now, not what was felt before the retreat, shall be zero
        for driven in self._arms.values():
            driven.arm.zero_wrench()
        self._clock.look()
        return {name: sensor.read(1.0) for name, sensor in self._sensors.items()}

    def touch(self) -> None:
        """Raises NotConfirmed, NoTouch."""
        if not self._confirm():
            raise NotConfirmed("nobody confirmed that the body is in its place; nothing approaches it")
        self._clock.look()
        if self._feel is not None and self._arms:
            self._approach(self._feel)
        self._clock.restart()

    def _approach(self, feel: Callable[[], float]) -> None:
        """All arms along their sensors' axes, step by step: what lies between them is met by all alike."""
        step, way = self._facts.approach_step, 0.0
        while feel() < 1.0:
            way += step
            if way > self._facts.approach_way:
                self._go(self._begun, TRAVEL)
                raise NoTouch(
                    f"no touch after an approach of {1e3 * way:.3g} mm; is the body between the sensors? The arms are "
                    "back at their start (start.approach_way in the rig file bounds the way)"
                )
            ahead = Pose(np.array([0.0, 0.0, way]))
            due = time.monotonic() + step / self._facts.approach_speed
            self._go({name: se3.compose(pose, ahead) for name, pose in self._begun.items()}, 5.0)
            time.sleep(max(0.0, due - time.monotonic()))
            self._clock.look()

    def _go(self, targets: Mapping[str, Pose], timeout: float) -> None:
        for name, driven in self._arms.items():  # none in a dry run
            driven.target = driven.arm.command(targets[name])
        drive(self._arms, timeout)
