"""A sensor and an arm that somebody else has written: installed beside tacsim, of which nothing is edited.

`tacsim new driver` makes the distribution; pip installs it into a folder of the test, without the network.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

from tacsim.record.reader import read_episode

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
COMMAND = ("-c", "from robot.cli import main; main()")
RIG = """
name: mine
clock: wall
period: 100 ms
canonical: {{ rows: 32, columns: 32, pitch: 0.5 mm }}
arms:
  hand:
    driver: soft-touch
    start: {{ position: [0, 0, 0], rotation: [180 deg, 0, 0] }}
    limits: {{ workspace: {{ lower: [-20 mm, -20 mm, -20 mm], upper: [20 mm, 20 mm, 20 mm] }}, depth: {depth} }}
sensors:
  tip: {{ driver: {driver}, arm: hand }}
start: {{ touch_signal: {signal}, approach_speed: {speed} }}
"""


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder where the distribution is installed."""
    folder = tmp_path_factory.mktemp("site")
    made = folder.parent / f"{folder.name}-soft-touch"
    done = python(folder, folder, *COMMAND, "new", "driver", "soft-touch", "--out", str(made))
    assert done.returncode == 0, done.stderr
    command = [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--no-build-isolation", "--no-index"]
    command += ["--disable-pip-version-check", "--target", str(folder), str(made), str(HERE / "refused_drivers")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=100)
    assert done.returncode == 0, done.stderr
    return folder


def python(site: Path, folder: Path, *words: str, **more: str) -> subprocess.CompletedProcess[str]:
    paths = [str(site), str(ROOT), *(path for path in sys.path if path)]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths), "COLUMNS": "300", **more}
    return subprocess.run(
        [sys.executable, *words], cwd=folder, env=environment, capture_output=True, text=True, timeout=200
    )


def write_rig(
    folder: Path, driver: str = "soft-touch", signal: str = "0.02", speed: str = "2 mm/s", depth: str = "2 mm"
) -> Path:
    file = folder / "mine.yaml"
    file.write_text(RIG.format(driver=driver, signal=signal, speed=speed, depth=depth))
    return file


def said(done: subprocess.CompletedProcess[str]) -> str:
    return " ".join(f"{done.stdout} {done.stderr}".replace("│", " ").split())


@pytest.mark.slow
def test_outside_drivers_pass_the_contract_suite(site: Path, tmp_path: Path) -> None:
    rig = write_rig(tmp_path, signal="null")
    suite: Sequence[str] = (
        "-m",
        "pytest",
        "-q",
        "-p",
        "no:cacheprovider",
        "-n",
        "0",
        "-m",
        "not deep",
        "-k",
        "hardware",
    )
    done = python(site, ROOT, *suite, str(HERE / "test_contract.py"), TACSIM_CONTRACT_RIG=str(rig))
    assert done.returncode == 0, said(done)
    assert "14 passed" in done.stdout, done.stdout


@pytest.mark.slow
def test_outside_drivers_run_replay_and_pass_doctor(site: Path, tmp_path: Path) -> None:
    rig = str(write_rig(tmp_path))
    done = python(site, tmp_path, *COMMAND, "run", rig, "--policy", "grip", "--steps", "3", "--out", "first")
    assert done.returncode == 0, said(done)
    episode = read_episode(tmp_path / "first" / "episode.mcap")
    assert len(episode.steps) == 4
    first = episode.steps[0]
    assert -2.0 < first.arms["hand"].wrench[2] < 0.0  # the approach has touched
    assert first.info["soft_touch_temperature_tip"] == 30.5

    done = python(site, tmp_path, *COMMAND, "replay", "first/episode.mcap", "--out", "again")
    assert done.returncode == 0, said(done)
    stats = [json.loads((tmp_path / name / "summary.json").read_text()) for name in ("first", "again")]
    assert stats[0]["deepest"] == stats[1]["deepest"]

    done = python(site, tmp_path, *COMMAND, "run", "replay", *_replayed(tmp_path), "--out", "as_rig")
    assert done.returncode == 0, said(done)

    done = python(site, tmp_path, *COMMAND, "doctor", "--rig", rig)
    assert done.returncode == 0, said(done)
    assert "hand: soft-touch" in done.stdout and "tip: soft-touch" in done.stdout and "50 frames/s" in done.stdout


def _replayed(folder: Path) -> list[str]:
    return ["--set", f"sensors.finger.source={folder / 'first' / 'episode.mcap'}"]


def test_an_approach_that_is_too_fast_for_an_outside_sensor_is_refused(site: Path, tmp_path: Path) -> None:
    rig = str(write_rig(tmp_path, speed="20 mm/s", depth="0.5 mm"))
    done = python(site, tmp_path, *COMMAND, "run", rig, "--policy", "grip", "--out", "out")
    assert done.returncode == 2, said(done)
    words = "20 mm/s is too fast: the image of sensor 'tip' shows a touch 60 ms late, with its gel 1.2 mm deep, and "
    assert words + "limits.depth of arm 'hand' is 0.5 mm. At most 8.3 mm/s" in said(done)
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("driver", "words"),
    [
        (
            "hasty",
            "the one of refused-drivers (refused_drivers.hasty:HastyDriver) does not state worst_latency, so",
        ),
        ("torn", "cannot be loaded: ModuleNotFoundError: No module named 'no_such_vendor_library'"),
        (
            "soft-touc",
            "driver 'soft-touc' is unknown; allowed: camera | mujoco | replay | sim | soft-touch; did you mean "
            "'soft-touch'?",
        ),
    ],
)
def test_an_unusable_driver_is_refused_with_its_reason(site: Path, tmp_path: Path, driver: str, words: str) -> None:
    rig = str(write_rig(tmp_path, driver))
    for command in ("run", "doctor"):
        more = ["--rig", rig] if command == "doctor" else [rig, "--policy", "grip"]
        done = python(site, tmp_path, *COMMAND, command, *more)
        assert done.returncode == 2, said(done)
        assert "mine.yaml:12: sensors.tip" in said(done) and words in said(done)


def test_an_installation_without_registered_drivers_names_the_command(tmp_path: Path) -> None:
    """As an editable one that is older than its code."""
    program = """
from importlib import metadata
metadata.entry_points = lambda group: ()
from tacsim import load_rig
load_rig("sim")
"""
    done = python(tmp_path, tmp_path, "-c", program)
    assert "ConfigError: sim: the drivers of tacsim are not registered" in done.stderr, done.stderr
    assert "python -m pip install -e . --no-deps --no-build-isolation" in done.stderr
