"""The tables of left-out presses, of subsets and of clicked circles, made on a small made-up set."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import cycle
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from benchmarks import held_out
from benchmarks.cases.real import balls, clicked
from benchmarks.cases.real.labels import BadData
from calibration.errors import BadFrames
from calibration.light.fit import LightFit
from tests.calibration.dotted import draw, lattice_points
from tests.calibration.presses import BALL, PITCH, HiddenSensor, Made

LABELS = f"""
sets:
  - name: made-up
    frames: ["press_*.png"]
    backgrounds: [background.png]
    circles: circles.csv
    ball_radius: {BALL}
    pixel_pitch: {PITCH}
  - name: not there
    frames: ["other_*.png"]
    backgrounds: [background.png]
    ball_radius: {BALL}
    pixel_pitch: {PITCH}
"""


def photographed(folder: Path, presses: int) -> list[Made]:
    """A folder of so many presses; what is true of them."""
    sensor = HiddenSensor(3)
    (folder / "balls.yaml").write_text(LABELS, encoding="utf-8")
    made = sensor.presses(presses)
    for name, image in [("background", sensor.empty())] + [(f"press_{i}", one.image) for i, one in enumerate(made)]:
        Image.fromarray(image).save(folder / f"{name}.png")
    return made


@pytest.mark.slow
def test_the_table_has_a_row_a_figure_of_each_set_that_is_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Truth: a camera whose noise alone is 1.2 grey levels in the mean; a ball that three other presses tell."""
    photographed(tmp_path, 4)
    monkeypatch.setattr(held_out, "TIMES", 1)
    held_out.main(tmp_path)
    head, _, *rows = capsys.readouterr().out.splitlines()
    assert head.startswith("| sensor | held-out figure | before | now |")
    cells = [[cell.strip() for cell in row.strip("|").split("|")] for row in rows]
    assert [(cell[0], cell[1]) for cell in cells] == [
        ("made-up, 4 presses", name) for name in ("contact MAE [grey levels]", "correlation", "normals [deg]")
    ]
    error, correlation, angle = (float(cell[3]) for cell in cells)
    assert 1.2 < error < 4.0 and correlation > 0.97 and 0.2 < angle < 4.0
    held_out.main(tmp_path, only="another")
    assert len(capsys.readouterr().out.splitlines()) == 2


@pytest.mark.slow
def test_the_spread_of_radii_over_subsets(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Truth: of four calibrations two find the radii that all presses give, one a tenth less; one is refused."""
    photographed(tmp_path, 4)
    of = balls.read_sets(tmp_path)[0]
    whole, _, _ = balls.calibrated(tmp_path, of)
    scales: Iterator[float | None] = cycle((1.0, 0.9, None, 1.0))
    asked: list[int] = []

    def part(reference: np.ndarray, frames: Sequence[tuple[str, np.ndarray]], ball: float) -> LightFit:
        asked.append(len({name for name, _ in frames}))
        scale = next(scales)
        if scale is None:
            raise BadFrames("none")
        chosen = [press for press in whole.presses if press.name in {name for name, _ in frames}]
        smaller = tuple(replace(p, circle=replace(p.circle, radius=scale * p.circle.radius)) for p in chosen)
        return replace(whole, presses=smaller, radius_uncertainty=0.02)

    monkeypatch.setattr(held_out, "calibrate_light", part)
    held_out.main(tmp_path, spread=4, presses=[3, 4])  # of four presses there is but one subset of four
    _, _, *rows = capsys.readouterr().out.splitlines()
    off = np.array([0.0, np.log(0.9), 0.0])
    assert asked == [3] * 4
    assert [[cell.strip() for cell in row.strip("|").split("|")] for row in rows] == [
        ["made-up, 4 presses", "3", "3 of 4", f"{off.mean():+.1%}", f"{off.std(ddof=1):.1%}", "-10.5%", "33%", "2.0%",
         "0%"]
    ]  # fmt: skip


@pytest.mark.slow
def test_clicked_circles_are_moved_and_scaled_as_the_other_presses_ask_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Truth: a person clicks 3 pixels to the right and takes a tenth of skirt for contact. As clicked, the light would
    be off by far more than noise (1.2 grey levels) and what four presses do not tell."""
    made = photographed(tmp_path, 8)
    lines = [f"press_{i}.png,{x + 3},{y},{1.1 * radius}" for i, (x, y, radius) in enumerate(one.circle for one in made)]
    (tmp_path / "circles.csv").write_text("\n".join(["file,x,y,radius", *lines]), encoding="utf-8")
    monkeypatch.setattr(clicked, "FOLDS", 2)
    held_out.main(tmp_path, clicked=True)
    _, _, *rows = capsys.readouterr().out.splitlines()
    ((name, refined, inside),) = [[cell.strip() for cell in row.strip("|").split("|")] for row in rows]
    assert name == "made-up, 8 presses" and 1.2 < float(refined) < 4.0
    error, count = inside.split()
    assert 1.2 < float(error) < 4.0 and count == "(8)"
    (tmp_path / "circles.csv").unlink()
    with pytest.raises(BadData, match="no clicked circles"):
        held_out.main(tmp_path, clicked=True)


def test_printed_dots_are_painted_over_in_all_pictures(tmp_path: Path) -> None:
    """Truth: gel of 110 grey levels under a lattice of nearly black dots."""
    labels = LABELS.replace("    circles: circles.csv", "    dots: true")
    (tmp_path / "balls.yaml").write_text(labels, encoding="utf-8")
    of = balls.read_sets(tmp_path)[0]
    centres = lattice_points(7, 9, 30.0) + [160, 120]
    for name, moved in (("background", 0), ("press_0", 2), ("press_1", 3), ("press_2", 4)):
        Image.fromarray(draw(centres + moved, 5.0)).save(tmp_path / f"{name}.png")
    reference, frames = balls.read_balls(tmp_path, of)
    assert len(frames) == 3
    assert all(np.abs(image.astype(int) - 110).max() < 10 for image in (reference, *(image for _, image in frames)))
    Image.fromarray(np.full_like(reference, 110)).save(tmp_path / "background.png")
    with pytest.raises(BadData, match="made-up"):
        balls.read_balls(tmp_path, of)
