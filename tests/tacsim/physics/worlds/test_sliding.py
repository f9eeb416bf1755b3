"""What is dragged over a gel, a rigid indenter or a body: friction at the default speed, and what is left of it."""

import math
from pathlib import Path

import numpy as np
import pytest
import trimesh

from tacsim.interface import Pose
from tacsim.models.material import BodyMaterial
from tacsim.models.scene import Body, Box, Cylinder, Gel, Indenter, Mesh, Scene, Shape, Sphere
from tacsim.physics.world import make_world
from tacsim.physics.worlds.press import PressWorld
from tests.tacsim.physics.worlds.pressing import move, world


def slide(w: PressWorld, by: float, most: int = 1000) -> float:
    """Drags the indenter by `by` [m]; the ratio of the forces then. It has settled with at most so many substeps."""
    pose = w.pose("indenter")
    stats = w.move({"indenter": Pose(pose.position + [by, 0, 0], pose.quaternion)})
    assert stats.settled and stats.substeps <= most, stats
    force = w.wrench("lower")
    return float(force[0] / -force[2])


def pressed_ball(friction: float, preset: str, deep: float = 0.5e-3) -> PressWorld:
    """A ball of 4 mm radius pressed into the default gel at the default speed and tolerance."""
    w = world(Sphere(radius=4e-3), friction, 1e-2, preset=preset, gel=Gel())
    move(w, (0, 0, -deep - 0.1e-3))
    return w


@pytest.mark.slow
@pytest.mark.parametrize(
    ("preset", "friction", "ratio"),
    [
        ("standard", 0.3, 0.32), ("standard", 0.6, 0.647), ("standard", 1.0, 1.098), ("standard", 1.5, 1.657),
        ("draft", 0.3, 0.32), ("draft", 0.6, 0.663), ("draft", 1.0, 1.147), ("draft", 1.5, 1.674),
    ],
)  # fmt: skip
def test_a_slid_ball_is_dragged_by_all_its_friction_at_the_default_speed(
    preset: str, friction: float, ratio: float
) -> None:
    """Ratios: of the contact that an axisymmetric finite-element solver (second order, neo-Hookean, 0.2 mm elements)
    finds under this ball, 0.5 mm deep, where it slides everywhere. At draft, with much friction, of the same mesh at
    Mach 0.003: it lies 2.5 and 4.5 % above, since an element is as wide as the contact. At 1.5, where it ploughs: of
    the same mesh at Mach 0.001."""
    assert slide(pressed_ball(friction, preset), 2e-3) == pytest.approx(ratio, rel=0.02)


@pytest.mark.slow
def test_a_steep_slide_in_two_is_one_and_nothing_shakes_apart() -> None:
    """At mu = 1.5 corners of elements get narrow after 1.6 mm; 1.302 and 1.656 at Mach 0.001. They shook apart, and a
    motion so retried ended at 1.60, one that came to rest again at 1.38."""
    w = pressed_ball(1.5, "standard")
    for ratio in (1.302, 1.656):
        pose = w.pose("indenter")
        stats = w.move({"indenter": Pose(pose.position + [1e-3, 0, 0], pose.quaternion)})
        force = w.wrench("lower")
        assert force[0] / -force[2] == pytest.approx(ratio, rel=0.03)
        assert stats.settled and stats.retries == 0


def test_a_short_slide_ends_as_a_slow_one() -> None:
    """0.3 and 0.6 mm at draft, where a part of the contact still sticks: the same mesh at Mach 0.001."""
    for friction, ratios in ((0.3, (0.318, 0.325)), (0.6, (0.424, 0.651)), (1.0, (0.457, 0.815))):
        w = pressed_ball(friction, "draft")
        assert [slide(w, 0.3e-3), slide(w, 0.3e-3)] == pytest.approx(ratios, rel=0.02)


