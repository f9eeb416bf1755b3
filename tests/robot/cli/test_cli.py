"""The `tacsim` command: exit codes, messages, presses."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread
from scipy.spatial.transform import Rotation

import robot
from robot.cli.output import writing
from robot.cli.terminal import describe_error
from robot.studies.press import PressMotion, _targets
from tacsim.config import ConfigError
from tacsim.interface import IncompatibleRig, Pose
from tacsim.record.episode import EpisodeError
from tests.robot.cli.invoked import START, environment, tacsim

pytestmark = pytest.mark.usefixtures("empty_folder")
COMMANDS = ("run", "press", "reproduce", "replay", "schema", "doctor", "debug", "bench", "mock", "compare")


@pytest.mark.parametrize("command", [*COMMANDS, "train", "evaluate", "export policy"])
def test_help_of_each_command_has_example(command: str) -> None:
    result = tacsim(*command.split(), "--help")
    assert result.exit_code == 0
    assert f"Example: tacsim {command}" in result.stdout


def test_help_lists_commands_without_heavy_imports() -> None:
    result = tacsim("--help")
    assert all(command in result.stdout for command in COMMANDS)
    code = "import sys, robot.cli; print(' '.join(sys.modules))"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert "typer" in loaded
    assert not {"taichi", "cv2", "matplotlib", "scipy", "numpy", "pydantic"} & set(loaded)


@pytest.mark.parametrize(("said", "threads"), [(None, "1"), ("3", "3")])
def test_command_sets_one_blas_thread(said: str | None, threads: str) -> None:
    """A busy machine's threads wait for one another, spinning: a calibration took three times the processor time."""
    code = (
        "import os, sys; sys.argv = ['tacsim', '--version']; from robot.cli import main\n"
        "try: main()\n"
        "finally: print('threads', os.environ['OPENBLAS_NUM_THREADS'])"
    )
    own = {} if said is None else {"OPENBLAS_NUM_THREADS": said}
    given = {key: value for key, value in environment().items() if key != "OPENBLAS_NUM_THREADS"} | own
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=given)
    assert f"threads {threads}" in ran.stdout


def test_command_prepares_only_itself_and_lists_all_if_unknown() -> None:
    code = "import sys; from robot import cli\ntry: cli.main()\nfinally: print(len(cli.app.registered_commands))"
    alone, wrong = (
        subprocess.run([sys.executable, "-c", code, *words], capture_output=True, text=True, env=environment())
        for words in (("schema", "-h"), ("schemma",))
    )
    assert alone.returncode == 0 and "tacsim schema" in alone.stdout and alone.stdout.endswith("\n1\n")
    assert wrong.returncode == 2 and "'schema'" in wrong.stderr and int(wrong.stdout) > 10


