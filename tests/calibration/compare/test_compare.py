"""Two sides against each other: alignment, null and floor, and each kind of bad input."""

from __future__ import annotations

import csv
import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calibration.compare.compare import METRICS, Comparison, Options, bootstrap_interval, compare_frames
from calibration.compare.metrics import align_by_geometry, align_by_size
from calibration.compare.report import comparison_as_json, comparison_figures, describe_comparison, write_comparison
from calibration.errors import BadFrames
from calibration.frame_set import Frame, FrameSet, rectified_by_corners, rectified_shape
from calibration.lens.view import BadCorners
from tacsim.interface import SurfaceMap
from tacsim.models.sensor import SensorGeometry
from tests.calibration.presses import COLUMNS, ROWS, HiddenSensor
from tests.calibration.sources import blank, changed, shifted, side


@pytest.fixture(scope="module")
def good(real: FrameSet) -> FrameSet:
    """The same light, other noise: as good as a simulation can be."""
    sensor = HiddenSensor(3)
    sensor.empty()  # so that its noise is another
    made = side(sensor, name="good")
    return replace(made, reference=real.reference, untouched=())


@pytest.fixture(scope="module")
def other(real: FrameSet) -> FrameSet:
    """Another light: what an uncalibrated simulation is."""
    return replace(side(HiddenSensor(8), name="other"), untouched=())


@pytest.fixture(scope="module")
def compared(good: FrameSet, real: FrameSet) -> Comparison:
    return compare_frames(good, real)


def test_a_good_simulation_surely_beats_the_null_and_comes_near_the_floor(compared: Comparison) -> None:
    for key in ("contact_mae", "contact_psnr", "contact_ssim", "contact_ncc", "contact_iou"):
        assert compared.overall[key].outperforms_null, key
        assert compared.overall[key].better == 1.0
    error = compared.overall["contact_mae"]
    assert error.floor == pytest.approx(2 * 1.5 / math.sqrt(math.pi), abs=0.15)  # two pictures of noise 1.5
    assert error.mean == pytest.approx(error.floor, rel=0.1)
    assert error.low < error.mean < error.high < error.null / 5
    assert compared.overall["contact_ncc"].mean > 0.98
    assert compared.overall["contact_centroid"].mean < 0.7
    assert math.hypot(*compared.alignment.shift) < 0.1


def test_a_blank_beats_no_null(real: FrameSet) -> None:
    result = compare_frames(blank(real), real)
    for key in ("mae", "psnr", "ssim", "contact_mae", "contact_psnr", "contact_ssim", "contact_ncc", "contact_iou"):
        assert result.overall[key].outperforms_null is False, key
        assert result.overall[key].mean == result.overall[key].null
    assert all("A: no contact" in pair.flags for pair in result.pairs)
    assert "no shift was estimated" in result.alignment.description


def test_another_light_is_told_from_the_right_one(other: FrameSet, real: FrameSet, compared: Comparison) -> None:
    result = compare_frames(other, real)
    assert result.overall["contact_mae"].mean > 5 * compared.overall["contact_mae"].mean
    assert result.overall["contact_ncc"].mean < 0.9
    assert math.hypot(*result.alignment.shift) < 3  # contacts are found in any light


@pytest.mark.slow
@pytest.mark.parametrize("shift", [(0.0, 0.0), (3.4, -2.7), (-8.25, 5.5)])
def test_a_known_shift_is_found_and_undone(good: FrameSet, real: FrameSet, shift: tuple[float, float]) -> None:
    moved = changed(good, lambda image: shifted(image, *shift), "all")
    result = compare_frames(moved, real)
    assert result.alignment.shift == pytest.approx(shift, abs=0.1)
    assert result.overall["contact_ncc"].mean > 0.97
    if shift != (0.0, 0.0):
        unmoved = compare_frames(moved, real, options=Options(shift=False))
        assert unmoved.alignment.shift == (0.0, 0.0)
        assert unmoved.overall["contact_mae"].mean > 1.5 * result.overall["contact_mae"].mean


