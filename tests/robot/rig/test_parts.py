"""The drivers of a rig's parts, and the companion of its mocks."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from robot.arm.driver import UrDriver
from robot.open import open_rig
from robot.rig import CannotOpen
from robot.rig.parts import companion_class
from tacsim.config import load_rig

ROOT = Path(__file__).resolve().parents[3]
REAL = """
import sys, numpy as np
from PIL import Image
from robot.doctor import examine_rig
from robot.errors import DeviceError
from robot.open import open_rig
from tacsim.config import load_rig

Image.fromarray(np.full((480, 640, 3), 90, np.uint8)).save("0.png")
simulator = ["arms.arm.simulator=true", "arms.arm.host=127.0.0.1"]  # where nothing answers
config = load_rig("ur5e-one", overrides=[*simulator, "sensors.finger.source=."]).config
try:
    open_rig(config, dry_run=True)
except DeviceError as failure:
    print(failure)
print([check.name for check in examine_rig(config)])
print("mocks:", [name for name in sys.modules if name.startswith("robot.mock")])
"""


@pytest.mark.slow
def test_rig_without_mocks_imports_no_mock(tmp_path: Path) -> None:
    """Up to the arm that does not answer, and in `tacsim doctor`."""
    done = subprocess.run(
        [sys.executable, "-c", REAL],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=100,
    )
    assert done.returncode == 0, done.stderr
    assert "127.0.0.1" in done.stdout and "arm: network" in done.stdout and "finger: camera" in done.stdout
    assert "mocks: []" in done.stdout


def test_keep_out_unsupported_by_driver_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(UrDriver, "keeps_distances", False)
    with pytest.raises(ValueError, match="keep_out of lower and upper: their drivers, 'ur' and 'ur', do not keep"):
        open_rig("mock")


def test_mocks_with_different_companions_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(UrDriver, "companion", property(lambda driver: "elsewhere:Cell"))
    with pytest.raises(CannotOpen, match=r"different companions, elsewhere:Cell and robot\.mock"):
        companion_class(load_rig("mock").config)
