"""A reference that shows a contact, and frames with red and blue swapped: told, and in which words."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

from calibration.frame_normaliser import FrameNormaliser
from calibration.frame_set import Frame, FrameSet, find_touched_references, frame_warnings
from calibration.light.calibrator import calibrate_light
from calibration.normaliser import normaliser_for_calibration
from calibration.reference import StaleReference, is_contact_image_swapped
from tacsim.interface import TactileFrame
from tacsim.models.sensor import CanonicalGrid
from tests.calibration.presses import BALL, BALL_PX, PITCH, HiddenSensor


@pytest.fixture(scope="module")
def sensor() -> HiddenSensor:
    return HiddenSensor(3)


@pytest.fixture(scope="module")
def normalise(sensor: HiddenSensor) -> FrameNormaliser:
    frames = [(f"{i}", press.image) for i, press in enumerate(sensor.presses(5))]
    fit = calibrate_light(sensor.empty(), frames, BALL_PX)
    return normaliser_for_calibration(fit.to_calibration("s", BALL, PITCH), CanonicalGrid(), fit.reference)


def frame(image: np.ndarray) -> TactileFrame:
    return TactileFrame(image=image, time=0.0, index=0)


@pytest.mark.slow
@pytest.mark.parametrize("depth", [0.1e-3, 0.5e-3])
def test_a_reference_that_shows_a_contact_is_told(
    sensor: HiddenSensor, normalise: FrameNormaliser, depth: float
) -> None:
    with pytest.warns(UserWarning, match="the reference shows a contact"):
        normalise.take_reference(frame(sensor.press(depth, 150, 90).image))
    normalise(frame(sensor.empty()), 0.0)
    assert normalise.diagnostics()["touched_reference"] == 1.0


def test_a_lamp_that_has_drifted_is_no_contact(sensor: HiddenSensor, normalise: FrameNormaliser) -> None:
    ramp = np.linspace(-10, 10, 260)[None, :, None] * np.array([1.0, -1.0, 0.5])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for image in (sensor.empty(), sensor.photograph(np.zeros((200, 260, 2)), ramp)):
            normalise.take_reference(frame(image))
            normalise(frame(image), 0.0)
            assert normalise.reference_doubt is None and "touched_reference" not in normalise.diagnostics()


def test_swapped_colours_of_frames_are_called_by_their_name(sensor: HiddenSensor, normalise: FrameNormaliser) -> None:
    reference = sensor.empty()
    normalise.take_reference(frame(reference))
    for image in (sensor.empty(), sensor.press(0.5e-3, 150, 90).image):
        swapped = np.ascontiguousarray(image[..., ::-1])
        with pytest.raises(StaleReference, match="red and blue are swapped"):
            normalise(frame(swapped), 0.0)
        nothing = np.zeros(image.shape[:2], dtype=np.bool_)
        assert any("red and blue are swapped" in word for word in frame_warnings(swapped, reference, nothing))
    dimmer = np.rint(0.8 * sensor.press(0.5e-3, 150, 90).image).astype(np.uint8)
    normalise(frame(dimmer), 0.0)
    assert normalise.stale


@pytest.mark.parametrize("seed", range(4))
def test_a_white_balance_as_strong_as_a_swap_is_no_swap(seed: int) -> None:
    """Red gets the mean level of blue and blue that of red: only where on the gel they are bright tells them apart."""
    sensor = HiddenSensor(seed)
    everywhere = np.ones((200, 260), dtype=np.bool_)
    reference, seen = (image.astype(np.float32) for image in (sensor.empty(), sensor.press(0.5e-3, 150, 90).image))
    red, _, blue = reference.mean(axis=(0, 1))
    balance = np.array([blue / red, 1.0, red / blue], dtype=np.float32)
    assert not is_contact_image_swapped(np.clip(seen * balance, 0, 255), reference, everywhere)
    assert is_contact_image_swapped(seen[..., ::-1], reference, everywhere)


def test_pictures_without_contact_are_compared_with_the_reference(sensor: HiddenSensor) -> None:
    touched, still = sensor.press(0.2e-3, 150, 90).image, Frame("background_2.png", sensor.empty())
    frames = (Frame("press.png", sensor.press(0.5e-3, 90, 90).image),)
    assert find_touched_references(FrameSet("real", sensor.empty(), "background.png", frames, (still,))) == []
    (said,) = find_touched_references(FrameSet("real", touched, "background.png", frames, (still,)))
    assert "background.png and background_2.png differ as by a contact" in said
