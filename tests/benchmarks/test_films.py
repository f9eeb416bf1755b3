"""Dots followed through films: made-up ones, whose dots are counted."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from benchmarks.cases.real.films import CASE, OWN, SHIPPED, Films, marker_film, read_films
from benchmarks.cases.real.labels import BadData
from benchmarks.cases.registry import description, select_cases
from tacsim.config import load_model
from tests.calibration.dotted import draw, lattice_points

LABELS = """
films:
  - { name: made up, frames: [none.avi, dots], dots: 48 }
"""


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """4 frames at rest, then 8 of a drag to the right that takes a column out of the picture."""
    root = tmp_path_factory.mktemp("films")
    frames = root / "deep" / "dots"
    frames.mkdir(parents=True)
    rest = lattice_points(6, 8, 24.0) + (170.0, 80.0)  # the last column 11 px from the border
    rng = np.random.default_rng(0)
    for k in range(12):
        far = 2.0 * max(0, k - 3)
        image = draw(rest + (far, 0.1 * far) + rng.normal(0, 0.02, rest.shape), 5.0, shape=(160, 266), noise=1.0)
        Image.fromarray(image).save(frames / f"{k}.png")
    (root / OWN).write_text(LABELS, encoding="utf-8")
    return root


@pytest.fixture
def film(drawn: Path, tmp_path: Path) -> Path:
    """A copy that a test may spoil."""
    return shutil.copytree(drawn, tmp_path / "film")


@pytest.mark.slow
def test_dots_are_followed_and_those_that_leave_are_told(film: Path) -> None:
    (case,) = (case for case in select_cases(["real"], baselines=False, data=film) if case.name == CASE)
    assert description("real", case.name, "tacsim").startswith("Dots tracked")
    (row,) = case.measure(1)
    assert row.figures["dots"] == 48
    assert row.figures["motion_px"] == pytest.approx(16.1, abs=0.3)
    assert row.figures["kept_percent"] == pytest.approx(100 * 42 / 48)
    assert row.figures["kept_in_picture_percent"] == 100.0
    assert row.note == "6 dots leave the picture"
    assert row.error == pytest.approx(100 * 6 / 48)
    assert 0.005 < row.figures["jitter_px"] < 0.05
    assert len(row.timing.samples) == 11


def test_a_film_without_dots_or_frames_is_named(film: Path) -> None:
    labels, path = next(iter(read_films(film).items()))
    for k in range(12):
        Image.fromarray(np.full((160, 266, 3), 90, np.uint8)).save(path / f"{k}.png")
    with pytest.raises(BadData, match="its first frame has no markers"):
        marker_film(labels, path, 1)
    for k in range(1, 12):
        (path / f"{k}.png").unlink()
    Image.fromarray(draw(lattice_points(6, 8, 24.0) + (130.0, 80.0), 5.0, shape=(160, 266))).save(path / "0.png")
    with pytest.raises(BadData, match="single frame"):
        marker_film(labels, path, 1)
    (path / "0.png").write_bytes(b"no picture")
    with pytest.raises(BadData, match=r"0\.png"):
        marker_film(labels, path, 1)


def test_labels_that_name_what_is_not_there_say_so(film: Path) -> None:
    (film / OWN).write_text(LABELS.replace("dots]", "spots]"), encoding="utf-8")
    with pytest.raises(BadData, match=r"names 'made up', but .* has none of none\.avi, spots"):
        read_films(film)
    (film / OWN).unlink()
    assert read_films(film) == {}  # the public film is not there, and nobody said it were
    assert load_model(Films, SHIPPED).films[0].dots == 128
