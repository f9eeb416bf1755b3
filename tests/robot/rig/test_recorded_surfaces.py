"""A replay's report shows what the gel did: found by a bundle, or by nothing but the distance of its printed dots."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from calibration.bundle import read_bundle, write_bundle
from tacsim.models.sensor import Markers, SensorGeometry, SensorModel
from tacsim.optics.markers import marker_flow
from tacsim.optics.render import Renderer
from tests.robot.cli.invoked import tacsim
from tests.tacsim.optics.surfaces import dent, flat

GEL, PITCH = (20e-3, 20e-3), 1.9e-3
MARKERS = Markers(rows=5, columns=7, pitch=PITCH, radius=0.22e-3)
BUNDLE = Path(__file__).parents[2] / "fixtures" / "bundle"
SLIDES = [(0.0, 0.0), (0.2e-3, -0.1e-3), (0.4e-3, -0.2e-3)]


def record(folder: Path, markers: Markers | None) -> Path:
    """Rendered pictures of a dent that slides; the first is untouched."""
    model = SensorModel(geometry=SensorGeometry(width=240, height=190, pixel_pitch=0.065e-3), markers=markers)
    render = Renderer(model, GEL)
    folder.mkdir()
    for number, surface in enumerate([flat(), *(dent((0.5e-3, 0.4e-3), 0.4e-3, slide) for slide in SLIDES)]):
        Image.fromarray(render(surface)).save(folder / f"{number}.png")
    return folder


def report(tmp_path: Path, frames: Path, *more: str) -> tuple[str, dict, str]:
    """Output of the run, summary.json, and the page."""
    settings = [word for each in (f"source={frames}", *more) for word in ("--set", f"sensors.finger.{each}")]
    done = tacsim("run", "replay", *settings, "--out", tmp_path / "out")
    assert done.exit_code == 0, done.output
    summary = json.loads((tmp_path / "out" / "summary.json").read_text(encoding="utf-8"))
    return done.output, summary, (tmp_path / "out" / "report.html").read_text(encoding="utf-8")


def test_recording_with_marker_pitch_gives_flow(tmp_path: Path) -> None:
    output, summary, page = report(tmp_path, record(tmp_path / "frames", MARKERS), "marker_pitch=1.9 mm")
    true = [np.linalg.norm(marker_flow(dent((0.5e-3, 0.4e-3), 0.4e-3, s), MARKERS), axis=2).max() for s in SLIDES]
    assert summary["flow"]["finger"] == pytest.approx(true, abs=0.2 * 0.065e-3)  # a fifth of a pixel
    assert "finger: flow" in page and "finger: height" not in page and "dark dots" not in output


def test_replay_reports_printed_dots(tmp_path: Path) -> None:
    output, summary, _ = report(tmp_path, record(tmp_path / "frames", MARKERS))
    assert "sensor finger shows 5 x 7 dark dots" in output and "sensors.finger.marker_pitch=" in output
    assert summary["flow"] == {}


def test_marker_pitch_without_dots_is_refused(tmp_path: Path) -> None:
    frames = record(tmp_path / "frames", None)
    done = tacsim(
        "run", "replay", "--set", f"sensors.finger.source={frames}", "--set", "sensors.finger.marker_pitch=2 mm"
    )
    assert done.exit_code == 2 and "sensors.finger" in done.output and "no lattice of dark dots" in done.output


@pytest.mark.slow
def test_replay_with_bundle_shows_height_without_task(tmp_path: Path) -> None:
    frames = tmp_path / "frames"
    frames.mkdir()
    for name, source in (("0.png", "reference.png"), ("1.png", "press.png")):
        (frames / name).write_bytes((BUNDLE / source).read_bytes())
    output, summary, page = report(tmp_path, frames, f"calibration={BUNDLE}")
    (deepest,) = summary["deepest"]["finger"]
    assert 0.4e-3 < deepest < 0.52e-3  # pressed 0.5 mm
    for there in ("finger: height", "finger: slope", "deepest", "steepest slope"):
        assert there in page
    assert "finger: flow" not in page
    for task in ("best distance", "final reward", "goal", "–"):
        assert task not in output and f">{task}" not in page
    again = tacsim("replay", str(tmp_path / "out" / "episode.mcap"), "--out", tmp_path / "again")
    assert again.exit_code == 0 and "finger: height" in (tmp_path / "again" / "report.html").read_text(encoding="utf-8")


@pytest.mark.slow
def test_replay_reports_partial_maps_and_overrides(tmp_path: Path) -> None:
    """The picture shows 31.2 x 24.7 mm by its dots, the map is 16 x 16 mm."""
    said = "sensor finger: maps show the middle 16 x 16 mm of 31.2 x 24.7 mm of gel; for all of it: tacsim run ..."
    all_of_it = ("--set canonical.columns=126", "--set canonical.rows=100")
    frames = record(tmp_path / "frames", MARKERS)
    output, _, _ = report(tmp_path, frames, "marker_pitch=3.8 mm")
    assert f"{said} {' '.join(all_of_it)}" in " ".join(output.split())
    again = tacsim("replay", str(tmp_path / "out" / "episode.mcap"), "--out", tmp_path / "again")
    assert said in " ".join(again.output.split())
    words = [f"--set sensors.finger.source={frames}", "--set sensors.finger.marker_pitch=3.8mm", *all_of_it]
    whole = tacsim("run", "replay", *" ".join(words).split(), "--out", tmp_path / "whole")
    assert whole.exit_code == 0 and "the middle" not in whole.output


@pytest.mark.slow
def test_replay_with_bundle_reports_partial_maps(tmp_path: Path) -> None:
    """Of 20.8 x 16 mm the map leaves out the left and right, or nothing where a region shows no more than 16 x 16."""
    frames = tmp_path / "frames"
    frames.mkdir()
    for name, source in (("0.png", "reference.png"), ("1.png", "press.png")):
        (frames / name).write_bytes((BUNDLE / source).read_bytes())
    output, _, _ = report(tmp_path, frames, f"calibration={BUNDLE}")
    said = " ".join(output.split())
    assert "the middle 16 x 16 mm of 20.8 x 16 mm of gel" in said and "canonical.columns=84" in said
    assert "canonical.rows" not in said
    calibration, untouched = read_bundle(BUNDLE)
    inner = calibration.model_copy(update={"region": ((35, 5), (225, 5), (225, 195), (35, 195))})
    (tmp_path / "inner").mkdir()
    write_bundle(tmp_path / "inner", inner, untouched)
    output, _, _ = report(tmp_path / "inner", frames, f"calibration={tmp_path / 'inner'}")
    assert "the middle" not in output


@pytest.mark.slow
def test_replay_with_untrusted_bundle_reports_it(tmp_path: Path) -> None:
    frames = tmp_path / "frames"
    frames.mkdir()
    for name, source in (("0.png", "reference.png"), ("1.png", "press.png")):
        (frames / name).write_bytes((BUNDLE / source).read_bytes())
    calibration, untouched = read_bundle(BUNDLE)
    for word in ("usable", "do not trust"):
        origin = calibration.provenance.model_copy(update={"warnings": (f"verdict: {word}; few presses",)})
        folder = tmp_path / word.replace(" ", "-")
        folder.mkdir()
        write_bundle(folder, calibration.model_copy(update={"provenance": origin}), untouched)
        output, _, _ = report(folder, frames, f"calibration={folder}")
        assert ("is 'do not trust'" in " ".join(output.split())) == (word == "do not trust")
