import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from tacsim.models.scene import GelSurface
from tacsim.optics.spline import (
    SplineTable,
    displacement_and_jacobian,
    line_matrices,
    refine_spline,
    spline_weights,
)


def _random_surface() -> GelSurface:
    control = np.random.default_rng(1).normal(0.0, 1e-4, (9, 7, 3)).astype(np.float32)
    return GelSurface(control, spacing=1e-3, origin=(-4e-3, -3e-3))


def _random_points(count: int) -> np.ndarray:
    return np.random.default_rng(2).uniform((-4e-3, -3e-3), (4e-3, 3e-3), (count, 2))


def test_spline_is_scipys_quadratic_without_prefilter_up_to_the_rim() -> None:
    surface, points = _random_surface(), _random_points(500)
    found, _ = displacement_and_jacobian(surface, points)
    position = (points - surface.origin) / surface.spacing
    for component in range(3):
        control = surface.displacement[..., component].astype(np.float64)
        expected = map_coordinates(control, position.T, order=2, prefilter=False, mode="nearest")
        np.testing.assert_allclose(found[:, component], expected, atol=1e-15)


def test_jacobian_is_the_finite_difference() -> None:
    surface, points = _random_surface(), _random_points(200)
    _, jacobian = displacement_and_jacobian(surface, points)
    step = 1e-8
    for axis in range(2):
        shift = step * np.eye(2)[axis]
        after, _ = displacement_and_jacobian(surface, points + shift)
        before, _ = displacement_and_jacobian(surface, points - shift)
        np.testing.assert_allclose(jacobian[..., axis], (after - before) / (2 * step), atol=2e-6)


def test_beyond_the_rim_the_surface_goes_on_unchanged() -> None:
    surface = _random_surface()
    rim, slope = displacement_and_jacobian(surface, np.array([(4e-3, 1e-3), (9e-3, 1e-3)]))
    np.testing.assert_array_equal(rim[0], rim[1])
    assert np.abs(slope[1, :, 0]).max() == 0.0
    assert np.abs(slope[1, :, 1]).max() > 0.0


def test_line_matrices_agree_with_the_weights() -> None:
    position = np.linspace(-1.0, 6.5, 40)
    control = np.random.default_rng(3).normal(size=6)
    value, derivative = line_matrices(position, nodes=6)
    index, weight, slope = spline_weights(position, nodes=6)
    column = control[:, None].astype(np.float32)
    np.testing.assert_allclose((value @ column)[:, 0], (control[index] * weight).sum(axis=1), rtol=1e-5)
    np.testing.assert_allclose((derivative @ column)[:, 0], (control[index] * slope).sum(axis=1), atol=1e-6)
    np.testing.assert_allclose(value @ np.ones((6, 1), np.float32), 1.0, rtol=1e-6)


@pytest.mark.parametrize("points", [2, 4, 8])
def test_what_is_refined_agrees_with_the_weights(points: int) -> None:
    control = np.random.default_rng(0).normal(size=(6, 5)).astype(np.float32)
    value, slope = refine_spline(control, points), refine_spline(control, points, derivative=True)
    of_values, of_slopes = line_matrices(np.arange(5 * points + 1) / points, nodes=6)
    np.testing.assert_allclose(value, of_values @ control, atol=1e-6)
    np.testing.assert_allclose(slope, of_slopes @ control, atol=1e-6)


@pytest.mark.parametrize("size", [0.05, 0.3, 0.6, 1.5])
def test_a_fold_is_found_as_by_the_determinant_of_the_surface(size: float) -> None:
    """In lattice spacings of 1; 0.05 is decided by the control values alone, the others by the derivatives."""
    rng, points = np.random.default_rng(4), 4
    at = np.stack(np.meshgrid(np.arange(21) / points, np.arange(21) / points, indexing="ij"), axis=-1).reshape(-1, 2)
    for _ in range(20):
        control = rng.uniform(-size, size, (6, 6, 3)).astype(np.float32)
        _, by_place = displacement_and_jacobian(GelSurface(control, 1.0, (0.0, 0.0)), at)
        folds = float(np.linalg.det(np.eye(2) + by_place[:, :2]).min()) <= 0.0
        assert SplineTable(control, 1.0, points).folded == folds
