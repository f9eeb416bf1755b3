"""The simulator presses what frames show: the whole way, on a made-up sensor whose truth is known."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from calibration.bundle import write_bundle
from calibration.errors import BadFrames
from calibration.frame_set import Frame, FrameSet
from robot.cli import app
from robot.studies.matched_press import match_presses
from tacsim.config import load_scene
from tacsim.models.sensor import CanonicalGrid, SensorGeometry, SensorModel
from tests.calibration.presses import HiddenSensor
from tests.calibration.sources import calibrated, save

SCENE = ("indenter.geometry.radius=2.5 mm", "gel.size=[12 mm, 12 mm, 8 mm]", "element_size=0.5 mm")
DEPTHS, PLACES = (0.5e-3, 0.65e-3), ((90, 110), (170, 80))


@pytest.fixture
def frames() -> FrameSet:
    """Two presses by Hertz, and one frame without contact."""
    sensor = HiddenSensor(3)
    made = [sensor.press(depth, *place) for depth, place in zip(DEPTHS, PLACES, strict=True)]
    frames = [Frame(f"press_{k}.png", press.image) for k, press in enumerate(made)]
    return FrameSet("real", sensor.empty(), "made up", (*frames, Frame("still.png", sensor.empty())))


def test_a_scene_against_frames(frames: FrameSet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    save(frames, Path("real"))
    calibration, reference = calibrated(HiddenSensor(3))
    Path("bundle").mkdir()
    write_bundle(Path("bundle"), calibration, reference)
    words = ["compare", "press", "real", "--calibration-b", "bundle", "--out", "out"]
    for setting in SCENE:
        words += ["--set", setting]
    result = CliRunner().invoke(app, words, env={"COLUMNS": "200"})
    assert result.exit_code == 0, result.output
    assert "still.png: not pressed: no ball's contact is seen" in " ".join(result.output.split())
    config = json.loads(Path("out/compare.json").read_text())
    overall = config["overall"]
    assert overall["contact_ncc"]["mean"] > 0.95
    assert overall["contact_mae"]["mean"] < 0.35 * overall["contact_mae"]["null"]
    assert overall["gradient_angle"]["mean"] < 4
    assert overall["surface_centroid"]["mean"] < 0.15e-3
    assert [pair["a"] for pair in config["pairs"]] == ["press_0.png", "press_1.png", "still.png"]
    assert config["pairs"][2]["flags"] == ["A: no contact", "B: no contact"]


def test_what_cannot_be_pressed_is_refused(frames: FrameSet) -> None:
    scene = load_scene("press", list(SCENE))
    sensor = SensorModel(geometry=SensorGeometry(width=260, height=200, pixel_pitch=0.08e-3))
    box = load_scene("press", ["indenter.geometry={shape: box, size: [5 mm, 5 mm, 5 mm]}"])
    with pytest.raises(BadFrames, match="'press' presses no ball"):
        match_presses(frames, box, sensor, CanonicalGrid())
    smaller = SensorModel(geometry=SensorGeometry(width=200, height=200, pixel_pitch=0.08e-3))
    with pytest.raises(BadFrames, match="real is 260 x 200 px, the calibration is of 200 x 200"):
        match_presses(frames, scene, smaller, CanonicalGrid())
    still = replace(frames, frames=(Frame("still.png", np.array(frames.reference)),))
    with pytest.raises(BadFrames, match="no frame shows a ball's contact"):
        match_presses(still, scene, sensor, CanonicalGrid())