def test_a_picture_of_twice_the_size_is_scaled(good: FrameSet, real: FrameSet) -> None:
    twice = changed(good, lambda image: image.repeat(2, axis=0).repeat(2, axis=1), "all")
    result = compare_frames(twice, real)
    assert result.overall["contact_ncc"].mean > 0.98
    assert result.alignment.shift == pytest.approx((0.0, 0.0), abs=0.1)
    assert "scaled by 0.5" in result.alignment.description


def test_pixel_centres_stay_whole_numbers_under_a_scale() -> None:
    """The outer borders coincide, not the centres of the first pixels."""
    aligned = align_by_size((40, 60), (20, 30))
    corners = np.array([[-0.5, -0.5, 1.0], [29.5, 19.5, 1.0]])
    assert corners @ aligned.a_from_b.T == pytest.approx(np.array([[-0.5, -0.5], [59.5, 39.5]]))


def test_geometries_place_both_on_the_gel() -> None:
    source = SensorGeometry(width=100, height=80, pixel_pitch=0.1e-3)
    target = SensorGeometry(width=60, height=40, pixel_pitch=0.2e-3, centre=(20.0, 10.0))
    aligned = align_by_geometry(source, target)
    assert aligned.a_from_b @ [20.0, 10.0, 1.0] == pytest.approx(source.principal)
    assert aligned.a_from_b @ [25.0, 10.0, 1.0] == pytest.approx(np.add(source.principal, (10.0, 0.0)))
    covered = aligned.covered_mask
    assert covered[10, 20]
    assert not covered[39, 59]  # 7.8 mm to the right of the axis; A reaches 5 mm


@pytest.mark.slow
def test_corners_undo_a_slanted_view(real: FrameSet) -> None:
    import cv2

    inset = np.array([(30, 20), (240, 8), (250, 190), (12, 170)], dtype=np.float32)
    full = np.array([(-0.5, -0.5), (COLUMNS - 0.5, -0.5), (COLUMNS - 0.5, ROWS - 0.5), (-0.5, ROWS - 0.5)])
    matrix = cv2.getPerspectiveTransform(full.astype(np.float32), inset)
    slanted = changed(real, lambda image: cv2.warpPerspective(image, matrix, (COLUMNS, ROWS)), "all")
    corners = tuple((float(u), float(v)) for u, v in inset)
    straight = rectified_by_corners(slanted, corners, real.shape)
    assert compare_frames(slanted, real).overall["contact_ncc"].mean < 0.8
    assert compare_frames(straight, real).overall["contact_ncc"].mean > 0.97
    assert rectified_shape(corners) == (182, 239)  # the longest sides: right and bottom
    outside = ((-20.0, 0.0), corners[1], corners[2], corners[3])
    with pytest.raises(BadCorners, match="outside the picture"):
        rectified_by_corners(slanted, outside, real.shape)


def test_surfaces_that_a_simulation_knows_are_compared() -> None:
    sensor = HiddenSensor(4)
    v, u = np.mgrid[:64, :64] - 31.5
    height = (0.4e-3 * np.exp(-(u**2 + v**2) / 200)).astype(np.float32)
    by_y, by_x = np.gradient(height, 0.25e-3)
    gradient = np.stack([by_x, by_y], axis=-1)
    plain = side(sensor, 3)

    def knowing(factor: float, markers: float) -> FrameSet:
        flow = np.full((5, 6, 2), markers, dtype=np.float32)
        surface = SurfaceMap(factor * height, factor * gradient, flow)
        return replace(plain, frames=tuple(replace(frame, surface=surface) for frame in plain.frames))

    result = compare_frames(knowing(0.9, 3e-5), knowing(1.0, 0.0))
    assert result.overall["marker_error"].mean == pytest.approx(3e-5 * math.sqrt(2), rel=1e-5)
    assert 0.05 < result.overall["height_share"].mean < 0.1  # a tenth too low, where it is at least half as deep
    assert result.overall["surface_iou"].mean == 1.0  # half of its own depth: the same place
    steep = np.degrees(np.arctan(np.hypot(by_x, by_y)) - np.arctan(0.9 * np.hypot(by_x, by_y)))
    pressed = height > 0.5 * height.max()
    assert result.overall["gradient_angle"].mean == pytest.approx(steep[pressed].mean(), rel=1e-3)
    assert result.overall["gradient_angle"].outperforms_null
    assert result.overall["height_rmse"].null > 5 * result.overall["height_rmse"].mean


