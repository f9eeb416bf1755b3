"""The `tacsim` command: exit codes, messages, files, signals."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner, Result

from robot.cli import app
from robot.cli.errors import explain
from robot.cli.output import writing
from robot.studies.experiment import (
    EXPERIMENTS,
    TrialFailed,
    as_json,
    image_difference,
    key_steps,
    run_trials,
    shortcomings,
)
from robot.studies.press import PressMotion, _targets
from tacsim.config import ConfigError
from tacsim.interface import IncompatibleRig, Pose, TactileFrame
from tacsim.models.scene import Sphere
from tacsim.record.episode import EpisodeError
from tacsim.record.reader import read_episode
from tacsim.report.figure4 import Trial

COMMANDS = ("run", "press", "reproduce", "replay", "schema", "doctor", "debug", "bench", "mock", "compare")
TINY = ("--set", "scene.particle_spacing=1 mm", "--set", "scene.element_size=2 mm")  # a world of seconds
START = (sys.executable, "-c", "from robot.cli import main; main()")


@pytest.fixture(autouse=True)
def in_an_empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setenv("TERM", "dumb")


def tacsim(*words: str) -> Result:
    return CliRunner().invoke(app, list(words), env={"COLUMNS": "200"})


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_explains_itself_with_an_example(command: str) -> None:
    result = tacsim(command, "--help")
    assert result.exit_code == 0
    assert f"Example: tacsim {command}" in result.stdout


def test_help_lists_all_commands_and_loads_nothing_heavy() -> None:
    result = tacsim("--help")
    assert all(command in result.stdout for command in COMMANDS)
    code = "import sys, robot.cli; print(' '.join(sys.modules))"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert "typer" in loaded
    assert not {"taichi", "cv2", "matplotlib", "scipy", "numpy", "pydantic"} & set(loaded)


def test_version() -> None:
    result = tacsim("--version")
    assert result.exit_code == 0
    assert result.stdout.startswith("tacsim")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("run", "no-such-rig"), "no-such-rig"),
        (("run", "--set", "scene.presett=draft"), "did you mean"),
        (("run", "--task", "juggle"), "juggle"),
        (("run", "--steps", "-1"), "--steps"),
        (("press", "banana"), "sphere, cylinder, box"),
        (("press", "sphere", "--depth", "1 kg"), "kg"),
        (("press", "sphere", "--slide", "1 mm"), "2 are needed"),
        (("schema", "rigg"), "rig, task, scene"),
        (("run", "--policy", "no.such:thing"), "no.such:thing"),
        (("run", "--policy", ""), "no policy ''"),
        (("run", "--set", "scene.element_size=1e-9"), "the limit is 5,000,000"),
        (("press", "sphere", "--radius", "1e308"), "radius"),
        (("run", "--set", "arms.upper.driver=replay"), "arms.upper"),
        (("run", "replay"), "sensors.finger.source"),
        (("press", "missing.stl"), "missing.stl: no such mesh file"),
        (("press", "sphere", "--depth", "9 mm"), "0.009"),
        (("press", "sphere", "--depth", "0"), "must be above 0"),
        (("press", "sphere", "--slide", "10 m, 0"), "at most 3 widths of the gel, 0.06 m"),
        (("press", "sphere", "--twist", "1e9 deg"), "at most 3600 deg"),
        (("press", "sphere", "--radius", "0.05 mm", "--depth", "0.3 mm"), "choose element_size at most"),
        (("press", "sphere", "--set", "gel.size=[20 mm, 13.3 mm, 4 mm]"), "does not divide into cubes"),
        (("press", "sphere", "--out", "/proc/self/x"), "/proc/self/x cannot be made"),
        (("run", "--out", "/dev/null/x"), "/dev/null/x cannot be made (Not a directory)"),
    ],
)
def test_wrong_words_end_with_2_and_write_nothing(words: tuple[str, ...], said: str, tmp_path: Path) -> None:
    result = tacsim(*words)
    assert result.exit_code == 2
    assert said in result.stderr
    assert "Traceback" not in result.output
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("run", "replay", "--set", "sensors.finger.source=missing.mcap"), "missing.mcap"),
        (("replay", "missing.mcap"), "missing.mcap"),
    ],
)
def test_what_cannot_be_done_ends_with_1_and_writes_nothing(words: tuple[str, ...], said: str, tmp_path: Path) -> None:
    result = tacsim(*words)
    assert result.exit_code == 1, result.output
    assert said in result.stderr
    assert "Traceback" not in result.output
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("words", [("run",), ("press", "sphere"), ("reproduce",), ("replay", "x.mcap")])
def test_an_existing_folder_is_refused_and_left_alone(words: tuple[str, ...], tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("keep")
    result = tacsim(*words, "--out", "mine")
    assert result.exit_code == 2
    assert "exists already" in result.stderr
    assert [path.name for path in (tmp_path / "mine").iterdir()] == ["notes.txt"]


def test_exit_codes_of_errors() -> None:
    assert explain(ConfigError([]))[1] == 2
    assert explain(EpisodeError("x.mcap: is no episode")) == ("x.mcap: is no episode", 1)
    assert explain(IncompatibleRig("it lacks truth"))[1] == 2
    assert explain(PermissionError(13, "Permission denied", "out")) == ("out: Permission denied", 1)
    assert "--debug" in explain(KeyError("slip"))[0]
    assert "no room" in explain(ExceptionGroup("two", [OSError("no room"), EpisodeError("bad")]))[0]


@pytest.mark.parametrize("words", [("--debug", "replay", "missing.mcap"), ("replay", "missing.mcap", "--debug")])
def test_debug_shows_the_traceback_wherever_it_stands(words: tuple[str, ...]) -> None:
    assert isinstance(tacsim(*words).exception, EpisodeError)


def test_schema_is_json_and_doctor_too() -> None:
    assert json.loads(tacsim("schema", "scene").stdout)["title"] == "tacsim scene"
    result = tacsim("doctor", "--json")
    report = json.loads(result.stdout)
    assert result.exit_code == (0 if report["ok"] else 1)


def test_press_measures_a_ball(tmp_path: Path) -> None:
    result = tacsim("press", "sphere", "--radius", "3 mm", "--depth", "0.5 mm", "--preset", "draft", "--out", "p")
    assert result.exit_code == 0, result.output
    config = json.loads((tmp_path / "p" / "press.json").read_text())
    # Half-space (Hertz): sqrt(R d) = 1.22 mm, 0.154 N; a layer of 4 mm on a rigid back is stiffer, elements are 1 mm.
    assert config["contact_radius"] == pytest.approx(1.22e-3, rel=0.2)
    assert 0.154 < config["force"] < 2 * 0.154
    height = np.load(tmp_path / "p" / "height.npy", allow_pickle=False)
    assert (height.dtype, height.shape) == (np.float32, (240, 320))
    assert height.max() == pytest.approx(0.5e-3, rel=0.1)
    assert np.unravel_index(height.argmax(), height.shape) == pytest.approx((119.5, 159.5), abs=6)
    assert imread(tmp_path / "p" / "rgb.png").shape[:2] == (240, 320)
    assert imread(tmp_path / "p" / "height.png").shape[1] == 800


def test_press_slides_and_twists_against_friction(tmp_path: Path) -> None:
    box = ("press", "box", "--size", "4 mm, 3 mm, 5 mm", "--depth", "0.4 mm", "--preset", "draft")
    assert tacsim(*box, "--slide", "0.5 mm, 0", "--twist", "5 deg", "--out", "slid").exit_code == 0
    slid = json.loads((tmp_path / "slid" / "press.json").read_text())
    force_x, moment_z = slid["wrench"][0], slid["wrench"][5]
    assert 0.02 < force_x / slid["force"] <= 0.6 + 1e-3  # drags the gel along, no more than friction 0.6 can
    assert moment_z > 0
    height = np.load(tmp_path / "slid" / "height.npy", allow_pickle=False)
    deep = np.argwhere(height > 0.35e-3)
    assert deep[:, 1].mean() == pytest.approx(159.5 + 0.5 / 0.0625, abs=3)  # +x is to the right, where the box went


@pytest.mark.parametrize(("name", "content", "said"), [("e", b"", "is empty"), ("t", bytes(84) + b"x", "should have")])
def test_a_broken_mesh_file_ends_with_2(name: str, content: bytes, said: str, tmp_path: Path) -> None:
    (tmp_path / f"{name}.stl").write_bytes(content)
    result = tacsim("press", f"{name}.stl")
    assert result.exit_code == 2 and said in result.stderr


@pytest.mark.deep
@pytest.mark.parametrize(
    ("variable", "value", "said"),
    [
        ("TACSIM_THREADS", "0", "TACSIM_THREADS must be a whole number from 1 on"),
        ("TACSIM_DEVICE", "abacus", "TACSIM_DEVICE must be one of cpu"),
        ("TACSIM_DEVICE", "metal", "Taichi finds no such device"),
    ],
)
def test_a_machine_that_is_not_there_ends_with_2(variable: str, value: str, said: str, tmp_path: Path) -> None:
    words = (*START, "press", "sphere", "--preset", "draft")
    result = subprocess.run(words, env={**_environment(), variable: value}, capture_output=True, text=True)
    assert result.returncode == 2 and said in result.stderr and "unexpected" not in result.stderr
    assert list(tmp_path.iterdir()) == []


def test_a_twist_beyond_half_a_turn_goes_on_the_same_way() -> None:
    start, motion = Pose(np.array([0.0, 0.0, 5e-3])), PressMotion(twist=np.radians(-270.0))
    targets = _targets(start, Sphere(radius=4e-3), motion)
    turns = [Rotation.from_quat(target.quaternion) for target in targets]
    steps = [np.degrees((b * a.inv()).as_rotvec()) for a, b in pairwise(turns)]
    assert np.allclose(steps, [[0, 0, -90.0]] * 3)


def test_a_press_that_is_not_held_says_so(tmp_path: Path) -> None:
    hasty = ("--preset", "draft", "--set", "settling.max_substeps=0", "--set", "gel.size=[8 mm, 8 mm, 4 mm]")
    result = tacsim("press", "sphere", "--radius", "2 mm", "--depth", "0.2 mm", "--out", "p", *hasty)
    assert result.exit_code == 0, result.output
    config = json.loads((tmp_path / "p" / "press.json").read_text())
    assert config["residual"] is None and config["settled"] is False
    assert "not settled, not held" in result.stderr


def test_a_press_that_diverges_leaves_what_debug_reads(tmp_path: Path) -> None:
    result = tacsim("press", "box", "--size", "5 mm, 5 mm, 5 mm", "--depth", "3.9 mm", "--preset=draft", "--out=p")
    assert result.exit_code == 1
    assert "tacsim debug p/diverged/00" in " ".join(result.output.split())
    assert (tmp_path / "p" / "diverged" / "00" / "state.npz").is_file()


def test_run_makes_exactly_its_steps_and_replay_shows_them_again(tmp_path: Path) -> None:
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


def test_run_without_out_makes_a_folder_below_runs(tmp_path: Path) -> None:
    result = tacsim("run", "--steps", "0", "--task", "reposition", *TINY)
    assert result.exit_code == 0, result.output
    (folder,) = (tmp_path / "runs").iterdir()
    assert folder.name.endswith("-reposition")
    assert f"runs/{folder.name}/report.html" in result.stdout


def test_an_error_of_the_policy_keeps_what_was_done(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "here.py").write_text("def act(observation):\n    raise RuntimeError('no idea')\n")
    monkeypatch.setattr(sys, "path", list(sys.path))  # the command adds the current folder
    result = tacsim("run", "--policy", "here:act", "--steps", "3", "--out", "r", *TINY)
    assert result.exit_code == 1
    assert "no idea" in result.stderr
    assert json.loads((tmp_path / "r" / "summary.json").read_text())["steps"] == 0
    assert len(read_episode(tmp_path / "r" / "episode.mcap").steps) == 1


def test_an_episode_without_steps_ends_with_its_own_error_alone(tmp_path: Path) -> None:
    text = "class Act:\n    needs = Needs()\n    def reset(self): raise OSError('no gripper')\n"
    text += "    def __call__(self, observation): return None\n"
    (tmp_path / "unready.py").write_text("from tacsim.interface import Needs\n" + text)
    result = tacsim("run", "--policy", "unready:Act", "--out", "r", *TINY)
    assert result.exit_code == 1
    assert "no gripper" in result.stderr
    assert "report" not in result.stderr
    again = tacsim("replay", "r/episode.mcap", "--out", "again")
    assert again.exit_code == 1
    assert "no step can be read" in again.stderr
    assert not (tmp_path / "again").exists()


def test_a_full_disk_is_named(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="No space") as caught, writing(tmp_path):
        raise OSError(28, "No space left on device")
    assert explain(caught.value) == (f"{tmp_path}: No space left on device", 1)


@pytest.mark.deep
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_ends_the_episode_and_saves_it(tmp_path: Path, number: signal.Signals, code: int) -> None:
    words = ("run", "--steps", "100000", "--task", "reposition", "--out", "r", *TINY)
    process = subprocess.Popen(
        [*START, *words], env=_environment(), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
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


def test_a_signal_in_this_process_ends_the_episode_and_saves_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = "import os, signal\nfrom tacsim.interface import Action\n"
    text += "def act(observation):\n    os.kill(os.getpid(), signal.SIGTERM)\n    return Action({})\n"
    (tmp_path / "ending.py").write_text(text)
    monkeypatch.setattr(sys, "path", list(sys.path))
    result = tacsim("run", "--policy", "ending:act", "--steps", "9", "--out", "r", *TINY)
    assert result.exit_code == 143, result.output
    assert "stopped by a signal before the last step; what was done is saved" in result.stderr
    assert len(read_episode(tmp_path / "r" / "episode.mcap").steps) == 2


def _environment() -> dict[str, str]:
    """So that a process started elsewhere finds the packages."""
    return {**os.environ, "PYTHONPATH": os.pathsep.join([str(Path(__file__).parents[3]), *sys.path])}


def _wait_for_steps(path: Path, process: subprocess.Popen[str]) -> None:
    """Until the recording has grown by a few steps."""
    end = time.monotonic() + 90
    while time.monotonic() < end and process.poll() is None:
        if path.exists() and path.stat().st_size > 1_500_000:
            return
        time.sleep(0.05)
    pytest.fail(f"no recording grew at {path}: {process.stderr.read() if process.poll() is not None else 'too slow'}")  # type: ignore[union-attr]


def made_up(distance: list[float]) -> Trial:
    """A trial with these distances [mm] from the goal."""
    metres = [value * 1e-3 for value in distance]
    seen = [0.5 * k for k in range(len(distance))]
    return Trial(
        list(range(len(distance))), [-d for d in distance], metres, seen, 7e-3, [], 1e-4, (0.02, 0.02, 0.004), 1e-3
    )


def test_a_curve_is_the_seeds_only_if_it_rises_to_the_goal_and_falls() -> None:
    good = made_up([3.0, 1.5, 0.04, 1.0, 2.0])
    assert shortcomings("squeeze", good) == []
    assert "closest" in shortcomings("squeeze", made_up([3.0, 1.5, 0.06, 1.0, 2.0]))[0]
    assert shortcomings("reposition", made_up([3.0, 1.5, 0.06, 1.0, 2.0])) == []  # 0.1 mm will do there
    assert "at the end" in shortcomings("squeeze", made_up([3.0, 1.5, 0.04, 0.1, 0.28]))[0]
    assert "at the start" in shortcomings("squeeze", made_up([0.2, 0.1, 0.04, 1.0, 2.0]))[0]
    assert "at the end" in shortcomings("squeeze", made_up([3.0, 2.0, 1.0, 0.5, 0.0]))[0]  # never falls
    blind = replace(good, image_difference=[0.0] * 5)
    assert "images" in shortcomings("squeeze", blind)[0]
    assert shortcomings("squeeze", made_up([float("nan")] * 5))  # nothing is no success


def test_what_the_reproduction_tells() -> None:
    assert key_steps(26, 15) == [0, 7, 15, 20, 25]
    assert key_steps(3, 2) == [0, 1, 2]
    config = as_json({"squeeze": {"seed": made_up([1.0, 0.0, 1.0])}})
    assert set(config["squeeze"]["seed"]) >= {"step", "reward", "goal", "image_difference"}
    json.dumps(config, allow_nan=False)
    dark, bright = (TactileFrame(np.full((2, 2, 3), value, np.uint8), 0.0, 0) for value in (250, 10))
    assert image_difference({"a": bright, "b": dark}, {"a": dark, "b": dark}) == 120.0  # no wrap-around of uint8


@pytest.mark.deep
def test_a_trial_that_fails_in_its_own_process_says_why() -> None:
    with pytest.raises(TrialFailed, match=r"squeeze by physics 'magic' failed: KeyError"):
        run_trials([("squeeze", "magic")])


@pytest.mark.deep
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="looks for the processes in /proc")
def test_a_signal_ends_the_reproduction_and_its_processes(tmp_path: Path) -> None:
    process = subprocess.Popen(
        [*START, "reproduce", "--out", "f"], env=_environment(), stderr=subprocess.PIPE, text=True
    )
    try:
        children = _wait_for_children(process)
        process.send_signal(signal.SIGTERM)
        _, errors = process.communicate(timeout=30)
    finally:
        process.kill()
    assert process.returncode == 143, errors
    assert "Traceback" not in errors
    assert not (tmp_path / "f").exists()
    end = time.monotonic() + 10
    while any(map(_lives, children)) and time.monotonic() < end:
        time.sleep(0.1)
    assert not list(filter(_lives, children))


def _lives(number: int) -> bool:
    """True while the process runs; an ended one may wait for its parent (state Z)."""
    try:
        return Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def _wait_for_children(process: subprocess.Popen[str]) -> list[int]:
    """Process ids of the workers, once there are some."""
    end = time.monotonic() + 60
    while time.monotonic() < end and process.poll() is None:
        children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
        if len(children) >= 2:
            return [int(word) for word in children]
        time.sleep(0.1)
    pytest.fail("no processes were started")


@pytest.mark.deep
@pytest.mark.timeout(600)
def test_the_seeds_experiment_comes_out(tmp_path: Path) -> None:
    result = tacsim("reproduce", "--out", "f")
    assert result.exit_code == 0, result.output
    config = json.loads((tmp_path / "f" / "fig4.json").read_text())
    for task, planned in EXPERIMENTS.items():
        assert set(config[task]) == {"seed", "hybrid"}
        for curve in config[task].values():
            assert curve["step"] == list(range(len(curve["reward"])))
            assert len(curve["step"]) <= planned.steps + 1
            assert 0.4 < np.argmax(curve["reward"]) / curve["step"][-1] < 0.8
    assert imread(tmp_path / "f" / "fig4.png").shape[1] > 1500
