"""Presses that do not belong together, pixels that are not square, a contact in the picture that should show none."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from calibration.light.calibrator import calibrate_light
from calibration.light.fit import LightFit
from calibration.light.verdict import KnownScale, judge
from tests.calibration.presses import BALL, BALL_PX, COLUMNS, PITCH, ROWS, HiddenSensor

Named = list[tuple[str, np.ndarray]]
SCALE = KnownScale(PITCH, BALL, (COLUMNS * PITCH, ROWS * PITCH))


@pytest.fixture(scope="module")
def good() -> tuple[np.ndarray, Named]:
    sensor = HiddenSensor(3)
    return sensor.empty(), [(f"press {i}", press.image) for i, press in enumerate(sensor.presses(8))]


def fitted(reference: np.ndarray, frames: Named, untouched: tuple[np.ndarray, ...] = ()) -> LightFit:
    return calibrate_light(reference, frames, BALL_PX, None, untouched)


def word(fit: LightFit) -> str:
    return judge(fit, SCALE).word


def test_square_pixels_are_told_from_wide_ones(good: tuple[np.ndarray, Named]) -> None:
    reference, frames = good
    plain = fitted(reference, frames)
    assert plain.left_out == () and plain.doubts == () and word(plain) == "usable"
    assert plain.stretch is not None and plain.stretch.ratio < 1.01
    for wide, high, angle in ((1.08, 1.0, 0.0), (1.0, 1.33, 90.0)):
        size = (round(COLUMNS * wide), round(ROWS * high))
        fit = fitted(cv2.resize(reference, size), [(name, cv2.resize(image, size)) for name, image in frames])
        assert fit.stretch is not None and fit.stretch.ratio == pytest.approx(max(wide, high), abs=0.01)
        assert abs(fit.stretch.angle) == pytest.approx(angle, abs=3.0)
        assert word(fit) == "do not trust" and "no circles" in str(judge(fit, SCALE))


@pytest.mark.parametrize("ratio", [0.75, 1.3])
def test_two_balls_are_told(good: tuple[np.ndarray, Named], ratio: float) -> None:
    reference, frames = good
    sensor = HiddenSensor(3)
    other = [
        (name, sensor.press(0.45e-3, x, y, ball=ratio * BALL_PX).image)
        for (name, _), (x, y) in zip(frames[:4], [(70, 60), (190, 140), (130, 100), (60, 150)], strict=True)
    ]
    one = fitted(reference, [*frames[:7], other[0]])
    assert [name for name, _ in one.left_out] == ["press 0"] and "ball" in one.left_out[0][1]
    half = fitted(reference, [*other, *frames[4:]])
    assert len(half.left_out) == 4 and word(half) == "do not trust"


@pytest.mark.parametrize("turned", [np.flipud, np.fliplr, lambda image: image[::-1, ::-1]])
def test_turned_pictures_are_left_out(good: tuple[np.ndarray, Named], turned: object) -> None:
    assert callable(turned)
    reference, frames = good
    mixed = [(name, np.ascontiguousarray(turned(image)) if k in (1, 4) else image) for k, (name, image) in enumerate(frames)]
    assert {name for name, _ in fitted(reference, mixed).left_out} == {"press 1", "press 4"}


@pytest.mark.parametrize("which", [(1, 4), (0, 1, 2, 3), range(8)])
def test_blurred_presses_are_left_out(good: tuple[np.ndarray, Named], which: tuple[int, ...]) -> None:
    reference, frames = good
    blurred = [(name, cv2.GaussianBlur(image, (0, 0), 2.0) if k in which else image) for k, (name, image) in enumerate(frames)]
    if len(which) == 8:
        with pytest.raises(Exception, match="blurred"):
            fitted(reference, blurred)
        return
    fit = fitted(reference, blurred)
    assert {name for name, why in fit.left_out if "blurred" in why} == {f"press {k}" for k in which}
    assert (word(fit) == "do not trust") == (len(which) > 8 / 3)


def test_a_contact_in_pictures_without_contact_is_told(good: tuple[np.ndarray, Named]) -> None:
    reference, frames = good
    touched = HiddenSensor(3).press(0.12e-3, 230, 165).image
    fit = fitted(touched, frames)
    assert word(fit) == "do not trust" and "which no press shows" in fit.doubts[0]
    fit = fitted(reference, frames, (reference, touched))
    assert word(fit) == "do not trust" and "pictures 1 and 3 without contact differ" in fit.doubts[0]
