"""Surfaces that fold over themselves, against a fold in closed form.

Along a slanted direction, with s the place of a material point on it, the surface moves by -a sin(k s) and has the
height 2 mm + b s + d t. With a k = 1.6 it folds once a period: there the camera sees of two sheets the deeper one.
"""

import numpy as np
import pytest

from tacsim.models.scene import GelSurface
from tacsim.models.sensor import Markers, SensorGeometry, SensorModel
from tacsim.optics import surface as surfaces
from tacsim.optics.grid import PixelGrid, image_grid
from tacsim.optics.markers import marker_transmission, rest_positions
from tacsim.optics.render import Renderer
from tacsim.optics.surface import SurfaceTable, sample_surface, visible_table_points
from tests.tacsim.optics.surfaces import dent, make_surface

MM = 1e-3
K, A, D = 2 * np.pi / (7 * MM), 1.6 * 7 * MM / (2 * np.pi), 0.02
ALONG = np.array([np.cos(0.4), np.sin(0.4)])
ACROSS = np.array([-ALONG[1], ALONG[0]])
SPACING = 0.25 * MM
GRID = PixelGrid(rows=101, columns=141, pitch=0.1 * MM, x0=-7 * MM, y0=-5 * MM)  # 3 mm from the gel's border
TURN = np.arccos(1 / (A * K)) / K  # from a fold's middle to where the surface is seen edge-on
SILHOUETTE = TURN - A * np.sin(K * TURN)  # where that is seen


