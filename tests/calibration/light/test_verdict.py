"""Absolute limits: what is wrong is told, whatever the other presses are like."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calibration.light.calibrator import calibrate_light
from calibration.light.dent import contact_depth
from calibration.light.fit import LightFit
from calibration.light.press_shapes import Stretch
from calibration.light.verdict import KnownScale, evaluate_calibration, write_page
from tests.calibration.presses import BALL, BALL_PX, COLUMNS, PITCH, ROWS, HiddenSensor

SIZE = (COLUMNS * PITCH, ROWS * PITCH)  # of the gel that the pictures show
DEPTH = (("press 2", 0.65e-3),)  # of a half-space, of which the presses are made
SCALE = KnownScale(PITCH, BALL, SIZE, depths=DEPTH)


def calibrated(count: int, ball: float = BALL_PX) -> LightFit:
    sensor = HiddenSensor(3)
    frames = [(f"press {i}", press.image) for i, press in enumerate(sensor.presses(count))]
    return calibrate_light(sensor.empty(), frames, ball)


@pytest.fixture(scope="module")
def fit() -> LightFit:
    return calibrated(5)


def said(fit: LightFit, scale: KnownScale, word: str) -> str:
    """What is found, of a verdict that must be `word`."""
    verdict = evaluate_calibration(fit, scale)
    assert verdict.word == word, verdict
    return str(verdict)


@pytest.mark.slow
def test_good_presses_are_good(fit: LightFit) -> None:
    told = KnownScale(PITCH, BALL, SIZE, 8e-3)
    assert "the ball's radius is not" in said(fit, told, "usable")  # half of it doubles each depth
    assert said(fit, SCALE, "good") == "good"


@pytest.mark.slow
def test_lengths_that_nothing_checks_are_not_called_good(fit: LightFit) -> None:
    """Truth: 0.08 mm a pixel; with 0.128 mm said for it the presses are explained as well, and all slopes are wrong."""
    wrong = calibrated(5, BALL_PX / 1.6)
    for found, pitch in ((fit, PITCH), (wrong, 1.6 * PITCH)):
        assert "nothing checks the lengths" in said(found, KnownScale(pitch, BALL), "unverified scale")
    assert "of the gel are to be seen" in said(wrong, KnownScale(1.6 * PITCH, BALL, SIZE), "do not trust")
    shown = (1.6 * SIZE[0], 1.6 * SIZE[1])  # by a profile that is another sensor's, whose pitch was taken with it
    assert "published" in said(wrong, KnownScale(1.6 * PITCH, BALL, shown, pitch_from_size=True), "unverified scale")


def test_too_many_left_out_are_no_calibration(fit: LightFit) -> None:
    some = tuple((f"bad {k}", "no contact") for k in range(3))
    assert "3 of 8 presses were left out" in said(replace(fit, left_out=some), SCALE, "do not trust")
    assert evaluate_calibration(replace(fit, left_out=some[:2]), SCALE).word == "good"


def test_marker_pitch_checks_the_pixel_pitch(fit: LightFit) -> None:
    assert "nothing" not in said(fit, KnownScale(PITCH, BALL, marker_pitches=(1.5e-3, 1.51e-3)), "usable")
    assert "dots are" in said(fit, KnownScale(PITCH, BALL, marker_pitches=(1.5e-3, 1.1e-3)), "do not trust")


@pytest.mark.parametrize(("count", "word"), [(1, "do not trust"), (2, "do not trust"), (4, "usable")])
def test_few_presses(fit: LightFit, count: int, word: str) -> None:
    few = replace(fit, presses=fit.presses[:count], predictions=fit.predictions[:count] if count > 1 else ())
    assert "press five at least" in said(few, SCALE, word)


@pytest.mark.parametrize(
    ("wrong", "words", "word"),
    [
        ({"angle": 6.0}, "off by 6.0 degrees", "usable"),
        ({"angle": 9.0}, "off by 9.0 degrees", "do not trust"),
        ({"correlation": 0.93}, "correlation of 0.930", "do not trust"),
        ({"error": 50.0, "null_error": 60.0}, "does not fit", "usable"),
    ],
)
def test_all_presses_alike_are_no_excuse(fit: LightFit, wrong: dict[str, float], words: str, word: str) -> None:
    bad = replace(fit, predictions=tuple(replace(press, **wrong) for press in fit.predictions))
    assert words in said(bad, SCALE, word)


def test_two_solutions_for_the_radii_are_told(fit: LightFit) -> None:
    assert "uncertain by 15%" in said(replace(fit, radius_uncertainty=0.15), SCALE, "do not trust")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("ball", "pitch", "words", "word"),
    [
        (0.4, 1.0, "pitch or radius is wrong: contact radius over ball radius a/R = 0.9", "do not trust"),
        (2.0, 1.0, "a diameter given for the radius, or too small a pixel pitch", "usable"),
        (1.0, 1.6, "of the gel are to be seen", "do not trust"),
        (1.0, 1 / 1.6, "of the gel are to be seen", "do not trust"),
    ],
    ids=["ball too small", "diameter for radius", "pitch too large", "pitch too small"],
)
def test_wrong_lengths_are_told(ball: float, pitch: float, words: str, word: str) -> None:
    told = KnownScale(PITCH * pitch, BALL * ball, SIZE)
    assert words in said(calibrated(5, BALL_PX * ball / pitch), told, word)


def test_contacts_that_are_all_as_wide_as_the_ball_tell_a_wrong_length(fit: LightFit) -> None:
    """A pitch wrong by 1.6 makes contacts of 0.58 of the ball 0.93: nobody has told the gel's size, and none is beyond
    what a ball can do. One press that deep may be, all of them are not."""
    wide = tuple(replace(press, circle=replace(press.circle, radius=0.93 * BALL_PX)) for press in fit.presses)
    assert "a/R = 0.93" in said(replace(fit, presses=wide), SCALE, "do not trust")
    assert evaluate_calibration(replace(fit, presses=(*fit.presses[:4], wide[4])), SCALE).word == "good"
    widest = replace(wide[4], circle=replace(wide[4].circle, radius=0.97 * BALL_PX))
    told = said(replace(fit, presses=(*fit.presses[:4], widest)), SCALE, "usable")
    assert "press 4 is as wide as the ball" in told and "is it the radius that was given?" in told


@pytest.mark.slow
def test_a_press_of_known_depth_tells_a_wrong_pitch(fit: LightFit) -> None:
    """Hertz's depth of a half-space, of which the presses are made, is 0.65 mm for the third."""
    depth = (("press 2", 0.65e-3),)
    assert evaluate_calibration(fit, KnownScale(PITCH, BALL, depths=depth)).word == "good"
    wrong = calibrated(5, BALL_PX / 1.6)
    told = said(wrong, KnownScale(1.6 * PITCH, BALL, depths=depth), "do not trust")
    assert "by the depth that is known" in told


