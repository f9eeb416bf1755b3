"""rho, classifier and drift: closed forms, then made-up sensors."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calibration.bundle import Calibration
from calibration.compare.compare import Comparison, compare_frames
from calibration.compare.invariance import (
    CHANGES,
    VIEWS,
    Report,
    area_under_curve,
    auc_interval,
    classifier_scores,
    measure_invariance,
    partner_distances,
)
from calibration.compare.report import comparison_as_json, comparison_figures, figure_names, write_comparison
from calibration.errors import BadFrames
from calibration.frame_set import Frame, FrameSet
from tests.calibration.presses import HiddenSensor
from tests.calibration.sources import calibrated, changed, side

RNG = np.random.default_rng(0)


def test_the_area_under_the_curve_counts_pairs() -> None:
    low, high = np.array([1.0, 2.0, 3.0]), np.array([2.0, 4.0, 5.0])
    assert area_under_curve(low, high) == pytest.approx((1 + 0.5 + 6) / 9)  # 2 beats 1, ties with 2; 4 and 5 beat all
    assert area_under_curve(low, low + 10) == 1.0
    assert area_under_curve(low + 10, low) == 0.0
    assert area_under_curve(np.zeros(4), np.zeros(4)) == 0.5


def test_a_weighted_press_counts_as_often_as_it_is_drawn() -> None:
    low, high = RNG.normal(0, 1, 6), RNG.normal(0.5, 1, 6)
    drawn = np.array([0, 0, 3, 5, 5, 5])
    weight = np.bincount(drawn, minlength=6).astype(float)
    assert area_under_curve(low, high, weight) == pytest.approx(area_under_curve(low[drawn], high[drawn]))
    both = area_under_curve(low, high, np.stack([weight, np.ones(6)]))
    assert both.tolist() == pytest.approx([float(area_under_curve(low, high, w)) for w in (weight, np.ones(6))])


def test_the_ratio_is_of_partners_and_neighbours() -> None:
    of_b = np.array([[0.0], [30.0], [10.0], [20.0]])  # in this order neighbours are 10 apart
    assert [np.median(each) for each in partner_distances(of_b + 4.0, of_b, np.array([0, 2, 3, 1]))] == [4.0, 10.0]


def test_a_classifier_finds_a_difference_and_no_other() -> None:
    presses = RNG.normal(0, 1, (20, 300))
    same = area_under_curve(*classifier_scores(presses + RNG.normal(0, 0.3, presses.shape), presses))
    assert 0.2 < same < 0.75
    offset = np.zeros(300)
    offset[:40] = 3.0
    assert area_under_curve(*classifier_scores(presses, presses + offset)) == 1.0


def test_a_press_is_never_scored_by_a_classifier_that_has_seen_it() -> None:
    """300 pure noises of 8 presses could be learnt by heart; left out, they are chance on average."""
    areas = [
        area_under_curve(*classifier_scores(rng.normal(0, 1, (8, 300)), rng.normal(0, 1, (8, 300))))
        for rng in map(np.random.default_rng, range(30))
    ]
    assert np.mean(areas) == pytest.approx(0.5, abs=0.08)


def test_changes_of_light_are_what_they_say() -> None:
    image = np.full((2, 2, 3), 200, dtype=np.uint8)
    seen = {change.key: change(image)[0, 0].tolist() for change in CHANGES}
    assert seen == {
        "gain_down": [140, 140, 140],
        "gain_up": [240, 240, 240],
        "white_balance": [240, 200, 170],
        "offset": [215, 215, 215],
    }
    assert CHANGES[1](image + 40)[0, 0].tolist() == [255, 255, 255]  # it saturates


@pytest.fixture(scope="module")
def real() -> FrameSet:
    return side(HiddenSensor(3), 6, name="real")


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    return calibrated(HiddenSensor(3))[0]


@pytest.fixture(scope="module")
def good(real: FrameSet, calibration: Calibration) -> Comparison:
    sensor = HiddenSensor(3)
    sensor.empty()
    made = replace(side(sensor, 6, name="good"), reference=real.reference, untouched=())
    return compare_frames(made, real, calibration, calibration)


@pytest.fixture(scope="module")
def report(good: Comparison, calibration: Calibration) -> Report:
    return measure_invariance([(good, calibration)])


@pytest.mark.slow
def test_a_good_simulation_is_nearer_than_the_next_press(report: Report) -> None:
    assert [view.view for view in report.views] == list(VIEWS)
    assert report.presses == 6 and report.patch == "5.2 mm"
    for view in report.views:
        assert view.rho < 0.5, view.view
        assert view.rho_low <= view.rho <= view.rho_high
        assert view.auc_low <= view.auc <= view.auc_high
        assert view.distance < view.neighbour < 2


@pytest.mark.slow
def test_another_light_is_seen_in_the_picture_but_hardly_in_the_surface(
    real: FrameSet, calibration: Calibration
) -> None:
    """The claim of all this: each source's own calibration brings them together."""
    sensor = HiddenSensor(8)
    own, _ = calibrated(HiddenSensor(8))
    result = compare_frames(replace(side(sensor, 6), untouched=()), real, own, calibration)
    found = measure_invariance([(result, calibration)])
    views = {view.view: view for view in found.views}
    assert views["raw"].rho > 1 and views["raw"].auc == 1.0
    assert views["difference"].rho > 1
    assert views["gradient"].rho < 0.5 and views["height"].rho < 0.5


