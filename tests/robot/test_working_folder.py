"""A working folder that holds files with the names of our packages, or of modules that Python itself brings."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import pytest

from robot.deploy.policy import PolicyNotFound, load_policy
from robot.fixtures import mock_host, rig_addresses
from robot.mock import MockCamera, MockUR
from robot.open import open_rig
from robot.studies.experiment import TrialFailed, run_trials
from tacsim.interface import RigSpec

ROOT = Path(__file__).resolve().parents[2]
TRAP = "from pathlib import Path\nPath(__file__).with_suffix('.executed').touch()\nraise SystemExit('not ours')\n"
SPEC = RigSpec({}, (), False, 0.1)


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A person's own robot.py, calibration/, socket.py and random.py; none of them may be executed."""
    for name in ("robot", "socket", "random", "calibration/__init__"):
        path = tmp_path / f"{name}.py"
        path.parent.mkdir(exist_ok=True)
        path.write_text(TRAP)
    monkeypatch.chdir(tmp_path)
    yield tmp_path
    assert list(tmp_path.rglob("*.executed")) == []


def python(*words: str, path: str = str(ROOT)) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": path, "COLUMNS": "200"}
    return subprocess.run([sys.executable, *words], env=environment, capture_output=True, text=True, timeout=120)


def test_mocks_start_there(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", os.pathsep)  # what `$PYTHONPATH:...` leaves: empty entries are the working folder
    with MockUR(mock_host(91)) as arm, MockCamera(mock_host(91)) as camera:
        assert arm.running and camera.running


@pytest.mark.slow
def test_the_processes_of_trials_start_there() -> None:
    with pytest.raises(TrialFailed, match="failed: KeyError"):
        run_trials([("no such task", "hybrid")])


@pytest.mark.skipif(find_spec("benchmarks") is None, reason="only in the checkout")
def test_the_processes_of_benchmarks_start_there() -> None:
    from benchmarks.harness.runner import Case, run_cases

    report = run_cases([Case("press", "raises", "tacsim", "none", json.loads)], 1, baselines=False, long=False)
    assert "TypeError" in report.failures[0].cause


@pytest.mark.skipif(find_spec("rtde_control") is None, reason="ur_rtde has no wheel for this Python and machine")
@pytest.mark.deep
def test_a_rig_of_mocks_opens_there() -> None:
    """Simulation, controllers, cameras, and the processes that talk to the arms."""
    with open_rig("mock", overrides=rig_addresses()) as rig:
        assert len(rig.arms) == 2


def test_the_command_runs_there_as_its_script_does() -> None:
    """Scripts that pip makes do not have the working folder on their path; `-P` is the same."""
    done = python("-P", "-c", "from robot.cli import main; main()", "schema", "scene")
    assert done.returncode == 0 and '"tacsim scene"' in done.stdout, done.stderr


@pytest.mark.parametrize(
    ("content", "name", "words"),
    [
        ("import robot\nrobot.arm_of_mine\n", "mine:act", "'robot' is a package of tacsim, .*robot.py is not imported"),
        ("import robot.mine\n", "mine:act", "imports 'robot.mine', which is missing. 'robot' is a package of tacsim"),
        ("from calibration import dots\n", "mine:act", "'calibration' is a package of tacsim, .*calibration is not"),
        ("", "robot:act", "'robot' has no 'act'. 'robot' is a package of tacsim, .*robot.py is not imported: rename"),
    ],
)
def test_a_policy_that_means_another_package_is_told(
    content: str, name: str, words: str, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (folder / "mine.py").write_text(content)
    monkeypatch.setattr(sys, "path", [*sys.path, str(folder)])  # as `tacsim run` does
    monkeypatch.delitem(sys.modules, "mine", raising=False)
    with pytest.raises(PolicyNotFound, match=words):
        load_policy(name, None, SPEC)


def test_a_script_beside_such_a_file_is_told_the_cause(folder: Path) -> None:
    """Of a script, its own folder stands before all installed packages."""
    for name in ("robot.py", "random.py", "socket.py"):
        (folder / name).unlink()
    done = python("-c", "import robot.open")
    assert f"'calibration' is {folder / 'calibration' / '__init__.py'}, not the package of tacsim" in done.stderr
    (folder / "robot.py").write_text("")
    done = python("-c", "from tacsim.gym import make_env; make_env(task='squeeze')")
    assert f"'robot' is {folder / 'robot.py'}, not the package of tacsim: rename it" in done.stderr