def test_without_surfaces_it_says_so(compared: Comparison) -> None:
    assert math.isnan(compared.overall["gradient_angle"].mean)
    assert sum("no surfaces are compared" in note for note in compared.notes) == 2


def test_a_lone_reference_has_no_floor(good: FrameSet, real: FrameSet) -> None:
    result = compare_frames(good, replace(real, untouched=()))
    assert math.isnan(result.overall["contact_mae"].floor)
    assert "noise floor absent: B has no second frame without contact" in result.notes


def test_frames_without_contact_on_both_sides_make_the_floor(good: FrameSet, real: FrameSet) -> None:
    still_a = replace(good, frames=(*good.frames, Frame("still.png", good.reference)))
    still_b = replace(real, frames=(*real.frames, Frame("still.png", real.untouched[0].image)), untouched=())
    result = compare_frames(still_a, still_b)
    assert result.overall["contact_mae"].floor == pytest.approx(1.69, abs=0.15)
    assert result.pairs[-1].flags == ("A: no contact", "B: no contact")
    assert math.isnan(result.pairs[-1].numbers["contact_mae"])
    assert not math.isnan(result.overall["contact_mae"].mean)


def test_one_frame_has_numbers_but_no_interval(good: FrameSet, real: FrameSet) -> None:
    result = compare_frames(replace(good, frames=good.frames[:1]), replace(real, frames=real.frames[:1]))
    error = result.overall["contact_mae"]
    assert error.mean < 3 and math.isnan(error.low) and error.outperforms_null is None
    assert "1 pair: too few for intervals; at least 3 are needed" in result.notes


@pytest.mark.slow
def test_saturated_frames_are_flagged(good: FrameSet, real: FrameSet) -> None:
    burnt = changed(real, lambda image: np.clip(image.astype(int) * 2, 0, 255).astype(np.uint8), "all")
    result = compare_frames(good, burnt)
    assert any(flag.startswith("B: saturated: ") for pair in result.pairs for flag in pair.flags)
    clean = compare_frames(good, real)
    assert not any("saturated" in flag for pair in clean.pairs for flag in pair.flags)


def test_a_stale_reference_is_flagged(good: FrameSet, real: FrameSet) -> None:
    stale = changed(real, lambda image: np.clip(image.astype(int) + 9, 0, 255).astype(np.uint8))
    result = compare_frames(good, stale)
    assert all(any("B: stale reference" in flag and "9 grey" in flag for flag in pair.flags) for pair in result.pairs)


def test_swapped_colours_are_noticed(good: FrameSet, real: FrameSet, compared: Comparison) -> None:
    bgr = changed(good, lambda image: np.ascontiguousarray(image[..., ::-1]), "all")
    assert any("red and blue look swapped" in note for note in compare_frames(bgr, real).notes)
    assert not any("swapped" in note for note in compared.notes)


def test_sizes_of_other_proportions_need_a_calibration(good: FrameSet, real: FrameSet) -> None:
    cut = changed(good, lambda image: image[:, :200], "all")
    with pytest.raises(BadFrames, match=r"A is 200 x 200 px, B 260 x 200.*--calibration-a.*--corners-a"):
        compare_frames(cut, real)


@pytest.mark.slow
def test_pairs_that_are_none_are_not_shifted(real: FrameSet) -> None:
    elsewhere = side(HiddenSensor(3), places=[(190, 140), (70, 60), (60, 150), (200, 60), (130, 50)])
    result = compare_frames(elsewhere, real)
    assert result.alignment.shift == (0.0, 0.0)
    assert "not shifted" in result.alignment.description


def test_the_bootstrap_has_the_width_of_the_mean() -> None:
    values = np.random.default_rng(1).normal(5, 2, 400)
    low, high = bootstrap_interval(values)
    assert low < values.mean() < high
    assert high - low == pytest.approx(2 * 1.96 * values.std() / 20, rel=0.1)
    assert all(math.isnan(bound) for bound in bootstrap_interval(values[:2]))


