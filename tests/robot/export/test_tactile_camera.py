"""A tactile sensor by itself as a camera: the picture that policies see, against that without contact."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from robot.camera.camera import Camera, StaleFrame
from robot.export.lerobot_rig import TactileCamera
from robot.fixtures import mock_host
from robot.mock import MockCamera
from tacsim.interface import IncompatibleRig
from tacsim.models.hardware import CameraSensorConfig

GREY = np.full((60, 80, 3), 120, np.uint8)
FILE = """
name: finger
clock: wall
canonical: { rows: 16, columns: 24, pitch: 0.5 mm }
sensors:
  finger: { driver: camera, source: 'SOURCE', width: 80, height: 60, stamped: true, max_age: 20 s, fps: 25 }
"""


@pytest.fixture
def mock() -> Iterator[MockCamera]:
    with MockCamera(mock_host(95), 8081, 80, 60, quality=100) as running:
        config = CameraSensorConfig(
            driver="camera", source=running.url, width=80, height=60, stamped=True, max_age=20.0
        )
        with Camera(config, "first") as camera:
            camera.wait_for(running.push(GREY), 20.0)  # before that it shows a picture of its own
        yield running


@pytest.fixture
def file(mock: MockCamera, tmp_path: Path) -> Path:
    path = tmp_path / "finger.yaml"
    path.write_text(FILE.replace("SOURCE", mock.url))
    return path


def test_the_picture_is_the_canonical_one(mock: MockCamera, file: Path) -> None:
    camera = TactileCamera(file)
    assert camera.shape == (32, 48, 3) and camera.fps == 25 and camera.name == "finger"  # known before it is open
    with pytest.raises(RuntimeError, match="not connected"):
        camera.read()
    camera.connect()
    try:
        untouched = camera.read()
        assert untouched.shape == camera.shape and np.abs(untouched.astype(int) - 128).max() <= 1
        pressing = GREY.copy()
        pressing[20:40, 30:50] = (132, 120, 108)  # a tenth of 120 more red and less blue
        mock.push(pressing)
        for _ in range(100):
            pressed = camera.read_new(20.0)
            if abs(int(pressed[16, 24, 0]) - 128) > 2:
                break
        red, green, blue = pressed[16, 24].astype(int) - 128  # without what looks like a lamp that changed
        assert red > 5 and abs(green) <= 1 and blue < -5
        assert camera.age() < 20.0
        mock.close()
        camera.read()
        with pytest.raises(StaleFrame, match=r"sensor 'finger': no new picture within 0.05 s"):
            camera.read_new(0.05)
    finally:
        camera.close()
    assert not camera.connected


def test_what_is_no_camera_is_refused(file: Path) -> None:
    with pytest.raises(IncompatibleRig, match="rig 'finger' has no sensor 'thumb'; it has finger"):
        TactileCamera(file, "thumb")
    with pytest.raises(IncompatibleRig, match="several sensors; name one of them: lower, upper"):
        TactileCamera("mock")
    with pytest.raises(IncompatibleRig, match="sensor 'lower' of rig 'sim' is sim, not a camera"):
        TactileCamera("sim", "lower")
    with pytest.raises(IncompatibleRig, match="a mock that its whole rig starts"):
        TactileCamera("mock", "lower")
