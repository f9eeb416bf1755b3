"""Texts of files, recordings and devices reach the terminal as text: nothing in them moves the cursor."""

from __future__ import annotations

import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from rich.progress import Progress, TextColumn
from rich.table import Table
from rich.text import Text

from robot.cli import app, terminal
from robot.cli.doctor import print_checks
from robot.cli.output import SafeConsole, require_writable, show_table
from robot.doctor import Check
from tacsim.interface import RigSpec, SensorSpec, TactileFrame
from tacsim.record import schemas
from tacsim.record.episode import EpisodeMeta, Step
from tacsim.record.writer import Recorder
from tests.robot.cli.invoked import tacsim

EVIL = "a\x1b[2J\x1b]0;b\x07\x9b31m\u202ec\u2066\r"
BAD = "\x1b\x07\x9b\u202e\u2066\r"

pytestmark = pytest.mark.usefixtures("empty_folder")


def check(shown: str) -> None:
    assert not set(BAD) & set(shown), repr(shown)
    assert "\\x1b[2J" in shown


def test_console_prints_control_characters_as_text() -> None:
    table = Table(title=Text(EVIL))
    table.add_row(EVIL, Text(EVIL))
    for what in (EVIL, Text(EVIL), table):
        console = SafeConsole(file=io.StringIO(), width=300)
        console.print(what, markup=False)
        check(console.file.getvalue())  # type: ignore[attr-defined]


def test_console_keeps_own_colours_and_cursor() -> None:
    there = {"TERM": "xterm", "COLUMNS": "100"}
    console = SafeConsole(file=io.StringIO(), force_terminal=True, _environ=there)
    with Progress(TextColumn("{task.description}", markup=False), console=console) as bar:
        bar.add_task(EVIL)
    shown = console.file.getvalue()  # type: ignore[attr-defined]
    assert "\x1b[?25l" in shown  # the bar hides the cursor
    assert "\\x1b[2J" in shown and "\x1b[2J" not in shown and "\u202e" not in shown


def test_errors_and_checks_print_control_characters_as_text(capsys: pytest.CaptureFixture[str]) -> None:
    terminal.print_error(EVIL)
    check(capsys.readouterr().err)
    print_checks([Check("serial", "warn", EVIL, "do this")])
    check(capsys.readouterr().out)
    message, _ = terminal.describe_error(FileNotFoundError(2, "No such file", "x\ny" + EVIL))
    check(message)
    assert "\n" not in message


def test_names_in_recording_are_printed_as_text(tmp_path: Path) -> None:
    spec = RigSpec({"lower": SensorSpec((8, 8), False, False, None)}, (), truth=False, period=0.1)
    meta = EpisodeMeta("rig\nerror: all is lost" + EVIL, None, EVIL, 0, spec, {EVIL: EVIL})
    frames = {"lower": TactileFrame(np.zeros((8, 8, 3), np.uint8), time=0.0, index=0)}
    with Recorder("e.mcap", meta) as recorder:
        recorder.write(Step(0, 0.0, frames, {}))
    result = tacsim("replay", "e.mcap", "--out", "r")
    assert result.exit_code == 0, result.output
    check(result.stdout)
    assert "\nerror" not in result.stdout
    page = (tmp_path / "r" / "report.html").read_text(encoding="utf-8")
    check(page)


def test_sensor_name_with_control_characters_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    name = "x\x1b[2J"
    spec = RigSpec({name: SensorSpec((8, 8), False, False, None)}, (), truth=False, period=0.1)
    meta = EpisodeMeta("r", None, "p", 0, spec, {})
    with pytest.raises(ValueError, match="holds control characters"):
        Recorder("refused.mcap", meta)
    with monkeypatch.context() as other:
        other.setattr(schemas, "_check_parts", lambda *_: None)  # a program that is not ours
        with Recorder("e.mcap", meta) as recorder:
            recorder.write(Step(0, 0.0, {}, {}))
    result = tacsim("replay", "e.mcap", "--out", "r")
    assert result.exit_code != 0
    check(result.stderr)


def test_table_prints_units_in_brackets(capsys: pytest.CaptureFixture[str]) -> None:
    show_table("of [N]", ("frame", "radius [mm]", "of [grey levels]"), [("a [1].png", "1.5", "40")])
    shown = capsys.readouterr().out
    assert all(words in shown for words in ("of [N]", "radius [mm]", "of [grey levels]", "a [1].png")), shown


def _options(command: Any, name: str) -> Iterator[tuple[str, str]]:
    """Name and help of every option and argument."""
    for parameter in command.params:
        yield f"{name} {parameter.name}", getattr(parameter, "help", None) or ""
    for word, each in getattr(command, "commands", {}).items():
        yield from _options(each, f"{name} {word}")


def test_help_of_each_option_prints_units() -> None:
    """Brackets are markup there: a unit in them would not be shown."""
    lost = [
        name
        for name, words in _options(typer.main.get_command(app), "tacsim")
        if Text.from_markup(words).plain != words.replace("\\[", "[")
    ]
    assert lost == []


@pytest.mark.parametrize("columns", [1, 20])
def test_narrow_terminal_prints_complete_table(columns: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", str(columns))
    table = Table(show_header=False, min_width=60)
    table.add_row("peak force |Fz|", "0.59 N (upper, step 1)")
    shown = io.StringIO()
    SafeConsole(file=shown, soft_wrap=True).print(table)
    assert "0.59 N (upper, step 1)" in shown.getvalue()


def test_require_writable_refuses_before_work(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    require_writable(tmp_path / "new" / "file", "--json", new=True)
    require_writable(tmp_path / "file", "--json")
    for file, words in ((tmp_path / "file", "exists already"), (tmp_path / "file" / "new", "cannot be written")):
        with pytest.raises(typer.BadParameter, match=words):
            require_writable(file, "--json", new=True)
    with pytest.raises(typer.BadParameter, match="cannot be written"):
        require_writable(tmp_path, "--json")
