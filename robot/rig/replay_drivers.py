"""The driver `replay`: recorded arms, grippers and sensors. The rig of a recording opens them (replay_rig.py)."""

from __future__ import annotations

from pathlib import Path
from typing import cast

import numpy as np
from numpy.typing import NDArray

from tacsim.interface import Normaliser
from tacsim.models.driver import ArmPart, GripperPart, SensorPart
from tacsim.models.rig import ReplayArmConfig, ReplayGripperConfig, ReplaySensorConfig


class ReplaySensorPart(SensorPart[ReplaySensorConfig]):
    """A sensor whose frames come from a recording, a video or a folder of pictures."""

    config_class = ReplaySensorConfig
    clocks = ("replay",)

    def require(self) -> None:
        if self.config.source is None:
            key = f"sensors.{self.name}.source"
            raise ValueError(f"{key}: no recording given; name one with --set {key}=PATH")

    def normaliser(self, untouched: NDArray[np.uint8] | None = None) -> Normaliser:
        """From the settings of the rig file, or else from the rig with which the episode was recorded."""
        from robot.rig.parts import sensor_of
        from robot.rig.replay_rig import recorded_rig

        stated = (self.config.corners, self.config.calibration, self.config.marker_pitch)
        original = recorded_rig(Path(self.config.source or "")) if stated == (None, None, None) else None
        if original is None or self.name not in original.sensors:
            return self._of_file(untouched)
        part = sensor_of(original.model_copy(update={"canonical": self.grid}), self.name)
        if original.clock == "replay":  # a recording of a recording: stop here, since they may refer to each other
            return cast(ReplaySensorPart, part)._of_file(untouched)
        return part.normaliser(untouched)

    def _of_file(self, untouched: NDArray[np.uint8] | None) -> Normaliser:
        from calibration.normaliser import normaliser_for_recording

        if untouched is None:
            raise ValueError(f"sensors.{self.name}: a recording is normalised with its reference image")
        return normaliser_for_recording(self.config, untouched.shape[:2], self.grid, untouched)


class ReplayArmPart(ArmPart[ReplayArmConfig]):
    """An arm whose poses and forces come from a recording or a table."""

    config_class = ReplayArmConfig
    clocks = ("replay",)


class ReplayGripperPart(GripperPart[ReplayGripperConfig]):
    """A gripper whose width and force come from a recording."""

    config_class = ReplayGripperConfig
    clocks = ("replay",)
