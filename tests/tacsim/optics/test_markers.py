import numpy as np
import pytest

from tacsim.models.sensor import Markers, SensorGeometry, SensorModel
from tacsim.optics.markers import (
    marker_coverage,
    marker_discs,
    marker_flow,
    require_dots_on_gel,
    rest_positions,
)
from tacsim.optics.render import Renderer
from tests.tacsim.optics.surfaces import dent, flat, make_surface

GEOMETRY = SensorGeometry()
MARKERS = Markers(rows=5, columns=8, pitch=1.5e-3)


def test_rows_run_along_y_and_columns_along_x() -> None:
    rest = rest_positions(MARKERS)
    assert rest.shape == (5, 8, 2)
    np.testing.assert_allclose(rest[0, 0], (-5.25e-3, -3e-3))
    np.testing.assert_allclose(rest[1, 0] - rest[0, 0], (0.0, 1.5e-3), atol=1e-12)
    pixels = marker_discs(flat(), MARKERS, GEOMETRY)[0]
    np.testing.assert_allclose(pixels[0, 0], (159.5 - 84.0, 119.5 - 48.0))


def test_markers_move_with_a_sheared_surface() -> None:
    """u_x grows with y and u_y with x: another shear each way, exact on a spline in the interior."""
    surface = make_surface(lambda x, y: (0.3e-3 + 0.05 * y, -0.1e-3 + 0.02 * x, 0 * x))
    rest = rest_positions(MARKERS)
    expected = np.stack([0.3e-3 + 0.05 * rest[..., 1], -0.1e-3 + 0.02 * rest[..., 0]], axis=-1)
    flow = marker_flow(surface, MARKERS)
    assert flow.dtype == np.float32
    np.testing.assert_allclose(flow, expected, atol=1e-9)
    moved = marker_discs(surface, MARKERS, GEOMETRY)[0] - marker_discs(flat(), MARKERS, GEOMETRY)[0]
    np.testing.assert_allclose(moved, expected / GEOMETRY.pixel_pitch, atol=1e-4)


def test_a_dot_is_drawn_at_its_place_to_a_fiftieth_of_a_pixel() -> None:
    for centre in [(30.0, 20.0), (30.3, 20.8), (29.61, 17.47)]:
        coverage = marker_coverage(np.array([centre]), radius=4.0, shape=(48, 64))
        v, u = np.indices(coverage.shape)
        found = np.array([(u * coverage).sum(), (v * coverage).sum()]) / coverage.sum()
        np.testing.assert_allclose(found, centre, atol=0.02)
        assert coverage.sum() == pytest.approx(np.pi * 4.0**2, rel=0.02)


def test_dots_beyond_the_border_are_cut_or_left_out() -> None:
    coverage = marker_coverage(np.array([(-1.0, 10.0), (500.0, 10.0), (-80.0, -80.0)]), radius=3.0, shape=(24, 32))
    assert coverage[10, 0] == 1.0
    assert coverage[:, 5:].sum() == 0.0


def test_rendered_dots_are_dark_where_the_surface_carries_them() -> None:
    renderer = Renderer(SensorModel(markers=MARKERS, texture=0.0), (20e-3, 20e-3))
    surface = dent(slide=(0.6e-3, -0.3e-3))
    image = renderer(surface).astype(int).sum(axis=2)
    for u, v in marker_discs(surface, MARKERS, GEOMETRY)[0].reshape(-1, 2):
        assert image[round(v), round(u)] < 80
    plain = Renderer(SensorModel(texture=0.0), (20e-3, 20e-3))(surface).astype(int).sum(axis=2)
    assert (image != plain).mean() == pytest.approx(40 * np.pi * 4.5**2 / image.size, rel=0.15)


def test_a_lattice_larger_than_the_gel_is_refused() -> None:
    require_dots_on_gel(MARKERS, (11.1e-3, 6.6e-3))
    with pytest.raises(ValueError, match=r"5 x 8 dots at 1.5 mm need a gel of 11.00 x 6.50 mm, the gel is 10 x 10 mm"):
        Renderer(SensorModel(markers=MARKERS), (10e-3, 10e-3))


def test_a_pinhole_shows_a_dot_that_is_pressed_towards_it_farther_out_and_larger() -> None:
    """By similar triangles: at distance H - h instead of H everything is H / (H - h) times as large."""
    near = GEOMETRY.model_copy(update={"camera_distance": 10e-3})
    pressed = make_surface(lambda x, y: (x * 0, x * 0, x * 0 - 1e-3))
    rest = marker_discs(flat(), MARKERS, near)[0]
    np.testing.assert_allclose(rest, marker_discs(flat(), MARKERS, GEOMETRY)[0])  # untouched gel lies where it lay
    centres, radii = marker_discs(pressed, MARKERS, near)
    np.testing.assert_allclose(centres - near.principal, (rest - near.principal) * 10 / 9, rtol=1e-6)
    np.testing.assert_allclose(radii, MARKERS.radius / near.pixel_pitch * 10 / 9, rtol=1e-6)
    np.testing.assert_allclose(marker_discs(pressed, MARKERS, GEOMETRY)[0], rest)  # parallel rays see none of it


def test_a_gel_pressed_up_to_the_pinhole_is_refused() -> None:
    near = GEOMETRY.model_copy(update={"camera_distance": 2e-3})
    with pytest.raises(ValueError, match=r"pressed in 2\.50 mm, up to the camera at camera_distance 2 mm"):
        marker_discs(make_surface(lambda x, y: (x * 0, x * 0, x * 0 - 2.5e-3)), MARKERS, near)[0]
