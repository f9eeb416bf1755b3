"""Motion at a constant normal load."""

import math
from collections.abc import Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from tacsim.interface import Pose
from tacsim.models.material import BodyMaterial
from tacsim.models.scene import Body, Box, Cylinder, Gel, Indenter, Scene, Sphere
from tacsim.physics.motion.controller import ForceReading, run_motion
from tacsim.physics.motion.load import LoadNotReached, move_at_constant_load
from tacsim.physics.motion.path import Path, plan_path
from tacsim.physics.motion.tuning import MIN_FORCE_SHARE
from tacsim.physics.world import World, make_world
from tacsim.physics.worlds.press import PressWorld


def press() -> PressWorld:
    return PressWorld(Scene(body=None, indenter=Indenter(geometry=Sphere(radius=4e-3))))


def by(world: World, name: str, shift: tuple[float, float, float]) -> dict[str, Pose]:
    pose = world.pose(name)
    return {name: Pose(pose.position + shift, pose.quaternion)}


def load(world: World, name: str) -> float:
    return -float(world.wrench(name)[2])


def test_a_load_is_found_from_without_contact_and_given_up_again() -> None:
    world = press()
    stats = world.move({}, loads={"lower": 0.3})
    assert stats.settled
    assert load(world, "lower") == pytest.approx(0.3, rel=0.01)
    assert stats.load_error == pytest.approx(abs(load(world, "lower") - 0.3), abs=1e-9)
    pressed = world.pose("lower").position
    assert pressed[2] > 0.2e-3 and np.abs(pressed[:2]).max() == 0  # came up to the indenter, and only that
    world.move({}, loads={"lower": 0.0})
    tolerance = 1e-2 * MIN_FORCE_SHARE * 0.145 * 4.0**2  # of what counts as none
    assert load(world, "lower") == pytest.approx(0.0, abs=tolerance)
    assert world.pose("lower").position[2] < pressed[2]


@pytest.mark.slow
@pytest.mark.parametrize("physics", ["hybrid", pytest.param("seed", marks=pytest.mark.cpu)])
def test_the_load_stays_through_a_shear(physics: str) -> None:
    body = Body(geometry=Box(size=(4e-3, 4e-3, 3e-3)), material=BodyMaterial(yield_stress=30e3))
    gel = Gel(size=(8e-3, 8e-3, 3e-3))
    world = make_world(Scene(body=body, gel=gel, physics=physics))  # type: ignore[arg-type]
    world.move({}, loads={"upper": 0.3})
    pose = world.pose("upper")
    stats = world.move(by(world, "upper", (0.4e-3, 0, 0)), loads={"upper": 0.3})
    assert stats.settled and load(world, "upper") == pytest.approx(0.3, rel=0.02)
    assert world.pose("upper").position[0] == pytest.approx(pose.position[0] + 0.4e-3, abs=1e-9)


@pytest.mark.parametrize(
    ("legs", "drags"),
    [
        ([(1.2e-3, 0.0), (0.6e-3, 0.0)], [(0.765, 0.0), (0.782, 0.0)]),
        ([(1.2e-3, 0.0), (-0.3e-3, 0.8e-3)], [(0.765, 0.0), (0.178, 0.739)]),
    ],
)
def test_a_load_that_is_held_while_a_ball_is_slid_leaves_its_drag(
    legs: list[tuple[float, float]], drags: list[tuple[float, float]]
) -> None:
    """Corrections that let go of the contact took a third of it. Drags: over the load, at Mach 0.001."""
    ball = Indenter(geometry=Sphere(radius=4e-3), friction=0.7)
    world = PressWorld(Scene(preset="draft", body=None, indenter=ball))
    world.move(by(world, "indenter", (0, 0, -0.6e-3)))  # 0.5 mm deep
    for leg, drag in zip(legs, drags, strict=True):
        stats = world.move(by(world, "indenter", (*leg, 0.0)), loads={"lower": 0.3})
        assert stats.settled and load(world, "lower") == pytest.approx(0.3, rel=0.01)
        assert stats.substeps < 1400  # 1,460 and 1,340 when each piece was corrected
        felt = world.wrench("lower")
        assert np.hypot(*(felt[:2] / -felt[2] - drag)) < 0.02 * 0.7