# files


def test_the_files_say_the_same_and_load_nothing(compared: Comparison, tmp_path: Path) -> None:
    paths = write_comparison(tmp_path, compared)
    assert [path.name for path in paths] == ["compare.json", "compare.csv", "compare.html"]
    config = json.loads(paths[0].read_text(encoding="utf-8"))
    assert config == comparison_as_json(compared)
    assert config["overall"]["gradient_angle"]["mean"] is None
    with paths[1].open(encoding="utf-8", newline="") as file:
        table = list(csv.DictReader(file))
    assert [row["a"] for row in table] == [frame.name for frame in compared.a.frames]
    assert float(table[2]["contact_mae"]) == compared.pairs[2].numbers["contact_mae"]
    assert float(table[2]["null_contact_mae"]) == compared.pairs[2].null["contact_mae"]
    page = paths[2].read_text(encoding="utf-8")
    assert page.count("data:image/jpeg;base64,") == 6 * len(compared.pairs)
    assert "http://" not in page and "https://" not in page and "<script" not in page
    worst = max(compared.pairs, key=lambda pair: pair.numbers["contact_mae"])
    assert page.index(f">{worst.a.name}</td>") == min(page.index(f">{pair.a.name}</td>") for pair in compared.pairs)


def test_the_columns_of_the_page_need_no_more_than_their_longest_word(compared: Comparison, tmp_path: Path) -> None:
    """Heads in one line made the tables wider than a window of 1200 px, and their last columns were cut off."""
    page = write_comparison(tmp_path, compared)[2].read_text(encoding="utf-8")
    style = page[page.index("<style>") : page.index("</style>")]
    for part, wrapped in (("thead th", "white-space: normal"), ("td.name", "overflow-wrap: anywhere")):
        assert wrapped in style[style.rindex(part) :].partition("}")[0]
    pairs = page[page.index('<table class="pairs">') :].partition("</table>")[0]
    assert pairs.count('<td class="name">') == 2 * len(compared.pairs)


@pytest.mark.slow
def test_names_of_files_are_no_markup(good: FrameSet, real: FrameSet, tmp_path: Path) -> None:
    evil = "<img src=x onerror=alert(1)>.png"
    frames = (replace(good.frames[0], name=evil), *good.frames[1:])
    result = compare_frames(replace(good, frames=frames, name="<b>A</b>"), real)
    page = write_comparison(tmp_path, result)[2].read_text(encoding="utf-8")
    assert evil not in page and "<b>A</b>" not in page
    assert "&lt;img src=x" in page


@pytest.mark.slow
def test_a_comparison_with_itself_can_be_written(real: FrameSet, tmp_path: Path) -> None:
    result = compare_frames(real, real)
    assert result.overall["psnr"].mean == math.inf
    config = json.loads(write_comparison(tmp_path, result)[0].read_text(encoding="utf-8"))
    assert config["overall"]["mae"]["mean"] == 0.0
    assert config["overall"]["psnr"]["mean"] is None


def test_every_metric_is_a_figure(compared: Comparison) -> None:
    values = comparison_figures(compared)
    assert {metric.key for metric in METRICS} <= set(values)
    assert values["contact_mae"] == compared.overall["contact_mae"].mean
    assert math.isnan(values["rho_gradient"])


# drift, sides, judgement


@pytest.mark.slow
def test_drift_of_the_light_is_no_contact(good: FrameSet, real: FrameSet) -> None:
    """A light that has changed by a quadratic of the place: 22 grey levels in one corner. The contact regions must be
    those without it."""
    v, u = np.mgrid[-1 : 1 : ROWS * 1j, -1 : 1 : COLUMNS * 1j]
    drift = (4.0 + 8.0 * u + 6.0 * v * v + 4.0 * u * v)[..., None] * np.array([1.0, 0.2, -0.5])

    def drifted(image: np.ndarray) -> np.ndarray:
        return np.clip(np.rint(image + drift), 0, 255).astype(np.uint8)

    plain, found = compare_frames(good, real), compare_frames(good, changed(real, drifted))
    assert plain.overall["contact_iou"].mean > 0.9
    assert found.overall["contact_iou"].mean > plain.overall["contact_iou"].mean - 0.03
    assert found.overall["contact_radius"].mean < plain.overall["contact_radius"].mean + 0.5
    assert found.alignment.shift == pytest.approx((0.0, 0.0), abs=0.15)


