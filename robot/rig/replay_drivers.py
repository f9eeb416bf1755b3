"""The driver `replay`: recorded arms and sensors. The rig of a recording opens them (replay_rig.py)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tacsim.interface import Normaliser
from tacsim.models.driver import ArmPart, SensorPart
from tacsim.models.rig import ReplayArmConfig, ReplaySensorConfig


class ReplaySensorPart(SensorPart[ReplaySensorConfig]):
    config_class = ReplaySensorConfig
    clocks = ("replay",)

    def require(self) -> None:
        if self.config.source is None:
            key = f"sensors.{self.name}.source"
            raise ValueError(f"{key}: no recording given; name one with --set {key}=PATH")

    def normaliser(self, untouched: NDArray[np.uint8] | None = None) -> Normaliser:
        """By what the rig file says of the picture."""
        from calibration.normaliser import normaliser_for_recording

        if untouched is None:
            raise ValueError(f"sensors.{self.name}: a recording is normalised with its picture without contact")
        return normaliser_for_recording(self.config, untouched.shape[:2], self.grid, untouched)


class ReplayArmPart(ArmPart[ReplayArmConfig]):
    config_class = ReplayArmConfig
    clocks = ("replay",)
