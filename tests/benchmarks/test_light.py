"""The real group on frames of a made-up sensor whose light, ball, depths and punch are known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from benchmarks.cases.real import balls, costs, invariance, known_depth, punches
from benchmarks.cases.real.labels import BadData, read_labels
from benchmarks.cases.registry import description, select_cases
from benchmarks.harness.runner import run_cases
from benchmarks.pages.page import INDEX, pages
from benchmarks.truth.layer import layer_contact
from tests.calibration.presses import BALL, COLUMNS, PITCH, ROWS, HiddenSensor

BALLS = """\
sets:
  - {{ name: hidden, {source}, ball_radius: 2.5 mm, pixel_pitch: 0.08 mm }}
  - {{ name: lost, frames: ["nowhere_*.png"], backgrounds: [empty.png], ball_radius: 2 mm, pixel_pitch: 0.1 mm }}
"""
PRESSES = """\
name: made up
pixel_pitch: 0.08 mm
gel_size: [21 mm, 16 mm]
gel_thickness: [8 mm]
backgrounds: [empty.png]
light: hidden
presses:
  - { frames: [deep.png], ball_radius: 2.5 mm, depth: 0.5 mm }
  - { frames: [none.png], ball_radius: 3.5 mm, depth: 0.5 mm, radius_px: 16 }
punches:
  - { frames: [punch_a.png], mesh: [block.stl], depth: 0.3 mm }
  - { frames: [nowhere.png], mesh: [other.stl], depth: 0.3 mm }
