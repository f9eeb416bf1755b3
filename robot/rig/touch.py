"""What an approach watches: how hard the gels of each arm touch, told as often as pictures or packages come."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from robot.rig.commanded_arm import CommandedArm
from tacsim.control.contact_signal import contact_signal
from tacsim.interface import Normaliser, TactileObservation, TactileSource

READ_TIMEOUT = 1.0  # of a picture [s]


@dataclass(frozen=True, slots=True)
class Touch:
    """One look."""

    pressed: Mapping[str, float]  # by arm: as a multiple of what counts as touch, of its gel that is pressed most
    news: float  # when something new came, of the sensor or arm that was new least recently, monotonic [s]


class TouchSense(Protocol):
    """How touch is felt."""

    @property
    def patience(self) -> float:
        """Without news for so long, an arm that approaches waits for them [s]."""
        ...

    def look(self, *, guarded: bool) -> Touch:
        """guarded: the arms are told what their gels show, as after every observation of an episode."""
        ...


class PictureTouch:
    """By the change of the pictures of the sensors that arms carry."""

    def __init__(
        self,
        sensors: Mapping[str, TactileSource],
        normalisers: Mapping[str, Normaliser],
        monitor: Callable[[Mapping[str, TactileObservation]], None],
        signal: float,
        patience: float,
    ) -> None:
        """signal: contact signal that counts as touch; monitor: guards the gels, raises beyond their limits."""
        self.patience, self._signal, self._monitor, self._normalisers = patience, signal, monitor, normalisers
        self._sensors = {name: sensor for name, sensor in sensors.items() if sensor.spec.arm is not None}
        self._news: dict[str, tuple[int, float]] = {}  # by sensor: index of its newest frame, when that was new
        self._seen: dict[str, TactileObservation] = {}

    def look(self, *, guarded: bool) -> Touch:
        pressed: dict[str, float] = {}
        for name, sensor in self._sensors.items():
            frame, arm = sensor.read(READ_TIMEOUT), sensor.spec.arm
            assert arm is not None
            if self._news.get(name, (-1, 0.0))[0] != frame.index:
                self._news[name] = frame.index, time.monotonic()
                self._seen[name] = self._normalisers[name](frame, frame.time)
            signal = contact_signal(self._seen[name]) / self._signal
            pressed[arm] = float(np.maximum(pressed.get(arm, 0.0), signal))  # a NaN stays one: that arm goes no farther
        if guarded:
            self._monitor(self._seen)
        return Touch(pressed, min(when for _, when in self._news.values()))


class ForceTouch:
    """By the normal force that the arms feel."""

    patience = 0.1

    def __init__(self, arms: Mapping[str, CommandedArm], force: float) -> None:
        """arms: those that carry a sensor; force: what counts as touch [N]."""
        self._arms, self._force = arms, force

    def look(self, *, guarded: bool) -> Touch:
        states = {name: arm.state() for name, arm in self._arms.items()}
        pressed = {name: -float(state.wrench[2]) / self._force for name, state in states.items()}
        news = min(state.time + self._arms[name].driver.latency for name, state in states.items())
        return Touch(pressed, news)
