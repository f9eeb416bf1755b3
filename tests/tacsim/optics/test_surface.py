from dataclasses import replace

import numpy as np
import pytest

from tacsim.models.sensor import CanonicalGrid, Markers, SensorGeometry
from tacsim.optics.grid import PixelGrid, canonical_cells, image_grid
from tacsim.optics.spline import displacement_and_jacobian
from tacsim.optics.surface import (
    SurfaceFolded,
    SurfaceTable,
    bilinear_lookup,
    block_centres,
    interpolate_blocks,
    material_points,
    sample_surface,
    surface_map,
)
from tests.tacsim.optics.surfaces import dent, make_surface

IMAGE = image_grid(SensorGeometry())


def test_dent_right_and_below_is_positive_there_and_slopes_away() -> None:
    sample = sample_surface(dent(centre=(3e-3, 2e-3), depth=0.8e-3), IMAGE)
    row, column = np.unravel_index(sample.height.argmax(), sample.height.shape)
    assert IMAGE.x[column] == pytest.approx(3e-3, abs=0.1e-3)
    assert IMAGE.y[row] == pytest.approx(2e-3, abs=0.1e-3)
    assert sample.height[row, column] == pytest.approx(0.8e-3, rel=0.06)
    assert sample.gradient[row, column + 16, 0] < -0.1  # one mm to the right: height falls with x
    assert sample.gradient[row, column - 16, 0] > 0.1
    assert sample.gradient[row + 12, column, 1] < -0.1  # below: height falls with y
    assert sample.gradient[row - 12, column, 1] > 0.1


@pytest.mark.slow
@pytest.mark.parametrize("slide", [(0.0, 0.0), (0.6e-3, -0.4e-3)])
@pytest.mark.parametrize(
    "grid", [IMAGE, IMAGE.refined(2), canonical_cells(CanonicalGrid())], ids=["image", "large", "canonical"]
)
def test_grid_agrees_with_newton_on_the_spline_itself(slide: tuple[float, float], grid: PixelGrid) -> None:
    surface = dent(slide=slide)
    sample = sample_surface(surface, grid)
    points = grid.points().reshape(-1, 2)
    material = material_points(surface, points)
    displacement, jacobian = displacement_and_jacobian(surface, material)
    np.testing.assert_allclose(material + displacement[:, :2], points, atol=1e-9)
    deformation = np.eye(2) + jacobian[:, :2]
    gradient = np.linalg.solve(deformation.transpose(0, 2, 1), -jacobian[:, 2, :, None])[..., 0]
    np.testing.assert_allclose(sample.height.ravel(), -displacement[:, 2], atol=3e-6)
    np.testing.assert_allclose(sample.gradient.reshape(-1, 2), gradient, atol=3e-3)
    assert np.sqrt(np.mean((sample.height.ravel() + displacement[:, 2]) ** 2)) < 0.3e-6


def test_gradient_is_the_slope_of_the_height_that_the_image_shows() -> None:
    grid = PixelGrid(rows=200, columns=240, pitch=0.03e-3, x0=-0.5e-3, y0=-1e-3)
    sample = sample_surface(dent(slide=(0.5e-3, 0.3e-3)), grid)
    by_y, by_x = np.gradient(sample.height.astype(np.float64), grid.pitch)
    inner = (slice(2, -2), slice(2, -2))
    # single differences carry the 1/32 steps of the look-up, hence the mean
    assert np.abs(by_x - sample.gradient[..., 0])[inner].mean() < 0.01
    assert np.abs(by_y - sample.gradient[..., 1])[inner].mean() < 0.01
    assert np.abs(sample.gradient).max() > 0.3


def test_uniform_sideways_motion_moves_the_picture() -> None:
    still = dent()
    moved = replace(still, displacement=still.displacement + np.array([0.5e-3, -0.25e-3, 0.0], dtype=np.float32))
    before, after = sample_surface(still, IMAGE), sample_surface(moved, IMAGE)
    np.testing.assert_allclose(after.height[:-4, 8:], before.height[4:, :-8], atol=2e-6)  # 8 px right, 4 px up


def test_stretch_beyond_the_fixed_point_is_still_exact() -> None:
    """u = 1.5 X: fixed-point iteration runs away, X = x / 2.5."""
    surface = make_surface(lambda x, y: (1.5 * x, 0.1 * y, -0.02 * x))
    grid = PixelGrid(rows=5, columns=9, pitch=1e-3, x0=-4e-3, y0=-2e-3)
    sample = sample_surface(surface, grid)
    np.testing.assert_allclose(sample.height, np.tile(0.02 / 2.5 * grid.x, (5, 1)), atol=1e-7)
    np.testing.assert_allclose(sample.gradient[..., 0], 0.02 / 2.5, rtol=1e-3)


