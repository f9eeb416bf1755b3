import numpy as np
import pytest

from calibration.height.integration import Integrator

PITCH = 0.1e-3


def _bump(shape: tuple[int, int], centre: tuple[float, float], width: float) -> tuple[np.ndarray, np.ndarray]:
    """Height (rows, columns) [m] of a Gaussian 1 mm high, and its slopes; centre and width [px]."""
    y, x = np.mgrid[: shape[0], : shape[1]].astype(float)
    dx, dy = x - centre[0], y - centre[1]
    height = 1e-3 * np.exp(-(dx**2 + dy**2) / (2 * width**2))
    gradient = -np.stack([dx, dy], axis=-1) * (height / (width**2 * PITCH))[..., None]
    return height, gradient.astype(np.float32)


@pytest.mark.parametrize("shape", [(120, 160), (97, 64)])
def test_a_bump_comes_back_from_its_slopes_in_metres(shape: tuple[int, int]) -> None:
    height, gradient = _bump(shape, (shape[1] / 2 + 3, shape[0] / 2 - 2), 10.0)
    found = Integrator(shape, PITCH)(gradient)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, height, atol=3e-6)


def test_zero_is_the_untouched_border_even_where_a_contact_crosses_it() -> None:
    """A bump at the border of the view: its own height there must not become zero, nor sink the rest."""
    height, gradient = _bump((120, 160), (0.0, 60.0), 10.0)
    found = Integrator((120, 160), PITCH)(gradient)
    assert found[60, 0] == pytest.approx(1e-3, rel=0.02)
    np.testing.assert_allclose(found, height, atol=10e-6)


def test_a_bulge_is_no_zero() -> None:
    """Beside a dent the gel bulges out, below zero: the least height is no reference."""
    dent, slopes = _bump((120, 160), (60.0, 60.0), 10.0)
    bulge, bulge_slopes = _bump((120, 160), (110.0, 60.0), 8.0)
    found = Integrator((120, 160), PITCH)(slopes - 0.2 * bulge_slopes)
    np.testing.assert_allclose(found, dent - 0.2 * bulge, atol=3e-6)


def test_noise_of_slopes_hardly_moves_the_height() -> None:
    noise = np.random.default_rng(0).normal(0.0, 0.02, size=(120, 160, 2)).astype(np.float32)
    assert np.abs(Integrator((120, 160), PITCH)(noise)).max() < 15e-6


def test_no_rectangle_is_refused() -> None:
    with pytest.raises(ValueError, match="at least 2 x 2"):
        Integrator((1, 50), PITCH)
