"""Indenters with edges, and what is finer than the gel's mesh: rounding, rest deep in the gel, blades."""

from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from tacsim.geometry.shapes import bounding_size
from tacsim.interface import Pose
from tacsim.models.scene import Box, Cylinder, Gel, Mesh, Shape, Sphere
from tacsim.physics.failure import diagnosis
from tacsim.physics.failure.health import SimulationDiverged
from tacsim.physics.worlds.press import PressWorld
from tests.tacsim.physics.worlds.pressing import move, world


@pytest.mark.parametrize(("depth", "force"), [(0.5e-3, 1.322), (1e-3, 2.566)])
def test_a_rounded_punch_presses_as_in_finite_elements(depth: float, force: float) -> None:
    """By axisymmetric finite elements of our own (quadratic, finite strain, no friction): radius 3, edge 0.25 mm; with
    elements of 0.33 and 0.25 mm they give 1.3210 and 1.3225 N, 2.550 and 2.576 N. A sharp one 0.5 mm deep: 1.5 N.
    """
    shape = Cylinder(radius=3e-3, height=4e-3)
    w = world(shape, 0.0, preset="standard", gel=Gel(), edge_radius=0.25e-3)
    move(w, (0, 0, -depth - 0.1e-3))
    assert -w.wrench("lower")[2] == pytest.approx(force, rel=0.03)


def deep(shape: Shape, preset: str, rotation: Rotation, depth: float) -> PressWorld:
    """A world in which the shape's lowest point has come to rest `depth` below the untouched gel."""
    w = world(shape, tolerance=1e-2, preset=preset, gel=Gel())
    half = bounding_size(shape) / 2
    reach = float(np.abs(rotation.as_matrix()[2]) @ half)
    for height in (reach + 0.1e-3, reach - depth):
        assert w.move({"indenter": Pose(np.array([0, 0, height]), rotation.as_quat())}).settled
    return w


BOX, PLATE = Box(size=(5e-3, 5e-3, 5e-3)), Box(size=(30e-3, 30e-3, 3e-3))


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["draft", pytest.param("standard", marks=pytest.mark.deep)])
@pytest.mark.parametrize(("shape", "tilt"), [(BOX, 0.0), (BOX, 30.0), (PLATE, 0.0)])
def test_what_has_sharp_edges_comes_to_rest_in_half_the_gel(shape: Box, tilt: float, preset: str) -> None:
    """The gel is 4 mm thick. Before, an element was turned inside out at a corner, by -0.3 to -3 of its volume."""
    w = deep(shape, preset, Rotation.from_euler("x", tilt, degrees=True), 2e-3)
    corners = diagnosis.corner_volumes(w.arrays()["gel_displacement"], 4.0)
    assert corners.min() > 0.0


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["draft", pytest.param("standard", marks=pytest.mark.deep)])
def test_a_star_comes_to_rest_in_half_the_gel(preset: str, tmp_path: Path) -> None:
    """A prism of five points, 4 and 2 mm from its axis."""
    import trimesh

    angle = np.arange(10) * np.pi / 5
    rim = np.where(np.arange(10) % 2, 2.0, 4.0)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    flat = np.vstack([rim, [[0.0, 0.0]]])
    corners = np.concatenate([np.c_[flat, np.full(11, z)] for z in (0.0, 6.0)])
    faces = []
    for i, j in zip(range(10), (*range(1, 10), 0), strict=True):
        faces += [[i, 10, j], [11 + i, 11 + j, 21], [i, j, 11 + j], [i, 11 + j, 11 + i]]
    star = trimesh.Trimesh(corners, faces)
    star.fix_normals()
    star.export(tmp_path / "star.stl")
    deep(Mesh(path=str(tmp_path / "star.stl")), preset, Rotation.identity(), 2e-3)


