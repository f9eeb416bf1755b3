"""Slopes from colours: the table of a light, and the polynomial of labelled presses."""

import itertools

import numpy as np
import pytest

from calibration.height.slopes import COLOUR_SCALE, TERMS, inverse_features, table_of_lighting, table_of_model
from calibration.height.tuning import MAX_TABLE_SLOPE
from tacsim.models.sensor import Light, Lighting, SensorModel
from tacsim.optics.render import phong_shading

RNG = np.random.default_rng(1)


def _change(slopes: np.ndarray, lighting: Lighting, background: tuple[float, float, float]) -> np.ndarray:
    """Relative change of colour by the renderer itself; slopes (n, 2) -> (1, n, 3)."""
    flat = phong_shading(np.zeros((1, 1, 2), dtype=np.float32), lighting)
    base = np.array(background, dtype=np.float32)
    return (np.clip(base + phong_shading(slopes[None].astype(np.float32), lighting) - flat, 0, 1) - base) / base


def _angle(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Between the normals of two sets of slopes (n, 2) [degrees]."""
    normals = [np.concatenate([s, np.ones((len(s), 1))], axis=1) for s in (found, true)]
    normals = [n / np.linalg.norm(n, axis=1, keepdims=True) for n in normals]
    return np.degrees(np.arcsin(np.clip(np.linalg.norm(np.cross(*normals), axis=1), 0, 1)))


def _random_slopes(steepest: float, count: int = 4000) -> np.ndarray:
    direction, size = RNG.uniform(0, 2 * np.pi, count), steepest * np.sqrt(RNG.uniform(0, 1, count))
    return np.stack([np.cos(direction), np.sin(direction)], axis=1) * size[:, None]


def test_slopes_come_back_from_their_colour() -> None:
    model = SensorModel()
    slopes = _random_slopes(0.4)
    found, beyond = table_of_model(model)(_change(slopes, model.lighting, (0.42, 0.44, 0.46)))
    error = _angle(found[0], slopes)
    assert error.mean() < 0.1
    assert error.max() < 1.0
    assert not beyond.any()


def test_lights_that_nobody_has_seen_before() -> None:
    """Hidden lights of any colour from all sides; no number is set for the shipped sensor."""
    for _ in range(3):
        turn = RNG.uniform(0, 2 * np.pi)
        lights = tuple(
            Light(
                direction=(np.cos(turn + a), np.sin(turn + a), -RNG.uniform(0.6, 1.0)),
                colour=tuple(np.clip(np.eye(3)[i] * 0.8 + RNG.uniform(0, 0.3, 3), 0, 1)),
                specular=RNG.uniform(0, 0.3),
            )
            for i, a in enumerate((0.0, 2.1, 4.2))
        )
        lighting = Lighting(lights=lights, background=(0.4, 0.4, 0.4))
        slopes = _random_slopes(0.5)
        found, _ = table_of_lighting(lighting, (0.4, 0.4, 0.4))(_change(slopes, lighting, (0.4, 0.4, 0.4)))
        error = _angle(found[0], slopes)
        assert error.mean() < 0.3
        assert np.quantile(error, 0.99) < 2.0


def test_no_change_is_no_slope() -> None:
    found, beyond = table_of_model(SensorModel())(np.zeros((2, 3, 3), dtype=np.float32))
    assert np.abs(found).max() < 1e-3
    assert not beyond.any()


def test_colours_beyond_the_light_are_clipped_and_flagged() -> None:
    change = np.array([[[2.5, 2.5, 2.5], [-0.9, -0.9, -0.9], [0.0, 0.0, 0.0]]], dtype=np.float32)
    found, beyond = table_of_model(SensorModel())(change)
    assert beyond.tolist() == [[True, True, False]]
    assert np.isfinite(found).all()
    assert np.abs(found).max() <= MAX_TABLE_SLOPE


@pytest.mark.parametrize(
    "lights",
    [
        (Light(direction=(1.0, 0.0, -0.5), colour=(1.0, 0.5, 0.2)),),  # one light tells one slope
        (Light(direction=(0.0, 0.0, -1.0), colour=(1.0, 1.0, 1.0)),),  # from behind: no slope at all
    ],
)
def test_a_light_that_tells_no_slope_is_refused(lights: tuple[Light, ...]) -> None:
    with pytest.raises(ValueError, match="lights from at least two sides"):
        table_of_lighting(Lighting(lights=lights), (0.4, 0.4, 0.4))


def test_a_black_gel_is_refused() -> None:
    with pytest.raises(ValueError, match="black in a channel"):
        table_of_lighting(Lighting(), (0.4, 0.0, 0.4))


def test_the_terms_are_all_products_of_at_most_three() -> None:
    rng = np.random.default_rng(0)
    change, (x, y) = rng.normal(0, 0.3, (40, 3)), rng.uniform(-1, 1, (2, 40))
    inputs = [*(COLOUR_SCALE * change).T, x, y]
    products = [
        np.prod([np.ones(40), *factors], axis=0)
        for order in range(4)
        for factors in itertools.combinations_with_replacement(inputs, order)
    ]
    found = inverse_features(change, x, y)
    assert found.shape == (40, TERMS) == (40, len(products))
    np.testing.assert_allclose(np.array(sorted(found.T.tolist())), np.array(sorted(p.tolist() for p in products)))