@pytest.mark.parametrize(
    ("shape", "friction", "way", "ratio"),
    [
        (Sphere(radius=6e-3), 0.8, (0.6e-3, 0.0, 0.3e-3), 0.731),
        (Cylinder(radius=2.5e-3, height=5e-3), 0.6, (1e-3, 0.0, 0.4e-3), 0.605),
        (Box(size=(4e-3, 4e-3, 4e-3)), 0.8, (1e-3, 1e-3, 0.5e-3), 0.779),
        (Sphere(radius=3e-3), 1.5, (1.5e-3, 0.0, 0.8e-3), 0.824),
    ],
)
def test_what_is_pressed_in_while_it_slides_is_dragged_as_slowly(
    shape: Shape, friction: float, way: tuple[float, float, float], ratio: float
) -> None:
    """One oblique motion from above the gel, at draft; ratios: the same at an eighth of the speed. It ended 3 to 9 %
    lower, settled: friction's limit lagged behind the pressure."""
    w = world(shape, friction, 1e-2, preset="draft", gel=Gel(), indenter=Indenter(geometry=shape, friction=friction))
    x, y, deep = way
    stats = w.move({"indenter": Pose(w.pose("indenter").position + [x, y, -deep - 0.1e-3])})
    force = w.wrench("lower")
    assert stats.settled and math.hypot(force[0], force[1]) / -force[2] == pytest.approx(ratio, rel=0.015)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("yield_stress", "by", "lateral"),
    [
        pytest.param(
            20e3, (0.6e-3, 0.0, 0.4e-3), 0.1689, marks=pytest.mark.xfail(strict=True, reason="2.1 % low, settled")
        ),
        (None, (0.6e-3, 0.0, 0.4e-3), 0.311),
        (None, (0.3e-3, 0.3e-3, 0.3e-3), 0.2522),
    ],
)
def test_a_body_that_is_closed_on_while_it_is_sheared_is_dragged_as_slowly(
    yield_stress: float | None, by: tuple[float, float, float], lateral: float
) -> None:
    """A cube between gels, at draft, both sensors in one motion from touch; forces [N]: the same at an eighth of the
    speed. They ended 12 to 15 % lower, settled."""
    material = {"youngs_modulus": 0.5e6, **({} if yield_stress is None else {"poisson_ratio": 0.45})}
    body = Body(geometry=Box(size=(6e-3, 6e-3, 5e-3)), material=BodyMaterial(yield_stress=yield_stress, **material))
    friction = 0.8 if by[1] else 0.4
    w = make_world(Scene(body=body, preset="draft", friction={"lower": friction, "upper": friction}))
    truth = w.truth()
    assert truth is not None
    gap = float(w.pose("upper").position[2]) - truth.height
    for way in ((0.0, 0.0, gap / 2), by):
        ways = {"upper": np.multiply(way, (1, 1, -1)), "lower": np.multiply(way, (-1, -1, 1))}
        stats = w.move({name: Pose(w.pose(name).position + way, w.pose(name).quaternion) for name, way in ways.items()})
    force = w.wrench("upper")
    assert stats.settled and math.hypot(force[0], force[1]) == pytest.approx(lateral, rel=0.02)