def folded(b: float) -> GelSurface:
    """The spline through samples of a sine is one, smaller by a factor."""
    smaller = np.prod(0.75 + 0.25 * np.cos(K * SPACING * ALONG))

    def displace(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        s, t = x * ALONG[0] + y * ALONG[1], x * ACROSS[0] + y * ACROSS[1]
        u = -A / smaller * np.sin(K * s)
        return u * ALONG[0], u * ALONG[1], -(2 * MM + b * s + D * t)

    return make_surface(displace, spacing=SPACING)


def seen(points: np.ndarray, b: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """s [m] of what is seen at image points (..., 2), their t [m], and how far they are from a silhouette [m]."""
    at, t = points @ ALONG, points @ ACROSS
    best = np.full(at.shape, -np.inf if b > 0 else np.inf)
    for period in range(-3, 4):
        low = np.full(at.shape, (period * 2 * np.pi) / K + TURN)
        high = low + 2 * np.pi / K - 2 * TURN
        inside = (low - A * np.sin(K * low) <= at) & (at <= high - A * np.sin(K * high))
        for _ in range(50):
            middle = (low + high) / 2
            above = middle - A * np.sin(K * middle) > at
            low, high = np.where(above, low, middle), np.where(above, middle, high)
        best = np.where(inside, np.maximum(best, low) if b > 0 else np.minimum(best, low), best)
    edge = SILHOUETTE if b > 0 else -SILHOUETTE
    return best, t, np.abs((at - edge + np.pi / K) % (2 * np.pi / K) - np.pi / K)


@pytest.mark.parametrize("b", [0.1, -0.1])
def test_of_two_sheets_the_camera_sees_the_deeper_one(b: float) -> None:
    sample = sample_surface(folded(b), GRID)
    s, t, off = seen(GRID.points(), b)
    assert sample.valid.all() and np.isfinite(sample.gradient).all()
    clear = off > GRID.pitch / 20
    assert clear.mean() > 0.95
    np.testing.assert_allclose(sample.height[clear], (2 * MM + b * s + D * t)[clear], atol=3e-6)
    narrow = 1 - A * K * np.cos(K * s)
    gradient = (b / narrow)[..., None] * ALONG + D * ACROSS
    away = narrow > 0.3
    assert 0.97 < away.mean() < 1
    np.testing.assert_allclose(sample.gradient[away], gradient[away], rtol=0.03, atol=1e-3)
    steep = np.linalg.norm(sample.gradient[~away] - D * ACROSS, axis=-1)
    assert abs(b) / 0.4 < steep.min() and steep.max() <= abs(b) / 0.1 * 1.01  # towards the silhouette, never beyond


def test_a_surface_without_a_fold_goes_the_quick_way_and_either_way_shows_the_same(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    table, grid = SurfaceTable(dent(slide=(0.6e-3, -0.4e-3))), image_grid(SensorGeometry())
    quick, inside = table.table_points(grid)
    assert not table.folded
    monkeypatch.setattr(SurfaceTable, "folded", True)
    slow, same = table.table_points(grid)
    assert np.array_equal(inside, same)
    np.testing.assert_allclose(slow[inside], quick[inside], atol=0.1)  # table points
    monkeypatch.delattr(surfaces, "visible_table_points")
    monkeypatch.setattr(SurfaceTable, "folded", False)
    assert np.array_equal(table.table_points(grid)[0], quick)


def test_a_fold_between_the_points_of_the_table_is_found_when_newton_finds_none(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def nowhere(*_: object) -> None:
        raise surfaces.SurfaceFolded

    plain = sample_surface(make_surface(lambda x, y: (1.5 * x, 0 * y, -0.02 * x)), GRID)  # beyond the fixed point
    monkeypatch.setattr(surfaces, "material_points", nowhere)
    drawn = sample_surface(make_surface(lambda x, y: (1.5 * x, 0 * y, -0.02 * x)), GRID)
    np.testing.assert_allclose(drawn.height, plain.height, atol=1e-7)


def test_what_faces_away_is_not_seen_and_neighbours_leave_no_gap() -> None:
    rows, columns = np.mgrid[0:5, 0:6].astype(float)
    height = (rows + columns).astype(np.float32)
    turned = 1.9 * np.stack([columns + 0.3 * rows, rows - 0.2 * columns], axis=-1) + [2.0, 3.0]
    points, inside = visible_table_points(turned, height, (14, 16))
    v, u = np.nonzero(inside)
    back = np.linalg.solve(np.array([[1.0, 0.3], [-0.2, 1.0]]), (np.stack([u, v]) - [[2.0], [3.0]]) / 1.9)
    np.testing.assert_allclose(points[v, u], back.T, atol=1e-5)
    all_back = np.linalg.solve(
        np.array([[1.0, 0.3], [-0.2, 1.0]]), (np.mgrid[0:14, 0:16][::-1].reshape(2, -1) - [[2.0], [3.0]]) / 1.9
    )
    within = (all_back >= 0).all(axis=0) & (all_back[0] <= 5) & (all_back[1] <= 4)
    assert np.array_equal(inside.ravel(), within) and within.sum() > 40
    assert not visible_table_points(turned[:, ::-1], height, (14, 16))[1].any()


def test_dots_behind_a_fold_are_not_drawn() -> None:
    b, geometry = 0.1, SensorGeometry()
    markers = Markers(rows=12, columns=15, pitch=1e-3, radius=0.15e-3)
    surface, grid = folded(b), image_grid(geometry)
    table = SurfaceTable(surface)
    at_rest = table.rest_coordinates(table.table_points(grid)[0], grid)
    light = marker_transmission(surface, markers, geometry, at_rest)
    rest = rest_positions(markers).reshape(-1, 2)
    own = rest @ ALONG
    places = rest - A * np.sin(K * own)[:, None] * ALONG
    visible, _, off = seen(places, b)
    hidden = np.abs(visible - own) > 0.3 * MM
    u, v = np.rint(places / geometry.pixel_pitch + geometry.principal).astype(int).T
    drawn = light[v, u] < 0.5
    clear = (off > 0.3 * MM) & (np.abs(places) < 7 * MM).all(axis=1)
    assert drawn[clear & ~hidden].all() and (clear & ~hidden).sum() > 60
    alone = np.linalg.norm(places[hidden][:, None] - places[~hidden], axis=-1).min(axis=1) > 0.3 * MM
    assert not drawn[hidden][alone & clear[hidden]].any() and (alone & clear[hidden]).sum() > 10
    everywhere = Renderer(SensorModel(texture=0.0, markers=markers), (20e-3, 20e-3))(surface)
    assert (everywhere[v, u].sum(axis=1) < 60)[clear & ~hidden].all()
