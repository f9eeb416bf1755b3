"""Gel pads that follow an engine by poses: forces, batches, state, refusals."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from tacsim.interface import Pose
from tacsim.models.material import GelMaterial
from tacsim.models.scene import Box, Cylinder, Gel, Indenter, Mesh, Scene, Shape, Sphere
from tacsim.physics.failure.health import SimulationDiverged
from tacsim.physics.pads.pads import GelPads
from tacsim.physics.worlds.press import PressWorld

SIDEWAYS = Rotation.from_euler("x", 90, degrees=True).as_quat()  # a cylinder whose axis is along the gel
UPRIGHT = np.array([0.0, 0.0, 0.0, 1.0])
BALL, BOX, ROD = Sphere(radius=8e-3), Box(size=(10e-3, 8e-3, 6e-3)), Cylinder(radius=6e-3, height=12e-3)


def pad(geometry: Shape, friction: float = 0.6, modulus: float = 0.145e6, roll: float = 0.0, **more: object) -> Scene:
    gel = Gel(material=GelMaterial(youngs_modulus=modulus))
    indenter = Indenter(geometry=geometry, friction=friction, roll=roll)
    return Scene.model_validate({"preset": "learn", "body": None, "indenter": indenter, "gel": gel, **more})


def place(z: float, x: float = 0.0, turn: np.ndarray = UPRIGHT) -> np.ndarray:
    return np.array([x, 0.0, z, *turn])


def press(pads: GelPads, starts: np.ndarray, ends: np.ndarray, steps: int = 40, rest: int = 60) -> np.ndarray:
    """Moves from poses to poses of the same orientation, and waits."""
    for share in np.linspace(0.0, 1.0, steps + 1):
        poses = ends.copy()
        poses[:, :3] = starts[:, :3] + share * (ends - starts)[:, :3]
        pads.step(poses)
    for _ in range(rest):
        pads.step(ends)
    return pads.wrenches


@pytest.mark.parametrize(
    ("geometry", "half", "depth", "roll"),
    [(BALL, 8e-3, 0.8e-3, 0.0), (BOX, 3e-3, 0.2e-3, 0.0), (ROD, 6e-3, 0.4e-3, 90.0)],
    ids=["ball", "box", "rod on its side"],
)
def test_a_press_and_a_slide_end_with_the_forces_of_a_settled_world(
    geometry: Shape, half: float, depth: float, roll: float
) -> None:
    scene = pad(geometry, roll=np.radians(roll), settling={"tolerance": 1e-3})
    turn, world = SIDEWAYS if roll else UPRIGHT, PressWorld(scene)
    for target in ([0.0, 0.0, half - depth], [0.3e-3, 0.0, half - depth]):
        world.move({"indenter": Pose(np.array(target), turn)})
    pads = GelPads([scene], 1e-3)
    down = place(half - depth, 0.0, turn)[None]
    press(pads, place(half + 0.05e-3, 0.0, turn)[None], down)
    found = press(pads, down, place(half - depth, 0.3e-3, turn)[None])[0]
    assert np.abs(found - world.wrench("lower"))[:3].max() < 0.01 * np.linalg.norm(found[:3])
    assert np.abs(found - world.wrench("lower"))[3:].max() < 0.01 * np.linalg.norm(found[:3]) * 10e-3


def test_the_wrench_is_the_mean_over_the_substeps() -> None:
    whole, parts = GelPads([pad(BALL)], 1e-3, 8), GelPads([pad(BALL)], 1e-3 / 8, 1)
    depths = np.linspace(8.0e-3, 7.7e-3, 11)
    for pads in (whole, parts):
        pads.step(place(depths[0])[None])
    for before, after in itertools.pairwise(depths):
        mean = whole.step(place(after)[None])
        single = [parts.step(place(before + n / 8 * (after - before))[None]) for n in range(1, 9)]
        assert mean == pytest.approx(np.mean(single, axis=0), rel=1e-3, abs=1e-6)
    assert mean[0, 2] < -0.05


def wander(count: int, seed: int) -> np.ndarray:
    """(steps, count, 7) poses that press, slide and turn."""
    random = np.random.default_rng(seed)
    poses = np.zeros((30, count, 7))
    for index in range(count):
        path = np.cumsum(random.uniform(-4e-5, 4e-5, (30, 3)), axis=0)
        path[:, 2] = 8e-3 - np.minimum(np.arange(30) * 3e-5, 6e-4)
        poses[:, index, :3] = path
        turns = np.cumsum(random.uniform(-2e-3, 2e-3, (30, 3)), axis=0)
        poses[:, index, 3:] = Rotation.from_rotvec(turns).as_quat()
    return poses


@pytest.mark.cpu
def test_a_pad_in_a_batch_has_the_bits_that_it_has_alone() -> None:
    scenes = [
        pad(BALL, 0.6),
        pad(Sphere(radius=7.95e-3), 0.3, 0.3e6),
        pad(Cylinder(radius=6e-3, height=16e-3), 1.0, 1e5),
    ]
    poses = wander(3, 1)
    together = GelPads(scenes, 1e-3)
    wrenches = np.array([together.step(each) for each in poses])
    assert (np.abs(wrenches[-1, :, 2]) > 0.05).all()
    for index, scene in enumerate(scenes):
        alone = GelPads([scene], 1e-3)
        assert np.array_equal(np.array([alone.step(each[[index]])[0] for each in poses]), wrenches[:, index])
        assert np.array_equal(alone.surface(0).displacement, together.surface(index).displacement)
        assert np.array_equal(alone.stiffness()[0], together.stiffness()[index])


@pytest.mark.cpu
def test_scenes_of_a_batch_step_or_fail_without_an_effect_on_the_others() -> None:
    """Some of them at a time; one whose object jumps, and one whose object goes through its gel, are as before."""
    scenes = [pad(BALL, 0.6), pad(BALL, 0.3), pad(BALL, 0.9, 0.3e6)]
    poses, both = wander(6, 3), [[0, 1], [2, 3], [4, 5]]
    together, alone = (
        GelPads([each for each in scenes for _ in range(2)], 1e-3),
        [GelPads([s] * 2, 1e-3) for s in scenes],
    )
    far, deep = poses[12].copy(), poses[12].copy()
    far[2, 0] += 10e-3
    deep[4, 2] = 1.5e-3
    for step, each in enumerate(poses):
        moving = [number for number in range(3) if (step + number) % 3 or step < 3]
        if step == 12:
            ends = together.step_scenes(both[:2], far[:4])
            assert ends[0] is None and "pad 2 moves by 10 mm" in str(ends[1])
            ends = together.step_scenes([both[0], both[2]], np.delete(deep, both[1], axis=0))
            assert ends[0] is None and isinstance(ends[1], SimulationDiverged) and "pad 4 in step" in str(ends[1])
            for _ in range(2):
                alone[0].step(each[:2])
        ends = together.step_scenes(
            [both[number] for number in moving], np.concatenate([each[both[n]] for n in moving])
        )
        assert ends == [None] * len(moving)
        for number in moving:
            alone[number].step(each[both[number]])
    for own, single in zip(both, alone, strict=True):
        assert np.array_equal(single.wrenches, together.wrenches[own]) and (single.wrenches[:, 2] < -0.05).all()
        assert np.array_equal(single.stiffness(), together.stiffness()[own])
        for number, pad_number in enumerate(own):
            kept, other = single.snapshot(number), together.snapshot(pad_number)
            assert all(np.array_equal(kept[name], other[name]) for name in kept if name != "sums")
    with pytest.raises(ValueError, match="each larger than the one before"):
        together.step_scenes([both[1], both[0]], poses[0, :4])


@pytest.mark.cpu
def test_a_restored_pad_continues_with_the_same_bits_and_the_others_as_they_were() -> None:
    pads, poses = GelPads([pad(BALL), pad(BALL, 0.2)], 1e-3), wander(2, 2)
    for each in poses[:20]:
        pads.step(each)
    kept = [pads.snapshot(index) for index in range(2)]
    ends = [np.array([pads.step(each) for each in poses[20:]])]
    for index in range(2):
        pads.restore(index, kept[index])
    ends.append(np.array([pads.step(each) for each in poses[20:]]))
    assert np.array_equal(*ends)
    pads.reset(0)
    first = pads.step(np.stack([poses[0, 0], poses[-1, 1]]))
    assert not first[0].any() and first[1].any()
    with pytest.raises(ValueError, match="snapshot: 'gel_displacement' must have shape"):
        pads.restore(0, {"steps": np.ones(1)})


@pytest.mark.parametrize(("geometry", "half", "force"), [(BALL, 8e-3, 2.0), (BOX, 3e-3, 2.0)], ids=["ball", "box"])
def test_the_stiffness_is_what_a_small_motion_within_a_step_shows(geometry: Shape, half: float, force: float) -> None:
    pads, depth = GelPads([pad(geometry)], 1e-3), 0.0
    pads.step(place(half)[None])
    for _ in range(150):
        depth += np.clip((force + pads.wrenches[0, 2]) * 1e-5, -1e-5, 1e-5)
        pads.step(place(half - depth)[None])
    for _ in range(20):
        pads.step(place(half - depth)[None])
    at, kept, estimate = place(half - depth), pads.snapshot(0), pads.stiffness()[0]
    rest = pads.step(at[None])[0]
    for axis, size in ((0, 1e-5), (2, 1e-5), (3, 1e-3), (5, 1e-3)):
        pads.restore(0, kept)
        moved = at.copy()
        if axis < 3:
            moved[axis] += size
        else:  # about the pad's origin
            turn = Rotation.from_rotvec(size * np.eye(3)[axis - 3])
            moved[:3], moved[3:] = turn.apply(at[:3]), turn.as_quat()
        shown = (pads.step(moved[None])[0] - rest)[axis] / size
        assert estimate[axis, axis] == pytest.approx(shown, rel=0.3), axis
    assert np.allclose(estimate, estimate.T)


def test_stiffness_is_zero_without_contact_and_along_the_surface_while_sliding() -> None:
    pads = GelPads([pad(BALL, 0.3)], 1e-3)
    pads.step(place(8.05e-3)[None])
    assert not pads.stiffness().any() and not pads.wrenches.any()
    press(pads, place(8.05e-3)[None], place(7.6e-3)[None])
    stuck = pads.stiffness()[0]
    assert pads.slip_share(0) < 0.05 and stuck[0, 0] > 0
    for step in range(120):
        pads.step(place(7.6e-3, step * 2e-5)[None])
    assert pads.slip_share(0) == pytest.approx(1.0, abs=0.1)
    assert pads.stiffness()[0, 0, 0] < 0.35 * stuck[0, 0]


@pytest.mark.slow
def test_a_mesh_presses_as_the_box_that_it_is(tmp_path: Path) -> None:
    file = tmp_path / "box.stl"
    trimesh.creation.box((10.0, 8.0, 6.0)).export(file)
    mesh = Mesh(path=str(file), scale=1e-3)
    pads = GelPads([pad(mesh), pad(BOX, indenter=Indenter(geometry=BOX, edge_radius=0.0))], 1e-3)
    found = press(pads, np.stack([place(3.02e-3)] * 2), np.stack([place(2.85e-3)] * 2), rest=40)
    assert found[0, 2] == pytest.approx(found[1, 2], rel=0.01)


def test_what_cannot_be_is_refused_with_the_pad_and_what_to_do(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"step is -1 s: give the positive time"):
        GelPads([pad(BALL)], -1.0)
    with pytest.raises(ValueError, match="pad 1 has none"):
        GelPads([pad(BALL), Scene()], 1e-3)
    with pytest.raises(ValueError, match="substeps is 0; give at least 1, or None for 8"):
        GelPads([pad(BALL)], 1e-3, 0)
    with pytest.raises(ValueError, match="need one gel lattice"):
        GelPads([pad(BALL), pad(BALL, preset="draft")], 1e-3)
    open_box = trimesh.creation.box((10.0, 8.0, 6.0))
    open_box.update_faces(np.arange(len(open_box.faces)) > 1)
    open_box.export(tmp_path / "open.stl")
    with pytest.raises(ValueError, match=r"open.stl: .*(hole|closed)"):
        GelPads([pad(Mesh(path=str(tmp_path / "open.stl")))], 1e-3)
    pads = GelPads([pad(BALL)], 1e-3)
    with pytest.raises(ValueError, match=r"shape \(1, 7\)"):
        pads.step(np.zeros((2, 7)))
    with pytest.raises(ValueError, match=r"pad 0 is .*quaternion .* of length 1"):
        pads.step(np.zeros((1, 7)))
    with pytest.raises(ValueError, match=r"pad 0 is 1 mm inside its gel"):
        pads.step(place(7e-3)[None])
    pads.step(place(8.5e-3)[None])
    with pytest.raises(ValueError, match=r"moves by 12 mm in a step of 0.001 s; the gels follow 8 mm: call reset"):
        pads.step(place(20.5e-3)[None])


def test_an_object_wider_than_the_gel_is_refused_where_it_would_rest_on_the_housing() -> None:
    wide = Box(size=(30e-3, 30e-3, 10e-3))
    pads = GelPads([pad(wide), pad(wide, gel=Gel(housing=None))], 1e-3)
    poses = np.stack([place(5.0e-3)] * 2)
    pads.step(poses)
    for _ in range(29):
        poses[:, 2] -= 1e-5
        pads.step(poses)
    poses[:, 2] -= 2e-5
    with pytest.raises(ValueError, match=r"pad 0 is wider than the gel and reaches 0\.01 mm into the housing"):
        pads.step(poses)


def test_a_pad_that_fails_leaves_all_as_they_were() -> None:
    pads = GelPads([pad(BALL), pad(BALL)], 1e-3)
    poses = np.stack([place(8.0e-3)] * 2)
    for _ in range(10):
        poses[:, 2] -= 2e-5
        before = pads.step(poses)
    kept = pads.snapshot(1)
    with pytest.raises(SimulationDiverged, match="pad 0 in step 10"):
        pads.step(np.stack([place(1.5e-3), poses[1]]))
    assert all(np.array_equal(kept[name], value) for name, value in pads.snapshot(1).items() if name != "sums")
    assert pads.step(poses)[:, 2] == pytest.approx(before[:, 2], rel=0.2)
