"""What tests of the camera driver share: configurations, patience, and the host of their servers."""

from __future__ import annotations

import os
import time

import numpy as np

from robot.camera.camera import Camera
from robot.mock.camera.camera import MockCamera
from tacsim.interface import TactileFrame
from tacsim.models.hardware import CameraSensorConfig

HOST = f"127.22.{os.getpid() >> 8 & 255}.{os.getpid() & 255}"
WAIT = 20.0  # for what must come, however slow the machine [s]


def config(source: object, **options: object) -> CameraSensorConfig:
    known: dict[str, object] = {"width": 320, "height": 240, "fps": 30.0, "max_age": 1.0}
    return CameraSensorConfig.model_validate({"driver": "camera", "source": str(source), **known, **options})


def stamped(mock: MockCamera, **options: object) -> CameraSensorConfig:
    return config(mock.url, stamped=True, **options)


def grey(value: int) -> np.ndarray:
    return np.full((240, 320, 3), value, dtype=np.uint8)


def newer(camera: Camera, than: TactileFrame) -> TactileFrame:
    deadline = time.monotonic() + WAIT
    while (frame := camera.read(WAIT)).index <= than.index:
        assert time.monotonic() < deadline, "no newer frame came"
        time.sleep(0.002)
    return frame
