"""A tactile sensor as a camera of LeRobot's, configured as any of its robots would."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from robot.fixtures import mock_host
from robot.mock import MockCamera
from tests.plugins.commands import LIMIT, surroundings

FILE = """
name: finger
clock: wall
canonical: { rows: 16, columns: 24, pitch: 0.5 mm }
sensors:
  finger: { driver: camera, source: 'SOURCE', width: 80, height: 60, stamped: true, max_age: 20 s, fps: 25 }
"""
PROGRAM = """
from lerobot.cameras import CameraConfig, make_cameras_from_configs
from lerobot.utils.import_utils import register_third_party_plugins

register_third_party_plugins()
config = CameraConfig.get_choice_class("tacsim")(rig="finger.yaml")
assert (config.fps, config.width, config.height) == (25, 48, 32)
with make_cameras_from_configs({"finger": config})["finger"] as camera:
    for picture in (camera.read(), camera.async_read(5000), camera.read_latest(20000)):
        assert picture.shape == (32, 48, 3) and picture.dtype == "uint8"
    assert camera.is_connected
assert not camera.is_connected
for wrong in ({"fps": 30}, {"sensor": "thumb"}):
    try:
        CameraConfig.get_choice_class("tacsim")(rig="finger.yaml", **wrong)
    except ValueError as failure:
        print(failure)
"""


@pytest.mark.deep
@pytest.mark.timeout(LIMIT + 20)
def test_lerobot_reads_the_canonical_picture(tmp_path: Path) -> None:
    random = np.random.default_rng(0)
    with MockCamera(mock_host(97), 8081, 80, 60) as mock:
        mock.push(random.integers(100, 140, (60, 80, 3), dtype=np.uint8))
        (tmp_path / "finger.yaml").write_text(FILE.replace("SOURCE", mock.url))
        done = subprocess.run(
            [sys.executable, "-c", PROGRAM], cwd=tmp_path, env=surroundings(tmp_path), capture_output=True, text=True,
            timeout=LIMIT,
        )  # fmt: skip
    assert done.returncode == 0, done.stderr[-3000:]
    assert "sensor 'finger' of finger.yaml has fps=25, not 30: leave it out" in done.stdout
    assert "rig 'finger' has no sensor 'thumb'; it has finger" in done.stdout
