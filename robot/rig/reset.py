"""The reset of a rig of hardware: retreat, reference images, the operator's confirmation, a slow approach until touch
(how strongly the gels of each arm touch is measured for each new image or package).

Only `Rig.reset` starts it. No arm approaches before the operator has confirmed that the body is in its place (on a mock
rig, the companion of the mocks places it).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from robot.errors import DeviceError
from robot.rig.commanded_arm import CommandedArm, wait_for_arrival
from tacsim import pose as se3
from tacsim.control import NoTouch, approach, contact_signal
from tacsim.interface import Normaliser, Pose, TactileFrame, TactileObservation, TactileSource
from tacsim.models.hardware import ResetConfig

READ_TIMEOUT = 1.0  # of an image [s]
RETREAT_DISTANCE = 5e-3  # first motion of a reset, along the sensor's own axis [m]
MOVE_TIMEOUT = 60.0  # of a motion to the start [s]
POLL_INTERVAL = 5e-3  # between two measurements of an approach [s]
END_TIMEOUT = 0.5  # an approach at its end has not touched if no touch is reported within this time [s]
FRAME_TIMEOUT = 15.0  # for an image that shows the gels at rest [s]
SETTLING_TIME = 0.3  # an arm comes to rest before its force is zeroed [s]
NO_TOUCH_ADVICE = (
    "is the body in front of the sensors? The arms are back at their start (start.approach_distance in the rig file "
    "limits the approach)"
)


@dataclass(frozen=True, slots=True)
class Touch:
    """One measurement of touch."""

    pressed: Mapping[str, float]  # by arm: contact of its most pressed gel over the threshold of touch
    latest_data_time: (
        float  # arrival of the newest frame or package of the sensor or arm with the oldest one, monotonic [s]
    )


class TouchSensing(Protocol):
    """Measures touch."""

    @property
    def data_timeout(self) -> float:
        """An approaching arm waits if its newest data are older than this [s]."""
        ...

    def measure_touch(self, *, guarded: bool) -> Touch:
        """guarded: tactile values are also reported to the arms, as after every observation of an episode."""
        ...


class PictureTouch:
    """By the change of the images of the sensors that arms carry."""

    def __init__(
        self,
        sensors: Mapping[str, TactileSource],
        normalisers: Mapping[str, Normaliser],
        monitor: Callable[[Mapping[str, TactileObservation]], None],
        signal: float,
        data_timeout: float,
    ) -> None:
        """signal: contact signal that counts as touch; monitor: checks the gels, raises beyond their limits."""
        self.data_timeout, self._signal, self._monitor, self._normalisers = data_timeout, signal, monitor, normalisers
        self._sensors = {name: sensor for name, sensor in sensors.items() if sensor.spec.arm is not None}
        self._latest_frames: dict[str, tuple[int, float]] = {}  # by sensor: index of its newest frame, and its arrival
        self._observations: dict[str, TactileObservation] = {}

    def measure_touch(self, *, guarded: bool) -> Touch:
        pressed: dict[str, float] = {}
        for name, sensor in self._sensors.items():
            frame, arm = sensor.read(READ_TIMEOUT), sensor.spec.arm
            assert arm is not None
            if self._latest_frames.get(name, (-1, 0.0))[0] != frame.index:
                self._latest_frames[name] = frame.index, time.monotonic()
                self._observations[name] = self._normalisers[name](frame, frame.time)
            signal = contact_signal(self._observations[name]) / self._signal
            pressed[arm] = float(np.maximum(pressed.get(arm, 0.0), signal))  # NaN stays NaN, which stops that arm
        if guarded:
            self._monitor(self._observations)
        return Touch(pressed, min(when for _, when in self._latest_frames.values()))


class ForceTouch:
    """By the normal force that the arms measure."""

    data_timeout = 0.1

    def __init__(self, arms: Mapping[str, CommandedArm], force: float) -> None:
        """arms: those that carry a sensor; force: what counts as touch [N]."""
        self._arms, self._force = arms, force

    def measure_touch(self, *, guarded: bool) -> Touch:
        states = {name: arm.state() for name, arm in self._arms.items()}
        pressed = {name: -float(state.wrench[2]) / self._force for name, state in states.items()}
        latest_data_time = min(state.time + self._arms[name].driver.latency for name, state in states.items())
        return Touch(pressed, latest_data_time)


class NotConfirmed(RuntimeError):
    """The operator did not confirm that the body is in its place. The arms are at their start."""


class ResetClock(Protocol):
    """A clock that can wait until observations belong to the present poses of the arms."""

    @property
    def real_time(self) -> bool:
        """True if images and forces arrive in real time; otherwise a simulation follows the arms as fast as it can."""
        ...

    def wait_for_data(self) -> None: ...
    def restart(self) -> None: ...


class HardwareReset:
    """The reset of a rig with real or mock arms.

    Args:
        arms, sensors: of the rig, by name.
        start: world_from_sensor of each arm, without contact.
        clock: of the rig.
        config: of the approach.
        touch_sensing: ends the approach; None: no approach. An arm that it does not measure stays at its start.
        confirm: asks the operator, True to continue; on a mock rig it puts the body in its place.
        placement: maximum shift of the start in world x and y, drawn from the seed [m].
        report: gets a short text about what the arms are doing, repeatedly.
    """

    def __init__(
        self,
        *,
        arms: Mapping[str, CommandedArm],
        sensors: Mapping[str, TactileSource],
        start: Mapping[str, Pose],
        clock: ResetClock,
        config: ResetConfig,
        touch_sensing: TouchSensing | None,
        confirm: Callable[[], bool],
        placement: float = 0.0,
        report: Callable[[str], None] = lambda words: None,
    ) -> None:
        self._arms, self._sensors, self._start, self._clock = arms, sensors, start, clock
        self._config, self._touch_sensing, self._confirm, self._placement = config, touch_sensing, confirm, placement
        self._report = report
        self._approach_start: dict[str, Pose] = dict(start)

    def clear(self, seed: int) -> Mapping[str, TactileFrame]:
        """Raises DeviceError if an arm is stopped or does not arrive, TimeoutError without a new image."""
        for arm in self._arms.values():
            arm.suspend_tactile_guard()
        offset = self._placement * np.random.default_rng(seed).uniform(-1.0, 1.0, size=2)
        shift = np.append(offset, 0.0)
        self._approach_start = {
            name: Pose(pose.position + shift, pose.quaternion) for name, pose in self._start.items()
        }
        if self._arms:
            self._report("to the start")
        self._move_arms(
            {name: se3.translated_along_z(arm.state().pose, -RETREAT_DISTANCE) for name, arm in self._arms.items()},
            MOVE_TIMEOUT,
        )
        self._move_arms(self._approach_start, MOVE_TIMEOUT)
        if self._arms:
            time.sleep(SETTLING_TIME)
            self._clock.wait_for_data()  # the force to be zeroed is the present one, not that before the retreat
        rested = time.monotonic()
        for arm in self._arms.values():
            arm.driver.zero_wrench()
        self._clock.wait_for_data()
        return {name: _read_exposed_after(rested, name, sensor) for name, sensor in self._sensors.items()}

    def touch(self) -> None:
        """Raises NotConfirmed, and NoTouch with the arms back at their start."""
        if not self._confirm():
            raise NotConfirmed("the operator did not confirm that the body is in its place; no arm approaches it")
        self._clock.wait_for_data()
        if self._touch_sensing is not None and self._arms:
            move_to_touch = self._approach if self._clock.real_time else self._approach_by_steps
            try:
                move_to_touch(self._touch_sensing)
            except NoTouch:
                for arm in self._arms.values():
                    arm.suspend_tactile_guard()
                self._report("back to the start")
                self._move_arms(self._approach_start, MOVE_TIMEOUT)
                raise
            self._report("touching")
        self._clock.restart()

    def _approach(self, sensing: TouchSensing) -> None:
        """Moves all arms along their sensors' axes at the approach speed, each until one of its gels touches. The arms
        wait while no new images or packages arrive."""
        min_progress = 0.1e-3  # an approach ends with an error if its arms progress less within MOVE_TIMEOUT [m]
        speed, max_distance = self._config.approach_speed, self._config.approach_distance
        moving = {name: self._arms[name] for name in sensing.measure_touch(guarded=True).pressed}
        ends = {name: se3.translated_along_z(self._approach_start[name], max_distance) for name in moving}
        travelled = dict.fromkeys(moving, 0.0)
        last_moving = last_progress = time.monotonic()
        counted_distance = 0.0  # sum over the arms, at the last progress [m]
        try:
            while moving:
                touch = sensing.measure_touch(guarded=True)
                now = time.monotonic()
                waiting = now - touch.latest_data_time > sensing.data_timeout
                for name in list(moving):
                    if touch.pressed[name] < 1.0:
                        moving[name].send(None if waiting else ends[name], speed)
                    else:  # NaN, too
                        moving.pop(name).send(None)
                for name, arm in moving.items():
                    travelled[name] = se3.pose_distance(arm.state().pose, self._approach_start[name])[0]
                distance = max(travelled.values())
                self._report(f"approach: {1e3 * distance:.1f} mm of at most {1e3 * max_distance:g} mm")
                if sum(travelled.values()) > counted_distance + min_progress:
                    counted_distance, last_progress = sum(travelled.values()), now
                if waiting or not all(arm.at_target() for arm in moving.values()):
                    last_moving = now
                elif moving and now - last_moving > END_TIMEOUT:
                    raise NoTouch(f"no touch after an approach of {1e3 * distance:.3g} mm; {NO_TOUCH_ADVICE}")
                if moving and now - last_progress > MOVE_TIMEOUT:  # no limit in total: a busy machine slows the arms
                    stopped = next(iter(moving.values()))
                    why = "no new images or packages arrive" if waiting else stopped.driver.explain()
                    raise DeviceError(f"the approach made no progress for {MOVE_TIMEOUT:g} s: {why}")
                time.sleep(POLL_INTERVAL)
        except BaseException:
            for arm in self._arms.values():
                arm.stop()
            raise
        wait_for_arrival(self._arms, MOVE_TIMEOUT)

    def _approach_by_steps(self, sensing: TouchSensing) -> None:
        """The same, with a simulation that follows each step before its touch can be measured."""
        step_timeout = 5.0  # of a step of an approach [s]
        moving = set(sensing.measure_touch(guarded=False).pressed)

        def touches() -> bool:
            pressed = sensing.measure_touch(guarded=False).pressed
            moving.difference_update([name for name in moving if not pressed[name] < 1.0])
            return not moving

        def advance(distance: float) -> None:
            self._move_arms(
                {name: se3.translated_along_z(self._approach_start[name], distance) for name in moving}, step_timeout
            )
            self._clock.wait_for_data()

        approach(touches, advance, self._config.approach_step, self._config.approach_distance, NO_TOUCH_ADVICE)

    def _move_arms(self, targets: Mapping[str, Pose], timeout: float) -> None:
        """Moves arms to their targets; arms without a target stay."""
        for name, arm in self._arms.items():  # none in a dry run
            arm.send(targets.get(name))
        wait_for_arrival(self._arms, timeout)


def _read_exposed_after(since: float, name: str, sensor: TactileSource) -> TactileFrame:
    """The first frame exposed after `since` [s]: the newest frame of a delayed camera may show a moving arm, or be
    older than the connection to the arm. Raises TimeoutError."""
    deadline = time.monotonic() + FRAME_TIMEOUT
    while (frame := sensor.read(1.0)).time < since:
        if time.monotonic() > deadline:
            raise TimeoutError(f"sensor '{name}': no image since the arms came to rest, {FRAME_TIMEOUT:g} s ago")
        time.sleep(POLL_INTERVAL)
    return frame
