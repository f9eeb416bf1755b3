"""An elastic mount between an arm and its sensor."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from tacsim.interface import FloatArray
from tacsim.models.hardware import MountConfig


class ElasticMount:
    """A spring with a damper in parallel (Kelvin-Voigt), the same along all axes; it does not turn. The force on the
    sensor moves it from where the arm holds it; the arm's encoders do not observe that.

    The displacement d from there follows damping_time dd/dt = F / stiffness - d. The force falls while mounts give way:
    a contact of stiffness C between mounts of the compliance S = sum of 1 / stiffness makes F / stiffness - d decay at
    the rate r / damping_time, r = 1 + C S. So in one control period T the displacement goes from d to
    d + (1 - exp(-r T / damping_time)) / r (F / stiffness - d), with F and d at the start of the period: exact for a
    linear contact and mounts of one damping_time. With r = 1, soft mounts oscillate against a stiff contact.

    compliance: S of all mounts on which the force acts, this one included [m/N].
    """

    def __init__(self, config: MountConfig, period: float, compliance: float) -> None:
        assert config.stiffness is not None
        self._stiffness, self._compliance = config.stiffness, compliance
        self._share_of_damping_time = period / config.damping_time
        self.begin()

    def begin(self) -> None:
        """A new episode: the mount is at rest under the present force."""
        self._arm: FloatArray | None = None  # (3,) where the arm holds the sensor, world [m]; None: a new episode
        self._last: tuple[FloatArray, FloatArray] | None = None  # from the opposite side to the sensor, and force
        self._contact = 0.0  # C [N/m]

    def arm_position(self, sensor: FloatArray, force: FloatArray) -> FloatArray:
        """(3,) where the arm holds a sensor that is at `sensor` (3,) under the force (3,) on it, world [m, N]."""
        if self._arm is None:
            self._arm = sensor - force / self._stiffness
        return self._arm

    def move_arm(
        self, target: FloatArray, sensor: FloatArray, force: FloatArray, opposite: Sequence[FloatArray] = ()
    ) -> FloatArray:
        """The arm goes to `target` (3,). Returns where the sensor (now at `sensor`, under `force`) then is [m].

        opposite: present positions (3,) of the sensors that press against this one [m]; none: a body that stands still.
        """
        displacement = sensor - self.arm_position(sensor, force)
        self._measure_contact(sensor - np.mean(opposite, axis=0) if opposite else sensor, force)
        rate = 1.0 + self._contact * self._compliance
        share = -math.expm1(-rate * self._share_of_damping_time) / rate
        self._arm = np.array(target)
        moved: FloatArray = self._arm + displacement + share * (force / self._stiffness - displacement)
        return moved

    def _measure_contact(self, position: FloatArray, force: FloatArray) -> None:
        """Takes C from the last two periods. It stays where nothing moved, or the force fell though the sensor closed
        in, as clay relaxes."""
        min_motion = 1e-6  # [m]
        if self._last is not None:
            motion, change = position - self._last[0], force - self._last[1]
            distance = float(np.linalg.norm(motion))
            if distance > min_motion and (contact := -float(motion @ change) / distance**2) >= 0.0:
                self._contact = contact
        self._last = np.array(position), np.array(force)


def elastic_mounts(configs: Mapping[str, MountConfig], period: float) -> dict[str, ElasticMount | None]:
    """The mounts of the arms of a rig, which press against each other; period: of control [s]. None for a rigid one."""
    compliance = sum(1.0 / each.stiffness for each in configs.values() if each.stiffness is not None)
    return {
        name: None if config.stiffness is None else ElasticMount(config, period, compliance)
        for name, config in configs.items()
    }
