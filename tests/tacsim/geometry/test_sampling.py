"""Particles of a body: inside it, evenly spread, on a lattice or without one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial import KDTree

from tacsim.geometry.sampling import blue_noise_points, body_points
from tacsim.geometry.shapes import enclosed_volume, lattice_particles, shape_distance
from tacsim.models.scene import Body, Box, Cylinder, Mesh, Shape, Sphere

MM = 1e-3
SPACING = 0.5 * MM
SHAPES = [Box(size=(4 * MM, 5 * MM, 6 * MM)), Sphere(radius=3 * MM), Cylinder(radius=3 * MM, height=4 * MM)]


def ball(folder: Path) -> Mesh:
    trimesh.creation.icosphere(subdivisions=3, radius=3.0).export(folder / "ball.stl")
    return Mesh(path=str(folder / "ball.stl"))


def check_random(geometry: Shape) -> None:
    found = body_points(Body(geometry=geometry, sampling="random"), SPACING)
    assert (shape_distance(geometry, found) < 0).all()
    assert len(found) * SPACING**3 == pytest.approx(enclosed_volume(geometry), rel=0.05)  # each is given volume / n
    nearest = KDTree(found).query(found, k=2)[0][:, 1] / SPACING
    assert nearest.min() > 0.5  # independent points: < 0.1
    assert nearest.mean() > 0.85  # independent points: 0.55
    depth = -shape_distance(geometry, found) / SPACING
    phase = np.exp(2j * np.pi * found[depth > 2] / SPACING).mean(axis=0)
    assert np.abs(phase).max() < 0.25  # no layers inside; a lattice gives 1
    # the outermost are about half a spacing deep, so that the surface is covered
    assert 0.4 < np.median(depth[depth < 0.8]) < 0.6


@pytest.mark.parametrize("geometry", SHAPES, ids=lambda g: g.shape)
def test_random_particles_fill_the_shape_evenly_without_a_lattice(geometry: Shape) -> None:
    check_random(geometry)


def test_random_particles_fill_a_mesh(tmp_path: Path) -> None:
    check_random(ball(tmp_path))


def test_the_seed_decides() -> None:
    body = Body(geometry=SHAPES[1], sampling="random")
    assert np.array_equal(body_points(body, SPACING), body_points(body, SPACING))
    other = body_points(body.model_copy(update={"seed": 1}), SPACING)
    assert not np.array_equal(body_points(body, SPACING)[:100], other[:100])


def test_a_lattice_is_the_default() -> None:
    assert np.array_equal(body_points(Body(geometry=SHAPES[0]), SPACING), lattice_particles(SHAPES[0], SPACING))


def test_what_cannot_be_sampled_is_refused_either_way() -> None:
    with pytest.raises(ValueError, match="a body needs 3"):
        body_points(Body(geometry=Sphere(radius=0.1 * MM), sampling="random"), 1 * MM)


def test_a_body_that_no_random_particle_falls_into_is_refused() -> None:
    """One particle of a lattice fits; one at random in the same cell may lie outside."""
    ball = Sphere(radius=0.5 * MM)
    assert len(blue_noise_points(ball, 1 * MM, seed=2)) == 1
    with pytest.raises(ValueError, match="sphere holds no particle at a spacing of 1 mm"):
        blue_noise_points(ball, 1 * MM, seed=0)


def test_a_sheet_of_a_mesh_that_no_particle_falls_into_is_refused(tmp_path: Path) -> None:
    trimesh.creation.box((4.0, 4.0, 0.02)).export(tmp_path / "sheet.stl")
    with pytest.raises(ValueError, match=r"sheet\.stl holds no particle at a spacing of 0\.5 mm"):
        blue_noise_points(Mesh(path=str(tmp_path / "sheet.stl")), SPACING, seed=0)


@pytest.mark.parametrize("sampling", ["lattice", "random"])
@pytest.mark.parametrize(("thickness", "layers"), [(0.5 * MM, 1), (1 * MM, 2)])
def test_a_sheet_of_one_or_two_layers_is_refused_with_what_to_choose(
    thickness: float, layers: int, sampling: str
) -> None:
    sheet = Box(size=(4 * MM, 4 * MM, thickness))
    said = rf"{layers} layers of particles 0\.5 mm apart; a body needs 3: choose a particle_spacing of 0\.\d+ mm"
    with pytest.raises(ValueError, match=said):
        body_points(Body.model_validate({"geometry": sheet, "sampling": sampling}), 0.5 * MM)
    assert len(np.unique(body_points(Body(geometry=sheet), thickness / 4)[:, 2])) == 4
