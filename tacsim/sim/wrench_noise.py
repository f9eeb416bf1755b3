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

    def __call__(self, index: int, period: float, episode: int) -> FloatArray:
        """(6,) in period `index` from 0, each of `period` [s]; force [N], then torque [N m]."""
        # Drawn from the episode's start: the zero is the sum of all steps until now.
        drawn = np.random.default_rng((*self._key, episode)).standard_normal((index + 1, 2, 6))
        zero = self._drift * np.sqrt(period / MINUTE) * drawn[:index, 1].sum(axis=0)
        noise: FloatArray = self._deviation * (drawn[index, 0] + zero)
        return noise


def wrench_noise_source(noise: WrenchNoise, arm: str) -> WrenchNoiseSource | None:
    """Of the arm of this name; None for a sensor without noise."""
    return WrenchNoiseSource(noise, arm) if noise.force or noise.torque else None
