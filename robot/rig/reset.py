"""The reset of a rig of hardware: retreat, references, a person's confirmation, and a slow approach until touch.

Only `Rig.reset` starts it, and nothing approaches before somebody has confirmed that the body lies where it should (on
a mock rig the companion of its mocks puts it there).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Protocol

import numpy as np

from robot.errors import DeviceError
from robot.rig.commanded_arm import CommandedArm, wait_for_arrival
from robot.rig.touch import TouchSense
from tacsim import pose as se3
from tacsim.control.contact_signal import NoTouch, approach
from tacsim.interface import Pose, TactileFrame, TactileSource
from tacsim.models.hardware import ResetConfig

RETREAT = 5e-3  # along the sensor's own axis, before anything else [m]
TRAVEL = 60.0  # longest motion to the start [s]
LOOK = 5e-3  # between two looks of an approach in motion [s]
AT_END = 0.5  # an approach that has come to its end has met nothing when nothing is told for so long [s]
PICTURE = 15.0  # longest wait for one that shows the gels at rest [s]
PAUSE = 0.3  # a shaken arm comes to rest before its force is zeroed [s]
ADVICE = (
    "is the body before the sensors? The arms are back at their start (start.approach_distance in the rig file bounds "
    "the approach)"
)


class NotConfirmed(RuntimeError):
    """Nobody confirmed that the body is in its place; the arms stand at their start."""


class ResetClock(Protocol):
    """A clock that can wait until observations belong to the present poses of the arms."""

    @property
    def real_time(self) -> bool:
        """Pictures and forces come as things happen; otherwise a simulation follows the arms as fast as it can."""
        ...

    def wait_for_data(self) -> None: ...
    def restart(self) -> None: ...


class HardwareReset:
    """The reset of a rig with real or mock arms.

    Args:
        arms, sensors: of the rig, by name.
        start: world_from_sensor of each arm, clear of everything.
        clock: of the rig.
        config: of the approach.
        touch_sense: what ends the approach; None: no approach. An arm that it does not know stays at its start.
        confirm: asks a person, True to go on; on a mock rig it puts the body in its place.
        placement: the arms start at most this far aside in world x and y, drawn from the seed [m].
        tell: is told what the arms are doing, again and again, in a few words.
    """

    def __init__(
        self,
        *,
        arms: Mapping[str, CommandedArm],
        sensors: Mapping[str, TactileSource],
        start: Mapping[str, Pose],
        clock: ResetClock,
        config: ResetConfig,
        touch_sense: TouchSense | None,
        confirm: Callable[[], bool],
        placement: float = 0.0,
        tell: Callable[[str], None] = lambda words: None,
    ) -> None:
        self._arms, self._sensors, self._start, self._clock = arms, sensors, start, clock
        self._config, self._touch_sense, self._confirm, self._placement = config, touch_sense, confirm, placement
        self._tell = tell
        self._begun: dict[str, Pose] = dict(start)

    def clear(self, seed: int) -> Mapping[str, TactileFrame]:
        """Raises DeviceError when an arm is stopped, or does not get there; TimeoutError without a picture of then."""
        for arm in self._arms.values():
            arm.suspend_tactile_guard()
        offset = self._placement * np.random.default_rng(seed).uniform(-1.0, 1.0, size=2)
        shift = np.append(offset, 0.0)
        self._begun = {name: Pose(pose.position + shift, pose.quaternion) for name, pose in self._start.items()}
        if self._arms:
            self._tell("to the start")
        self._go({name: se3.translated_along_z(arm.state().pose, -RETREAT) for name, arm in self._arms.items()}, TRAVEL)
        self._go(self._begun, TRAVEL)
        if self._arms:
            time.sleep(PAUSE)
            self._clock.wait_for_data()  # the force to be zeroed is that of now, not of before the retreat
        rested = time.monotonic()
        for arm in self._arms.values():
            arm.driver.zero_wrench()
        self._clock.wait_for_data()
        return {name: _exposed_after(rested, name, sensor) for name, sensor in self._sensors.items()}

    def touch(self) -> None:
        """Raises NotConfirmed, and NoTouch with the arms back at their start."""
        if not self._confirm():
            raise NotConfirmed("nobody confirmed that the body is in its place; nothing approaches it")
        self._clock.wait_for_data()
        if self._touch_sense is not None and self._arms:
            go = self._approach if self._clock.real_time else self._approach_by_steps
            try:
                go(self._touch_sense)
            except NoTouch:
                for arm in self._arms.values():
                    arm.suspend_tactile_guard()
                self._tell("back to the start")
                self._go(self._begun, TRAVEL)
                raise
            self._tell("touching")
        self._clock.restart()

    def _approach(self, sense: TouchSense) -> None:
        """All arms along their sensors' axes at the approach speed, each until a gel of its own touches. Where no new
        pictures or packages come, they wait."""
        min_progress = 0.1e-3  # an approach goes on while its arms come so much farther within TRAVEL [m]
        speed, longest = self._config.approach_speed, self._config.approach_distance
        going = {name: self._arms[name] for name in sense.look(guarded=True).pressed}
        ends = {name: se3.translated_along_z(self._begun[name], longest) for name in going}
        gone = dict.fromkeys(going, 0.0)
        before_end = farther = time.monotonic()
        counted = 0.0  # of the arms' ways together, when they were last seen to come farther [m]
        try:
            while going:
                touch = sense.look(guarded=True)
                now = time.monotonic()
                waiting = now - touch.news > sense.patience
                for name in list(going):
                    if touch.pressed[name] < 1.0:
                        going[name].send(None if waiting else ends[name], speed)
                    else:  # NaN, too
                        going.pop(name).send(None)
                for name, arm in going.items():
                    gone[name] = se3.pose_distance(arm.state().pose, self._begun[name])[0]
                self._tell(f"approach: {1e3 * max(gone.values()):.1f} mm of at most {1e3 * longest:g} mm")
                if sum(gone.values()) > counted + min_progress:
                    counted, farther = sum(gone.values()), now
                if waiting or not all(arm.at_target() for arm in going.values()):
                    before_end = now
                elif going and now - before_end > AT_END:
                    raise NoTouch(f"no touch after an approach of {1e3 * max(gone.values()):.3g} mm; {ADVICE}")
                if going and now - farther > TRAVEL:  # not after a time in all: a busy machine makes an arm slow
                    why = "no new pictures or packages come" if waiting else next(iter(going.values())).driver.explain()
                    raise DeviceError(f"the approach came no farther for {TRAVEL:g} s: {why}")
                time.sleep(LOOK)
        except BaseException:
            for arm in self._arms.values():
                arm.stop()
            raise
        wait_for_arrival(self._arms, TRAVEL)

    def _approach_by_steps(self, sense: TouchSense) -> None:
        """The same where a simulation has to follow each step before it can be felt."""
        step_timeout = 5.0  # longest step of an approach [s]
        going = set(sense.look(guarded=False).pressed)

        def touches() -> bool:
            pressed = sense.look(guarded=False).pressed
            going.difference_update([name for name in going if not pressed[name] < 1.0])
            return not going

        def advance(distance: float) -> None:
            self._go({name: se3.translated_along_z(self._begun[name], distance) for name in going}, step_timeout)
            self._clock.wait_for_data()

        approach(touches, advance, self._config.approach_step, self._config.approach_distance, ADVICE)

    def _go(self, targets: Mapping[str, Pose], timeout: float) -> None:
        """Arms without a target stay."""
        for name, arm in self._arms.items():  # none in a dry run
            arm.send(targets.get(name))
        wait_for_arrival(self._arms, timeout)


def _exposed_after(since: float, name: str, sensor: TactileSource) -> TactileFrame:
    """The first frame exposed after `since` [s]: a camera that was held up still has one of a moving arm, or of before
    the arm was connected. Raises TimeoutError."""
    deadline = time.monotonic() + PICTURE
    while (frame := sensor.read(1.0)).time < since:
        if time.monotonic() > deadline:
            raise TimeoutError(f"sensor '{name}': no picture since the arms came to rest, {PICTURE:g} s ago")
        time.sleep(LOOK)
    return frame