@pytest.mark.parametrize(
    ("shape", "friction"),
    [
        (Box(size=(4e-3, 4e-3, 4e-3)), 0.3),
        (Box(size=(4e-3, 4e-3, 4e-3)), 0.6),
        (Box(size=(4e-3, 4e-3, 4e-3)), 1.0),
        (Cylinder(radius=2e-3, height=4e-3), 1.0),
        (Cylinder(radius=2e-3, height=4e-3), 0.6),
    ],
)
def test_what_has_edges_ends_a_slide_as_a_slow_one(shape: Shape, friction: float) -> None:
    """0.5 mm at draft, against the same mesh at a sixth of the speed."""
    ratios = []
    for settling in ({}, {"mach": 0.003, "tolerance": 1e-3, "max_substeps": 500}):
        w = world(shape, friction, preset="draft", gel=Gel(), settling=settling)
        w.move({"indenter": Pose(w.pose("indenter").position - [0, 0, 0.4e-3])})
        ratios.append(slide(w, 0.5e-3, 3000))
    assert ratios[0] == pytest.approx(ratios[1], rel=0.02)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("shape", "friction", "by"),
    [
        (Cylinder(radius=2e-3, height=4e-3), 0.3, 1.37e-3),
        (Cylinder(radius=2e-3, height=4e-3), 0.6, 1.23e-3),
        (Cylinder(radius=2e-3, height=4e-3), 1.0, 2e-3),
        (Box(size=(4e-3, 4e-3, 4e-3)), 0.3, 1.1e-3),
        (Box(size=(4e-3, 4e-3, 4e-3)), 0.6, 1.66e-3),
        (Box(size=(4e-3, 4e-3, 4e-3)), 1.0, 2e-3),
    ],
)
def test_edges_as_the_mesh_carries_them_end_a_long_slide_as_a_slow_one(
    shape: Shape, friction: float, by: float
) -> None:
    """At draft, against a sixth of the speed; sharp edges catch on the mesh and end up to 50 % off."""
    ratios = []
    for settling in ({}, {"mach": 0.003, "tolerance": 1e-3, "max_substeps": 500}):
        indenter = Indenter(geometry=shape, friction=friction)
        w = world(shape, friction, preset="draft", gel=Gel(), settling=settling, indenter=indenter)
        w.move({"indenter": Pose(w.pose("indenter").position - [0, 0, 0.4e-3])})
        ratios.append(slide(w, by, 5000))
    assert ratios[0] == pytest.approx(ratios[1], rel=0.02)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("friction", "deep", "by", "ratio"), [(1.5, 0.3e-3, 2e-3, 1.639), (1.2, 0.4e-3, 1.9e-3, 1.376)]
)
def test_walls_with_much_friction_end_a_long_slide_as_a_slow_one(
    friction: float, deep: float, by: float, ratio: float
) -> None:
    """A cylinder R 2 mm at standard; ratios: at Mach 0.0025. They ended 2.9 and 2.2 % lower."""
    cylinder = Indenter(geometry=Cylinder(radius=2e-3, height=4e-3), friction=friction)
    w = world(cylinder.geometry, tolerance=1e-2, preset="standard", gel=Gel(), indenter=cylinder)
    move(w, (0, 0, -deep - 0.1e-3))
    assert slide(w, by, 2500) == pytest.approx(ratio, rel=0.02)


@pytest.mark.parametrize(
    ("edge_radius", "friction", "by", "settled"),
    [(0.0, 0.6, 0.5e-3, True), (0.0, 0.6, 0.6e-3, False), (0.5e-3, 0.6, 0.6e-3, True), (0.0, 0.0, 0.6e-3, True)],
)
def test_a_slide_by_an_edge_that_catches_has_not_settled(
    edge_radius: float, friction: float, by: float, settled: bool
) -> None:
    """At draft, where half an element is 0.5 mm."""
    shape = Cylinder(radius=2e-3, height=4e-3)
    w = world(shape, friction, 1e-2, preset="draft", gel=Gel(), edge_radius=edge_radius)
    move(w, (0, 0, -0.4e-3))
    pose = w.pose("indenter")
    stats = w.move({"indenter": Pose(pose.position + [by, 0, 0], pose.quaternion)})
    assert stats.residual <= 1e-2 and stats.settled == settled
    assert w.move({}).settled == settled  # held on, it is where it has caught


