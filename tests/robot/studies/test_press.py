"""`tacsim press`: what its result says of edges, and the outline of a contact."""

import base64
import json
import re
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage
from scipy.spatial.transform import Rotation

from robot.studies.press import (
    MAX_MISSED_DEPTH_SHARE,
    PressMotion,
    PressResult,
    deepest_possible,
    force_curve,
    press,
    press_report,
    write,
)
from tacsim.config import load_sensor
from tacsim.interface import Pose
from tacsim.models.scene import Box, Cylinder, Gel, Indenter, Mesh, Scene, Shape, Sphere
from tacsim.physics.failure.health import SimulationDiverged
from tacsim.physics.worlds.press import PressWorld

SENSOR = load_sensor("ideal")


def pressed(preset: str, motion: PressMotion, shape: Shape, **indenter: float) -> tuple[Scene, PressResult]:
    scene = Scene.model_validate(
        {"body": None, "preset": preset, "indenter": Indenter(geometry=shape, **indenter), "gel": Gel()}
    )
    return scene, press(scene, SENSOR, motion)


@pytest.mark.parametrize(
    ("shape", "given", "carried"),
    [
        (Cylinder(radius=2e-3, height=4e-3), {}, 0.5e-3),
        (Box(size=(5e-3, 5e-3, 1e-3)), {}, 0.25e-3),  # a quarter of its shortest side
        (Box(size=(5e-3, 5e-3, 5e-3)), {"edge_radius": 0.0}, 0.0),
        (Sphere(radius=4e-3), {}, None),
    ],
)
def test_the_result_says_how_round_edges_are(shape: Shape, given: dict[str, float], carried: float | None) -> None:
    """At draft, half of whose elements is 0.5 mm."""
    motion = PressMotion(0.2e-3)
    scene, result = pressed("draft", motion, shape, **given)
    assert press_report(scene, motion, result, SENSOR)["edge_radius"] == carried


def test_the_contact_of_a_slid_cylinder_has_no_holes() -> None:
    """Behind its edge the surface swings back by 10 µm, less than an element from the pressed rim."""
    shape = Cylinder(radius=2e-3, height=5e-3)
    _, result = pressed("standard", PressMotion(0.3e-3, (0.5e-3, 0.0)), shape, edge_radius=0.25e-3, friction=0.6)
    holes = ndimage.binary_fill_holes(result.contact) & ~result.contact
    assert not holes.any()
    assert 1.8e-3 < result.contact_radius < 2.0e-3


@pytest.mark.slow
def test_a_press_whose_surface_folds_over_has_a_picture_and_says_so() -> None:
    """A plate wider than the gel, half of it deep: the gel's rim rolls over, as that of rubber does: sooner at
    the default speed, whose force is 4 % above that at Mach 0.004."""
    motion = PressMotion(2e-3)
    scene, result = pressed("draft", motion, Box(size=(30e-3, 30e-3, 5e-3)))
    told = press_report(scene, motion, result, SENSOR)
    assert told["folded"] is True and told["settled"] and told["force"] == pytest.approx(1.038 * 195.1, rel=0.02)
    inner = result.height[:, 20:-20]  # the rest is the rim
    assert inner.min() > 1.9e-3 and inner.max() < 2.1e-3
    assert np.isfinite(result.height).all() and result.contact[:, 20:-20].mean() > 0.9
    assert np.median(result.image) == pytest.approx(128, abs=40)  # a flat face, lit as one


@pytest.mark.slow
def test_a_press_says_how_much_of_its_depth_the_gel_does_not_feel(tmp_path: Path) -> None:
    """A wedge of 60 degrees 1 mm deep at draft: 0.40 N, and 0.48 N with elements of 0.25 mm. A box comes out right."""
    import trimesh

    wedge = trimesh.convex.convex_hull([(x, y, z) for x in (-3, 3) for y, z in ((0, 0), (-2.9, 5), (2.9, 5))])
    wedge.export(tmp_path / "wedge.stl")
    motion = PressMotion(1e-3)
    for shape, wrong in ((Mesh(path=str(tmp_path / "wedge.stl")), True), (Box(size=(5e-3, 5e-3, 5e-3)), False)):
        scene, result = pressed("draft", motion, shape)
        told = press_report(scene, motion, result, SENSOR)["unfelt"]
        assert (told > MAX_MISSED_DEPTH_SHARE) == wrong and 0.0 <= told < 0.25


def test_a_press_that_does_not_fold_the_gel_says_so() -> None:
    motion = PressMotion(0.2e-3)
    scene, result = pressed("draft", motion, Sphere(radius=4e-3))
    assert press_report(scene, motion, result, SENSOR)["folded"] is False


def test_a_press_too_deep_for_the_gel_says_how_deep_it_came() -> None:
    with pytest.raises(SimulationDiverged, match=r"; it had reached (\d\.\d+) mm of 3\.9 mm depth") as error:
        pressed("draft", PressMotion(3.9e-3), Sphere(radius=4e-3))
    came = float(str(error.value).split("; it had reached ")[1].split()[0])
    assert 2.0 < came < 3.9
    pressed("draft", PressMotion(0.9 * came * 1e-3), Sphere(radius=4e-3))


BAR = (3.0, 4.0, 6.0)  # [mm]


