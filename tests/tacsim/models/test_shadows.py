import numpy as np
import pytest

from tacsim.models.photometric import (
    SHADOW_PLACES,
    SHADOW_SLOPES,
    SHADOW_STEPS,
    SHADOW_WIDTH,
    CastShadows,
    horizon_slope,
    shadow_terms,
)

CREST, FLANK = 0.01, 0.5  # of a ridge along y: its height [widths of the picture], its slope


def ridge(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.maximum(CREST - FLANK * np.abs(x), 0.0)


@pytest.mark.parametrize("step", SHADOW_STEPS[3:8])
def test_beside_a_ridge_the_horizon_is_its_crest(step: float) -> None:
    place = np.array([-step]), np.array([0.1])
    towards = horizon_slope(ridge, *place, (1e4, 0.1))
    assert towards == pytest.approx(CREST / step, rel=1e-4)
    assert horizon_slope(ridge, *place, (-1e4, 0.1)) == 0.0


def test_along_a_ridge_nothing_is_hidden() -> None:
    along = horizon_slope(ridge, np.array([-0.05]), np.array([0.0]), (-0.05, 1e4))
    assert along == pytest.approx(0.0, abs=1e-12)


def test_a_lamp_in_the_picture_is_seen_from_all_sides() -> None:
    x, y = np.array([-0.06, 0.06, 0.0]), np.array([0.0, 0.0, 0.06])
    hill = horizon_slope(lambda x, y: 0.01 * np.exp(-(x * x + y * y) / 2e-4), x, y, (0.0, 0.0))
    assert hill == pytest.approx(hill[0], rel=1e-6) and hill[0] > 0.1


def test_terms_grow_from_each_slope_on_and_stand_by_lamp_slope_and_place() -> None:
    u, v = np.array([0.2]), np.array([-0.3])
    first, second = np.array([SHADOW_SLOPES[0] * (1 + SHADOW_WIDTH) / 2]), np.array([9.0])
    terms = shadow_terms([first, second], u, v).reshape(2, len(SHADOW_SLOPES), SHADOW_PLACES)
    ramps = [[0.5, 0.0, 0.0], [1.0, 1.0, 1.0]]
    np.testing.assert_allclose(terms, np.array(ramps)[..., None] * [1.0, 0.2, -0.3])


def test_other_numbers_of_weights_are_refused() -> None:
    with pytest.raises(ValueError, match="shadows of 1 lamps have 9"):
        CastShadows(lamps=((0.0, 1.0),), weights=((0.0, 0.0, 0.0),))
