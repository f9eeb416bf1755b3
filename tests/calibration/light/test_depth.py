"""What depth changes of a colour, on made-up sensors whose pressed gel is darker where it is flat, too."""

from dataclasses import replace

import numpy as np
import pytest

from calibration.light.calibrator import calibrate_light
from calibration.light.dent import ContactCircle
from calibration.light.fit import LightFit, counted_pixels
from calibration.light.photometry import SLOPE_TERMS, ModelSize
from calibration.light.press import BallPress, gaussian_blur
from tacsim.models.photometric import DEPTH_TERMS, PhotometricLight, image_grid_places
from tacsim.optics.render import phong_shading
from tests.calibration.presses import BALL_PX, COLUMNS, PITCH, ROWS, HiddenSensor, Made

DEEP = np.array([-25.0, 18.0, 10.0]) / 0.5e-3  # grey levels a metre of depth
FADE = 0.6 / 0.65e-3  # share of the lamps' light that is lost with a metre of depth


def deeper(made: Made) -> Made:
    image = made.image + DEEP * made.height[..., None]
    return replace(made, image=np.clip(np.rint(image), 0, 255).astype(np.uint8))


def faded(sensor: HiddenSensor, made: Made) -> Made:
    """The deeper a slope lies, the less the lamps tell of it."""
    flat = phong_shading(np.zeros((1, 1, 2), dtype=np.float32), sensor.lighting)
    lit = 255 * (phong_shading(made.gradient.astype(np.float32), sensor.lighting) - flat)
    image = made.image - FADE * np.maximum(made.height, 0.0)[..., None] * lit
    return replace(deeper(made), image=np.clip(np.rint(image), 0, 255).astype(np.uint8))


def fitted(sensor: HiddenSensor, presses: list[Made]) -> LightFit:
    return calibrate_light(sensor.empty(), [(f"press {i}", press.image) for i, press in enumerate(presses)], BALL_PX)


def drawn(fit: LightFit, slopes: np.ndarray, height: np.ndarray) -> np.ndarray:
    """(H, W, 3) grey levels of a surface of this height [m]."""
    assert fit.forward is not None
    light = PhotometricLight(fit.forward, tuple(fit.reference.mean(axis=(0, 1)).tolist()))
    places = image_grid_places(COLUMNS, ROWS)
    change = light.change(slopes.astype(np.float32), *places, (height / (PITCH * COLUMNS)).astype(np.float32))[0]
    return fit.reference + gaussian_blur(change.astype(float), fit.forward.blur)


@pytest.mark.slow
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


@pytest.mark.slow
@pytest.mark.parametrize("seed", [3, 11])
def test_slopes_at_depth_are_found_and_hold_for_what_is_no_ball(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Truth: lamps that fade with depth; a bar with steep edges and a wedge, that no ball presses."""
    sensor = HiddenSensor(seed, noise=0.5)
    presses = [faded(sensor, made) for made in sensor.presses(8)]
    fit = fitted(sensor, presses)
    monkeypatch.setattr("calibration.light.tuning.MIN_SLOPES_IMPROVEMENT", 0.0)
    without = fitted(sensor, presses)
    assert fit.forward is not None and fit.forward.depth is not None and fit.forward.depth.slopes
    assert without.forward is not None and (without.forward.depth is None or not without.forward.depth.slopes)
    errors = [np.mean([press.error for press in each.predictions]) for each in (fit, without)]
    assert errors[0] < errors[1]
    y, x = np.mgrid[:ROWS, :COLUMNS].astype(np.float64)
    ends = 1 / (1 + np.exp((np.abs(y - 100) - 40) / 3))
    bar = 0.4e-3 / (1 + np.exp((np.abs(x - 130) - 24) / 3)) * ends
    wedge = 0.5e-3 * np.exp(-np.hypot(x - 130, 6) / 12) * ends
    for shape in (bar, wedge):
        slopes = np.stack(np.gradient(shape, PITCH)[::-1], axis=-1)
        image = faded(sensor, Made(sensor.photograph(slopes), slopes, shape, (0, 0, 0))).image
        touched = shape > 0.02e-3
        off = [np.abs(drawn(each, slopes, shape) - image)[touched].mean() for each in (fit, without)]
        assert off[0] < 0.9 * off[1]  # the bar 1.2 and 1.8 grey levels, the wedge 1.0 and 1.1


@pytest.mark.slow
def test_a_saturated_pixel_says_at_least(monkeypatch: pytest.MonkeyPatch) -> None:
    """Truth: lamps so bright that flanks are white. What nobody counts may be predicted dark."""
    sensor = HiddenSensor(3, noise=0.5, gain=2.5)
    presses = sensor.presses(8)

    def short() -> float:
        """Grey levels that white pixels of left-out presses are predicted too dark by."""
        found = []
        for prediction, made in zip(fitted(sensor, presses).predictions, presses, strict=True):
            white = made.image == 255
            found.append(prediction.real[white] - prediction.predicted[white])
        return float(np.concatenate(found).mean())

    counted = short()
    monkeypatch.setattr("calibration.light.calibrator.SATURATED_ROUNDS", 0)
    assert counted < 0.97 * short()  # 1.06 and 1.12; where light bends at its brightest, far more


def test_which_saturated_pixels_are_predicted_too_dark() -> None:
    """Truth: by weights of 0 nothing changes, which is too dark for what has become brighter and not for the rest."""
    made = HiddenSensor(3).press(0.5e-3, 130, 100)
    change = np.full((ROWS, COLUMNS, 3), 0.3)
    change[:, 130:] = -0.3
    lit = np.ones((ROWS, COLUMNS, 3), dtype=np.bool_)
    lit[90:110, 110:150, 0] = False
    press = BallPress("white", ContactCircle(*made.circle), change, 0 * change, lit)
    size, beside = ModelSize(3, 0, 1e-6), np.zeros((ROWS, COLUMNS, DEPTH_TERMS + SLOPE_TERMS))
    counted = counted_pixels(press, made.gradient, beside, np.zeros((size.terms, 3)), size)
    wanted = lit.copy()
    wanted[90:110, 110:130, 0] = True
    near = np.abs(np.arange(COLUMNS) - 130) > 4  # the change is smoothed first
    np.testing.assert_array_equal(counted[:, near], wanted[:, near])


@pytest.mark.slow
@pytest.mark.parametrize("seed", [3, 11])
def test_no_depth_is_found_where_it_changes_nothing(seed: int) -> None:
    sensor = HiddenSensor(seed)
    forward = fitted(sensor, sensor.presses(6)).forward
    assert forward is not None and forward.depth is None
