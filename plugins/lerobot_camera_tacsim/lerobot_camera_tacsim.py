"""LeRobot's camera `tacsim`: a tactile sensor beside any robot, as the picture that policies see (docs/lerobot.md)."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from lerobot.cameras import Camera, CameraConfig
from numpy.typing import NDArray

from robot import TactileCamera

READ = 1.0  # longest wait for a new picture [s]


@CameraConfig.register_subclass("tacsim")
@dataclass(kw_only=True)
class TacsimCameraConfig(CameraConfig):
    """A sensor of a rig file, whose arms are left alone; `sensor` may be left out where there is one. fps, width and
    height are the file's; others are refused."""

    rig: str
    sensor: str | None = None
    overrides: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        camera = TactileCamera(self.rig, self.sensor, self.overrides)
        height, width, _ = camera.shape
        for name, value in (("fps", round(camera.fps)), ("width", width), ("height", height)):
            given = getattr(self, name)
            if given not in (None, value):
                raise ValueError(f"sensor '{camera.name}' of {self.rig} has {name}={value}, not {given}: leave it out")
            setattr(self, name, value)


class TacsimCamera(Camera):
    """Nothing may touch the gel while it connects: that picture is the reference of all others."""

    def __init__(self, config: TacsimCameraConfig) -> None:
        super().__init__(config)
        self._sensor = TactileCamera(config.rig, config.sensor, config.overrides)

    @staticmethod
    def find_cameras() -> list[dict[str, Any]]:
        return []  # a tactile sensor is one by its calibration, which a rig file names

    @property
    def is_connected(self) -> bool:
        return self._sensor.connected

    def connect(self, warmup: bool = True) -> None:
        self._sensor.connect()

    def read(self) -> NDArray[np.uint8]:
        return self._sensor.read_new(READ)

    def async_read(self, timeout_ms: float = 200) -> NDArray[np.uint8]:
        return self._sensor.read_new(1e-3 * timeout_ms)

    def read_latest(self, max_age_ms: int = 500) -> NDArray[np.uint8]:
        if (age := 1e3 * self._sensor.age()) > max_age_ms:
            raise TimeoutError(f"the newest picture is {age:.0f} ms old, limit {max_age_ms} ms")
        return self._sensor.read(0.0)

    def disconnect(self) -> None:
        self._sensor.close()
