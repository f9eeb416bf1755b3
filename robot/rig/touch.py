"""Touch during an approach: how strongly the gels of each arm touch, measured for each new image or package."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from robot.rig.commanded_arm import CommandedArm
from tacsim.control import contact_signal
from tacsim.interface import Normaliser, TactileObservation, TactileSource

READ_TIMEOUT = 1.0  # of an image [s]


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