def test_depth_of_a_layer() -> None:
    """A half-space gives Hertz's a^2 / R. On a layer four contact radii thick it is 0.8305 of that: pressures
    (1 - r^2)^(m + 1/2), m = 0 to 4, by Hankel transforms, whose surface has the ball's slope to 1e-4 (Poisson's ratio
    0.48)."""
    assert contact_depth(1.0, 3.0, 1e4) == pytest.approx(1 / 3, rel=1e-3)
    assert contact_depth(1.0, 3.0, 4.0) * 3 == pytest.approx(0.8305, rel=0.01)


def test_a_light_without_direction_is_told(fit: LightFit) -> None:
    dark = tuple((0.0, 0.0, 0.0) if i != 2 else (-1.0, -1.0, -1.0) for i in range(len(fit.forward.weights)))
    blind = replace(fit, forward=fit.forward.model_copy(update={"weights": dark}))
    assert "tells no direction" in said(blind, SCALE, "do not trust")


def test_the_page_says_it_first_and_harms_nobody(fit: LightFit, tmp_path: Path) -> None:
    bad = replace(fit, left_out=(("<script>.png", "no contact"),), radius_uncertainty=float("nan"))
    verdict = evaluate_calibration(replace(fit, radius_uncertainty=0.15), SCALE)
    write_page(tmp_path / "page.html", "finger", bad, SCALE, verdict, None, ["a fact"])
    page = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert "<title>finger: do not trust</title>" in page and "Next:" in page and "a fact" in page
    assert "<script>" not in page and "http://" not in page
    assert np.all([press.name in page for press in fit.predictions])


@pytest.mark.parametrize(
    ("ratio", "uncertainty", "word"),
    [(1.025, 0.0, "good"), (1.04, 0.001, "usable"), (1.08, 0.003, "do not trust"), (1.06, 0.02, "good")],
)
def test_contacts_are_no_ellipses(fit: LightFit, ratio: float, uncertainty: float, word: str) -> None:
    assert evaluate_calibration(replace(fit, stretch=Stretch(ratio, 20.0, uncertainty)), SCALE).word == word
