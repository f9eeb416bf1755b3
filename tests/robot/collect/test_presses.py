"""A set of presses: each row is the press that it says, and a function of seed and number alone."""

from __future__ import annotations

import io
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from pyarrow import parquet

from robot.collect.collect import collect
from robot.collect.objects import CLOSED_FORMS, make_meshes
from robot.collect.presses import COLUMN_TEXTS, PressSet
from robot.studies.press import MAX_MISSED_DEPTH_SHARE, PressMotion, press
from tacsim import pose as se3
from tacsim.config import load_scene, load_sensor
from tacsim.geometry.mesh_file import load_mesh
from tacsim.geometry.shapes import shape_distance
from tacsim.interface import Pose
from tacsim.models.scene import Mesh, Scene, Sphere
from tacsim.optics.markers import rest_positions
from tests.robot.collect.small import job, rows, settings


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("made") / "set"
    collect(job(6, shear=(0.1e-3, 0.2e-3), twist=(-0.1, 0.1)), path, {}, "tacsim collect press")
    return path


def decoded(value: dict[str, Any]) -> Any:
    with Image.open(io.BytesIO(value["bytes"])) as picture:
        return np.array(picture)


def test_a_row_is_the_press_of_its_number(folder: Path) -> None:
    """Picture, height and force are those of the same press by itself, bit for bit."""
    made = settings(shear=(0.1e-3, 0.2e-3), twist=(-0.1, 0.1))
    for row in rows(folder)[3:5]:
        _, scene, motion = made.draw_press(row["index"])
        alone = press(scene, made.sensor, motion)
        assert np.array_equal(decoded(row["image"]), alone.image)
        assert np.array(row["height"], np.float32).tobytes() == alone.height.tobytes()
        assert np.array_equal(decoded(row["contact"]) == 255, alone.contact)
        assert row["normal_force"] == -alone.wrench[2] and row["shear_force"] == alone.wrench[:2].tolist()
        assert np.linalg.norm(row["shear"]) > 0.99e-4 and abs(row["twist"]) > 0


def test_pose_depth_and_contact_agree(tmp_path: Path) -> None:
    """The ball, where the row says that it is, reaches as deep as the row says, and the gel under the contact lies on
    it: half of the pixels within 0.02 mm, on elements of 1 mm, which cannot follow its rim."""
    made = job(1, scene=load_scene("press", ["preset=draft"]))
    sphere = made.settings.objects["ball"]
    assert isinstance(sphere, Sphere)
    collect(made, tmp_path / "set", {}, "x")
    (row,) = rows(tmp_path / "set")
    contact = decoded(row["contact"]) == 255
    grid = np.stack(np.meshgrid(np.arange(320) - 159.5, np.arange(240) - 119.5), axis=-1) * 0.0625e-3
    assert row["depth"] == pytest.approx(sphere.radius - row["position"][2], abs=1e-12)
    points = np.dstack([grid, -np.array(row["height"])])[contact] - row["position"]
    assert np.median(np.abs(shape_distance(sphere, points))) < 0.02e-3
    assert np.linalg.norm(grid[contact].mean(axis=0) - row["position"][:2]) < 0.1e-3
    assert row["contact_area"] == pytest.approx(contact.sum() * 0.0625e-3**2)


@pytest.mark.parametrize("pose", ["random", "centred"])
def test_the_side_that_presses_is_that_of_the_scene(pose: str) -> None:
    scene = load_scene("press", ["preset=draft", "indenter.roll=180 deg"])
    made = settings(scene=scene, pose=pose, tilt=(0.0, np.radians(5.0) if pose == "random" else 0.0))
    for index in range(4):
        _, placed, motion = made.draw_press(index)
        assert placed.indenter is not None
        turn = placed.indenter.turn if motion.turn is None else motion.turn
        own_z = se3.rotate(Pose(quaternion=turn), [0.0, 0.0, 1.0])
        assert own_z[2] < -np.cos(np.radians(5.01))


def test_flow_is_told_on_the_lattice_that_the_card_names(folder: Path) -> None:
    lattice = settings().lattice
    flow = np.array(rows(folder)[0]["flow"])
    assert flow.shape == rest_positions(lattice).shape == (14, 19, 2)
    assert "14 x 19 points (rows along y) 1 mm apart" in (folder / "README.md").read_text().replace("\n", " ")


def test_a_tilted_object_reaches_as_deep_as_it_shall() -> None:
    """A cube, tilted: its lowest corner or edge, by its corners alone (rounded edges: learn rounds by 1 mm)."""
    made = settings(tilt=(0.3, 0.3))
    _, scene, motion = made.draw_press(1)
    assert scene.indenter is not None and motion.turn is not None
    pressed = press(scene, made.sensor, motion)
    radius = scene.indenter.effective_edge_radius(scene.effective_element_size)
    corners = (np.array([4e-3, 5e-3, 5e-3]) / 2 - radius) * (2 * np.indices((2, 2, 2)).reshape(3, -1).T - 1)
    lowest = se3.transform(pressed.pose, corners)[:, 2].min() - radius
    assert lowest == pytest.approx(-motion.depth, abs=1e-9)


def test_more_options_change_no_other_draws() -> None:
    plain, more = settings(), settings(shear=(0.0, 0.3e-3), twist=(0.0, 0.2))
    for index in range(4):
        a, b = plain.draw_press(index)[2], more.draw_press(index)[2]
        assert (a.depth, a.at) == (b.depth, b.at) and np.array_equal(np.array(a.turn), np.array(b.turn))