"""
SCALE, PLACE = 0.9, (140.0, 90.0)  # of the punch, and where [px]


def save(image: np.ndarray, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(image).save(path)


def slopes_of_a_block(size: tuple[float, float], depth: float) -> np.ndarray:
    """(ROWS, COLUMNS, 2) under a block of size x, y [m] at PLACE."""
    n = 512
    x = (np.arange(n) - n // 2) * PITCH
    inside = (np.abs(x)[None, :] <= size[0] / 2) & (np.abs(x)[:, None] <= size[1] / 2)
    contact = layer_contact(np.where(inside, 0.0, 1.0), depth, PITCH, 8e-3, 0.145e6, 0.45)
    by_y, by_x = np.gradient(contact.displacement, PITCH)
    top, left = n // 2 - round(PLACE[1]), n // 2 - round(PLACE[0])
    return np.stack([by_x, by_y], axis=-1)[top : top + ROWS, left : left + COLUMNS]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root, sensor = tmp_path_factory.mktemp("real"), HiddenSensor(3)
    save(sensor.empty(), root / "balls" / "empty.png")
    for k, press in enumerate(sensor.presses(6)):
        save(press.image, root / "balls" / f"ball_{k}.png")
    save(sensor.empty(), root / "depths" / "empty.png")
    save(sensor.press(0.5e-3, 150, 90).image, root / "depths" / "deep.png")
    save(sensor.photograph(slopes_of_a_block((SCALE * 6e-3, SCALE * 4e-3), 0.3e-3)), root / "depths" / "punch_a.png")
    trimesh.creation.box((6.0, 4.0, 9.0)).export(root / "block.stl")
    (root / balls.OWN).write_text(
        BALLS.format(source='frames: ["ball_*.png"], backgrounds: [empty.png]'), encoding="utf-8"
    )
    (root / "presses.yaml").write_text(PRESSES, encoding="utf-8")
    return root


@pytest.fixture
def hidden(folder: Path) -> balls.BallSet:
    return balls.read_sets(folder)[0]


@pytest.mark.slow
def test_left_out_presses_are_scored_beside_a_picture_without_contact(folder: Path, hidden: balls.BallSet) -> None:
    picture, normals = balls.ball_presses(folder, hidden, 1)
    assert (picture.variant, normals.variant) == ("hidden: picture", "hidden: normals")
    assert picture.error < 2.6  # the camera's noise alone is 1.5 of deviation, in frame and reference: 1.7
    assert picture.figures["null_grey"] > 5 * picture.error
    assert picture.figures["ncc"] > 0.97
    assert picture.figures["low_grey"] < picture.error < picture.figures["high_grey"]
    assert picture.figures["presses"] == 6
    assert normals.error < 2.5 < 10 < normals.figures["null_deg"]
    assert picture.timing.median > 0


def test_presses_in_an_archive_are_the_same_presses(folder: Path, hidden: balls.BallSet, tmp_path: Path) -> None:
    reference, frames = balls.read_balls(folder, hidden)
    images = np.stack([image for _, image in frames])
    np.savez(tmp_path / "pack.npz", images=images[..., ::-1], background=reference[..., ::-1])
    text = BALLS.format(source="archive: [pack.npz], blue_first: true")
    (tmp_path / balls.OWN).write_text(text, encoding="utf-8")
    packed = balls.read_sets(tmp_path)[0]
    again, others = balls.read_balls(tmp_path, packed)
    assert np.array_equal(again, reference)
    assert all(np.array_equal(one[1], other[1]) for one, other in zip(frames, others, strict=True))
    np.savez(tmp_path / "pack.npz", images=images.astype(object), background=reference)
    with pytest.raises(BadData, match=r"pack\.npz: needs arrays .* without pickles"):
        balls.read_balls(tmp_path, packed)
    np.savez(tmp_path / "pack.npz", images=images[:, :50], background=reference)
    with pytest.raises(BadData, match=r"`images` are \(6, 50"):
        balls.read_balls(tmp_path, packed)


def test_only_the_first_set_that_is_there_is_calibrated_without_long(tmp_path: Path) -> None:
    text = "sets:\n" + "".join(
        f"  - {{name: {name}, frames: ['{name}_*.png'], backgrounds: [empty.png], ball_radius: 4 mm, "
        "pixel_pitch: 0.05 mm}\n"
        for name in ("none", "first", "second")
    )
    (tmp_path / balls.OWN).write_text(text, encoding="utf-8")
    for name in ("first", "second"):
        (tmp_path / f"{name}_0.png").touch()
    of_sets = [(bool(case.missing), case.long) for case in balls.cases(tmp_path)]
    assert of_sets == [(True, False), (False, False), (False, True)]


def test_a_press_of_known_depth_is_simulated_from_it_alone(folder: Path) -> None:
    picture, height = known_depth.known_depth(folder, BALL, 1)
    assert picture.variant.endswith(": picture") and height.variant.endswith(": height")
    assert picture.error < 0.3 * picture.figures["null_grey"]  # noise of frame and reference is half of it
    assert picture.figures["ssim"] > picture.figures["null_ssim"] + 0.1
    assert picture.figures["ncc"] > 0.95
    assert height.error < 6 < 15 < height.figures["null_percent"]
    assert height.figures["peak_ratio"] == pytest.approx(1.0, abs=0.15)


@pytest.mark.deep
def test_scale_and_place_of_a_punch_are_found(folder: Path) -> None:
    (row,) = punches.punch(folder, "block", 1)
    assert row.figures["scale"] == pytest.approx(SCALE, abs=0.021)
    assert (row.figures["x_px"], row.figures["y_px"]) == pytest.approx(PLACE, abs=1.0)
    assert row.error < 0.45 * row.figures["null_grey"]
    assert row.figures["ncc"] > 0.9


def test_the_highest_face_of_a_mesh_is_the_punch(tmp_path: Path) -> None:
    plate = trimesh.creation.box((20.0, 20.0, 2.0))
    wedge = trimesh.creation.extrude_triangulation(np.array([[0, 0], [4, 0], [0, 2.0]]), np.array([[0, 1, 2]]), 9.0)
    trimesh.util.concatenate([plate, wedge]).export(tmp_path / "wedge.stl")
    face = punches.read_face(tmp_path / "wedge.stl")
    mask = face.mask((100, 100), 40.3, 59.7, 0.1e-3, 1.0)  # no edge on a row of pixel centres
    assert mask.sum() == pytest.approx(4 * 2 / 2 / 0.01, rel=0.03)
    assert mask[55, 45] and not mask[65, 45]  # y of the mesh points up in the image
    assert face.mask((100, 100), 40.3, 59.7, 0.1e-3, 1.0, rim=3)[62, 45]
    with pytest.raises(BadData, match=r"none\.stl"):
        punches.read_face(tmp_path / "none.stl")


def test_what_a_folder_lacks_is_said_and_is_no_failure(folder: Path) -> None:
    cases = select_cases(["real"], baselines=False, long=True, data=folder)
    lacking = {(case.name, case.resolution): case.missing for case in cases if case.missing}
    words = " | ".join(lacking.values())
    assert "lost: no nowhere_*.png below" in words
    assert "no frame of this ball" in words
    assert "no frame or no mesh of the punch 'other'" in words
    assert "no film of a dotted gel" in words
    report = run_cases([case for case in cases if case.missing], 1, baselines=False)
    assert report.failures == [] and report.results == []
    assert {one.cause for one in report.missing} == set(lacking.values())
    assert "- ball_presses: lost: no nowhere" in pages(report)[INDEX]
    there = {case.name for case in cases if not case.missing}
    assert {balls.CASE, known_depth.CASE, punches.CASE, invariance.CASE, costs.RENDER, costs.NORMALISE} <= there
    assert all(description("real", case.name, case.method) for case in cases)


def test_without_light_everything_that_needs_it_says_so(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "presses.yaml").write_text(PRESSES.replace("light: hidden", "light: ''"), encoding="utf-8")
    assert all(
        "calibrate its light" in case.missing for case in (*known_depth.cases(tmp_path), *invariance.cases(tmp_path))
    )
    (tmp_path / "presses.yaml").write_text(PRESSES, encoding="utf-8")
    (tmp_path / balls.OWN).write_text((folder / balls.OWN).read_text(encoding="utf-8"), encoding="utf-8")
    with pytest.raises(BadData, match=r"no ball_\*\.png below"):
        known_depth.light_of(tmp_path, read_labels(tmp_path))


@pytest.mark.deep
def test_costs_are_measured_beside_their_error() -> None:
    for row in (*costs.calibrated_render(320, 3), *costs.normaliser(3)):
        assert row.timing.median > 0 and len(row.timing.samples) >= 3
        limit = 1.0 if row.error_unit == "grey at most" else 6.0
        assert row.error < limit, row.variant


@pytest.mark.deep
def test_presses_of_our_gel_beside_the_same_made_up_ones(
    folder: Path, hidden: balls.BallSet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(invariance, "MIN_PRESSES", 6)
    monkeypatch.setattr(invariance, "FOLDS", 2)
    rows = {row.variant: row for row in invariance.invariance(folder, hidden, (21e-3, 16e-3, 8e-3), 1)}
    assert rows["pictures: picture"].error < 0.25 * rows["pictures: picture"].figures["null"]
    assert rows["surfaces: rho, gradient"].error < 1
    assert rows["surfaces: rho, gradient"].figures["presses"] == 6
    monkeypatch.setattr(invariance, "MIN_PRESSES", 10)
    with pytest.raises(BadData, match="6 presses; at least 10 are needed"):
        invariance.invariance(folder, hidden, (21e-3, 16e-3, 8e-3), 1)
