"""`tacsim run` and `tacsim replay`: episodes, their files, errors of policies, signals."""

from __future__ import annotations

import importlib.util
import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from robot.export.rerun_view import DISPLAYS
from tacsim.record.reader import read_episode
from tests.robot.cli.invoked import START, TINY, environment, plain_text, tacsim

pytestmark = pytest.mark.usefixtures("empty_folder")


@pytest.mark.slow
def test_run_records_given_steps_and_replay_shows_them(tmp_path: Path) -> None:
    result = tacsim("run", "--steps", "3", "--seed", "5", "--out", "r", *TINY)
    assert result.exit_code == 0, result.output
    names = ("report.html", "report.png", "episode.mcap", "summary.json")
    assert sorted(path.name for path in (tmp_path / "r").iterdir()) == sorted(names)
    assert all(str(Path("r") / name) in result.stdout for name in names)
    config = json.loads((tmp_path / "r" / "summary.json").read_text())
    assert (config["steps"], len(config["reward"]), config["seed"], config["complete"]) == (3, 3, 5, True)
    assert config["distance"][2] < config["distance"][0]  # the scripted policy squeezes
    episode = read_episode(tmp_path / "r" / "episode.mcap")
    assert [step.index for step in episode.steps] == [0, 1, 2, 3]
    assert b"scene:" in episode.meta.attachments["rig.yaml"]

    result = tacsim("replay", "r/episode.mcap", "--out", "again")
    assert result.exit_code == 0, result.output
    again = json.loads((tmp_path / "again" / "summary.json").read_text())
    assert again["reward"] == pytest.approx(config["reward"])
    assert again["force"] == config["force"]


@pytest.mark.slow
def test_run_without_out_makes_folder_in_runs(tmp_path: Path) -> None:
    result = tacsim("run", "--steps", "0", "--task", "reposition", *TINY)
    assert result.exit_code == 0, result.output
    (folder,) = (tmp_path / "runs").iterdir()
    assert folder.name.endswith("-reposition")
    assert f"runs/{folder.name}/report.html" in result.stdout


@pytest.mark.slow
def test_run_writes_film_and_film_of_recording_has_same_frames(tmp_path: Path) -> None:
    result = tacsim("run", "--steps", "2", "--out", "r", "--film", "first.gif", *TINY)
    assert result.exit_code == 0, result.output
    assert "first.gif" in result.stdout
    result = tacsim("film", "r/episode.mcap")
    assert result.exit_code == 0, result.output
    assert "r/episode.gif" in result.stdout
    with Image.open(tmp_path / "first.gif") as first, Image.open(tmp_path / "r/episode.gif") as again:
        assert first.n_frames == again.n_frames == 3  # type: ignore[attr-defined]
        assert np.array_equal(np.asarray(first.convert("RGB")), np.asarray(again.convert("RGB")))


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("run", "--film", "a.avi"), "a.avi must end in .gif or .mp4"),
        (("run", "--film", "mine.gif"), "exists already"),
        (("film", "missing.mcap"), "missing.mcap: no such file; `tacsim run` records an episode.mcap"),
        (("film", "mine.gif", "--out", "b.gif"), "name the episode.mcap of a run"),
        (("film", "missing.mcap", "--out", "a.txt"), "a.txt must end in .gif or .mp4"),
    ],
)
def test_film_that_cannot_be_made_is_refused_before_anything_runs(
    words: tuple[str, ...], said: str, tmp_path: Path
) -> None:
    (tmp_path / "mine.gif").write_text("keep")
    result = tacsim(*words)
    assert result.exit_code == 2
    assert said in plain_text(result.stderr)
    assert [path.name for path in tmp_path.iterdir()] == ["mine.gif"]
    assert (tmp_path / "mine.gif").read_text() == "keep"


@pytest.mark.parametrize("option", [("--view",), ("--save-view", "a.rrd")])
def test_a_view_that_cannot_be_shown_is_refused_before_the_simulation(
    option: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "rerun" else find(name))
    monkeypatch.setattr("robot.rig.sim_rig.make_world", lambda scene: pytest.fail("the simulation was opened"))
    result = tacsim("run", *option)
    assert result.exit_code == 2 and "a view needs rerun-sdk, which is not installed" in result.stderr