def test_a_ball_is_in_the_picture_and_on_the_gel_and_a_larger_one_amidst() -> None:
    made = settings(objects={"ball": Sphere(radius=3e-3), "large": Sphere(radius=11e-3)})
    places = np.array([made.draw_press(index)[2].at for index in range(0, 400, 2)])
    assert np.abs(places).max(axis=0) == pytest.approx([7e-3, 4.5e-3], rel=0.03)
    assert np.allclose([made.draw_press(index)[2].at for index in range(1, 20, 2)], 0.0, atol=1e-12)


def test_the_mesh_of_a_ball_has_the_contact_of_the_ball(tmp_path: Path) -> None:
    """Of a mesh the contact is found on the grid that physics has of it."""
    from trimesh import creation

    creation.icosphere(4, 3.0).export(tmp_path / "ball.stl")
    sensor, motion = load_sensor("ideal"), PressMotion(0.5e-3, at=(1e-3, -2e-3))
    areas = []
    for geometry in (Sphere(radius=3e-3), Mesh(path=str(tmp_path / "ball.stl"))):
        scene = load_scene("press", ["preset=draft"])
        assert scene.indenter is not None
        indenter = scene.indenter.model_copy(update={"geometry": geometry})
        areas.append(press(scene.model_copy(update={"indenter": indenter}), sensor, motion).contact)
    assert (areas[0] != areas[1]).sum() < 0.05 * areas[0].sum()


def test_the_files_tell_datasets_their_types(folder: Path) -> None:
    """And the card's head tells it where they are. (`datasets` itself is not needed here.)"""
    path = folder / "data/train-00000.parquet"
    told = json.loads(parquet.read_schema(path).metadata[b"huggingface"])["info"]["features"]
    assert list(told) == list(COLUMN_TEXTS) == parquet.read_schema(path).names
    assert told["image"] == told["contact"] == {"_type": "Image"}
    assert told["object"] == {"names": ["ball", "cube"], "_type": "ClassLabel"}
    assert told["height"] == {"shape": [240, 320], "dtype": "float32", "_type": "Array2D"}
    head = (folder / "README.md").read_text().split("---\n")[1]
    assert "path: data/train-*.parquet" in head and "split: train" in head


def test_the_card_has_statistics_of_the_rows(folder: Path) -> None:
    text = (folder / "README.md").read_text()
    depths = [1e3 * row["depth"] for row in rows(folder)]
    cells = next(line for line in text.splitlines() if line.startswith("| all |")).split("|")
    assert cells[2].strip() == "6"
    assert float(cells[3].split(",")[1]) == pytest.approx(float(np.median(depths)), rel=0.01)
    assert "6 presses, 0 failed" in text


def test_a_press_whose_edge_the_gel_cannot_feel_is_told(tmp_path: Path) -> None:
    """A wedge of 60 degrees 1 mm deep at draft: its force is a sixth too small, which nothing else of its row shows."""
    import trimesh

    wedge = trimesh.convex.convex_hull([(x, y, z) for x in (-3, 3) for y, z in ((0, 0), (-2.9, 5), (2.9, 5))])
    objects = {"ball": Sphere(radius=3e-3), "wedge": Mesh(path="objects/wedge.stl")}
    made = job(2, objects=objects, scene=load_scene("press", ["preset=draft"]), depth=(1e-3, 1e-3), pose="centred")
    collect(made, tmp_path / "set", {"objects/wedge.stl": wedge.export(file_type="stl")}, "x")
    ball, edge = rows(tmp_path / "set")
    assert ball["unfelt"] < MAX_MISSED_DEPTH_SHARE < edge["unfelt"] < 0.25 and not (ball["folded"] or edge["folded"])
    assert "1 with forces too small" in (tmp_path / "set/README.md").read_text()


def test_a_press_that_fails_is_a_row_of_failures_and_the_set_goes_on(tmp_path: Path) -> None:
    """A pin between the contact points of a coarse mesh is refused by the world that it is pressed in."""
    objects = {"ball": Sphere(radius=3e-3), "pin": Sphere(radius=0.1e-3)}
    done = collect(job(5, objects=objects), tmp_path / "set", {}, "x")
    lines = [json.loads(line) for line in (tmp_path / "set/failures.jsonl").read_text().splitlines()]
    assert [line["index"] for line in lines] == [1, 3] and done.made == 3
    assert all("fits between the gel's contact points" in line["reason"] for line in lines)
    assert [row["index"] for row in rows(tmp_path / "set")] == [0, 2, 4]
    again = collect(job(5, objects=objects), tmp_path / "set", {}, "x")
    assert again.made == 0 and list(again.failures) == [1, 3]


def test_twenty_shapes_are_closed_meshes_that_a_gel_has_room_for(tmp_path: Path) -> None:
    made = make_meshes()
    assert len(CLOSED_FORMS) + len(made) == 20
    for name, mesh in made.items():
        mesh.export(tmp_path / f"{name}.stl")
        loaded = load_mesh(tmp_path / f"{name}.stl", 1e-3)
        assert mesh.volume > 0 and 2e-3 < loaded.extents[:2].max() < 10e-3


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"depth": (0.5e-3, 0.1e-3)}, "depth ranges from 0.0005 to 0.0001: give the smaller number first"),
        ({"depth": (0.1e-3, 4e-3)}, "depth is 4 mm; it must be above 0 and below the gel's 4 mm"),
        ({"tilt": (0.0, math.pi)}, "at most 45 deg"),
        ({"shear": (-1e-3, 0.0)}, "shear starts at -0.001"),
        ({"scene": Scene()}, "has no indenter"),
    ],
)
def test_what_cannot_be_pressed_is_refused_at_once(given: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        PressSet.model_validate(settings().model_dump() | given)