@pytest.mark.parametrize(
    ("shape", "friction", "by", "ratios"),
    [
        (Cylinder(radius=2e-3, height=4e-3), 0.7, (1e-3, 0.0), (0.7571, 0.2889)),
        (Box(size=(5e-3, 3e-3, 4e-3)), 0.6, (1.039e-3, 0.6e-3), (0.6624, 0.1209)),
    ],
)
def test_a_slide_and_less_than_half_of_it_back_end_as_slow_ones(
    shape: Shape, friction: float, by: tuple[float, float], ratios: tuple[float, float]
) -> None:
    """At draft; ratios: the same at Mach 0.002. Where the limit of friction followed the pressure no quicker than at a
    friction of 1.5, the second was 2 to 2.5 % low, settled."""
    indenter = Indenter(geometry=shape, friction=friction)
    w = world(shape, friction, 1e-2, preset="draft", gel=Gel(), indenter=indenter)
    move(w, (0, 0, -0.5e-3))
    found = []
    for share in (1.0, -0.4):
        stats = w.move({"indenter": Pose(w.pose("indenter").position + [share * by[0], share * by[1], 0])})
        force = w.wrench("lower")
        assert stats.settled
        found.append(math.hypot(force[0], force[1]) / -force[2])
    assert found == pytest.approx(ratios, rel=0.015)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("preset", "shape", "friction", "deep", "ways", "ratios"),
    [
        ("draft", Sphere(radius=5e-3), 0.4, 0.6e-3, ((0.0, 1.3e-3), (0.7e-3, 0.0)), (0.4119, 0.1419)),
        ("draft", Sphere(radius=4e-3), 0.7, 0.5e-3, ((1e-3, 0.0), (-0.3e-3, 0.7e-3)), (0.187, 0.724)),
        ("draft", Box(size=(6e-3, 3.2e-3, 4e-3)), 0.38, 0.5e-3, ((0.0, 1.7e-3), (-1.3e-3, 0.0)), (-0.4467, 0.0872)),
        ("draft", Cylinder(radius=2.5e-3, height=5e-3), 0.5, 0.4e-3, ((0.0, 1.3e-3), (1e-3, 0.0)), (0.5077, 0.1461)),
        ("standard", Sphere(radius=5e-3), 0.3, 0.6e-3, ((0.0, 0.9e-3), (0.5e-3, 0.0)), (0.3039, 0.1063)),
    ],
)
def test_a_slide_that_turns_is_dragged_in_the_direction_of_a_slow_one(
    preset: str, shape: Shape, friction: float, deep: float, ways: tuple[tuple[float, float], ...],
    ratios: tuple[float, float],
) -> None:  # fmt: skip
    """Ratios of the drag along x and y to the normal force after the second leg: the same at Mach 0.001. The drag was
    as long, but pointed 2 to 3 degrees behind, 4 to 6 % of it across."""
    indenter = Indenter(geometry=shape, friction=friction)
    w = world(shape, friction, 1e-2, preset=preset, gel=Gel(), indenter=indenter)
    move(w, (0, 0, -deep - 0.1e-3))
    for x, y in ways:
        stats = w.move({"indenter": Pose(w.pose("indenter").position + [x, y, 0])})
        assert stats.settled
    force = w.wrench("lower")
    assert math.dist(force[:2] / -force[2], ratios) < 0.02 * math.hypot(*ratios)


@pytest.mark.parametrize(("friction", "by", "settled"), [(1.1, 2.1e-3, False), (1.1, 2e-3, True), (1.0, 2.1e-3, True)])
def test_a_long_slide_with_much_friction_has_not_settled(friction: float, by: float, settled: bool) -> None:
    """The gel is 4 mm thick. Further on it lets go in snaps, and ends with 2 to 17 % more or less drag than a slow one
    in one of five slides of balls."""
    w = pressed_ball(friction, "draft")
    stats = w.move({"indenter": Pose(w.pose("indenter").position + [by, 0, 0])})
    assert stats.residual <= 1e-2 and stats.settled == settled


def test_what_is_lifted_in_steps_after_a_slide_keeps_its_drag() -> None:
    """Of the friction, after each lift, at Mach 0.001; at full speed it was 0.97, 0.88, 0.74."""
    w = world(Cylinder(radius=3e-3, height=4e-3), 0.5, 1e-2, preset="draft", gel=Gel(), edge_radius=0.5e-3)
    move(w, (0, 0, -0.45e-3))
    move(w, (0.8e-3, 0, 0))
    for lift, drag in ((0.1e-3, 1.041), (0.1e-3, 1.017), (0.08e-3, 1.004)):
        move(w, (0, 0, lift))
        force = w.wrench("lower")
        assert abs(force[0] / force[2]) / 0.5 == pytest.approx(drag, abs=0.02)