def test_version_option_prints_version() -> None:
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
        (("press", "sphere", "--depth", "9 mm"), "9 mm"),
        (("press", "sphere", "--depth", "0"), "must be above 0"),
        (("press", "sphere", "--slide", "10 m, 0"), "at most 3 widths of the gel, 0.06 m"),
        (("press", "sphere", "--twist", "1e9 deg"), "the limits are -3600 and 3600 deg"),
        (("press", "sphere", "--radius", "0.05 mm", "--depth", "0.3 mm"), "choose element_size at most"),
        (("press", "sphere", "--set", "gel.size=[20 mm, 13.3 mm, 4 mm]"), "does not divide into cubes"),
        (("press", "sphere", "--edge-radius", "0.1 mm"), "a sphere has no edges"),
        (("press", "box", "--edge-radius", "3 mm"), "half the shortest side of the box, 0.0025 m"),
        (("press", "cylinder", "--edge-radius", "-1 mm"), "edge_radius"),
        (("press", "box", "--depth", "-1 mm"), "must be above 0"),
        (("press", "box", "--depth", "nan"), "depth"),
        (("press", "sphere", "--out", "/proc/self/x"), "/proc/self/x cannot be made"),
        (("run", "--out", "/dev/null/x"), "/dev/null/x cannot be made (Not a directory)"),
    ],
)
def test_wrong_arguments_exit_with_2_and_write_nothing(words: tuple[str, ...], said: str, tmp_path: Path) -> None:
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
def test_missing_recording_exits_with_2_and_writes_nothing(words: tuple[str, ...], said: str, tmp_path: Path) -> None:
    result = tacsim(*words)
    assert result.exit_code == 2, result.output
    assert said in result.stderr
    assert "Traceback" not in result.output
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("words", [("run",), ("press", "sphere"), ("reproduce",), ("replay", "x.mcap")])
def test_existing_folder_is_refused_and_kept(words: tuple[str, ...], tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("keep")
    result = tacsim(*words, "--out", "mine")
    assert result.exit_code == 2
    assert "exists already" in result.stderr
    assert [path.name for path in (tmp_path / "mine").iterdir()] == ["notes.txt"]


def test_describe_error_returns_exit_codes() -> None:
    assert describe_error(ConfigError([]))[1] == 2
    assert describe_error(EpisodeError("x.mcap: is no episode")) == ("x.mcap: is no episode", 2)
    assert describe_error(IncompatibleRig("it lacks truth"))[1] == 2
    assert describe_error(PermissionError(13, "Permission denied", "out")) == ("out: Permission denied", 2)
    assert describe_error(OSError(28, "No space left on device", "out")) == ("out: No space left on device", 1)
    assert "--debug" in describe_error(KeyError("slip"))[0]
    assert "no room" in describe_error(ExceptionGroup("two", [OSError("no room"), EpisodeError("bad")]))[0]


@pytest.mark.slow
def test_missing_working_folder_is_reported() -> None:
    code = (
        "import os, tempfile; os.chdir(tempfile.mkdtemp()); os.rmdir(os.getcwd()); from robot.cli import main; main()"
    )
    command = [sys.executable, "-c", code, "run", "--steps", "1", "--out", "/nowhere/out"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (
        2,
        "error: the working directory no longer exists; change to another folder\n",
    )


@pytest.mark.parametrize("words", [("--debug", "replay", "missing.mcap"), ("replay", "missing.mcap", "--debug")])
def test_debug_option_anywhere_shows_traceback(words: tuple[str, ...]) -> None:
    assert isinstance(tacsim(*words).exception, EpisodeError)


def test_schema_and_doctor_print_json() -> None:
    assert json.loads(tacsim("schema", "scene").stdout)["title"] == "tacsim scene"
    result = tacsim("doctor", "--json")
    report = json.loads(result.stdout)
    assert result.exit_code == (0 if report["ok"] else 1)


@pytest.mark.slow
def test_press_of_ball_measures_force_and_radius(tmp_path: Path) -> None:
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


@pytest.mark.slow
def test_press_reports_and_selects_pressing_side(tmp_path: Path) -> None:
    import trimesh

    trimesh.creation.box((3.0, 4.0, 6.0)).export(tmp_path / "bar.stl")
    press = ("press", "bar.stl", "--depth", "0.2 mm", "--preset", "draft")
    lying = tacsim(*press, "--out", "lying")
    assert lying.exit_code == 0, lying.output
    assert "pressing side    -z of bar.stl, a flat face of 4 x 3 mm" in lying.stdout
    turned = tacsim(*press, "--down", "+x", "--out", "turned")
    assert "pressing side    +x of bar.stl, a flat face of 6 x 4 mm" in turned.stdout
    rotated = tacsim(*press, "--rotation", "0, 90 deg, 0", "--out", "rotated")
    force = [
        json.loads((tmp_path / name / "press.json").read_text())["force"] for name in ("turned", "rotated", "lying")
    ]
    assert rotated.exit_code == 0 and force[0] == force[1] > 1.3 * force[2]
    shown = [imread(tmp_path / name / "side.png") for name in ("lying", "turned")]
    assert min(each.shape[1] for each in shown) > 800 and not np.array_equal(*(each[:200] for each in shown))
    both = tacsim(*press, "--down", "+x", "--rotation", "0,0,0", "--out", "both")
    assert both.exit_code == 2 and "give --down or --rotation, not both" in " ".join(both.stderr.split())


def test_command_names_another_package_robot(tmp_path: Path) -> None:
    """As robotframework leaves it: its files in place of those of the same name, ours beside them."""
    site = tmp_path / "site"
    shutil.copytree(Path(robot.__path__[0]), site / "robot", ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("__init__", "errors"):
        (site / "robot" / f"{name}.py").write_text('"""Of Robot Framework."""\n')
    paths = [str(site), *environment()["PYTHONPATH"].split(os.pathsep)]
    done = subprocess.run(
        [*START, "--version"], capture_output=True, text=True, cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(paths)},
    )  # fmt: skip
    assert done.returncode == 1 and "site/robot/__init__.py is not of tacsim but of another distribution" in done.stderr
    assert "pip uninstall -y robotframework" in done.stderr and "Traceback" not in done.stderr


@pytest.mark.slow
def test_press_repairs_and_measures_an_open_mesh_in_metres(tmp_path: Path) -> None:
    import trimesh

    bar = trimesh.creation.box((3e-3, 4e-3, 6e-3))
    bar.update_faces(bar.face_normals[:, 2] < 0.9)
    bar.export(tmp_path / "bar.obj")
    press = ("press", "bar.obj", "--depth", "0.2 mm", "--preset", "draft", "--out", "out")
    refused = tacsim(*press)
    assert refused.exit_code == 2 and "the mesh is not closed" in refused.stderr and "--repair" in refused.stderr
    done = tacsim(*press, "--repair")
    assert done.exit_code == 0, done.output
    words = " ".join(done.stderr.split())
    assert "bar.obj: read in metres, guessed from its size (3 x 4 x 6 mm)" in words
    assert "bar.obj: holes closed: 1, the largest 5 mm wide with 4 edges" in words
    assert "pressing side    -z of bar.obj, a flat face of 4 x 3 mm" in done.stdout


@pytest.mark.slow
def test_press_too_deep_reports_possible_depth(tmp_path: Path) -> None:
    deep = tacsim("press", "sphere", "--depth", "3.9 mm", "--preset", "draft", "--out", "deep")
    said = re.search(
        r"error: a depth of 3\.9 mm is not possible with this indenter; ([\d.]+) mm is possible", deep.stderr
    )
    assert deep.exit_code == 1 and said is not None
    again = tacsim("press", "sphere", "--depth", f"{said[1]} mm", "--preset", "draft", "--out", "again")
    assert again.exit_code == 0


def test_press_slide_and_twist_give_friction(tmp_path: Path) -> None:
    box = ("press", "box", "--size", "4 mm, 3 mm, 5 mm", "--depth", "0.4 mm", "--preset", "draft")
    assert tacsim(*box, "--slide", "0.5 mm, 0", "--twist", "5 deg", "--out", "slid").exit_code == 0
    slid = json.loads((tmp_path / "slid" / "press.json").read_text())
    force_x, moment_z = slid["wrench"][0], slid["wrench"][5]
    assert 0.02 < force_x / slid["force"] <= 0.6 + 1e-3  # drags the gel along, no more than friction 0.6 can
    assert moment_z > 0
    height = np.load(tmp_path / "slid" / "height.npy", allow_pickle=False)
    deep = np.argwhere(height > 0.35e-3)
    assert deep[:, 1].mean() == pytest.approx(159.5 + 0.5 / 0.0625, abs=3)  # +x is to the right, where the box went


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("sphere", "--size", "1 mm, 1 mm, 1 mm"), "--size: 'sphere' does not have it; it has --radius"),
        (("cylinder", "--scale", "0.01"), "--scale: 'cylinder' does not have it; it has --radius and --height"),
        (("box", "--radius", "3 mm"), "--radius: 'box' does not have it; it has --size"),
        (("part.stl", "--height", "3 mm"), "--height: 'part.stl' does not have it; it has --scale"),
    ],
)
def test_press_size_of_other_indenter_is_refused(words: tuple[str, ...], said: str) -> None:
    result = tacsim("press", *words)
    assert result.exit_code == 2 and said in " ".join(result.stderr.split())


