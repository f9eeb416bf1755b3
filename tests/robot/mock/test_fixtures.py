"""The pytest plugin for users: it works in a project of theirs, and side by side with itself."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from robot.fixtures import mock_host, rig_addresses
from tacsim.config import load_rig

ROOT = Path(__file__).resolve().parents[3]
THEIRS = """
import numpy as np
import pytest
from robot.camera.camera import Camera
from tacsim.config import load_rig
from tacsim.models.hardware import CameraSensorConfig


def test_mock_ur_fixture_accepts_faults(mock_ur):
    assert mock_ur.faults.state().mode == "RUNNING"
    mock_ur.faults.protective_stop()
    assert mock_ur.faults.state().safety == "PROTECTIVE_STOP"


def test_mock_ur_fixture_is_new_in_next_test(mock_ur):
    assert mock_ur.faults.state().safety == "NORMAL"


def test_mock_camera_fixture_shows_pushed_image(mock_camera):
    mock_camera.push(np.full((240, 320, 3), 77, np.uint8))
    config = CameraSensorConfig(
        driver="camera", source=mock_camera.url, width=320, height=240, stamped=True, max_age=10
    )
    with Camera(config, "finger") as camera:
        assert abs(int(camera.wait_for(1, 10.0).image.mean()) - 77) < 3


def test_mock_rig_fixture_takes_overrides(mock_rig, tmp_path):
    with pytest.raises(Exception, match="no_such_key"):
        mock_rig("no_such_key=1")
"""


@pytest.mark.slow
def test_fixtures_work_as_plugin_of_other_tests(tmp_path: Path) -> None:
    (tmp_path / "conftest.py").write_text('pytest_plugins = ["robot.fixtures"]\n')
    (tmp_path / "test_theirs.py").write_text(THEIRS)
    done = subprocess.run(
        [sys.executable, "-W", "error", "-m", "pytest", "-q", "-p", "no:cacheprovider", str(tmp_path)],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=100,
    )
    assert "4 passed" in done.stdout, done.stdout + done.stderr
    assert done.returncode == 0 and "Warning" not in done.stderr, done.stderr


def test_fixture_addresses_are_loopback_of_process() -> None:
    config = load_rig("mock", overrides=rig_addresses()).config
    hosts = [arm.host for arm in config.arms.values()]  # type: ignore[union-attr]
    assert len(set(hosts)) == 2
    assert all(host.startswith(mock_host(1).rpartition(".")[0] + ".") and host.startswith("127.") for host in hosts)
    for name, host in zip(config.arms, hosts, strict=True):
        assert f"//{host}:" in config.sensors[name].source  # type: ignore[union-attr, operator]


@pytest.mark.parametrize("number", [1, 254])
def test_fixture_addresses_differ_between_processes(number: int, monkeypatch: pytest.MonkeyPatch) -> None:
    own = mock_host(number)
    other = os.getpid() + 1
    monkeypatch.setattr(os, "getpid", lambda: other)
    assert mock_host(number) != own