@pytest.mark.slow
def test_no_shift_is_sought_where_a_is_made_in_the_pixels_of_b(good: FrameSet, real: FrameSet) -> None:
    placed = replace(changed(good, lambda image: shifted(image, 3.0, 0.0), "all"), same_pixels=True)
    assert compare_frames(placed, real).alignment.shift == (0.0, 0.0)
    asked = compare_frames(placed, real, options=Options(shift=True))
    assert asked.alignment.shift == pytest.approx((3.0, 0.0), abs=0.1)


def test_what_could_not_be_made_is_left_out_and_said(good: FrameSet, real: FrameSet) -> None:
    words = "press_1.png: not pressed: too deep"
    part = replace(good, frames=(good.frames[0], *good.frames[2:]), same_pixels=True, simulated=True, notes=(words,))
    result = compare_frames(part, real)
    assert [pair.b.name for pair in result.pairs] == [frame.name for frame in part.frames]
    assert words in result.notes
    with pytest.raises(BadFrames, match=r"press_1\.png: not pressed"):
        compare_frames(replace(part, frames=()), real)


@pytest.mark.slow
def test_a_simulation_and_its_truth_are_called_so(good: FrameSet, real: FrameSet, tmp_path: Path) -> None:
    result = compare_frames(replace(good, simulated=True), real)
    assert result.names == ("simulated", "real")
    page = write_comparison(tmp_path, result)[2].read_text(encoding="utf-8")
    assert "simulated against real" in page and "A against B" not in page
    assert compare_frames(good, replace(real, simulated=True)).names == ("real", "simulated")
    assert comparison_as_json(result)["a"]["is"] == "simulated"


@pytest.mark.slow
def test_the_judgement_is_one_plain_sentence(
    compared: Comparison, other: FrameSet, good: FrameSet, real: FrameSet, tmp_path: Path
) -> None:
    close = describe_comparison(compared)
    assert comparison_as_json(compared)["judgement"] == close
    assert close.startswith("In contact A looks like B: they differ by 1.") and "noise alone by 1." in close
    assert "no more like B than a picture without contact" in describe_comparison(compare_frames(other, real))
    dull = changed(good, lambda image: np.rint(0.5 * (image + np.float64(good.reference))).astype(np.uint8))
    assert "A resembles B, but is not close to it" in describe_comparison(compare_frames(dull, real))
    assert "no more like B than a picture without contact" in describe_comparison(compare_frames(blank(real), real))
    few = compare_frames(replace(good, frames=good.frames[:1]), replace(real, frames=real.frames[:1]))
    assert describe_comparison(few).startswith("Too few pairs to judge")
    still = compare_frames(blank(real), blank(real))
    assert describe_comparison(still) == "No pair shows contact, so nothing can be judged."
    page = write_comparison(tmp_path, compared)[2].read_text(encoding="utf-8")
    assert page.index(close[:40]) < page.index("<table")


def test_every_table_of_the_page_has_units(compared: Comparison, tmp_path: Path) -> None:
    page = write_comparison(tmp_path, compared)[2].read_text(encoding="utf-8")
    assert "<td>grey</td>" in page and "contact NCC of the difference [1]" in page
    assert comparison_as_json(compared)["units"]["height_rmse"] == "m"
    assert "quarter of the strongest change" in page  # which pixels the figures are of


def test_a_simulation_without_noise_is_told_by_its_grain(good: FrameSet, real: FrameSet) -> None:
    import cv2

    smooth = changed(good, lambda image: cv2.GaussianBlur(image, (0, 0), 2.0), "all")
    noisy, quiet = (compare_frames(each, real).overall["grain"] for each in (good, smooth))
    assert noisy.mean < 0.05 * noisy.null and noisy.outperforms_null
    assert quiet.mean > 0.8 * quiet.null
