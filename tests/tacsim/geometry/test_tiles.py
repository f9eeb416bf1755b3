"""Distances from a mesh, tile by tile."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from tacsim.geometry import tiles
from tacsim.geometry.mesh import fingerprint, signed_distance_on_grid
from tacsim.geometry.shapes import BAND, distance
from tacsim.geometry.tiles import TILE, TiledDistance, tiled_distance
from tacsim.models.scene import Mesh

SPACING = 0.1e-3


@pytest.fixture(scope="module")
def mesh(tmp_path_factory: pytest.TempPathFactory) -> Mesh:
    path = tmp_path_factory.mktemp("mesh") / "box.stl"
    trimesh.creation.box((8.0, 5.0, 3.0)).export(path)
    return Mesh(path=str(path))


@pytest.fixture
def tiled(mesh: Mesh) -> TiledDistance:
    return tiled_distance(mesh, SPACING)


def test_distances_are_exact_near_the_surface_and_right_in_sign_elsewhere(mesh: Mesh, tiled: TiledDistance) -> None:
    first, end = tiled.around(-tiled.half, np.array([0.0, 0.0, 1.0]))
    values = tiled.values(first, end)
    axes = [o + SPACING * (TILE * a + np.arange(n)) for o, a, n in zip(tiled.origin, first, values.shape, strict=True)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)[::7]
    found, truth = values.reshape(-1)[::7], distance(mesh, nodes)
    near = np.abs(truth) < BAND * SPACING
    assert near.any() and np.abs(found - truth)[near].max() < 1e-9
    assert (np.sign(found) == np.sign(truth))[~near].all() and (np.abs(found)[~near] >= 0.99 * BAND * SPACING).all()


def test_a_tile_is_the_same_whatever_it_is_laid_with(
    mesh: Mesh, tiled: TiledDistance, monkeypatch: pytest.MonkeyPatch
) -> None:
    one, two = np.array([1, 0, 0]), np.array([2, 1, 1])
    alone = tiled.values(one, two)
    monkeypatch.setattr(tiles, "_kept", {})
    other = TiledDistance(mesh, fingerprint(mesh.path), SPACING)
    assert np.array_equal(other.values(np.zeros(3, int), two + 1)[TILE : 2 * TILE, :TILE, :TILE], alone)


def test_a_tile_far_from_the_surface_is_all_inside(tmp_path: Path) -> None:
    trimesh.creation.box((14.0, 14.0, 14.0)).export(tmp_path / "cube.stl")
    tiled = tiled_distance(Mesh(path=str(tmp_path / "cube.stl")), SPACING)
    middle = np.array([2, 2, 2])
    values = tiled.values(middle, middle + 1)
    assert values.max() < -3e-3


def test_the_latest_tiles_of_all_meshes_are_kept_and_others_are_laid_again_alike(
    mesh: Mesh, tiled: TiledDistance, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, end = np.array([1, 0, 0]), np.array([3, 2, 1])
    smaller = tiled_distance(mesh.model_copy(update={"scale": 0.5e-3}), SPACING)
    expected, other = tiled.values(first, end), smaller.values(first, first + 1)
    laid: list[int] = []
    monkeypatch.setattr(tiles, "signed_distance_on_grid", lambda *a: (laid.append(1), signed_distance_on_grid(*a))[1])
    monkeypatch.setattr(tiles, "KEPT", 3)
    monkeypatch.setattr(tiles, "_kept", {})

    def lays(tiled: TiledDistance, first: np.ndarray, end: np.ndarray, expected: np.ndarray) -> int:
        laid.clear()
        assert np.array_equal(tiled.values(first, end), expected) and len(tiles._kept) <= 3
        return len(laid)

    assert lays(tiled, first, end, expected) == 4
    second = np.array([1, 1, 0]), np.array([2, 2, 1]), expected[:TILE, TILE:]
    assert lays(tiled, *second) == 0  # the first of the four is gone, this one is now the latest used
    assert lays(smaller, first, first + 1, other) == 1
    assert lays(tiled, *second) == 0
    assert lays(tiled, first, first + 1, expected[:TILE, :TILE]) == 1
    assert lays(tiled, first, end, expected) >= 2


def test_a_grid_beyond_memory_is_refused(tiled: TiledDistance) -> None:
    with pytest.raises(ValueError, match=r"box\.stl: a grid of 3200 x 3200 x 3200 nodes 0\.1 mm apart .* 20,000,000"):
        tiled.values(np.zeros(3, int), np.full(3, 100))
