import numpy as np

from tacsim.models.sensor import CanonicalGrid, SensorGeometry
from tacsim.optics.grid import PixelGrid, canonical_cells, canonical_image, image_grid


def test_pixel_centres_are_integers_about_the_sensor_axis() -> None:
    grid = image_grid(SensorGeometry(width=320, height=240, pixel_pitch=0.05e-3, centre=(100.0, 30.0)))
    assert grid.x[100] == 0.0
    assert grid.y[30] == 0.0
    np.testing.assert_allclose(grid.x[101], 0.05e-3)
    np.testing.assert_allclose(grid.points()[40, 110], (0.5e-3, 0.5e-3))


def test_default_image_is_centred() -> None:
    grid = image_grid(SensorGeometry())
    np.testing.assert_allclose(grid.x, -grid.x[::-1], atol=1e-12)
    np.testing.assert_allclose(grid.y, -grid.y[::-1], atol=1e-12)


def test_canonical_pixels_share_the_area_of_their_cell() -> None:
    config = CanonicalGrid(rows=16, columns=24, pitch=0.25e-3, image_scale=3)
    cells, pixels = canonical_cells(config), canonical_image(config)
    assert pixels.shape == (48, 72)
    np.testing.assert_allclose(pixels.x.reshape(24, 3).mean(axis=1), cells.x, atol=1e-12)
    np.testing.assert_allclose(pixels.y.reshape(16, 3).mean(axis=1), cells.y, atol=1e-12)


def test_within_is_the_gel() -> None:
    grid = PixelGrid(rows=5, columns=5, pitch=1e-3, x0=-2e-3, y0=-2e-3)
    np.testing.assert_array_equal(grid.points_on_gel((4e-3, 2e-3)).sum(axis=1), [0, 5, 5, 5, 0])