@pytest.mark.skipif(sys.platform != "linux", reason="other systems need no variable for a window")
def test_a_view_without_a_display_is_refused_before_the_simulation(monkeypatch: pytest.MonkeyPatch) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: find("json") if name == "rerun" else find(name))
    monkeypatch.setattr("robot.rig.sim_rig.make_world", lambda scene: pytest.fail("the simulation was opened"))
    for name in DISPLAYS:
        monkeypatch.delenv(name, raising=False)
    result = tacsim("run", "--view")
    assert result.exit_code == 2
    assert "a view needs a display" in result.stderr and "--save-view FILE.rrd" in result.stderr


@pytest.mark.slow
def test_simulated_body_is_recorded_unless_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("robot.deploy.control_loop.MAX_PARTICLES", 7)
    for name, more in (("with", []), ("without", ["--set", "record.body=false"])):
        result = tacsim("run", "--steps", "1", "--out", name, *TINY, *more)
        assert result.exit_code == 0, result.output
    first, last = (step.body for step in read_episode(tmp_path / "with/episode.mcap").steps)
    assert first is not None and last is not None and 4 <= len(first) <= 7 and not np.array_equal(first, last)
    assert np.ptp(first[:, 2]) > 1e-3 and first[:, 2].min() > -1e-3  # spread over the body, on the lower gel
    assert all(step.body is None for step in read_episode(tmp_path / "without/episode.mcap").steps)
    for rig in ("ur5e-one", "press"):  # hardware; an indenter
        refused = tacsim("run", rig, "--set", "record.body=true", "--out", "refused")
        assert refused.exit_code == 2 and "only a simulated rig with a body" in refused.stderr.replace("\n", " ")


@pytest.mark.slow
def test_policy_error_keeps_finished_steps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "here.py").write_text("def act(observation):\n    raise RuntimeError('no idea')\n")
    result = tacsim("run", "--policy", "here:act", "--steps", "3", "--out", "r", *TINY)
    assert result.exit_code == 1
    assert "no idea" in result.stderr
    assert json.loads((tmp_path / "r" / "summary.json").read_text())["steps"] == 0
    assert len(read_episode(tmp_path / "r" / "episode.mcap").steps) == 1


def test_episode_without_steps_prints_only_its_error(tmp_path: Path) -> None:
    text = "class Act:\n    needs = Needs()\n    def reset(self): raise OSError('no gripper')\n"
    text += "    def __call__(self, observation): return None\n"
    (tmp_path / "unready.py").write_text("from tacsim.interface import Needs\n" + text)
    result = tacsim("run", "--policy", "unready:Act", "--out", "r", *TINY)
    assert result.exit_code == 1
    assert "no gripper" in result.stderr
    assert "report" not in result.stderr
    again = tacsim("replay", "r/episode.mcap", "--out", "again")
    assert again.exit_code == 2
    assert "no step can be read" in again.stderr
    assert not (tmp_path / "again").exists()


@pytest.mark.deep
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)])
def test_signal_ends_episode_and_saves_it(tmp_path: Path, number: signal.Signals, code: int) -> None:
    words = ("run", "--steps", "100000", "--task", "reposition", "--out", "r", *TINY)
    process = subprocess.Popen(
        [*START, *words], env=environment(), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        _wait_for_steps(tmp_path / "r" / "episode.mcap", process)
        process.send_signal(number)
        output, errors = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == code, errors
    episode = read_episode(tmp_path / "r" / "episode.mcap")
    assert episode.complete
    config = json.loads((tmp_path / "r" / "summary.json").read_text())
    assert config["steps"] == len(episode.steps) - 1 > 0
    assert (tmp_path / "r" / "report.html").exists()
    assert "report.html" in output
    assert "Traceback" not in errors


@pytest.mark.slow
def test_signal_in_process_ends_episode_and_saves_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = "import os, signal\nfrom tacsim.interface import Action\n"
    text += "def act(observation):\n    os.kill(os.getpid(), signal.SIGTERM)\n    return Action({})\n"
    (tmp_path / "ending.py").write_text(text)
    result = tacsim("run", "--policy", "ending:act", "--steps", "9", "--out", "r", *TINY)
    assert result.exit_code == 143, result.output
    assert "stopped by a signal before the last step; all finished steps are saved" in result.stderr
    assert len(read_episode(tmp_path / "r" / "episode.mcap").steps) == 2


def _wait_for_steps(path: Path, process: subprocess.Popen[str]) -> None:
    """Until the recording has grown by a few steps."""
    end = time.monotonic() + 90
    while time.monotonic() < end and process.poll() is None:
        if path.exists() and path.stat().st_size > 1_500_000:
            return
        time.sleep(0.05)
    pytest.fail(f"no recording grew at {path}: {process.stderr.read() if process.poll() is not None else 'too slow'}")  # type: ignore[union-attr]
