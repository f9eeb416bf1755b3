"""The driver `mujoco`: arms, grippers and sensors that MuJoCo moves. Their rig makes them (mujoco_rig.py)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tacsim.interface import Normaliser
from tacsim.models.driver import ArmPart, GripperPart, SensorPart
from tacsim.models.mujoco import MujocoArmConfig, MujocoGripperConfig, MujocoSensorConfig


class MujocoArmPart(ArmPart[MujocoArmConfig]):
    """A free flange, a UR5e or a model of yours in MuJoCo, with a gripper."""

    config_class = MujocoArmConfig
    clocks = ("mujoco",)


class MujocoGripperPart(GripperPart[MujocoGripperConfig]):
    """A parallel gripper in MuJoCo, with a gel on each finger."""

    config_class = MujocoGripperConfig
    clocks = ("mujoco",)


class MujocoSensorPart(SensorPart[MujocoSensorConfig]):
    """A tactile sensor on a finger in MuJoCo: its picture is rendered from the deformed gel."""

    config_class = MujocoSensorConfig
    clocks = ("mujoco",)

    def normaliser(self, untouched: NDArray[np.uint8] | None = None) -> Normaliser:
        from calibration.normaliser import normaliser_for_simulation

        if self.gel_size is None:
            raise ValueError(f"sensors.{self.name} is simulated, but the rig has no scene; give scene, or a task")
        return normaliser_for_simulation(self.config.model, self.gel_size, self.grid)