def test_newton_finds_no_single_point_in_a_fold() -> None:
    """The sheets of a folded surface are tested in test_fold.py."""

    def displace(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return -1.5 * (x - 2e-3) * np.exp(-(((x - 2e-3) ** 2 + y**2) / 2e-6)), 0 * x, 0 * x

    with pytest.raises(SurfaceFolded, match=r"folds over at \d+ points, first at x = .* mm"):
        material_points(make_surface(displace), IMAGE.points().reshape(-1, 2))


def test_beyond_the_gel_nothing_is_seen() -> None:
    surface = make_surface(lambda x, y: (0 * x, 0 * x, 0 * x - 1e-4), size=(10e-3, 6e-3))
    sample = sample_surface(surface, IMAGE)
    np.testing.assert_array_equal(sample.valid, IMAGE.points_on_gel((10e-3, 6e-3)))
    assert 0.1 < sample.valid.mean() < 0.9
    np.testing.assert_allclose(sample.height[sample.valid], 1e-4, rtol=1e-5)
    assert not sample.height[~sample.valid].any()
    assert not sample.gradient[~sample.valid].any()


def test_surface_map_is_canonical_and_has_flow_only_with_markers() -> None:
    surface = dent(slide=(0.4e-3, 0.0))
    known = surface_map(surface, CanonicalGrid(rows=32, columns=48), None)
    assert known.height.shape == (32, 48)
    assert known.gradient.shape == (32, 48, 2)
    assert known.height.dtype == known.gradient.dtype == np.float32
    assert known.height.flags.c_contiguous
    assert known.flow is None
    markers = Markers(rows=5, columns=7)
    flow = surface_map(surface, CanonicalGrid(), markers).flow
    assert flow is not None
    assert flow.shape == (5, 7, 2)


def test_bad_surfaces_are_named() -> None:
    good = dent()
    broken = good.displacement.copy()
    broken[4, 7, 2] = np.nan
    with pytest.raises(ValueError, match=r"not finite at 1 of 1681 nodes, first at \(4, 7\)"):
        sample_surface(replace(good, displacement=broken), IMAGE)
    with pytest.raises(ValueError, match=r"must be \(nx >= 3, ny >= 3, 3\), got \(41, 41\)"):
        sample_surface(replace(good, displacement=good.displacement[..., 0]), IMAGE)
    with pytest.raises(ValueError, match="spacing must be positive"):
        sample_surface(replace(good, spacing=0.0), IMAGE)
    with pytest.raises(ValueError, match="sideways"):
        sample_surface(replace(good, displacement=good.displacement + np.float32(1.0)), IMAGE)


@pytest.mark.parametrize(
    "grid",
    [
        IMAGE,
        PixelGrid(rows=30, columns=40, pitch=0.05e-3, x0=2e-3, y0=1e-3),
        PixelGrid(rows=40, columns=60, pitch=0.1e-3, x0=6e-3, y0=-12e-3),
    ],
    ids=["image", "middle", "corner"],
)
def test_what_a_grid_shows_lies_in_its_part_of_the_table(grid: PixelGrid) -> None:
    table = SurfaceTable(dent(slide=(0.6e-3, -0.4e-3)))
    points, inside = table.table_points(grid)
    np.testing.assert_array_equal(inside, grid.points_on_gel((20e-3, 20e-3)))
    part, outside = table.visible_part(grid), np.ones_like(table.fields)
    outside[part] = 0.0
    assert not bilinear_lookup(outside, points).any()
    assert outside.mean() > 0.1


def test_a_grid_beside_the_gel_has_a_part_of_its_table_too() -> None:
    table = SurfaceTable(dent())
    for x0, y0 in ((-40e-3, -3e-3), (40e-3, 30e-3)):
        part = table.visible_part(PixelGrid(rows=30, columns=40, pitch=0.05e-3, x0=x0, y0=y0))
        assert table.fields[part].size > 0


@pytest.mark.parametrize("block", [1, 2, 3, 5])
def test_values_at_the_middles_of_blocks_are_spread_over_their_points(block: int) -> None:
    grid = PixelGrid(rows=31, columns=44, pitch=0.05e-3, x0=2e-3, y0=1e-3)
    blocks = block_centres(grid, block)
    assert blocks.shape == (grid.shape if block == 1 else (-(-31 // block) + 2, -(-44 // block) + 2))
    found = interpolate_blocks(blocks.points().astype(np.float32), block, grid.shape)  # linear in x and in y
    np.testing.assert_allclose(found, grid.points(), atol=1e-9)
