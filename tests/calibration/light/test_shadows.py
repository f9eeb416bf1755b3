"""Cast shadows of made-up sensors whose lamps nobody tells the calibrator."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from calibration.light.calibrator import calibrate_light
from tacsim.models.photometric import PhotometricLight, horizon_slope, image_grid_places
from tests.calibration.presses import BALL_PX, COLUMNS, PITCH, ROWS, HiddenSensor

DISTANCE = 1.1  # of the lamps from the middle [widths of the picture]
ELEVATIONS = (0.15, 0.25, 0.35, 0.45)  # that a lamp is seen at: tangents


def cast(height: np.ndarray, lamps: np.ndarray) -> np.ndarray:
    """(H, W, 3) share of each lamp that a surface of this height [px] hides, followed pixel by pixel."""
    y, x = np.mgrid[:ROWS, :COLUMNS].astype(np.float32)
    hidden = np.zeros((ROWS, COLUMNS, 3))
    for channel, lamp in enumerate(lamps * COLUMNS + [(COLUMNS - 1) / 2, (ROWS - 1) / 2]):
        way = np.hypot(lamp[0] - x, lamp[1] - y)
        towards = np.zeros((ROWS, COLUMNS))
        for step in np.arange(2.0, 80.0, 2.0):
            at = [(c + step * (to - c) / way).astype(np.float32) for c, to in ((x, lamp[0]), (y, lamp[1]))]
            there = cv2.remap(height.astype(np.float32), *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            towards = np.maximum(towards, (there - height) / step)
        hidden[..., channel] = np.mean([towards > elevation for elevation in ELEVATIONS], axis=0)
    return cv2.GaussianBlur(hidden, (0, 0), 1.5)


def in_shade(image: np.ndarray, height: np.ndarray, lamps: np.ndarray) -> np.ndarray:
    return np.clip(image - 70.0 * cast(height, lamps), 0, 255).round().astype(np.uint8)


@pytest.mark.deep
def test_shadows_are_found_and_hold_for_what_is_no_ball(monkeypatch: pytest.MonkeyPatch) -> None:
    """Truth: lamps beside the gel, hidden by the dent. Left out, and for a bar, the picture is nearer with shadows."""
    sensor = HiddenSensor(3, noise=0.5)
    lamps = DISTANCE * np.array([light.direction[:2] for light in sensor.lighting.lights])
    presses = [replace(made, image=in_shade(made.image, made.height / PITCH, lamps)) for made in sensor.presses(8)]
    named = [(f"press {i}", press.image) for i, press in enumerate(presses)]
    fit = calibrate_light(sensor.empty(), named, BALL_PX)
    monkeypatch.setattr("calibration.light.tuning.MIN_SHADOW_RESIDUAL", 1.0)
    without = calibrate_light(sensor.empty(), named, BALL_PX)
    assert fit.forward is not None and without.forward is not None
    assert fit.forward.shadows is not None and without.forward.shadows is None
    for found, true in zip(fit.forward.shadows.lamps, lamps, strict=True):
        assert np.dot(found, true) / np.hypot(*found) / np.hypot(*true) > np.cos(np.radians(20))
    errors = [np.mean([press.error for press in each.predictions]) for each in (fit, without)]
    assert errors[0] < 0.75 * errors[1]
    wrong = [
        np.mean([abs(p.circle.radius / made.circle[2] - 1) for p, made in zip(each.presses, presses, strict=True)])
        for each in (fit, without)
    ]
    assert wrong[0] < 0.03 and wrong[0] < wrong[1]

    y, x = np.mgrid[:ROWS, :COLUMNS].astype(np.float32)
    along, across = 0.8 * (x - 130) + 0.6 * (y - 100), 0.8 * (y - 100) - 0.6 * (x - 130)
    bar = 6 / (1 + np.exp((np.abs(across) - 9) / 3)) / (1 + np.exp((np.abs(along) - 30) / 3))
    slopes = np.stack(np.gradient(bar)[::-1], axis=-1)
    change = in_shade(sensor.photograph(slopes), bar, lamps).astype(float) - sensor.empty()
    u, v = image_grid_places(COLUMNS, ROWS)

    def height(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        at = [(each * COLUMNS + (n - 1) / 2).astype(np.float32) for each, n in ((x, COLUMNS), (y, ROWS))]
        seen = cv2.remap(bar.astype(np.float32), *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return seen / np.float32(COLUMNS)

    off = []
    for each in (fit, without):
        light = PhotometricLight(each.forward, tuple(sensor.empty().mean(axis=(0, 1)).tolist()))
        predicted = light.change(slopes.astype(np.float32), u, v)[0]
        if each.forward.shadows is not None:
            towards = [
                horizon_slope(height, u, v * np.float32(ROWS / COLUMNS), lamp) for lamp in each.forward.shadows.lamps
            ]
            predicted = predicted + light.shadow_change(towards, u, v)
        off.append(np.abs(predicted - change)[cast(bar, lamps).max(axis=2) > 0.2].mean())
    assert off[0] < 0.5 * off[1]  # 2.4 and 7.1 grey levels
