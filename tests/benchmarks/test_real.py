"""The real group on made-up frames whose truth is known; and what a folder may lack."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread
from PIL import Image

from benchmarks.cases.real import contact_radius
from benchmarks.cases.real.labels import OWN, SHIPPED, BadData, PressLabels, read_frames, read_labels
from benchmarks.cases.registry import select_cases
from benchmarks.harness.runner import measure
from benchmarks.pages.picture import draw_radii
from tacsim.config import ConfigError, load_model
from tests.robot.cli.invoked import tacsim

Folder = tuple[Path, float]
FRAME = Path("deep") / "presses" / "ball_a.png"


def test_the_radius_of_frame_and_simulation(
    folder_of_frames: Folder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, truth = folder_of_frames
    monkeypatch.setattr(contact_radius, "ELEMENT", 0.5e-3)
    case = select_cases(["real"], baselines=False, data=folder)[0]
    rows = {row.variant: row for row in measure(case, 1)}
    image, pressure = rows["R 3 mm, 0.5 mm deep: image"], rows["R 3 mm, 0.5 mm deep: pressure"]
    assert image.figures["real_px"] == pytest.approx(truth, abs=1.0)
    assert image.figures["layer_px"] == pytest.approx(truth, abs=0.1)  # the same pitch, the same solver
    assert image.figures["cap_px"] == pytest.approx(np.sqrt(2 * 3 * 0.5 - 0.25) / 0.0625)
    assert image.figures["hertz_px"] == pytest.approx(np.sqrt(3 * 0.5) / 0.0625)
    assert image.error == pytest.approx(abs(image.figures["image_px"] - image.figures["real_px"]))
    assert image.error < 2 and image.error_unit == "px"
    assert pressure.error == pytest.approx(abs(pressure.figures["pressure_px"] - truth), abs=1e-4)
    assert pressure.error < 2
    assert set(rows) == {image.variant, pressure.variant, "R 3 mm, 0.25 mm deep: pressure"}  # no frame of that depth
    assert draw_radii(list(rows.values()), tmp_path / "radii.png")
    assert imread(tmp_path / "radii.png").std() > 0.01


def test_other_thicknesses_are_long_rows(folder_of_frames: Folder) -> None:
    folder, _ = folder_of_frames

    def thicknesses(*, long: bool) -> list[str]:
        cases = select_cases(["real"], baselines=False, long=long, data=folder)
        return [case.resolution for case in cases if case.name == contact_radius.CASE]

    assert thicknesses(long=False) == ["ball R 3 mm, gel 4 mm, h 0.5 mm"]
    assert len(thicknesses(long=True)) == 2
    assert select_cases(["real"], baselines=True, long=True) == []


def test_the_shipped_labels_are_those_of_the_public_set() -> None:
    labels = load_model(PressLabels, SHIPPED)
    assert [press.radius_px for press in labels.presses] == [12.5, 20.0, 25.5, 30.5, 18.5, 28.0, 35.5, 42.0]
    assert labels.balls == pytest.approx([2.92e-3, 4.925e-3])
    assert labels.pixel_pitch == pytest.approx(5.92593e-5)


def test_a_folder_without_labels_of_its_own_is_searched_for_the_public_frames(tmp_path: Path) -> None:
    assert read_labels(tmp_path) == load_model(PressLabels, SHIPPED)
    with pytest.raises(BadData, match=r"no frame of 'THUsight.*sphere_0\.25_real\.png"):
        read_frames(tmp_path, read_labels(tmp_path))


def test_what_is_missing_is_named(folder_of_frames: Folder) -> None:
    folder, _ = folder_of_frames
    labels = read_labels(folder)
    _, frames = read_frames(folder, labels)
    assert list(frames) == [labels.presses[0]]

    text = (folder / OWN).read_text(encoding="utf-8")
    (folder / OWN).write_text(text.replace("radius_px: 14 ", "radius_px: null "), encoding="utf-8")
    with pytest.raises(BadData, match=r"no frame and no radius_px for R 3 mm, 0\.25 mm deep"):
        read_frames(folder, read_labels(folder))

    (folder / FRAME.parent.parent / "copy").mkdir()
    twin = folder / FRAME.parent.parent / "copy" / FRAME.name
    twin.write_bytes((folder / FRAME).read_bytes())
    with pytest.raises(BadData, match="exists twice"):
        read_frames(folder, labels)
    twin.unlink()

    (folder / "deep" / "empty.png").unlink()
    with pytest.raises(BadData, match=r"no frame without contact; looked for none\.png, \.\./empty\.png"):
        read_frames(folder, labels)
    with pytest.raises(BadData, match="is not a folder"):
        read_labels(folder / "elsewhere")


def test_an_unreadable_frame_is_named(folder_of_frames: Folder) -> None:
    folder, _ = folder_of_frames
    labels = read_labels(folder)
    (folder / FRAME).write_bytes(b"no picture")
    with pytest.raises(BadData, match=r"ball_a\.png: no readable picture"):
        read_frames(folder, labels)
    Image.fromarray(np.zeros((20, 20, 3), np.uint8)).save(folder / FRAME)
    with pytest.raises(BadData, match="differ in size"):
        read_frames(folder, labels)


def test_labels_with_mistakes_say_where(folder_of_frames: Folder) -> None:
    folder, _ = folder_of_frames
    text = (folder / OWN).read_text(encoding="utf-8")
    (folder / OWN).write_text(text.replace("depth: 0.5 mm", "depth: 0.5 kg"), encoding="utf-8")
    with pytest.raises(ConfigError, match=r"presses\.yaml:8"):
        read_labels(folder)
    (folder / OWN).write_text("name: nothing else", encoding="utf-8")
    with pytest.raises(ConfigError, match="pixel_pitch"):
        read_labels(folder)


def test_a_frame_without_a_dent_is_named(folder_of_frames: Folder) -> None:
    folder, _ = folder_of_frames
    empty = np.asarray(Image.open(folder / "deep" / "empty.png"))
    camera = contact_radius.RenderedSensor(read_labels(folder), empty)
    with pytest.raises(BadData, match=r"this frame: no .*contact.* is seen"):
        camera.radius(empty, empty, 3e-3, "this frame")


def test_wrong_words_on_the_command_line(folder_of_frames: Folder, tmp_path: Path) -> None:
    for words, said in (
        (("real",), "--data DIR"),
        (("press", "--data", tmp_path), "uses no real frames"),
        (("real", "--data", tmp_path / "none"), "is not a folder"),
        (("real", "--data", folder_of_frames[0] / "deep"), "holds them"),  # labels missing there
    ):
        result = tacsim("bench", *words, "--json", tmp_path / "none.json")
        assert result.exit_code == 2 and said in " ".join(result.output.split()), result.output
        assert not (tmp_path / "none.json").exists()


@pytest.mark.deep
def test_the_report_of_a_run_has_the_rows(folder_of_frames: Folder, tmp_path: Path) -> None:
    result = tacsim("bench", "real", "--data", folder_of_frames[0], "--json", tmp_path / "real.json")
    assert result.exit_code == 0, result.output
    report = json.loads((tmp_path / "real.json").read_text(encoding="utf-8"))
    assert {row["group"] for row in report["results"]} == {"real"}
    assert report["metadata"]["long"] is False
