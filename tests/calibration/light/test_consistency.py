"""Presses that do not belong together, pixels that are not square, a contact in the picture that should show none."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from calibration.errors import BadFrames
from calibration.light.calibrator import calibrate_light
from calibration.light.consistency import find_blurred_presses, find_inconsistent_presses, find_reference_contact
from calibration.light.press import BallPress, Window, find_press, gaussian_blur, mean_reference_colour
from calibration.light.press_shapes import find_other_balls, fit_stretch
from calibration.light.verdict import KnownScale, evaluate_calibration
from tests.calibration.presses import BALL, BALL_PX, COLUMNS, PITCH, ROWS, HiddenSensor

SCALE = KnownScale(PITCH, BALL, (COLUMNS * PITCH, ROWS * PITCH))
PLACES = [(70, 60), (190, 140), (130, 100), (60, 150), (200, 60), (100, 50), (160, 60), (90, 120)]
DEPTHS = [0.5e-3, 0.35e-3, 0.65e-3, 0.45e-3, 0.55e-3, 0.3e-3, 0.6e-3, 0.4e-3]


def images(balls: list[float] | None = None) -> list[np.ndarray]:
    """The same presses by the same sensor, of balls of these radii."""
    sensor = HiddenSensor(3)
    radii = [1.0] * 8 if balls is None else balls
    shots = zip(DEPTHS, PLACES, radii, strict=True)
    return [sensor.press(depth, x, y, ball=ratio * BALL_PX).image for depth, (x, y), ratio in shots]


def found(shown: list[np.ndarray], empty: np.ndarray, ball: float = BALL_PX) -> list[BallPress]:
    mean = mean_reference_colour(empty)
    return [find_press(f"press {k}", image, empty, mean, ball) for k, image in enumerate(shown)]


def windows(presses: list[BallPress]) -> list[Window]:
    """Every third pixel of contact and skirt."""
    cut = []
    for press in presses:
        v, u = np.nonzero(press.distance() < 2.3 * press.circle.radius)
        keep = (u % 3 == 0) & (v % 3 == 0)
        change = gaussian_blur(press.change, 0.8)[v[keep], u[keep]]
        cut.append(Window(u[keep].astype(float), v[keep].astype(float), change))
    return cut


@pytest.fixture(scope="module")
def empty() -> np.ndarray:
    return HiddenSensor(3).empty()


@pytest.mark.parametrize(("wide", "high", "angle"), [(1, 1, None), (1.08, 1, 0), (1, 1.33, 90), (0.93, 1, 90)])
def test_pixels_that_are_not_square_are_measured(
    empty: np.ndarray, wide: float, high: float, angle: float | None
) -> None:
    size = (round(COLUMNS * wide), round(ROWS * high))
    presses = found([cv2.resize(image, size) for image in images()], cv2.resize(empty, size))
    fit = fit_stretch(windows(presses), [press.circle for press in presses], 3 * BALL_PX, BALL_PX, presses[0].shape)
    assert fit.ratio == pytest.approx(max(wide / high, high / wide), abs=0.015) and fit.uncertainty < 0.015
    if angle is not None:
        assert abs(fit.angle) == pytest.approx(angle, abs=4.0)


@pytest.mark.parametrize(
    ("ratio", "other"), [(1.0, ()), (0.75, (7,)), (1.3, (2, 5)), (0.8, (0, 2, 4, 6)), (1.3, (0, 1, 3))]
)
def test_presses_of_another_ball_are_told(empty: np.ndarray, ratio: float, other: tuple[int, ...]) -> None:
    presses = found(images([ratio if k in other else 1.0 for k in range(8)]), empty)
    circles = [press.circle for press in presses]
    told, size = find_other_balls(windows(presses), circles, 3 * BALL_PX, BALL_PX, presses[0].shape)
    if len(other) == 4:  # then nobody knows which is the other one
        assert set(told) in (set(other), set(range(8)) - set(other))
        return
    assert set(told) == set(other)
    assert size == pytest.approx(ratio, rel=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("turned", [np.flipud, np.fliplr, lambda image: image[::-1, ::-1]])
def test_presses_of_a_turned_sensor_are_told(turned: object) -> None:
    """Under even light without a pattern of its own, so that the picture without contact gives nothing away."""
    assert callable(turned)
    even = HiddenSensor(3)
    even._base = np.full_like(even._base, 110.0)
    flat = even.empty()
    shown = [press.image for press in even.presses(8)]
    mixed = [np.ascontiguousarray(turned(image)) if k in (1, 4) else image for k, image in enumerate(shown)]
    assert find_inconsistent_presses(found(shown, flat), windows(found(shown, flat)), BALL_PX) == []
    presses = found(mixed, flat)
    assert find_inconsistent_presses(presses, windows(presses), BALL_PX) == [1, 4]


@pytest.mark.parametrize("which", [(), (1, 4), (0, 1, 2, 3), tuple(range(8))])
def test_blurred_presses_are_told(empty: np.ndarray, which: tuple[int, ...]) -> None:
    shown = [cv2.GaussianBlur(image, (0, 0), 1.5) if k in which else image for k, image in enumerate(images())]
    told = find_blurred_presses(found(shown, empty), empty, mean_reference_colour(empty))
    assert tuple(k for k, _ in told) == which


def test_a_contact_in_pictures_without_contact_is_told(empty: np.ndarray) -> None:
    mean, again = mean_reference_colour(empty), HiddenSensor(3).empty()
    touched = HiddenSensor(3).press(0.1e-3, 230, 165).image
    presses = found(images(), empty)
    assert find_reference_contact(presses, empty, mean, [again], BALL_PX) is None
    told = find_reference_contact(presses, empty, mean, [again, touched], BALL_PX)
    assert told is not None and "pictures 1 and 3 without contact differ" in told
    touched = HiddenSensor(3).press(0.14e-3, 230, 165).image
    told = find_reference_contact(found(images(), touched), touched, mean, [], BALL_PX)
    assert told is not None and "(230, 165) px, which no press shows" in told


@pytest.mark.slow
def test_a_set_of_two_balls_and_wide_pixels_is_not_trusted(empty: np.ndarray) -> None:
    size = (round(1.08 * COLUMNS), ROWS)
    frames = [(f"press {k}", cv2.resize(image, size)) for k, image in enumerate(images([0.75] * 4 + [1.0] * 4))]
    fit = calibrate_light(cv2.resize(empty, size), frames, BALL_PX)
    verdict = evaluate_calibration(fit, SCALE)
    assert len(fit.left_out) == 4 and all("ball" in why for _, why in fit.left_out)
    assert verdict.word == "do not trust"
    assert "4 of 8 presses were left out" in str(verdict) and "contacts of the ball are no circles" in str(verdict)
    blurred = [(name, cv2.GaussianBlur(image, (0, 0), 2.0)) for name, image in frames]
    with pytest.raises(BadFrames, match="blurred: "):
        calibrate_light(cv2.resize(empty, size), blurred, BALL_PX)
