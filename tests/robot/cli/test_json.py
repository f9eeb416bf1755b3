"""`--json`: a command prints its result as exactly one JSON document on stdout; notes and progress go to stderr."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
import yaml

from calibration.poses.latency import Latency
from robot.cli import app
from robot.cli.output import print_json, results
from tacsim.record.images import encode_png
from tests.robot.cli.invoked import TINY, tacsim

pytestmark = pytest.mark.usefixtures("empty_folder")
WITHOUT_RESULT = {"tacsim mock", "tacsim schema", "tacsim serve"}  # run until Ctrl-C; print nothing but JSON


def document(*words: object, exit_code: int = 0) -> Any:
    done = tacsim(*words, "--json")
    assert done.exit_code == exit_code, done.output
    return json.loads(done.stdout, parse_constant=pytest.fail)


def commands(group: Any, name: str = "tacsim") -> Iterator[tuple[str, Any]]:
    for word, command in group.commands.items():
        if hasattr(command, "commands"):
            yield from commands(command, f"{name} {word}")
        else:
            yield f"{name} {word}", command


def test_every_command_with_a_result_has_the_option() -> None:
    missing = {
        name
        for name, command in commands(typer.main.get_command(app))
        if not any("--json" in parameter.opts for parameter in command.params)
    }
    assert missing <= WITHOUT_RESULT


@pytest.fixture
def chosen(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(results, "quiet", True)


@pytest.mark.usefixtures("chosen")
def test_values_without_a_json_number_become_null(capsys: pytest.CaptureFixture[str]) -> None:
    print_json(
        {"a": float("nan"), "b": np.array([1.0, np.inf]), "c": Latency(0.1, float("nan"), 1.0, 3), "d": np.float32(2)},
        [Path("x\x1b\u202e")],
    )
    out = capsys.readouterr().out
    assert json.loads(out) == {
        "a": None, "b": [1.0, None], "d": 2.0,
        "c": {"seconds": 0.1, "uncertainty": None, "correlation": 1.0, "samples": 3},
        "files": ["x\x1b\u202e"],
    }  # fmt: skip
    assert out.isascii() and "\x1b" not in out


@pytest.mark.slow
def test_episode_its_report_and_its_recovery(tmp_path: Path) -> None:
    ran = document("run", *TINY, "--steps", "1", "--out", "first")
    assert ran["summary"]["task"] == "squeeze" and ran["summary"]["step"] == [1]
    assert ran["summary"] == json.loads((tmp_path / "first" / "summary.json").read_text("utf-8"))
    assert {Path(each) for each in ran["files"]} == {
        Path("first") / name for name in ("report.html", "report.png", "episode.mcap", "summary.json")
    }
    again = document("replay", "first/episode.mcap", "--out", "again")
    assert again["summary"]["reward"] == ran["summary"]["reward"]
    assert document("recover", "first/episode.mcap") == {
        "steps": 2, "finished": True, "damaged": [], "missing": [], "files": [],
    }  # fmt: skip


def test_press(tmp_path: Path) -> None:
    pressed = document("press", "sphere", "--preset", "learn", "--depth", "0.2 mm", "--out", "pressed")
    assert pressed["force"] > 0 and Path("pressed/press.json") in map(Path, pressed.pop("files"))
    assert pressed == json.loads((tmp_path / "pressed" / "press.json").read_text("utf-8"))


def test_new_names_its_file() -> None:
    assert document("new", "rig", "mine") == {"files": ["mine.yaml"]}


def test_doctor_keeps_its_exit_code(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("robot.doctor.as_json", lambda checks: {"ok": False, "checks": []})
    assert document("doctor", exit_code=1) == {"ok": False, "checks": []}


def test_comparison_over_its_limit_is_printed(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        for name in ("background", "press_1", "press_2"):
            picture = rng.integers(80, 180, (60, 80, 3)).astype(np.uint8)
            (tmp_path / folder / f"{name}.png").write_bytes(encode_png(picture))
    found = document("compare", "a", "b", "--fail-above", "mae=0", "--out", "compared", exit_code=1)
    assert found["beyond_limits"] and found["overall"]["mae"]["mean"] > 0
    assert Path("compared/compare.csv") in map(Path, found["files"])


def test_view_of_a_gel_from_its_corners(tmp_path: Path) -> None:
    (tmp_path / "gel.png").write_bytes(encode_png(np.full((60, 80, 3), 128, np.uint8)))
    found = document(
        "calibrate", "lens", "gel.png", "--corners", "5,5 70,5 70,50 5,50", "--size", "16 mm, 12 mm", "--out", "view"
    )
    assert found.pop("files") == ["view/view.yaml", "view/rectified.png"]
    assert found == yaml.safe_load((tmp_path / "view" / "view.yaml").read_text("utf-8"))


def test_an_error_leaves_stdout_empty() -> None:
    done = tacsim("run", "no-such-rig", "--json")
    assert done.exit_code == 2 and done.stdout == "" and "no-such-rig" in done.stderr


def test_the_next_command_prints_text_again() -> None:
    document("list", "sensor")
    assert "gelsight-mini" in tacsim("list", "sensor").stdout
    assert tacsim("show", "gelsight-min", "--json").exit_code == 2
    assert tacsim("show", "gelsight-mini").stdout.startswith("sensor gelsight-mini")
