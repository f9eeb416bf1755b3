"""`tacsim press`: what its result says of edges, and the outline of a contact."""

from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage

from robot.studies.press import UNFELT, PressMotion, PressResult, press, press_report
from tacsim.config import load_sensor
from tacsim.models.scene import Box, Cylinder, Gel, Indenter, Mesh, Scene, Shape, Sphere
from tacsim.physics.failure.health import SimulationDiverged

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


def test_a_press_says_how_much_of_its_depth_the_gel_does_not_feel(tmp_path: Path) -> None:
    """A wedge of 60 degrees 1 mm deep at draft: 0.40 N, and 0.48 N with elements of 0.25 mm. A box comes out right."""
    import trimesh

    wedge = trimesh.convex.convex_hull([(x, y, z) for x in (-3, 3) for y, z in ((0, 0), (-2.9, 5), (2.9, 5))])
    wedge.export(tmp_path / "wedge.stl")
    motion = PressMotion(1e-3)
    for shape, wrong in ((Mesh(path=str(tmp_path / "wedge.stl")), True), (Box(size=(5e-3, 5e-3, 5e-3)), False)):
        scene, result = pressed("draft", motion, shape)
        told = press_report(scene, motion, result, SENSOR)["unfelt"]
        assert (told > UNFELT) == wrong and 0.0 <= told < 0.25


def test_a_press_that_does_not_fold_the_gel_says_so() -> None:
    motion = PressMotion(0.2e-3)
    scene, result = pressed("draft", motion, Sphere(radius=4e-3))
    assert press_report(scene, motion, result, SENSOR)["folded"] is False


def test_a_press_too_deep_for_the_gel_says_how_deep_it_came() -> None:
    with pytest.raises(SimulationDiverged, match=r"; it had come (\d\.\d+) mm deep, of 3\.9 mm") as error:
        pressed("draft", PressMotion(3.9e-3), Sphere(radius=4e-3))
    came = float(str(error.value).split("; it had come ")[1].split()[0])
    assert 2.0 < came < 3.9
    pressed("draft", PressMotion(0.9 * came * 1e-3), Sphere(radius=4e-3))