@pytest.mark.parametrize("nearer", [-0.4e-3, -0.1e-3, 0.2e-3])
def test_a_target_that_is_nearer_or_further_does_not_let_go_of_the_contact(nearer: float) -> None:
    """What of the path goes along the sensor's z is the load's: a policy may name any height."""
    drags = []
    for off in (0.0, nearer):
        world = PressWorld(
            Scene(preset="draft", body=None, indenter=Indenter(geometry=Sphere(radius=4e-3), friction=0.7))
        )
        world.move({}, loads={"lower": 0.2})
        for _ in range(2):
            world.move(by(world, "indenter", (0.5e-3, 0.0, -off)), loads={"lower": 0.2})
        drags.append(world.wrench("lower")[:2] / load(world, "lower"))
    assert np.abs(drags[0]).max() > 0.6
    assert np.abs(drags[1] - drags[0]).max() < 0.01 * 0.7


def test_a_body_that_is_dragged_at_a_load_is_dragged_alike_at_any_height() -> None:
    drags = []
    for off in (0.0, 0.15e-3):
        body = Body(geometry=Box(size=(4e-3, 4e-3, 3e-3)), material=BodyMaterial(yield_stress=None))
        world = make_world(Scene(preset="draft", body=body, gel=Gel(size=(8e-3, 8e-3, 3e-3))))
        world.move({}, loads={"upper": 0.3})
        world.move(by(world, "upper", (0.4e-3, 0.0, off)), loads={"upper": 0.3})
        world.move(by(world, "upper", (0.3e-3, 0.0, off)), loads={"upper": 0.3})
        drags.append(world.wrench("upper")[:2] / load(world, "upper"))
    assert np.abs(drags[0]).max() > 0.3
    assert np.abs(drags[1] - drags[0]).max() < 0.02


def test_both_sensors_loaded_are_carried_together() -> None:
    """What both do is no approach: the body goes along, up and down with them."""
    body = Body(geometry=Box(size=(4e-3, 4e-3, 3e-3)), material=BodyMaterial(yield_stress=None))
    world = make_world(Scene(preset="draft", body=body, gel=Gel(size=(8e-3, 8e-3, 3e-3))))
    world.move({}, loads={"upper": 0.3, "lower": 0.3})
    before = world.truth()
    up = {**by(world, "upper", (0, 0, 0.5e-3)), **by(world, "lower", (0, 0, 0.5e-3))}
    world.move(up, loads={"upper": 0.3, "lower": 0.3})
    after = world.truth()
    assert before is not None and after is not None
    assert after.points[:, 2].mean() - before.points[:, 2].mean() == pytest.approx(0.5e-3, abs=0.05e-3)


@pytest.mark.parametrize(("load_", "drag"), [(0.2, 1.00), (0.1, 0.98), (0.05, 0.98)])
def test_a_load_that_is_lowered_after_a_slide_keeps_the_drag(load_: float, drag: float) -> None:
    """Drags: of the friction, at Mach 0.001. In lifts at full speed it fell to 0.75."""
    indenter = Indenter(geometry=Cylinder(radius=3e-3, height=4e-3), friction=0.5)
    world = PressWorld(Scene(preset="draft", body=None, indenter=indenter))
    world.move({}, loads={"lower": 1.0})
    world.move(by(world, "indenter", (0.8e-3, 0.0, 0.0)), loads={"lower": 1.0})
    assert world.move({}, loads={"lower": load_}).settled
    felt = world.wrench("lower")
    assert abs(felt[0] / felt[2]) / 0.5 == pytest.approx(drag, abs=0.04)