@pytest.mark.deep
def test_a_wedge_comes_to_rest(tmp_path: Path) -> None:
    """Of 53 degrees, 6 mm long."""
    import trimesh

    wedge = trimesh.convex.convex_hull([(x, y, z) for x in (-3, 3) for y, z in ((0, 0), (-1.5, 3), (1.5, 3))])
    wedge.export(tmp_path / "wedge.stl")
    deep(Mesh(path=str(tmp_path / "wedge.stl")), "standard", Rotation.identity(), 1e-3)


@pytest.mark.parametrize(("edge_radius", "geometry"), [(2.6e-3, BOX), (1.6e-3, PLATE), (1e-4, Sphere())])
def test_an_edge_that_does_not_fit_is_refused(edge_radius: float, geometry: Shape) -> None:
    with pytest.raises(ValidationError, match=r"half the shortest side of the box, 0\.00|a sphere has no edges"):
        world(geometry, edge_radius=edge_radius)


@pytest.mark.slow
def test_a_blade_that_sinks_between_the_contact_points_in_part_is_an_error(tmp_path: Path) -> None:
    """A wedge of 20 degrees: the points beside its edge feel its flanks, and what is below them nobody feels."""
    import trimesh

    blade = trimesh.convex.convex_hull([(x, y, z) for x in (-3, 3) for y, z in ((0, 0), (-1.0, 5.7), (1.0, 5.7))])
    blade.export(tmp_path / "blade.stl")
    w = world(Mesh(path=str(tmp_path / "blade.stl")), preset="draft", gel=Gel(), tolerance=1e-2)
    move(w, (0.1e-3, 0.05e-3, 0))
    with pytest.raises(
        SimulationDiverged, match=r"mm deep in the gel, and no contact point more than 0.* such as 0\.5 mm"
    ):
        move(w, (0, 0, -1.1e-3))


@pytest.mark.slow
@pytest.mark.parametrize("long", [11.0, 30.0])
def test_blade_at_or_outside_gel_rim_is_error(long: float, tmp_path: Path) -> None:
    """A wedge of 33 degrees, 1 mm deep: elements of 1 mm give 55 % of its force with elements of 0.25 mm."""
    import trimesh

    half = long / 2
    blade = trimesh.convex.convex_hull([(x, y, z) for x in (-half, half) for y, z in ((0, 0), (-1.5, 5), (1.5, 5))])
    blade.export(tmp_path / "blade.stl")
    gel = Gel(size=(12e-3, 12e-3, 4e-3))
    w = world(Mesh(path=str(tmp_path / "blade.stl")), preset="draft", gel=gel, tolerance=1e-2)
    with pytest.raises(SimulationDiverged, match=r"mm deep in the gel, and no contact point more than 0\.0"):
        move(w, (0, 0, -1.1e-3))


@pytest.mark.slow
@pytest.mark.parametrize("size", [(30, 30, 3), (30, 2, 3)])
def test_what_is_flat_and_wider_than_the_gel_is_none(size: tuple[float, float, float], tmp_path: Path) -> None:
    import trimesh

    trimesh.creation.box(size).export(tmp_path / "bar.stl")
    deep(Mesh(path=str(tmp_path / "bar.stl")), "draft", Rotation.identity(), 1e-3)


def test_rotated_knife_with_less_than_three_quarters_depth_at_contact_points_is_error() -> None:
    """Across the mesh, 1.5 mm deep, its force is 0.34 N; with elements of 0.25 mm it is 0.58 N."""
    w = world(Box(size=(0.3e-3, 6e-3, 5e-3)), preset="standard", gel=Gel(size=(12e-3, 12e-3, 4e-3)), tolerance=1e-2)
    turn = Rotation.from_euler("z", 30, degrees=True).as_quat()
    w.move({"indenter": Pose(np.array([0, 0, 2.6e-3]), turn)})
    with pytest.raises(SimulationDiverged, match=r"mm deep in the gel, and no contact point more than 0\.1"):
        w.move({"indenter": Pose(np.array([0, 0, 1.0e-3]), turn)})