def test_a_fresh_reference_saves_from_a_change_of_gain(report: Report) -> None:
    drifts = {drift.change.key: drift for drift in report.drifts}
    assert abs(drifts["gain_down"].fresh) < 0.5
    assert drifts["gain_down"].stale > 2 * abs(drifts["gain_down"].fresh) + 0.5
    assert 0 < report.angle < 5


@pytest.mark.slow
def test_a_change_after_which_no_surface_is_found_is_named(
    real: FrameSet, calibration: Calibration, monkeypatch: pytest.MonkeyPatch
) -> None:
    from calibration.compare import invariance as module

    lost = module.Change("lamps dimmed", "dim", (0.3, 0.3, 0.3))  # too much to measure by a reference from before
    monkeypatch.setattr(module, "CHANGES", (lost,))
    found = measure_invariance(
        [(compare_frames(replace(real, untouched=()), real, calibration, calibration), calibration)]
    )
    (drift,) = found.drifts
    assert math.isfinite(drift.fresh) and math.isnan(drift.stale)
    assert any("no drift is measured, after: lamps dimmed" in note for note in found.notes)


def test_surfaces_and_drift_are_left_out_with_a_word(real: FrameSet) -> None:
    found = measure_invariance([(compare_frames(replace(real, untouched=()), real), None)])
    assert [view.view for view in found.views] == ["raw", "difference"]
    assert found.drifts == () and math.isnan(found.angle)
    assert len(found.notes) == 2
    assert found.views[0].rho == 0.0  # the same pictures
    assert found.patch.endswith("3 radii of the usual contact region")


def test_too_few_presses_are_refused(real: FrameSet) -> None:
    few = replace(real, frames=real.frames[:3])
    with pytest.raises(BadFrames, match="3 pairs show contact in B; 4 are needed"):
        measure_invariance([(compare_frames(few, few), None)])


def test_the_report_is_in_all_files(good: Comparison, report: Report, tmp_path: Path) -> None:
    config = comparison_as_json(good, report)["invariance"]
    assert config["views"]["gradient"]["rho"] == report.views[2].rho
    assert config["drift"]["gain_down"]["fresh"] == report.drifts[0].fresh
    values = comparison_figures(good, report)
    assert set(values) == set(figure_names())
    assert values["auc_low_height"] == report.views[3].auc_low
    assert values["stale_offset"] == report.drifts[3].stale
    page = write_comparison(tmp_path, good, report)[2].read_text(encoding="utf-8")
    assert "gain −30 %" in page and f"{report.views[2].rho:.2f}" in page
    assert page.count("data:image/jpeg;base64,") == 8 * len(good.pairs)  # heights too


@pytest.mark.slow
def test_drift_of_the_light_does_not_give_the_source_away(real: FrameSet, calibration: Calibration) -> None:
    """A policy sees differences without drift; the classifier must too."""
    v, u = np.mgrid[-1:1:200j, -1:1:260j]
    drift = (5.0 + 4.0 * u - 3.0 * v)[..., None] * np.array([1.0, 0.5, -0.5])

    def drifted(image: np.ndarray) -> np.ndarray:
        return np.clip(np.rint(image + drift), 0, 255).astype(np.uint8)

    sensor = HiddenSensor(3)
    sensor.empty()
    good = replace(side(sensor, 6, name="good"), reference=real.reference, untouched=())
    plain, changed_light = (
        {view.view: view for view in measure_invariance([(compare_frames(good, each), None)]).views}["difference"]
        for each in (real, changed(real, drifted))
    )
    assert changed_light.distance < 1.2 * plain.distance
    assert changed_light.auc < 0.85


def test_the_interval_holds_the_true_area() -> None:
    """Partners that are alike, sources half a deviation apart: the area is 0.638 (normal distributions)."""
    held = 0
    for rng in map(np.random.default_rng, range(100)):
        common = rng.normal(0, 0.7, 15)
        low, high = common + rng.normal(0, 0.714, 15), 0.5 + common + rng.normal(0, 0.714, 15)
        drawn = rng.integers(0, 15, (500, 15))
        times = np.stack([(drawn == press).sum(axis=1) for press in range(15)], axis=1).astype(np.float64)
        below, above = auc_interval(low, high, times)
        assert below <= area_under_curve(low, high) <= above
        held += below <= 0.638 <= above
    assert 88 <= held <= 100


def test_a_frame_in_which_nothing_can_be_measured_does_not_end_the_others(
    good: Comparison, real: FrameSet, calibration: Calibration
) -> None:
    dark = Frame(real.frames[1].name, (0.45 * real.frames[1].image).astype(np.uint8))
    spoilt = replace(real, frames=(real.frames[0], dark, *real.frames[2:]))
    result = compare_frames(good.a, spoilt, calibration, calibration)
    assert result.surfaces(1) is None and result.surfaces(0) is not None
    assert math.isnan(result.pairs[1].numbers.get("gradient_angle", math.nan))
    assert result.overall["gradient_angle"].mean < 4
    assert any("press_1.png" in note and "lamp out" in note for note in result.notes)
