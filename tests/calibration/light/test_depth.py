"""What depth changes of a colour, on made-up sensors whose pressed gel is darker where it is flat, too."""

from dataclasses import replace

import numpy as np
import pytest

from calibration.light.calibrator import calibrate_light
from calibration.light.fit import LightFit
from calibration.light.press import smooth
from tacsim.models.photometric import PhotometricLight, places_in_image
from tests.calibration.presses import BALL_PX, COLUMNS, PITCH, ROWS, HiddenSensor, Made

DEEP = np.array([-25.0, 18.0, 10.0]) / 0.5e-3  # grey levels a metre of depth


def deeper(made: Made) -> Made:
    image = made.image + DEEP * made.height[..., None]
    return replace(made, image=np.clip(np.rint(image), 0, 255).astype(np.uint8))


def fitted(sensor: HiddenSensor, presses: list[Made]) -> LightFit:
    return calibrate_light(sensor.empty(), [(f"press {i}", press.image) for i, press in enumerate(presses)], BALL_PX)


def drawn(fit: LightFit, slopes: np.ndarray, height: np.ndarray) -> np.ndarray:
    """(H, W, 3) grey levels of a surface of this height [m]."""
    assert fit.forward is not None
    light = PhotometricLight(fit.forward, tuple(fit.reference.mean(axis=(0, 1)).tolist()))
    places = places_in_image(COLUMNS, ROWS)
    change = light.change(slopes.astype(np.float32), *places)[0]
    if fit.forward.depth is not None:
        change = change + light.depth((height / (PITCH * COLUMNS)).astype(np.float32), *places)
    return fit.reference + smooth(change.astype(float), fit.forward.blur)


def test_the_colour_of_depth_is_found_and_holds_for_what_is_no_ball() -> None:
    """Truth: a bar with a flat bottom, 0.35 mm deep; its picture by the slopes alone is 17 grey levels off there."""
    sensor = HiddenSensor(3, noise=0.5)
    fit = fitted(sensor, [deeper(made) for made in sensor.presses(7)])
    y, x = np.mgrid[:ROWS, :COLUMNS].astype(np.float64)
    bar = 0.35e-3 / (1 + np.exp((np.abs(x - 130) - 30) / 3)) / (1 + np.exp((np.abs(y - 100) - 40) / 3))
    slopes = np.stack(np.gradient(bar, PITCH)[::-1], axis=-1)
    bottom = bar > 0.34e-3
    image = deeper(Made(sensor.photograph(slopes), slopes, bar, (0, 0, 0))).image
    off = drawn(fit, slopes, bar) - image
    assert np.abs(image.astype(float) - fit.reference)[bottom].mean() > 10.0
    assert np.abs(off[bottom].mean(axis=0)).max() < 2.5


@pytest.mark.parametrize("seed", [3, 11])
def test_no_depth_is_found_where_it_changes_nothing(seed: int) -> None:
    sensor = HiddenSensor(seed)
    forward = fitted(sensor, sensor.presses(6)).forward
    assert forward is not None and forward.depth is None
