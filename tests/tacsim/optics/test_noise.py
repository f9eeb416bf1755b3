import numpy as np
import pytest

from tacsim.models.sensor import CameraNoise, SensorModel
from tacsim.optics.noise import NoiseSource, noise_source
from tacsim.optics.render import Renderer
from tests.tacsim.optics.surfaces import flat

SHAPE = (120, 160)
NOISE = CameraNoise(deviation=(1.8, 1.5, 0.6), colours=(0.4, 0.4, 0.3), neighbours=(0.7, 0.4))
GREY = np.full((*SHAPE, 3), 100, np.uint8)


def correlation(a: np.ndarray, b: np.ndarray) -> float:
    return float((a * b).mean() / np.sqrt((a * a).mean() * (b * b).mean()))


def test_noise_has_the_spread_and_the_correlations_of_its_model() -> None:
    draw = NoiseSource(NOISE, SHAPE)
    noise = np.stack([draw(GREY, frame) for frame in range(200)]).astype(float) - 100
    assert noise.std(axis=(0, 1, 2)) == pytest.approx(NOISE.deviation, rel=0.03)
    assert np.abs(noise.mean(axis=(0, 1, 2))).max() < 0.05
    red, green, blue = np.moveaxis(noise, -1, 0)
    assert correlation(red, green) == pytest.approx(0.4, abs=0.04)
    assert correlation(red[:, :, 1:], red[:, :, :-1]) == pytest.approx(0.7, abs=0.04)
    assert correlation(red[:, :, 3:], red[:, :, :-3]) == pytest.approx(0.7**3, abs=0.06)
    assert correlation(red[:, 1:], red[:, :-1]) == pytest.approx(0.4, abs=0.04)
    # rounding takes a part of the correlations of what is less than a grey level
    assert 0.2 < correlation(green, blue) < 0.34


def test_noise_follows_from_seed_sensor_episode_and_frame() -> None:
    draw, twin = NoiseSource(NOISE, SHAPE, "upper"), NoiseSource(NOISE, SHAPE, "upper")
    one = draw(GREY, 7, episode=3)
    draw(GREY, 8)
    np.testing.assert_array_equal(draw(GREY, 7, episode=3), one)
    np.testing.assert_array_equal(twin(GREY, 7, episode=3), one)
    others = [
        draw(GREY, 8, episode=3),
        draw(GREY, 7, episode=4),
        NoiseSource(NOISE, SHAPE, "lower")(GREY, 7, episode=3),
        NoiseSource(NOISE.model_copy(update={"seed": 1}), SHAPE, "upper")(GREY, 7, episode=3),
    ]
    for other in others:
        assert abs(correlation(one[..., 0] - 100.0, other[..., 0] - 100.0)) < 0.1
    np.testing.assert_array_equal(GREY, 100)  # the picture itself is left as it was


def test_black_and_white_are_limits_and_no_deviation_is_no_noise() -> None:
    loud = CameraNoise(deviation=(30, 30, 0))
    draw = NoiseSource(loud, SHAPE)
    black, white = draw(np.zeros_like(GREY), 0), draw(np.full_like(GREY, 255), 0)
    assert (black[..., 0] == 0).mean() == pytest.approx(0.5, abs=0.05)
    assert (white[..., 0] == 255).mean() == pytest.approx(0.5, abs=0.05)
    assert (black[..., 2] == 0).all() and (white[..., 2] == 255).all()
    with pytest.raises(ValueError, match="the noise is for"):
        draw(GREY[1:], 0)


def test_colours_that_cannot_be_correlated_so_are_refused() -> None:
    with pytest.raises(ValueError, match="no three colours"):
        CameraNoise(deviation=(1, 1, 1), colours=(0.9, 0.9, -0.9))


def test_the_ideal_sensor_has_none_and_a_renderer_never_draws_it() -> None:
    assert noise_source(SensorModel(), "upper") is None
    noisy = SensorModel(noise=NOISE)
    plain, drawn = (Renderer(model, (20e-3, 15e-3))(flat()) for model in (SensorModel(), noisy))
    np.testing.assert_array_equal(drawn, plain)
    source = noise_source(noisy, "upper")
    assert source is not None and source(np.zeros((240, 320, 3), np.uint8), 0).any()
