"""Distances from a mesh, tile by tile."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from tacsim.geometry import tiles
from tacsim.geometry.mesh import signed_distance_on_grid
from tacsim.geometry.mesh_file import file_fingerprint
from tacsim.geometry.shapes import shape_distance
from tacsim.geometry.tiles import (
    TILE_NODES,
    TiledDistance,
    cached_tiled_distance,
    report_tiles,
    share_tiles,
    trilinear_interpolation,
)
from tacsim.models.scene import Mesh

SPACING = 0.1e-3


@pytest.fixture(scope="module")
def mesh(tmp_path_factory: pytest.TempPathFactory) -> Mesh:
    path = tmp_path_factory.mktemp("mesh") / "box.stl"
    trimesh.creation.box((8.0, 5.0, 3.0)).export(path)
    return Mesh(path=str(path))


@pytest.fixture
def tiled(mesh: Mesh) -> TiledDistance:
    return cached_tiled_distance(mesh, SPACING)


def test_between_nodes_it_is_trilinear_with_its_own_gradient() -> None:
    spacing, radius = 0.1e-3, 2e-3
    nodes = spacing * (np.stack(np.indices((45, 45, 45)), axis=-1) - 22.0)
    values = (np.linalg.norm(nodes, axis=-1) - radius).astype(np.float32)
    rng = np.random.default_rng(2)
    at = rng.normal(size=(500, 3))
    at *= (radius + rng.uniform(-0.2e-3, 0.2e-3, (500, 1))) / np.linalg.norm(at, axis=1, keepdims=True)
    length = np.linalg.norm(at, axis=1)
    value, gradient = trilinear_interpolation(values, at / spacing + 22.0, spacing)
    assert np.abs(value - (length - radius)).max() < 3 / 8 * spacing**2 / 1.75e-3
    assert np.abs(gradient - at / length[:, None]).max() < 1.1 * spacing / 1.75e-3


def test_a_linear_field_comes_back_and_nothing_is_known_outside() -> None:
    slope, shape, origin = np.array([2.0, -3.0, 5.0]), (4, 5, 6), np.array([1.0, 2.0, 3.0])
    values = np.einsum("a,aijk->ijk", slope, np.indices(shape) * 0.5).astype(np.float32)
    at = np.array([[1.0, 2.0, 3.0], [1.7, 2.3, 4.1], [2.5, 4.0, 5.5]])
    value, gradient = trilinear_interpolation(values, (at - origin) / 0.5, 0.5)
    assert np.allclose(value, (at - origin) @ slope)
    assert np.allclose(gradient, slope)
    value, gradient = trilinear_interpolation(
        values, (np.array([[0.9, 2.1, 3.1], [1.0, 2.0, 5.6]]) - origin) / 0.5, 0.5
    )
    assert np.isposinf(value).all()
    assert (gradient == 0).all()


@pytest.mark.slow
def test_a_tile_is_the_same_whatever_it_is_laid_with(
    mesh: Mesh, tiled: TiledDistance, monkeypatch: pytest.MonkeyPatch
) -> None:
    one, two = np.array([1, 0, 0]), np.array([2, 1, 1])
    alone = tiled.values(one, two)
    monkeypatch.setattr(tiles, "_tiles", {})
    other = TiledDistance(mesh, file_fingerprint(mesh.path), SPACING)
    assert np.array_equal(
        other.values(np.zeros(3, int), two + 1)[TILE_NODES : 2 * TILE_NODES, :TILE_NODES, :TILE_NODES], alone
    )


def test_a_tile_far_from_the_surface_is_all_inside(tmp_path: Path) -> None:
    trimesh.creation.box((14.0, 14.0, 14.0)).export(tmp_path / "cube.stl")
    tiled = cached_tiled_distance(Mesh(path=str(tmp_path / "cube.stl")), SPACING)
    middle = np.array([2, 2, 2])
    values = tiled.values(middle, middle + 1)
    assert values.max() < -3e-3


@pytest.mark.slow
def test_the_latest_tiles_of_all_meshes_are_kept_and_others_are_laid_again_alike(
    mesh: Mesh, tiled: TiledDistance, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, end = np.array([1, 0, 0]), np.array([3, 2, 1])
    smaller = cached_tiled_distance(mesh.model_copy(update={"scale": 0.5e-3}), SPACING)
    expected, other = tiled.values(first, end), smaller.values(first, first + 1)
    laid: list[int] = []
    monkeypatch.setattr(tiles, "signed_distance_on_grid", lambda *a: (laid.append(1), signed_distance_on_grid(*a))[1])
    monkeypatch.setattr(tiles, "MAX_TILES", 3)
    monkeypatch.setattr(tiles, "_tiles", {})

    def lays(tiled: TiledDistance, first: np.ndarray, end: np.ndarray, expected: np.ndarray) -> int:
        laid.clear()
        assert np.array_equal(tiled.values(first, end), expected) and len(tiles._tiles) <= 3
        return len(laid)

    assert lays(tiled, first, end, expected) == 4
    second = np.array([1, 1, 0]), np.array([2, 2, 1]), expected[:TILE_NODES, TILE_NODES:]
    assert lays(tiled, *second) == 0  # the first of the four is gone, this one is now the latest used
    assert lays(smaller, first, first + 1, other) == 1
    assert lays(tiled, *second) == 0
    assert lays(tiled, first, first + 1, expected[:TILE_NODES, :TILE_NODES]) == 1
    assert lays(tiled, first, end, expected) >= 2


def test_a_grid_beyond_memory_is_refused(tiled: TiledDistance) -> None:
    with pytest.raises(ValueError, match=r"box\.stl: a grid of 3200 x 3200 x 3200 nodes 0\.1 mm apart .* 20,000,000"):
        tiled.values(np.zeros(3, int), np.full(3, 100))


@pytest.mark.slow
def test_a_tile_that_another_process_has_left_is_not_computed_again(
    mesh: Mesh, tiled: TiledDistance, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    first, end = np.array([0, 0, 0]), np.array([2, 2, 1])
    expected = tiled.values(first, end)
    laid: list[int] = []
    monkeypatch.setattr(tiles, "signed_distance_on_grid", lambda *a: (laid.append(1), signed_distance_on_grid(*a))[1])

    def lays(of: TiledDistance = tiled) -> int:
        monkeypatch.setattr(tiles, "_tiles", {})  # as a process that begins
        laid.clear()
        assert np.array_equal(of.values(first, end), expected) or of is not tiled
        return len(laid)

    share_tiles(tmp_path / "shared")
    try:
        assert lays() == 4  # a folder that is not there costs time alone
        (tmp_path / "shared").mkdir()
        assert (lays(), lays()) == (4, 0)
        elsewhere = tmp_path / "again.stl"
        elsewhere.write_bytes(Path(mesh.path).read_bytes())
        assert lays(cached_tiled_distance(mesh.model_copy(update={"path": str(elsewhere)}), SPACING)) == 0
        assert lays(cached_tiled_distance(mesh.model_copy(update={"scale": 0.9e-3}), SPACING)) == 4
        files = sorted((tmp_path / "shared").iterdir())
        files[0].write_bytes(files[0].read_bytes()[:-1])  # cut short
        monkeypatch.setattr(tiles, "MAX_SHARED_TILES", 8)
        lays(), lays(cached_tiled_distance(mesh.model_copy(update={"scale": 0.8e-3}), SPACING))
        assert len(list((tmp_path / "shared").iterdir())) == 8
    finally:
        share_tiles(None)
    assert lays() == 4


@pytest.mark.parametrize("turn", [(0, 0, 0), (0, 90, 0), (0, 0, 30), (20, 10, 40), (4, -7, 0)])
def test_the_lowest_point_over_a_rectangle_is_that_of_the_edges_there(
    turn: tuple[float, float, float], tiled: TiledDistance, mesh: Mesh
) -> None:
    """By points along all edges; of a level edge it is the middle of what is over the rectangle."""
    axes, place, half = Rotation.from_euler("xyz", turn, degrees=True).as_matrix(), np.array([1e-3, 0, 4e-3]), 2.5e-3
    found = tiled.lowest(axes, place, np.full(2, half))
    assert found is not None
    at = tiled.vertices @ axes.T + place
    triangles = at[tiled._faces]
    share = np.linspace(0, 1, 4001)[:, None, None]
    points = np.concatenate(
        [a + share * (b - a) for a, b in ((triangles[:, i], triangles[:, i - 1]) for i in range(3))]
    )
    points = points.reshape(-1, 3)
    over = points[(np.abs(points[:, :2]) <= half).all(axis=1)]
    assert found[2] == pytest.approx(over[:, 2].min(), abs=3e-6)
    assert (np.abs(found[:2]) <= half + 1e-12).all()
    assert abs(shape_distance(mesh, ((found - place) @ axes)[None])[0]) < 1e-9
    assert tiled.lowest(axes, place + [0.1, 0, 0], np.full(2, half)) is None


def test_who_watches_is_told_how_far_a_mesh_is_measured(tmp_path: Path) -> None:
    import trimesh

    path = tmp_path / "ball.stl"
    trimesh.creation.icosphere(2, 4.0).export(path)
    mesh, told = cached_tiled_distance(Mesh(path=str(path)), 0.2e-3), []
    with report_tiles(lambda *each: told.append(each)):
        mesh.values(*mesh.tile_range(-mesh.half, mesh.half))
    number = len(told)
    assert number > 1 and told == [(str(path), done, number) for done in range(number)]