def test_catching_edge_is_reported_after_reversed_slide() -> None:
    """It never comes far from where it touched, but each slide moves the points that hang on it."""
    w = world(Box(size=(5e-3, 5e-3, 4e-3)), 0.6, 1e-2, preset="draft", gel=Gel(), edge_radius=0.0)
    move(w, (0, 0, -0.4e-3))
    told = []
    for by in (0.4e-3, -0.4e-3):
        pose = w.pose("indenter")
        told.append(w.move({"indenter": Pose(pose.position + [by, 0, 0], pose.quaternion)}).settled)
    assert told == [True, False]
    pose = w.pose("indenter")
    w.move({"indenter": Pose(pose.position + [0, 0, 1e-3], pose.quaternion)})  # off the gel, it starts anew
    assert w.move({"indenter": Pose(pose.position, pose.quaternion)}).settled


@pytest.mark.slow
def test_many_small_slides_that_come_as_far_have_not_settled_either() -> None:
    """How far it is from where it came to the gel counts, and a snapshot knows that; lifted, it begins anew."""
    w = pressed_ball(1.1, "draft")
    for settled in (True, True, True, False):
        stats = w.move({"indenter": Pose(w.pose("indenter").position + [0.6e-3, 0, 0])})
        assert stats.settled == settled and bool(w.unsettled_reason) != settled
    other = PressWorld(w.scene)
    other.restore(w.snapshot())
    assert not other.move({"indenter": Pose(w.pose("indenter").position + [0.1e-3, 0, 0])}).settled
    assert not other.move({}).settled  # held on, it is no nearer to a slow one
    move(other, (0, 0, 2e-3))
    move(other, (0, 0, -2e-3))
    move(other, (0.6e-3, 0, 0))


def test_what_counts_is_the_motion_between_sensor_and_indenter() -> None:
    """Opposite ways each of half the slide, it is as slow as the whole by one; together, nothing slides at all."""
    by, found = np.array([1.2e-3, 0.5e-3, 0.0]), []
    for share in (1.0, 0.5):
        w = pressed_ball(0.5, "draft")
        sensor, ball = w.pose("lower"), w.pose("indenter")
        stats = w.move(
            {
                "indenter": Pose(ball.position + share * by, ball.quaternion),
                "lower": Pose(sensor.position - (1.0 - share) * by, sensor.quaternion),
            }
        )
        force = w.wrench("lower")
        assert stats.settled
        found.append(force[:2] / -force[2])
    assert found[1] == pytest.approx(found[0], rel=2e-3)
    w = pressed_ball(1.5, "draft")
    far = np.array([3e-3, 0.0, 0.0])
    stats = w.move({name: Pose(w.pose(name).position + far, w.pose(name).quaternion) for name in ("lower", "indenter")})
    assert stats.settled and abs(w.wrench("lower")[0]) < 1e-3


def test_a_slide_of_a_deep_wall_has_not_settled() -> None:
    """Slid by 2 to 4 mm, half of the cylinders and boxes deeper than 0.6 mm ended 2 to 11 % off at draft, settled."""
    for shape, deep, settled in (
        (Cylinder(radius=2e-3, height=5e-3), 0.7e-3, False),
        (Cylinder(radius=2e-3, height=5e-3), 0.5e-3, True),
        (Sphere(radius=4e-3), 0.7e-3, True),
    ):
        w = world(shape, 0.6, 1e-2, preset="draft", gel=Gel(), indenter=Indenter(geometry=shape))
        move(w, (0, 0, -deep - 0.1e-3))
        stats = w.move({"indenter": Pose(w.pose("indenter").position + [2.5e-3, 0, 0])})
        assert stats.residual <= 1e-2 and stats.settled == settled


