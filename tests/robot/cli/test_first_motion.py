"""From a shipped hardware file to a first motion: every command of the PAGES on a copy with only hosts and
cameras changed, before mocks that pass for real arms."""

from __future__ import annotations

import re
import shlex
import time
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import pytest

from robot.arm.ur import URArm
from robot.camera.camera import Camera
from robot.mock.cell.cell import MockCell
from tests.docs.test_blocks import all_blocks
from tests.robot.cli.invoked import tacsim
from tests.robot.cli.lab import Lab, copy_of
from tests.robot.cli.terminal import Terminal

if find_spec("rtde_control") is None:
    pytest.skip("ur_rtde has no wheel for this Python and machine", allow_module_level=True)

PAGES = ("uses.md", "bringup.md", "hand-eye.md")

pytestmark = pytest.mark.usefixtures("empty_folder")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where a person works."""
    return tmp_path_factory.mktemp("lab")


@pytest.fixture(scope="module")
def one_arm(folder: Path) -> Iterator[Lab]:
    with Lab(copy_of("ur5e-one", folder, 61)) as lab:
        yield lab


@pytest.mark.slow
def test_dry_run_on_one_arm_file_records_episode(one_arm: Lab, folder: Path, tmp_path: Path) -> None:
    result = tacsim("run", folder / "my.yaml", "--dry-run", "--steps", "2", "--out", "dry")
    assert result.exit_code == 0, result.output
    assert (tmp_path / "dry" / "report.html").exists()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--task", "squeeze"], r"task 'squeeze'.*lacks arm 'lower'; arm 'upper'.*--set task=null"),
        (["--policy", "mine:NeedsHeight"], r"lacks surface height.*Use --policy grip, which needs only pictures"),
        (["--policy", "nothing"], "no policy 'nothing'"),
        (["--set", "arms.arm.limits.depth=1 mm"], r"limits\.depth: sensor 'finger' does not measure it"),
        (
            ["--set", "arms.arm.simulator=false", "--set", "arms.arm.watchdog=10"],
            "is a real arm, but its host .* is this machine.*simulator: true",
        ),
        (["--set", "arms.arm.host=192.0.2.1"], r"simulator: true.*host 192\.0\.2\.1 is outside this machine"),
        (["--set", "arms.arm.mock={}"], "either a maker's simulator .* or our mock"),
    ],
)
def test_unsuitable_run_is_refused_before_opening(
    tmp_path: Path, words: list[str], said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def opened(*_: object, **__: object) -> None:
        pytest.fail("something was opened")

    for part in (MockCell, Camera, URArm):
        monkeypatch.setattr(part, "__init__", opened)
    (tmp_path / "mine.py").write_text(
        "from tacsim import Needs\nclass NeedsHeight:\n    needs = Needs(height=True)\n"
        "    def reset(self): ...\n    def __call__(self, observation): ...\n"
    )
    file = copy_of("ur5e-one", tmp_path, 61)
    result = tacsim("run", str(file), *words, "--dry-run", "--out", "out")
    assert result.exit_code in (1, 2), result.output
    assert re.search(said, " ".join(result.stderr.split())), result.stderr
    assert not (tmp_path / "out").exists()


def commands() -> list[str]:
    """What the pages tell a person to type once my.yaml is written."""
    blocks = [block for block in all_blocks() if block.page in PAGES and block.language == "bash"]
    lines = [line.partition("#")[0].strip() for block in blocks for line in block.code.splitlines()]
    return [line for line in lines if re.match(r"tacsim .*\bmy\.yaml", line)]


def follow(command: str, folder: Path) -> tuple[int, str]:
    """Types it, and y to each question that can be read on the screen. How it ended, and the screen then."""
    asked = 0
    with Terminal(*shlex.split(command)[1:], folder=folder) as screen:
        while screen.process.poll() is None:
            if screen.text.count("[y/N]:") > asked:
                asked += 1
                screen.type("y\n")
            time.sleep(0.05)
        return screen.end(), screen.picture


def test_pages_contain_each_step() -> None:
    told = " ".join(commands())
    for step in ("doctor --rig", "--dry-run", "--policy grip", "calibrate latency", "calibrate touch"):
        assert step in told


@pytest.mark.deep
@pytest.mark.parametrize("command", commands())
def test_commands_of_pages_run_on_one_arm_file(one_arm: Lab, folder: Path, command: str) -> None:
    code, shown = follow(command, folder)
    if "calibrate touch" in command:  # as the page says, of a sensor whose light is calibrated
        assert code == 2 and "calibrate its light first" in shown, shown
    else:
        assert code == 0, shown


@pytest.mark.deep
def test_first_episode_on_two_arm_file_touches(tmp_path: Path) -> None:
    with Lab(copy_of("ur5e", tmp_path, 63)) as lab:
        code, shown = follow("tacsim run my.yaml --steps 3 --out first", tmp_path)
        assert code == 0, shown
        pressed = {name: lab.depth(name, faults.state().pose) for name, faults in lab.faults.items()}
    assert min(pressed.values()) > 0.0, pressed


@pytest.mark.deep
@pytest.mark.parametrize(
    ("moment", "key", "code"), [("[y/N]:", "\x03", 130), ("[y/N]:", "\x04", 1), ("mm of", "\x03", 130)]
)
def test_stop_request_at_question_ends_command(one_arm: Lab, folder: Path, moment: str, key: str, code: int) -> None:
    """At the question, and on the approach: the arm rests, nothing was touched."""
    with Terminal("run", "my.yaml", "--out", "never", folder=folder) as screen:
        screen.wait_for("[y/N]:")
        if moment != "[y/N]:":
            screen.type("y\n")
            screen.wait_for(moment)
        screen.type(key)
        assert screen.end() == code, screen.picture
        assert screen.shows("no answer to the question" if key == "\x04" else "stopped by SIGINT")
    state = one_arm.faults["arm"].state()
    assert state.rests and one_arm.depth("arm", state.pose) < 0.0
    assert not (folder / "never").exists()


@pytest.mark.deep
def test_question_before_manual_presses_stays_on_screen(one_arm: Lab, folder: Path) -> None:
    words = ("calibrate", "sensor", "--camera", "my.yaml/finger", "--ball-radius", "4 mm", "--pixel-pitch", "0.03 mm")
    with Terminal(*words, folder=folder, columns=40) as screen:
        screen.wait_for("Is nothing touching the gel? [Y/n]:")
        screen.type("n\n")
        screen.wait_for("Take everything off the gel first.")
        screen.until(lambda: screen.text.count("[Y/n]:") == 2, "the question once more")
        screen.type("\x04")
        assert screen.end() == 1 and screen.shows("no answer to the question")
