"""What a person at a terminal is asked can be read until it is answered, on the screen and whatever else is drawn."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import time
from pathlib import Path

import pytest

from robot.cli.terminal import ask_operator
from tests.robot.cli.invoked import environment, tacsim
from tests.robot.cli.lab import copy_of
from tests.robot.cli.terminal import Terminal

QUESTION = "Is the body in its place in front of the sensor, and is everyone out of reach of the arm?"
ASKING = f"""
import time
from pathlib import Path
from robot.cli.output import busy, notes, progress
from robot.cli.terminal import ask_operator
from robot.cli.terminal import Interrupt
def wait(moment):
    while not Path(moment).exists():
        time.sleep(0.01)
def asked(moment):
    notes.print("on the way")
    wait(moment)
    notes.print("SAID " + str(ask_operator({QUESTION!r})))
with Interrupt() as interrupt:
    with progress() as bar:
        row = bar.add_task("starting slowly", total=12)
        asked("started")
        for step in range(12):
            bar.update(row, description="the episode", completed=step)
            time.sleep(0.05)
        wait("seen")
    with busy("tapping"):
        asked("seen")
"""


def stays(screen: Terminal, words: str) -> None:
    """For as long as a bar is drawn ten times."""
    for _ in range(12):
        assert screen.shows(words), screen.picture
        time.sleep(0.05)


@pytest.mark.slow
@pytest.mark.parametrize("columns", [100, pytest.param(30, marks=pytest.mark.deep)])
def test_question_stays_on_screen_and_bar_continues(tmp_path: Path, columns: int) -> None:
    with Terminal(program=ASKING, folder=tmp_path, columns=columns) as screen:
        screen.wait_for("starting")
        (tmp_path / "started").touch()
        screen.wait_for(f"{QUESTION} [y/N]:")
        stays(screen, f"{QUESTION} [y/N]:")
        screen.type("y\n")
        screen.wait_for("SAID True")
        screen.wait_for("the episode")
        (tmp_path / "seen").touch()
        screen.until(lambda: screen.text.count("[y/N]:") == 2, "the second question")
        stays(screen, "[y/N]: ")
        screen.type("n\n")
        assert screen.end() == 0
        assert screen.shows("SAID False")


@pytest.mark.parametrize(
    ("typed", "said"),
    [("\x03", "stopped by SIGINT"), ("\x04", "no answer to the question"), ("what?\n\n", "SAID False")],
    ids=["Ctrl-C", "end of input", "nonsense, then Enter"],
)
def test_question_without_yes_is_not_confirmed(tmp_path: Path, typed: str, said: str) -> None:
    (tmp_path / "started").touch()
    with Terminal(program=ASKING, folder=tmp_path) as screen:
        screen.wait_for(f"{QUESTION} [y/N]:")
        for part in re.findall(r"[^\n]*\n|[^\n]+", typed):
            screen.type(part)
            time.sleep(0.1)
        screen.wait_for(said)


def test_text_typed_before_question_is_discarded(tmp_path: Path) -> None:
    with Terminal(program=ASKING, folder=tmp_path) as screen:
        screen.wait_for("on the way")
        screen.type("y\n")
        (tmp_path / "started").touch()
        screen.wait_for(f"{QUESTION} [y/N]:")
        stays(screen, f"{QUESTION} [y/N]:")
        assert not screen.shows("SAID")


@pytest.mark.parametrize(
    "words", [["run"], ["calibrate", "latency", "--arm", "arm", "--sensor", "finger"]], ids=["run", "latency"]
)
def test_run_without_terminal_refuses_real_arm(tmp_path: Path, words: list[str]) -> None:
    file = copy_of("ur5e-one", tmp_path, 61)
    result = tacsim(*words, str(file))
    assert result.exit_code == 2, result.output
    assert "run this from a terminal" in " ".join(result.stderr.split())


def test_question_without_readable_output_is_not_asked(tmp_path: Path) -> None:
    """The input is a terminal, what is asked would go into a file."""
    program = "from robot.cli.terminal import ask_operator\nprint(ask_operator('Yes?'))"
    outer, inner = os.openpty()
    done = subprocess.run(
        [sys.executable, "-c", program], stdin=inner, capture_output=True, text=True, timeout=60, env=environment()
    )
    os.close(outer)
    os.close(inner)
    assert done.stdout == "False\n", done


def test_question_without_standard_input_returns_false(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdin", None)  # started by `<&-`, or by a service
    assert not ask_operator("Is anybody there?")


def test_calibration_asks_before_opening_devices(tmp_path: Path) -> None:
    """Nothing answers at the file's addresses."""
    text = copy_of("ur5e-one", tmp_path, 61).read_text().replace("model: null", "model: ideal")
    text = re.sub(r"corners: .*", "", text).replace("width: 640", "width: 320").replace("height: 480", "height: 240")
    (tmp_path / "my.yaml").write_text(text)
    words = ("calibrate", "touch", "--rig", "my.yaml", "--arm", "arm", "--sensor", "finger", "--ball-radius", "4 mm")
    with Terminal(*words, folder=tmp_path, columns=40) as screen:
        screen.wait_for("may the arm move? [y/N]:")
        screen.type("n\n")
        assert screen.end() == 2 and screen.shows("the operator did not confirm")