@pytest.mark.slow
def test_edges_of_a_file_catch_as_they_are_drawn_where_they_touch(tmp_path: Path) -> None:
    """A cube's do; a ball of facets has none, and half a ball's is at its back."""
    ball = trimesh.creation.icosphere(subdivisions=3, radius=4.0)
    turns = np.linspace(0.0, 2 * np.pi, 60)[:-1]
    rim = 4.0 * np.stack([np.cos(turns), np.sin(turns), 0.0 * turns], axis=1)
    half = trimesh.convex.convex_hull(np.concatenate([ball.vertices[ball.vertices[:, 2] < -0.2], rim]))
    made = {"cube": trimesh.creation.box((4.0, 4.0, 4.0)), "ball": ball, "half": half}
    for name, settled in (("cube", False), ("ball", True), ("half", True)):
        made[name].export(tmp_path / f"{name}.stl")
        shape = Mesh(path=str(tmp_path / f"{name}.stl"))
        w = world(shape, 0.5, 1e-2, preset="draft", gel=Gel(), indenter=Indenter(geometry=shape, friction=0.5))
        move(w, (0, 0, -0.5e-3))
        stats = w.move({"indenter": Pose(w.pose("indenter").position + [0.6e-3, 0, 0])})
        assert stats.residual <= 1e-2 and stats.settled == settled


@pytest.mark.parametrize("friction", [0.3, 1.0])
def test_small_slides_end_as_slow_ones_and_cost_little(friction: float) -> None:
    """Four slides of 0.1 mm at draft, against the same mesh at Mach 0.001."""
    slow = {0.3: (0.1487, 0.26, 0.3182, 0.3228), 1.0: (0.1654, 0.3163, 0.4568, 0.5855)}[friction]
    w = pressed_ball(friction, "draft")
    ratios = [slide(w, 0.1e-3, 150) for _ in range(4)]
    assert ratios == pytest.approx(slow, rel=0.015)


def test_what_is_driven_faster_than_friction_may_be_followed_has_not_settled() -> None:
    """At Mach 0.1 the gel slips by inertia on the way: the force of this press is 6 % low (Mach 0.001), whatever the
    residual. Without friction the same state is found at any speed."""
    for friction, mach, settled in ((0.6, None, True), (0.6, 0.1, False), (0.0, 0.1, True)):
        w = world(Sphere(radius=4e-3), friction, 1e-2, preset="draft", gel=Gel(), settling={"mach": mach})
        pose = w.pose("indenter")
        stats = w.move({"indenter": Pose(pose.position - [0, 0, 1.1e-3], pose.quaternion)})
        assert stats.settled == settled
        assert stats.residual <= 1e-2


def test_a_slid_ball_keeps_its_drag_while_it_is_held() -> None:
    """Pressure that wandered among contact points would lose it: 3 % in 1,000 substeps."""
    w = pressed_ball(1.0, "draft")
    drag = slide(w, 2e-3)
    held = 0
    while held < 1000:
        held += w.move({}).hold
    force = w.wrench("lower")
    assert force[0] / -force[2] == pytest.approx(drag, rel=0.01)


def test_a_slid_plate_reaches_coulomb_friction_and_stuck_contact_keeps_its_shear() -> None:
    """A plate wider than the gel: no edge ploughs, so the ratio of forces is the coefficient."""
    # settled well, since the tolerance is a share of the normal force, of which shear is a tenth
    w = world(Box(size=(30e-3, 30e-3, 4e-3)), friction=0.3, tolerance=2e-4)
    move(w, (0, 0, -0.3e-3))
    move(w, (0.05e-3, 0, 0))
    stuck = w.wrench("lower")
    assert 0.02 < stuck[0] / -stuck[2] < 0.29
    move(w, (0, 0, 0))  # a further hold: friction with memory does not creep
    assert w.wrench("lower")[0] == pytest.approx(stuck[0], rel=5e-3)
    for _ in range(6):
        move(w, (0.4e-3, 0, 0))
    slid = w.wrench("lower")
    assert slid[0] / -slid[2] == pytest.approx(0.3, rel=0.03)


def test_a_failed_attempt_leaves_nothing_behind() -> None:
    """Forces that are not numbers stay in memory when the state before them is restored."""
    w = pressed_ball(0.3, "draft")
    before, wanted = w.snapshot(), slide(w, 0.1e-3)
    w.restore(before)
    gels = w.state._gels
    gels.common_group.f[...] = float("nan")
    gels._corners[gels._corners != 0.0] = float("nan")
    assert slide(w, 0.1e-3) == wanted