@pytest.mark.parametrize(("name", "content", "said"), [("e", b"", "is empty"), ("t", bytes(84) + b"x", "should have")])
def test_press_broken_mesh_exits_with_2(name: str, content: bytes, said: str, tmp_path: Path) -> None:
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
        ("TACSIM_TAICHI_PATCHES", "off", "TACSIM_TAICHI_PATCHES must be 0 (off) or 1 (on)"),
    ],
)
def test_invalid_machine_setting_exits_with_2(variable: str, value: str, said: str, tmp_path: Path) -> None:
    words = (*START, "press", "sphere", "--preset", "draft")
    result = subprocess.run(words, env={**environment(), variable: value}, capture_output=True, text=True)
    assert result.returncode == 2 and said in result.stderr and "unexpected" not in result.stderr
    assert list(tmp_path.iterdir()) == []


def test_press_twist_beyond_half_turn_keeps_direction() -> None:
    start, motion = Pose(np.array([0.0, 0.0, 5e-3])), PressMotion(twist=np.radians(-270.0))
    targets = _targets(start, 4e-3, motion)
    turns = [Rotation.from_quat(target.quaternion) for target in targets]
    steps = [np.degrees((b * a.inv()).as_rotvec()) for a, b in pairwise(turns)]
    assert np.allclose(steps, [[0, 0, -90.0]] * 3)


def test_press_without_hold_reports_it(tmp_path: Path) -> None:
    hasty = ("--preset", "draft", "--set", "settling.max_substeps=0", "--set", "gel.size=[8 mm, 8 mm, 4 mm]")
    result = tacsim("press", "sphere", "--radius", "2 mm", "--depth", "0.2 mm", "--out", "p", *hasty)
    assert result.exit_code == 0, result.output
    config = json.loads((tmp_path / "p" / "press.json").read_text())
    assert config["residual"] is None and config["settled"] is False
    assert "not settled, not held" in result.stderr


@pytest.mark.slow
def test_diverged_press_leaves_dump(tmp_path: Path) -> None:
    result = tacsim("press", "box", "--size", "5 mm, 5 mm, 5 mm", "--depth", "3.9 mm", "--preset=draft", "--out=p")
    assert result.exit_code == 1
    assert "tacsim debug p/diverged/00" in " ".join(result.output.split())
    assert (tmp_path / "p" / "diverged" / "00" / "state.npz").is_file()


def test_full_disk_error_names_folder(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="No space") as caught, writing(tmp_path):
        raise OSError(28, "No space left on device")
    assert describe_error(caught.value) == (f"{tmp_path}: No space left on device", 1)
