"""LeRobot's own commands, unmodified, with our plug-ins and a device that plays a script."""

from __future__ import annotations

import os
import subprocess
import sys
from importlib import util
from pathlib import Path

import pytest

from tests.robot.rig.bare_rig import bare_file

if util.find_spec("lerobot") is None:
    pytest.skip("LeRobot is not installed: it wants Python 3.12", allow_module_level=True)
for kind in ("robot", "camera", "env", "teleoperator"):
    if util.find_spec(f"lerobot_{kind}_tacsim") is None:
        pytest.skip(f"plugins/lerobot_{kind}_tacsim is not installed", allow_module_level=True)

ROOT = Path(__file__).resolve().parents[2]
LIMIT = 240.0  # of one command [s]


def surroundings(home: Path) -> dict[str, str]:
    """Of a command: nothing of LeRobot's is kept outside `home`, no network, and the scripted device is found as an
    installed distribution is."""
    found = home / "site"
    described = found / "lerobot_teleoperator_script-0.dist-info"
    if not described.is_dir():
        described.mkdir(parents=True)
        (described / "METADATA").write_text("Metadata-Version: 2.1\nName: lerobot_teleoperator_script\nVersion: 0\n")
        module = Path(__file__).with_name("lerobot_teleoperator_script.py")
        (found / module.name).write_text(module.read_text(encoding="utf-8"), encoding="utf-8")
    offline = {"HF_HUB_OFFLINE": "1", "HF_LEROBOT_HOME": str(home / "lerobot"), "HF_HOME": str(home / "hf")}
    return {**os.environ, **offline, "PYTHONPATH": os.pathsep.join([str(found), str(ROOT)])}


def words_of(command: str, *options: str) -> list[str]:
    """`lerobot-record` and its sisters as a module: the same code, by this Python."""
    return [sys.executable, "-m", f"lerobot.scripts.{command.replace('-', '_')}", *options]


def run(home: Path, command: str, *options: str) -> str:
    """What it said. It must end well."""
    done = subprocess.run(
        words_of(command, *options),
        cwd=home, env=surroundings(home), capture_output=True, text=True, timeout=LIMIT, stdin=subprocess.DEVNULL,
    )  # fmt: skip
    said = done.stdout + done.stderr
    assert done.returncode == 0, said[-6000:]
    return said


def refused(home: Path, command: str, *options: str) -> str:
    """What it said. It must fail."""
    done = subprocess.run(
        words_of(command, *options),
        cwd=home, env=surroundings(home), capture_output=True, text=True, timeout=LIMIT, stdin=subprocess.DEVNULL,
    )  # fmt: skip
    assert done.returncode != 0, done.stdout[-3000:]
    return done.stdout + done.stderr


def rig_file(folder: Path, first: int) -> Path:
    """Two mock arms and two cameras at addresses of this process, patient with a busy machine."""
    file = bare_file(folder, first)
    text = file.read_text().replace("period: 50 ms", "period: 100 ms").replace("max_age: 1 s", "max_age: 20 s")
    file.write_text(text.replace("watchdog: 0.4", "watchdog: 0.4\n    observation_timeout: 30 s"))
    return file
