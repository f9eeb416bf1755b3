"""Which side of an indenter presses: its name, what is there, and its section."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from tacsim.geometry.pressing_side import SIDES, describe_side, find_pressing_side, section_lines
from tacsim.geometry.shapes import bounding_size, depth_below_centre, rotated_bounding_size
from tacsim.interface import Pose
from tacsim.models.scene import Box, Cylinder, Indenter, Mesh, Shape, Sphere

AXES = {"x": 0, "y": 1, "z": 2}


@pytest.fixture(scope="module")
def cone(tmp_path_factory: pytest.TempPathFactory) -> Mesh:
    """The tip is up, the base of radius 3 mm down; 6 mm high."""
    path = tmp_path_factory.mktemp("mesh") / "cone.stl"
    trimesh.creation.cone(3.0, 6.0, sections=64).export(path)
    return Mesh(path=str(path))


@pytest.fixture(scope="module")
def bar(tmp_path_factory: pytest.TempPathFactory) -> Mesh:
    path = tmp_path_factory.mktemp("mesh") / "bar.stl"
    trimesh.creation.box((2.0, 4.0, 8.0)).export(path)
    return Mesh(path=str(path))


def test_the_angles_turn_about_world_axes_one_after_the_other() -> None:
    indenter = Indenter(roll=0.3, pitch=-0.7, yaw=1.9)
    assert indenter.turn == pytest.approx(Rotation.from_euler("xyz", [0.3, -0.7, 1.9]).as_quat(), abs=1e-12)
    assert Indenter(yaw=0.4).turn.tolist() == [0.0, 0.0, math.sin(0.2), math.cos(0.2)]


@pytest.mark.parametrize("side", SIDES)
def test_the_side_that_is_asked_for_is_the_one_that_is_down(side: str, bar: Mesh) -> None:
    roll, pitch = SIDES[side]
    indenter = Indenter(geometry=bar, roll=roll, pitch=pitch)
    outward = (-1.0 if side[0] == "-" else 1.0) * np.eye(3)[AXES[side[1]]]
    assert Rotation.from_quat(indenter.turn).apply(outward) == pytest.approx([0, 0, -1], abs=1e-12)
    size = sorted(np.delete([2, 4, 8], AXES[side[1]]), reverse=True)
    assert describe_side(indenter) == f"{side} of bar.stl, a flat face of {size[0]} x {size[1]} mm"
    assert find_pressing_side(indenter).lowest_point == pytest.approx(bounding_size(bar) / 2 * outward, abs=1e-9)


def test_points_edges_and_other_directions_are_named(cone: Mesh, bar: Mesh) -> None:
    assert describe_side(Indenter(geometry=cone)) == "-z of cone.stl, a flat face of 6 x 6 mm"
    assert describe_side(Indenter(geometry=cone, roll=math.pi)) == "+z of cone.stl, a point"
    edge = Indenter(geometry=bar, pitch=math.pi / 4)
    assert describe_side(edge) == "(0.71, 0.00, -0.71) of bar.stl, an edge 4 mm long"
    assert describe_side(Indenter(geometry=Sphere(radius=4e-3))) == "-z of the sphere, a ball"


@pytest.mark.parametrize(
    "shape", [Box(size=(2e-3, 4e-3, 8e-3)), Cylinder(radius=2e-3, height=7e-3), Sphere(radius=3e-3), None]
)
def test_size_and_depth_of_what_is_turned(shape: Shape | None, bar: Mesh) -> None:
    """Against points on its surface."""
    turn = Indenter(roll=0.4, pitch=0.9, yaw=-0.3).turn
    geometry = shape or bar
    made = {
        "box": lambda: trimesh.creation.box((2e-3, 4e-3, 8e-3)),
        "cylinder": lambda: trimesh.creation.cylinder(2e-3, 7e-3, sections=720),
        "sphere": lambda: trimesh.creation.icosphere(5, 3e-3),
    }
    points = Rotation.from_quat(turn).apply(made.get(geometry.shape, made["box"])().vertices)
    assert rotated_bounding_size(geometry, turn) == pytest.approx(np.ptp(points, axis=0), rel=1e-3)
    assert depth_below_centre(geometry, turn) == pytest.approx(-points[:, 2].min(), rel=1e-3)


def test_a_section_lies_in_its_plane_and_closes(cone: Mesh) -> None:
    pose = Pose(np.array([1e-3, 2e-3, 5e-3]), Indenter(roll=math.pi).turn)
    lines = section_lines(cone, pose, 1, 2e-3)
    assert np.ptp(lines[..., 1]) < 1e-12
    assert lines[..., 2].min() == pytest.approx(2e-3) and lines[..., 2].max() == pytest.approx(8e-3)
    assert np.ptp(lines[..., 0]) == pytest.approx(6e-3, rel=1e-2)
    ends, uses = np.unique(np.rint(lines.reshape(-1, 3) * 1e9), axis=0, return_counts=True)
    assert len(ends) and (uses % 2 == 0).all()


def test_the_pressing_side_of_a_mesh_is_said_when_a_rig_is_loaded(cone: Mesh, tmp_path: Path) -> None:
    from tacsim.config import load_rig

    words = f'scene.indenter.geometry={{"shape": "mesh", "path": "{cone.path}"}}'
    loaded = load_rig("press", overrides=[words, "scene.indenter.roll=180 deg"])
    assert any("pressing side: +z of cone.stl, a point" in note for note in loaded.notes)
