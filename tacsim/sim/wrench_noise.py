"""The noise of a force sensor."""

from __future__ import annotations

import zlib

import numpy as np

from tacsim.interface import FloatArray
from tacsim.models.rig import WrenchNoise

MINUTE = 60.0  # [s]


class WrenchNoiseSource:
    """What an arm's force sensor adds to the wrench: noise of each reading, and a zero that wanders.

    It follows from the seed of `noise`, the arm, the episode and the period alone.
    """

    def __init__(self, noise: WrenchNoise, arm: str) -> None:
        self._deviation = np.repeat([noise.force, noise.torque], 3)
        self._drift = noise.drift
        self._key = (noise.seed, zlib.crc32(arm.encode()))
        self._begin(0)

    def _begin(self, episode: int) -> None:
        self._episode, self._index = episode, -1
        self._generator = np.random.default_rng((*self._key, episode))
        self._reading, self._step, self._zero = np.zeros(6), np.zeros(6), np.zeros(6)

    def __call__(self, index: int, period: float, episode: int) -> FloatArray:
        """(6,) in period `index` from 0, each of `period` [s]; force [N], then torque [N m]."""
        if episode != self._episode or index < self._index:
            self._begin(episode)
        while self._index < index:
            self._index += 1
            self._zero = self._zero + self._step
            self._reading, self._step = self._generator.standard_normal((2, 6))
        zero = self._drift * np.sqrt(period / MINUTE) * self._zero
        noise: FloatArray = self._deviation * (self._reading + zero)
        return noise


def wrench_noise_source(noise: WrenchNoise, arm: str) -> WrenchNoiseSource | None:
    """Of the arm of this name; None for a sensor without noise."""
    return WrenchNoiseSource(noise, arm) if noise.force or noise.torque else None