@pytest.mark.slow
@pytest.mark.parametrize(("angles", "size"), [({"pitch": 90.0}, (6, 4, 3)), ({"roll": -90.0, "yaw": 90.0}, (6, 3, 4))])
def test_a_mesh_that_is_turned_presses_as_a_box_and_as_a_mesh_saved_turned(
    angles: dict[str, float], size: tuple[float, float, float], tmp_path: Path
) -> None:
    import trimesh

    bar = trimesh.creation.box(BAR)
    bar.export(tmp_path / "bar.stl")
    turned = Indenter.model_validate({name: f"{angle} deg" for name, angle in angles.items()})
    bar.vertices = Rotation.from_quat(turned.turn).apply(bar.vertices)
    bar.export(tmp_path / "turned.stl")
    motion = PressMotion(0.4e-3)
    radians = {name: float(np.radians(angle)) for name, angle in angles.items()}
    force = {
        "turned": pressed("draft", motion, Mesh(path=str(tmp_path / "bar.stl")), **radians)[1].wrench[2],
        "saved turned": pressed("draft", motion, Mesh(path=str(tmp_path / "turned.stl")))[1].wrench[2],
        "box": pressed("draft", motion, Box(size=tuple(1e-3 * side for side in size)), edge_radius=0.0)[1].wrench[2],
        "as it lies": pressed("draft", motion, Mesh(path=str(tmp_path / "bar.stl")))[1].wrench[2],
    }
    assert force["turned"] == pytest.approx(force["saved turned"], rel=2e-3)
    assert force["turned"] == pytest.approx(force["box"], rel=0.02)
    assert abs(force["as it lies"] / force["turned"] - 1) > 0.2


@pytest.mark.slow
def test_a_depth_that_is_possible_is_found_for_one_that_is_not() -> None:
    scene = Scene.model_validate({"body": None, "preset": "draft", "indenter": Indenter(geometry=Sphere(radius=4e-3))})
    motion = PressMotion(3.9e-3)
    with pytest.raises(SimulationDiverged) as failed:
        press(scene, SENSOR, motion)
    depth = deepest_possible(scene, motion, failed.value)
    assert depth is not None and 2e-3 < depth < 3.9e-3
    press(scene, SENSOR, PressMotion(depth))


def test_a_move_that_fails_says_how_far_it_came() -> None:
    scene = Scene.model_validate({"body": None, "preset": "draft", "indenter": Indenter(geometry=Sphere(radius=4e-3))})
    world = PressWorld(scene)
    start = world.pose("indenter")
    before = world.snapshot()
    words = r"^'indenter' moved (\d\.\d+) mm of the 3\.[789] mm .* about"
    with pytest.raises(SimulationDiverged, match=words) as failed:  # noqa: PT012
        for depth in (3.7e-3, 3.8e-3, 3.9e-3):  # which of these fail depends on the processor, by rounding
            world.restore(before)
            world.move({"indenter": Pose(start.position - [0.0, 0.0, depth], start.quaternion)})
    possible = float(str(failed.value).split("no more than about ")[1].split()[0])
    world.move({"indenter": Pose(start.position - [0.0, 0.0, 1e-3 * possible], start.quaternion)})


@pytest.mark.slow
def test_page_of_a_press_has_picture_height_and_force_over_depth(tmp_path: Path) -> None:
    motion = PressMotion(0.4e-3)
    scene, result = pressed("draft", motion, Sphere(radius=4e-3))
    curve = force_curve(scene, motion)
    depths, forces = np.array(curve).T
    assert depths == pytest.approx(np.linspace(0, 0.4e-3, 7)[1:])
    assert (np.diff(forces) > 0).all() and np.diff(forces)[-1] > np.diff(forces)[0]  # a ball: stiffer with depth
    assert forces[-1] == pytest.approx(-result.wrench[2], rel=0.01)  # as the press in one motion
    write(tmp_path, result, press_report(scene, motion, result, SENSOR), scene, SENSOR, curve)
    page = (tmp_path / "press.html").read_text()
    assert base64.b64encode((tmp_path / "rgb.png").read_bytes()).decode() in page
    assert page.count("<circle") == 7 and f"{forces[-1]:.3g} N" in page and "0.4 mm" in page
    (text,) = re.findall(r'<script type="application/json" id="data">(.*?)</script>', page, re.DOTALL)
    surface = json.loads(text)
    heights = np.array(surface["depths"]).reshape(surface["rows"], surface["columns"])
    assert heights.max() == pytest.approx(1e3 * result.height.max(), rel=0.03)
    row, column = np.unravel_index(heights.argmax(), heights.shape)
    assert abs(row - surface["rows"] / 2) <= 1 and abs(column - surface["columns"] / 2) <= 1
    assert not re.search(r"https?://|fetch\(", page) and len(page) < 1_000_000


@pytest.mark.slow
def test_force_curve_ends_before_a_depth_that_is_not_possible() -> None:
    scene = Scene.model_validate(
        {"body": None, "preset": "draft", "indenter": Indenter(geometry=Sphere(radius=4e-3)), "gel": Gel()}
    )
    curve = force_curve(scene, PressMotion(3.9e-3))
    assert 0 < len(curve) < 6
