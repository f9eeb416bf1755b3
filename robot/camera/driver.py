"""The driver `camera`: a tactile sensor seen by a camera, real or mock."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import NDArray

from robot.errors import DeviceError
from tacsim.interface import Normaliser, SensorSpec, TactileSource
from tacsim.models.driver import Check, Companion, SensorDriver
from tacsim.models.hardware import CameraSensorConfig
from tacsim.record.episode import PICTURES_DAMAGED, PICTURES_LOST, PICTURES_REPEATED

if TYPE_CHECKING:
    from calibration.frame_normaliser import FrameNormaliser
    from robot.camera.camera import Camera

MIN_LATENCY = 0.05  # of a camera whose file says 0, as far as an approach may trust it [s]
CHECK_TIMEOUT = 3.0  # of connecting to a camera that is checked [s]
CHECK_TIME = 1.0  # for which it is then read [s]


class CameraDriver(SensorDriver[CameraSensorConfig]):
    """A camera of the GelSight kind: USB, or MJPEG over HTTP; real or mock."""

    config_class = CameraSensorConfig

    @property
    def companion(self) -> str | None:
        return "robot.mock.cell.cell:MockCell" if self.config.is_mock else None

    def require(self) -> None:
        if self.config.model is None:
            return
        rows, columns = self.config.model.image_shape
        if (columns, rows) != (self.config.width, self.config.height):
            raise ValueError(
                f"sensors.{self.name} delivers {self.config.width} x {self.config.height} px (width, height), its "
                f"model '{self.config.model.name}' shows {columns} x {rows}; make them alike"
            )

    def normaliser(self, untouched: NDArray[np.uint8] | None = None) -> FrameNormaliser:
        from calibration.errors import error_context
        from calibration.normaliser import normaliser_for_camera

        gel_size = self.config.size if self.gel_size is None else self.gel_size
        with error_context(f"sensors.{self.name}"):
            return normaliser_for_camera(self.config, gel_size, self.grid)

    def spec(self, normaliser: Normaliser) -> SensorSpec:
        shape = self.config.height, self.config.width
        return SensorSpec(shape, normaliser.finds_height, normaliser.finds_flow, self.config.arm, self.config.gripper)

    def open(self, spec: SensorSpec, companion: Companion | None) -> Camera:
        from robot.camera.camera import Camera

        camera = Camera(self.config, self.name)
        camera.spec = spec
        return camera

    def sample_rate(self) -> float:
        return self.config.fps

    def worst_latency(self) -> float:
        return max(self.config.latency, MIN_LATENCY) + 1.0 / self.config.fps

    def checks(self) -> Iterable[Check]:
        min_frame_rate = 0.8  # share of the rate asked for; a slower camera is a warning
        from robot.camera.camera import Camera

        config, label = self.config, f"{self.name}: camera"
        try:
            with Camera(config, self.name, CHECK_TIMEOUT) as camera:
                time.sleep(CHECK_TIME)
                status = camera.status
        except DeviceError as failure:
            return [Check(label, "fail", str(failure), "see cable, address, and what else uses the camera")]
        fps, age = status.fps or 0.0, status.age or 0.0
        words = (
            f"{config.width} x {config.height} px, {fps:.1f} frames/s, newest {1e3 * age:.0f} ms old, "
            f"{status.dropped} lost, {status.damaged} damaged, {status.repeated} shown again"
        )
        if status.error is not None and age > config.max_age:
            return [Check(label, "fail", words, status.error)]
        if fps < min_frame_rate * config.fps or status.damaged > 1:  # the first after opening is often damaged
            return [
                Check(label, "warn", words, f"{config.fps:g} frames/s were asked for: exposure, USB hub, or cable?")
            ]
        return [Check(label, "ok", words)]

    def diagnostics(self, source: TactileSource) -> Mapping[str, float]:
        """The frames that gave no picture."""
        status = cast("Camera", source).status
        counts = {PICTURES_LOST: status.dropped, PICTURES_DAMAGED: status.damaged, PICTURES_REPEATED: status.repeated}
        return {key + self.name: float(count) for key, count in counts.items()}
