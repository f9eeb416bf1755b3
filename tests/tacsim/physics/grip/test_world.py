"""Objects held at rest between pads: laws of statics and friction, and agreement with a press."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tacsim.interface import Pose
from tacsim.models.scene import Box, Gel, Indenter, Mesh, Scene, Shape
from tacsim.physics.grip.model import HeldObject, Support
from tacsim.physics.worlds.press import PressWorld
from tests.tacsim.physics.grip.gripping import BALL, BOX, HOME, held, make_grip, pads_at, total_force

pytestmark = pytest.mark.cpu


@pytest.mark.parametrize("geometry", [BOX, BALL], ids=["box", "ball"])
@pytest.mark.parametrize("gravity", [(0.0, 0.0, -9.81), (-6.0, 5.0, 4.0)], ids=["down", "tilted"])
def test_at_rest_the_pads_carry_the_weight(geometry: Shape, gravity: tuple[float, float, float]) -> None:
    world, _ = held(geometry, gravity=gravity)
    states = world.step(pads_at(), forces=[4.0], settle=True)
    assert states.at_rest.all() and states.touching.all()
    assert np.linalg.norm(total_force(states) - 0.1 * np.array(gravity)) < 1e-3 * 0.981
    assert -states.wrenches[0, :, 2].mean() == pytest.approx(4.0, rel=1e-3)


def test_a_moment_is_balanced_as_well() -> None:
    item = HeldObject(BOX, 0.1, centre_of_mass=(0.0, 4e-3, 0.0))
    world = make_grip(item)
    world.grasp(pads_at(), [6.0])
    states = world.step(pads_at(), forces=[6.0], settle=True)
    turns = Rotation.from_quat(states.pads[0, :, 3:])
    forces, moments = (turns.apply(states.wrenches[0, :, part]) for part in (slice(0, 3), slice(3, 6)))
    at = Rotation.from_quat(states.objects[0, 3:]).apply([0.0, 4e-3, 0.0]) + states.objects[0, :3]
    about = (moments + np.cross(states.pads[0, :, :3] - at, forces)).sum(axis=0)
    assert states.at_rest.all() and np.abs(states.objects[0, 3:6]).max() > 1e-4  # it has turned
    assert np.abs(about).max() < 2e-3 * 0.981 * 4e-3 + 1e-6


@pytest.mark.parametrize("geometry", [BOX, BALL], ids=["box", "ball"])
def test_the_force_is_that_of_a_press_at_the_same_depth(geometry: Shape) -> None:
    _, states = held(geometry, gravity=(0.0, 0.0, 0.0), force=3.0)
    back = Rotation.from_quat(states.pads[0, 0, 3:]).inv()
    at = back.apply(states.objects[0, :3] - states.pads[0, 0, :3])
    turn = (back * Rotation.from_quat(states.objects[0, 3:])).as_quat()
    scene = Scene.model_validate(
        {"preset": "learn", "body": None, "indenter": Indenter(geometry=geometry), "gel": Gel(housing=None),
         "settling": {"tolerance": 1e-3}}
    )  # fmt: skip
    world = PressWorld(scene)
    world.place({"indenter": Pose(at + [0.0, 0.0, 2e-3], turn)})
    world.move({"indenter": Pose(at, turn)})
    assert states.wrenches[0, 0, 2] == pytest.approx(float(world.wrench("lower")[2]), rel=0.01)
    assert states.wrenches[0, 0, 2] == pytest.approx(-3.0, rel=1e-3)


def test_a_given_width_presses_and_the_force_follows() -> None:
    world, states = held(gravity=(0.0, 0.0, 0.0), force=3.0)
    closed = pads_at(0.2e-3 - states.closings[0])
    now = world.step(closed, settle=True)
    assert now.closings[0] == 0.0
    assert now.wrenches[0, :, 2] == pytest.approx(states.wrenches[0, :, 2], rel=2e-3)
    narrower = world.step(pads_at(0.2e-3 - states.closings[0] - 0.05e-3), settle=True)
    assert (narrower.wrenches[0, :, 2] < 1.3 * now.wrenches[0, :, 2]).all()


def test_pads_that_move_together_carry_the_object_with_them() -> None:
    world, before = held()
    pose = np.array([30e-3, -20e-3, 50e-3, *Rotation.from_euler("z", 90, degrees=True).as_quat()])
    after = world.step(pads_at(pose=pose), forces=[4.0])
    turn = Rotation.from_quat(pose[3:])
    assert after.objects[0, :3] == pytest.approx(pose[:3] + turn.apply(before.objects[0, :3]), abs=2e-6)
    assert np.abs(after.wrenches - before.wrenches).max() < 2e-3
    assert after.substeps[0] == world.substeps


@pytest.mark.parametrize(("share", "holds"), [(0.93, True), (1.07, False)])
def test_a_box_slips_at_the_limit_of_friction(share: float, holds: bool) -> None:
    world, _ = held(gravity=(0.0, 0.0, 0.0), force=3.0)
    load = np.array([[0.0, 0.0, -share * 2 * 0.6 * 3.0, 0.0, 0.0, 0.0]])
    for part in (0.4, 0.6, 0.7, 0.8, 0.85, 0.9, 0.95, *[1.0] * 8):
        states = world.step(pads_at(), forces=[3.0], loads=part * load)
    before = states.objects[0, 2]
    for _ in range(6):
        states = world.step(pads_at(), forces=[3.0], loads=load)
    moved = abs(states.objects[0, 2] - before)
    assert (moved < 2e-6) == holds and (moved > 200e-6) != holds
    assert states.slip_shares[0] == pytest.approx(share if holds else 1.0, abs=0.02)


def test_an_object_too_heavy_for_its_grip_is_dropped_and_stays_where_no_pad_touches_it() -> None:
    world = make_grip(HeldObject(BOX, 2.0), HeldObject(BOX, 0.1))
    states = world.grasp(pads_at(count=2), [4.0, 4.0])
    assert list(states.dropped) == [True, False]
    assert states.limited_substeps[0] >= 0 and not states.touching[0].any()
    again = world.step(pads_at(count=2), forces=[4.0, 4.0])
    assert np.array_equal(again.objects[0, :3], states.objects[0, :3])
    assert states.slip_shares[0] == pytest.approx(1.0)


def test_a_grip_that_opens_lets_go() -> None:
    world, states = held()
    assert not states.dropped[0]
    states = world.step(pads_at(0.5e-3))
    assert states.dropped[0] and not states.touching.any() and not states.wrenches.any()
    world.reset(HOME, pads_at()[0], 0)
    assert not world.step(pads_at()).dropped[0]


def test_one_pad_alone_pushes_an_object_along() -> None:
    world = make_grip(HeldObject(BALL, 0.05), gravity=(0.0, 0.0, 0.0))
    pads = pads_at(0.4e-3)
    world.reset(HOME[None], pads)
    for _ in range(10):
        pads[0, 0, 0] += 0.2e-3
        states = world.step(pads)
        pads[0, 1, 0] += 0.2e-3
    assert states.objects[0, 0] == pytest.approx(1.6e-3, abs=0.2e-3)
    assert np.abs(states.wrenches).max() < 0.1


def test_a_support_carries_and_gives_way_at_its_limit() -> None:
    world, _ = held(mass=0.2, force=6.0)
    support = Support([2e3] * 3 + [1.0] * 3, max_force=1.0)
    states = world.step(pads_at(), forces=[6.0], support=support, settle=True)
    assert total_force(states)[2] == pytest.approx(-1.962, rel=2e-3)  # it begins without load
    pose = HOME.copy()
    for _ in range(4):  # the pads lift against it: its springs give the difference, at most 1 N
        pose[2] += 0.2e-3
        states = world.step(pads_at(pose=pose), forces=[6.0], support=support, settle=True)
    assert total_force(states)[2] == pytest.approx(-1.962 - 1.0, abs=0.03)
    free = world.step(pads_at(pose=pose), forces=[6.0], settle=True)
    assert total_force(free)[2] == pytest.approx(-1.962, rel=2e-3)


@pytest.mark.slow
def test_a_mesh_is_held_as_the_box_that_it_describes(tmp_path: object) -> None:
    import trimesh

    path = f"{tmp_path}/box.stl"
    trimesh.creation.box((20e-3, 12e-3, 16e-3)).export(path)
    world = make_grip(HeldObject(Mesh(path=path, scale=1.0), 0.1), HeldObject(BOX, 0.1, edge_radius=0.0))
    world.grasp(pads_at(count=2), [4.0, 4.0])
    for _ in range(4):
        states = world.step(pads_at(count=2), forces=[4.0, 4.0], settle=True)
    assert states.at_rest.all() and states.touching.all()
    assert states.wrenches[0] == pytest.approx(states.wrenches[1], abs=0.02)
    assert states.closings[0] == pytest.approx(states.closings[1], abs=5e-6)


@pytest.mark.slow
@pytest.mark.parametrize(("mass", "modulus"), [(0.005, 1e6), (0.5, 0.05e6), (0.05, 0.145e6)])
def test_a_thousand_random_steps_lose_nothing_and_ring_down(mass: float, modulus: float) -> None:
    force = max(3.0, 1.6 * mass * 9.81 / 1.2)
    world, _ = held(BOX, mass, force, modulus=modulus)
    random, pose = np.random.default_rng(1), HOME.copy()
    for number in range(1000):
        pose[:3] += random.uniform(-2e-3, 2e-3, 3)
        pose[3:] = (Rotation.from_rotvec(random.uniform(-0.02, 0.02, 3)) * Rotation.from_quat(pose[3:])).as_quat()
        load = np.concatenate([0.15 * force * random.normal(size=3) / 1.7, np.zeros(3)])[None] * (number % 4 == 0)
        states = world.step(pads_at(pose=pose), forces=[force * random.uniform(1.0, 1.3)], loads=load)
        assert states.touching.all() and not states.limited_substeps.any(), number
    for _ in range(10):
        states = world.step(pads_at(pose=pose), forces=[force])
    before = states.objects[0, :3]
    states = world.step(pads_at(pose=pose), forces=[force])
    assert np.abs(states.objects[0, :3] - before).max() < 0.1e-6
    assert np.linalg.norm(total_force(states)) == pytest.approx(mass * 9.81, rel=0.01)


def test_a_wide_object_that_reaches_the_housing_is_refused_and_nothing_moves() -> None:
    world, _ = held(Box(size=(20e-3, 60e-3, 60e-3)), housing=0.3e-3, force=2.0)
    before = world.snapshot(0)
    with pytest.raises(ValueError, match=r"pad 0 of grip 0 is wider than the gel and reaches"):
        world.step(pads_at(-0.6e-3))
    assert all(np.array_equal(array, before[name]) for name, array in world.snapshot(0).items())
