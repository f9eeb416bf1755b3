"""An elastic mount between an arm and its sensor."""

from __future__ import annotations

import math

import numpy as np

from tacsim.interface import FloatArray
from tacsim.models.hardware import MountConfig


class ElasticMount:
    """A spring with a damper in parallel (Kelvin-Voigt), the same along all axes; it does not turn. The force on the
    sensor moves it from where the arm holds it; the arm's encoders do not observe that.

    In one control period T the displacement d goes from d to d + (1 - exp(-T / damping_time)) (F / stiffness - d), with
    the force F at the start of the period.
    """

    def __init__(self, config: MountConfig, period: float) -> None:
        assert config.stiffness is not None
        self._stiffness = config.stiffness
        self._share = -math.expm1(-period / config.damping_time)
        self._arm: FloatArray | None = None  # (3,) where the arm holds the sensor, world [m]; None: a new episode

    def begin(self) -> None:
        """A new episode: the mount is at rest under the present force."""
        self._arm = None

    def arm_position(self, sensor: FloatArray, force: FloatArray) -> FloatArray:
        """(3,) where the arm holds a sensor that is at `sensor` (3,) under the force (3,) on it, world [m, N]."""
        if self._arm is None:
            self._arm = sensor - force / self._stiffness
        return self._arm

    def move_arm(self, target: FloatArray, sensor: FloatArray, force: FloatArray) -> FloatArray:
        """The arm goes to `target` (3,). Returns where the sensor (now at `sensor`, under `force`) then is [m]."""
        displacement = sensor - self.arm_position(sensor, force)
        displacement = displacement + self._share * (force / self._stiffness - displacement)
        self._arm = np.array(target)
        moved: FloatArray = self._arm + displacement
        return moved


def elastic_mount(config: MountConfig, period: float) -> ElasticMount | None:
    """The mount of an arm whose control period is `period` [s]; None for a rigid one."""
    return None if config.stiffness is None else ElasticMount(config, period)