def test_a_load_that_is_lowered_too_far_is_found_again() -> None:
    """On a stiff gel a correction by the stiffness of the higher load ends beyond contact."""
    gel = {"material": {"youngs_modulus": 1e6, "poisson_ratio": 0.48}}
    indenter = Indenter(geometry=Cylinder(radius=3e-3, height=4e-3), friction=0.5)
    world = PressWorld(Scene.model_validate({"preset": "draft", "body": None, "gel": gel, "indenter": indenter}))
    world.move({}, loads={"lower": 0.3})
    world.move({}, loads={"lower": 0.003})
    assert load(world, "lower") == pytest.approx(0.003, rel=0.05)


def test_a_load_on_a_sharp_edge_that_is_slid_has_not_settled() -> None:
    """Though each piece of the path is shorter than what an edge may be slid."""
    box = Indenter(geometry=Box(size=(5e-3, 5e-3, 4e-3)), friction=0.7, edge_radius=0.0)
    world = PressWorld(Scene(preset="draft", body=None, indenter=box))
    assert world.move({}, loads={"lower": 0.7}).settled
    assert world.move(by(world, "indenter", (0.4e-3, 0.0, 0.0)), loads={"lower": 0.7}).settled
    assert not world.move(by(world, "indenter", (0.4e-3, 0.0, 0.0)), loads={"lower": 0.7}).settled
    assert "catches" in world.unsettled_reason


def test_a_load_out_of_reach_is_an_error_and_nothing_has_moved() -> None:
    world = press()
    world.move(by(world, "indenter", (0, 0, 3e-3)))
    before = world.snapshot()
    with pytest.raises(LoadNotReached, match=r"'lower' does not reach a load of 0\.3 N: 0 N after \+2\.5 mm"):
        world.move({}, loads={"lower": 0.3})
    after = world.snapshot()
    assert all(before[name].tobytes() == after[name].tobytes() for name in before)


def test_loads_that_make_no_sense_are_refused() -> None:
    world = press()
    with pytest.raises(KeyError, match="no sensor 'indenter' to hold a load"):
        world.move({}, loads={"indenter": 0.3})
    with pytest.raises(ValueError, match="load of 'lower' is -1 N"):
        world.move({}, loads={"lower": -1.0})


def test_the_sensor_that_went_too_far_is_named() -> None:
    """Beside one that is wrong too, but in place: it sticks, and swings about its load."""
    scene, rest = Scene(), ForceReading(np.zeros((2, 3)), np.zeros((2, 3)), 1.0, 0.0, 0)
    end = {"lower": Pose(), "upper": Pose()}

    class Stuck:
        def __init__(self) -> None:
            self.scene, self.sensors = scene, tuple(end)

        def wrench(self, name: str) -> NDArray[np.float64]:
            force = 0.4 + math.copysign(0.1, end[name].position[2]) if name == "lower" else 0.0
            return np.array([0.0, 0.0, -force, 0.0, 0.0, 0.0])

        def plan(self, start: Sequence[Pose], goal: Sequence[Pose]) -> Path:
            return plan_path(start, goal, 0.03, 0.4, 10.0, 4.0)

    motion = move_at_constant_load(Stuck(), dict(end), end, {"lower": 0.4, "upper": 0.3}, 1, balanced=False)
    with pytest.raises(LoadNotReached, match=r"'upper' does not reach a load of 0\.3 N: 0 N after \+2\.5 mm"):
        run_motion(motion, lambda launch: [rest])


def test_a_path_that_would_take_for_ever_is_refused_with_a_load_too() -> None:
    world = press()
    before = world.snapshot()
    with pytest.raises(ValueError, match="are the targets in metres"):
        world.move(by(world, "indenter", (500.0, 0, 0)), loads={"lower": 0.3})
    assert all(a.tobytes() == before[name].tobytes() for name, a in world.snapshot().items())
