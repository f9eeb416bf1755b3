"""`tacsim press`: what its result says of edges, and the outline of a contact."""

import pytest
from scipy import ndimage

from robot.studies.press import PressMotion, PressResult, press, press_report
from tacsim.config import load_sensor
from tacsim.models.scene import Box, Cylinder, Gel, Indenter, Scene, Shape, Sphere

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
