"""The distance to a mesh on a grid."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from tacsim.geometry.mesh import make_surface, signed_distance, signed_distance_on_grid
from tacsim.geometry.mesh_file import load_mesh


@pytest.mark.slow
def test_a_grid_that_the_surface_does_not_enter_has_the_distance_from_its_nearest_node(tmp_path: Path) -> None:
    """In a ball and beside it: the node that is nearest to the surface is exact, and none is too near."""
    trimesh.creation.icosphere(4, 8.0).export(tmp_path / "ball.stl")
    surface = make_surface(load_mesh(tmp_path / "ball.stl", 1e-3))
    for place in ([1e-3, 0.5e-3, -1.2e-3], [9e-3, 2e-3, -12e-3]):
        axes = tuple(at + 0.1e-3 * np.arange(10) for at in place)
        found = signed_distance_on_grid(surface, axes, 0.2e-3).ravel()
        exact = signed_distance(surface, np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3))
        nearest = np.argmin(np.abs(exact))
        assert found[nearest] == pytest.approx(exact[nearest], rel=1e-9)
        assert (np.sign(found) == np.sign(exact)).all() and (np.abs(found) >= np.abs(exact) - 1e-12).all()
