"""A calibrated tactile sensor by itself, for people whose arms are not ours: the picture that policies see."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from robot.camera.camera import Camera, StaleFrame
from robot.export.lerobot_rig import picture_shape
from robot.open import load_with_task
from robot.rig.parts import sensor_of
from tacsim.interface import IncompatibleRig
from tacsim.models.hardware import CameraSensorConfig, parts_of

FIRST = 5.0  # longest wait for the picture without contact [s]
POLL = 2e-3  # between two looks for a new picture [s]


class TactileCamera:
    """One camera of a rig file. Its arms, if it has some, are left alone.

    sensor: its name in the file; None: the only one. Raises what loading the file and its calibration raise, and
    IncompatibleRig for a sensor that is no camera. Nothing is opened.
    """

    def __init__(self, rig: str | Path, sensor: str | None = None, overrides: Sequence[str] = ()) -> None:
        config = load_with_task(rig, None, overrides).config
        there = ", ".join(config.sensors)
        if sensor is None and len(config.sensors) > 1:
            raise IncompatibleRig(f"rig '{config.name}' has several sensors; name one of them: {there}")
        self.name = next(iter(config.sensors)) if sensor is None else sensor
        if self.name not in config.sensors:
            raise IncompatibleRig(f"rig '{config.name}' has no sensor '{self.name}'; it has {there}")
        found = parts_of(config.sensors, CameraSensorConfig).get(self.name)
        if found is None:
            driver = config.sensors[self.name].driver
            raise IncompatibleRig(f"sensor '{self.name}' of rig '{config.name}' is {driver}, not a camera")
        if found.is_mock:
            raise IncompatibleRig(
                f"sensor '{self.name}' of rig '{config.name}' is a mock that its whole rig starts; name a camera that "
                "runs by itself"
            )
        self.fps: float = found.fps  # that the camera is asked for
        self.shape = picture_shape(config.canonical)  # of a picture: rows, columns, 3
        self._config = found
        self._normaliser = sensor_of(config, self.name).normaliser()
        self._camera: Camera | None = None
        self._seen = -1  # index of the frame that `read_new` gave last

    @property
    def connected(self) -> bool:
        return self._camera is not None

    def connect(self) -> None:
        """Opens the camera and takes its picture now as that without contact: nothing may touch the gel.

        Raises DeviceError, and RuntimeError when it is connected already.
        """
        if self._camera is not None:
            raise RuntimeError(f"sensor '{self.name}' is connected already")
        with ExitStack() as stack:
            camera = stack.enter_context(Camera(self._config, self.name))
            self._normaliser.take_reference(camera.read(FIRST))
            stack.pop_all()
        self._camera, self._seen = camera, -1

    def read(self, timeout: float = 1.0) -> NDArray[np.uint8]:
        """The newest canonical picture, (H, W, 3) RGB. Raises TimeoutError without one within the sensor's max_age, and
        RuntimeError when it is not connected."""
        frame = self._opened().read(timeout)
        self._seen = frame.index
        return self._normaliser(frame, frame.time).image

    def read_new(self, timeout: float) -> NDArray[np.uint8]:
        """One that was not read before. Raises as `read`."""
        camera, deadline = self._opened(), time.monotonic() + timeout
        while camera.read(max(0.0, deadline - time.monotonic())).index == self._seen:
            if time.monotonic() >= deadline:
                raise StaleFrame(f"sensor '{self.name}': no new picture within {timeout:.3g} s")
            time.sleep(POLL)
        return self.read(timeout)

    def age(self) -> float:
        """Of the newest picture, since its exposure [s]. Raises RuntimeError when it is not connected."""
        age = self._opened().status.age
        return float("inf") if age is None else age

    def close(self) -> None:
        """Releases the camera. A second call does nothing."""
        camera, self._camera = self._camera, None
        if camera is not None:
            camera.close()

    def _opened(self) -> Camera:
        if self._camera is None:
            raise RuntimeError(f"sensor '{self.name}' is not connected: call connect() first")
        return self._camera
