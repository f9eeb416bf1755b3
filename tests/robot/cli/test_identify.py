"""`tacsim identify`: what it refuses, and a gel whose truth another process knows."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import pytest

from tests.robot.cli.invoked import START, environment, tacsim


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("gel",), "name recordings, or --motions"),
        (("gel", "gone"), "gone: no such file or folder"),
        (("gel", "gone", "--scene", "squeeze"), "has not an indenter"),
        (("body", "gone", "--scene", "press"), "has not a body"),
        (("body", "gone", "--set", "physics=seed"), "cannot be identified"),
        (("gel", "a.csv", "--fit", "colour"), "'colour' is not a parameter of a gel; allowed: youngs"),
        (("gel", "gone", "--force-noise", "0 N"), "allowed: 1e-06 to 1000"),
        (("gel", "gone", "--ball", "6 mm"), "'6 mm' is not NAME=RADIUS"),
        (("gel", "a.csv", "--ball", "b=6 mm"), "no recording 'b' that a ball belongs to; the recordings are a"),
    ],
)
def test_identify_invalid_input_is_reported(
    words: tuple[str, ...], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("a.csv").write_text("x,y,z,fz\n0,0,0.001,0\n0,0,0,0\n0,0,-0.0002,-0.1\n")
    result = tacsim("identify", *words)
    assert result.exit_code == 2 and message in " ".join(result.output.split())
    assert [path.name for path in tmp_path.iterdir()] == ["a.csv"]


def test_identify_motions_prints_run_commands(tmp_path: Path) -> None:
    result = tacsim("identify", "body", "--motions", tmp_path / "m")
    assert result.exit_code == 0 and "tacsim run sim --policy" in result.output
    assert sorted(path.name for path in (tmp_path / "m").iterdir()) == ["slide.csv", "squeeze.csv", "tilt.csv"]
    assert tacsim("identify", "body", "--motions", tmp_path / "m").exit_code == 2  # nothing is overwritten


@pytest.mark.deep
def test_identify_gel_recovers_hidden_truth(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The twin has another mesh. A flat punch taken for its ball is noticed."""
    monkeypatch.chdir(tmp_path)
    truth = {"youngs_modulus": 0.19e6, "friction": 0.42}
    hidden = [
        "scene.element_size=0.8 mm", "scene.gel.material.youngs_modulus=0.19e6", "scene.indenter.friction=0.42",
        "scene.gel.material.poisson_ratio=0.47",
    ]  # fmt: skip
    assert tacsim("identify", "gel", "--motions", "m").exit_code == 0
    for name in ("press", "slide"):
        steps = len(Path("m", f"{name}.csv").read_text().splitlines()) - 1
        command = ["run", "press", "--policy", f"m/{name}.csv", "--steps", str(steps), "--out", f"runs/{name}"]
        sets = [word for each in hidden for word in ("--set", each)]
        subprocess.run([*START, *command, *sets], env=environment(), check=True, capture_output=True)
    found = tacsim("identify", "gel", "runs", "--preset", "draft", "--out", "gel")
    assert found.exit_code == 0, found.output
    numbers = json.loads(Path("gel/identified.json").read_text())["parameters"]
    for name, value in truth.items():
        assert numbers[name]["value"] == pytest.approx(value, rel=0.1)
        assert numbers[name]["low"] < value < numbers[name]["high"]
    punch = "indenter.geometry={shape: cylinder, radius: 2 mm, height: 8 mm}"
    wrong = tacsim("identify", "gel", "runs", "--preset", "draft", "--set", punch, "--out", "wrong")
    assert wrong.exit_code == 2 and "no material is written" in wrong.output
    assert not Path("wrong/material.yaml").exists() and Path("wrong/identified.png").exists()
