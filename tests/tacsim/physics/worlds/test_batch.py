"""Worlds that share launches of kernels: each as if it were alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tacsim.geometry import tiles
from tacsim.interface import Pose
from tacsim.models.material import BodyMaterial, GelMaterial
from tacsim.models.scene import Body, Box, Cylinder, Gel, Indenter, Mesh, Scene, Shape, Sphere
from tacsim.physics.body import plasticine
from tacsim.physics.exec.lanes import COPIES, MAX_NUMBERS
from tacsim.physics.failure.health import SimulationDiverged
from tacsim.physics.failure.tuning import MAX_GRID_NODES
from tacsim.physics.motion.load import LoadNotReached
from tacsim.physics.move import MoveStats
from tacsim.physics.world import World
from tacsim.physics.worlds import press_state
from tacsim.physics.worlds.batch import Batch
from tacsim.physics.worlds.hybrid import HybridWorld
from tacsim.physics.worlds.press import PressWorld
from tacsim.physics.worlds.tuning import MAX_RETRIES

GEL = Gel(size=(8e-3, 8e-3, 4e-3))
CLAY = BodyMaterial(yield_stress=30e3)
STAY: dict[str, Pose] = {}


def with_body(geometry: Shape, material: BodyMaterial = CLAY, gel: Gel = GEL, **scene: Any) -> Scene:
    return Scene.model_validate({"body": Body(geometry=geometry, material=material), "gel": gel, **scene})


SCENES = (
    with_body(Box(size=(3e-3, 3e-3, 3e-3))),
    with_body(
        Cylinder(radius=2e-3, height=3.5e-3), BodyMaterial(youngs_modulus=3e5, yield_stress=1e4, hardening_modulus=1e4),
        friction={"lower": 0.2, "upper": 0.9}, settling={"mach": 0.03, "tolerance": 5e-3},
    ),
    with_body(
        Box(size=(4e-3, 2e-3, 2.5e-3)), BodyMaterial(), Gel(size=GEL.size, material=GelMaterial(youngs_modulus=1e6)),
        particle_spacing=0.4e-3,
    ),
)  # fmt: skip


def closed(world: World, by: float, across: float = 0.0) -> dict[str, Pose]:
    """Targets that bring both sensors nearer by `by` [m] in all, the upper one `across` to the side."""
    lower, upper = world.pose("lower"), world.pose("upper")
    return {
        "lower": Pose(lower.position + [0, 0, by / 2], lower.quaternion),
        "upper": Pose(upper.position + [across, 0, -by / 2], upper.quaternion),
    }


def state(world: World) -> dict[str, bytes]:
    return {name: a.tobytes() for name, a in world.snapshot().items()}


def assert_same(worlds: Sequence[World], others: Sequence[World]) -> None:
    for index, (world, other) in enumerate(zip(worlds, others, strict=True)):
        left, right = state(world), state(other)
        assert left.keys() == right.keys()
        assert not [name for name in left if left[name] != right[name]], f"environment {index}"
        for name in world.sensors:
            assert world.wrench(name).tobytes() == other.wrench(name).tobytes()
            assert world.surface(name).displacement.tobytes() == other.surface(name).displacement.tobytes()


@pytest.fixture(scope="module")
def batch() -> Batch:
    return Batch(SCENES)


@pytest.fixture(scope="module")
def begin(batch: Batch) -> list[Mapping[str, Any]]:
    return [world.snapshot() for world in batch.worlds]


@pytest.fixture
def fresh(batch: Batch, begin: list[Mapping[str, Any]]) -> Batch:
    """The batch as after construction: one set of arrays for all tests."""
    for world, snapshot in zip(batch.worlds, begin, strict=True):
        world.restore(snapshot)
    return batch


@pytest.mark.cpu
def test_three_environments_are_three_worlds_to_the_bit(fresh: Batch) -> None:
    alone = [HybridWorld(scene) for scene in SCENES]
    assert len({len(world.truth().points) for world in alone}) == 3
    for by, across in (((0.7e-3, 0.9e-3, 0.6e-3), 0.0), ((0.2e-3, 0.4e-3, 0.3e-3), 0.05e-3)):
        expected = [world.move(closed(world, each, across)) for world, each in zip(alone, by, strict=True)]
        targets = [closed(world, each, across) for world, each in zip(fresh.worlds, by, strict=True)]
        assert fresh.move(targets) == expected
        assert len({stats.substeps for stats in expected}) == 3  # they end at different launches
        assert_same(fresh.worlds, alone)
    assert all(world.wrench("lower")[2] < -0.01 for world in alone)
    for name in ("lower", "upper"):
        assert fresh.worlds[1].pose(name).position == pytest.approx(alone[1].pose(name).position)


@pytest.mark.cpu
def test_one_that_rests_does_not_change_and_moves_alone_later(fresh: Batch) -> None:
    before = state(fresh.worlds[1])
    ends = fresh.move([closed(fresh.worlds[0], 0.5e-3), None, closed(fresh.worlds[2], 0.5e-3)])
    assert ends[1] is None and all(isinstance(ends[index], MoveStats) for index in (0, 2))
    assert state(fresh.worlds[1]) == before
    others = [state(fresh.worlds[index]) for index in (0, 2)]
    alone = HybridWorld(SCENES[1])
    assert fresh.worlds[1].move(closed(alone, 0.6e-3)) == alone.move(closed(alone, 0.6e-3))
    assert_same([fresh.worlds[1]], [alone])
    assert [state(fresh.worlds[index]) for index in (0, 2)] == others


@pytest.mark.cpu
def test_one_that_is_replaced_is_a_new_world_to_the_bit() -> None:
    """Also by more particles than the batch had room for, and by fewer; the others notice nothing."""
    batch, alone = Batch([SCENES[0], SCENES[1]]), HybridWorld(SCENES[1])
    batch.move([closed(batch.worlds[0], 1.5e-3), closed(batch.worlds[1], 0.6e-3)])
    alone.move(closed(alone, 0.6e-3))
    for scene in (with_body(Box(size=(5e-3, 5e-3, 3e-3)), BodyMaterial()), SCENES[2], SCENES[0]):
        batch.replace(0, scene)
        new = HybridWorld(scene)
        assert_same(batch.worlds, [new, alone])
        end = batch.move([None, closed(alone, 0.1e-3)])[1]  # the other alone, now that rows may be longer
        assert end == alone.move(closed(alone, 0.1e-3))
        assert_same(batch.worlds, [new, alone])
        ends = batch.move([closed(new, 0.7e-3), closed(alone, 0.1e-3)])
        assert ends == [new.move(closed(new, 0.7e-3)), alone.move(closed(alone, 0.1e-3))]
        assert_same(batch.worlds, [new, alone])
    with pytest.raises(ValueError, match="give both the same gel"):
        batch.replace(0, with_body(Box(), gel=Gel(size=(9e-3, 8e-3, 4e-3))))
    assert_same(batch.worlds, [new, alone])
    with pytest.raises(ValueError, match="make a new Batch for indenters"):
        batch.replace(0, Scene(body=None, indenter=Indenter(), gel=GEL))


def test_batch_without_targets_changes_nothing(fresh: Batch) -> None:
    before = [state(world) for world in fresh.worlds]
    assert fresh.move([None] * 3) == [None] * 3
    assert [state(world) for world in fresh.worlds] == before


@pytest.mark.cpu
@pytest.mark.parametrize("fails", [1, MAX_RETRIES + 1])
def test_one_that_diverges_is_taken_back_while_others_go_on(
    fresh: Batch, fails: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A NaN in the velocity of a particle of environment 1, at the third launch of its first tries."""
    alone = [HybridWorld(scene) for scene in SCENES]
    before, launches = state(fresh.worlds[1]), 0
    prepare = HybridWorld.prepare

    def poisoned(world: HybridWorld, launch: Any) -> Any:
        nonlocal launches
        if world is fresh.worlds[1]:
            launches = launches + 1 if launch.first or not launch.path.substeps else 1
            if launches == 3 and launch.path.refine < 2**fails:
                world.arrays()["strain"][5, 1] = np.nan
        return prepare(world, launch)

    monkeypatch.setattr(HybridWorld, "prepare", poisoned)
    ends = fresh.move([closed(world, 0.6e-3) for world in fresh.worlds])
    monkeypatch.undo()
    for index in (0, 2):
        assert ends[index] == alone[index].move(closed(alone[index], 0.6e-3))
    assert_same([fresh.worlds[0], fresh.worlds[2]], [alone[0], alone[2]])
    if fails == 1:
        end = ends[1]
        assert isinstance(end, MoveStats) and end.retries == 1 and end.settled
        alone[1].move(closed(alone[1], 0.6e-3))
        force = alone[1].wrench("lower")[2]
        assert fresh.worlds[1].wrench("lower")[2] == pytest.approx(force, rel=0.05)
    else:
        assert isinstance(ends[1], SimulationDiverged)
        assert f"1/{2**MAX_RETRIES} of the time step" in str(ends[1])
        assert state(fresh.worlds[1]) == before


def test_state_with_nan_fails_in_its_environment_only(fresh: Batch) -> None:
    fresh.worlds[2].arrays()["position"][0] = np.nan
    ends = fresh.move([closed(fresh.worlds[0], 0.3e-3), None, STAY])
    assert isinstance(ends[0], MoveStats)
    assert isinstance(ends[2], SimulationDiverged) and "before the motion began" in str(ends[2])


@pytest.mark.cpu
def test_a_body_far_away_enlarges_no_array_but_the_grid(fresh: Batch) -> None:
    arrays = fresh.state.particles.rows, fresh.state.contact_history, fresh.state.gels.common_group.nodes
    nodes = fresh.state.particles.masses.shape[2]
    for place in ("position", "reference"):
        fresh.worlds[0].arrays()[place][-1] += [0.0, 60.0, 0.0]
    stats = fresh.move([STAY, closed(fresh.worlds[1], 0.4e-3), None])[1]
    assert fresh.state.particles.masses.shape[2] > nodes
    assert all(a is b for a, b in zip(
        arrays,
        (fresh.state.particles.rows, fresh.state.contact_history, fresh.state.gels.common_group.nodes),
        strict=True,
    ))  # fmt: skip
    alone = HybridWorld(SCENES[1])
    assert alone.move(closed(alone, 0.4e-3)) == stats
    assert_same([fresh.worlds[1]], [alone])


def out_of_room(ends: Sequence[Any], batch: Batch, before: list[dict[str, bytes]], lost: int) -> SimulationDiverged:
    """The failure of environment `lost`, which is as before; all others end as worlds alone, to the bit."""
    for index, (world, scene) in enumerate(zip(batch.worlds, [SCENES[0]] * 4, strict=True)):
        if index == lost:
            assert state(world) == before[index]
        else:
            alone = HybridWorld(scene)
            assert ends[index] == alone.move(closed(alone, 0.3e-3))
            assert_same([world], [alone])
    failure = ends[lost]
    assert isinstance(failure, SimulationDiverged), failure
    return failure


@pytest.mark.cpu
def test_grid_above_share_fails_in_its_environment_only() -> None:
    """Its grid would be allowed in a world of its own; of four, in four copies, kernels could not count the nodes."""
    batch = Batch(SCENES[:1] * 4)
    most = batch.state.particles.max_grid_nodes
    assert most < MAX_GRID_NODES and 4 * COPIES * 4 * most <= MAX_NUMBERS
    way = (most ** (1 / 3) - 9) * 2 * SCENES[0].spacing * 1e3  # [mm]; body and borders are another 17 cells
    for place in ("position", "reference"):
        batch.worlds[1].arrays()[place][-1] += [way, way, way]
    before = [state(world) for world in batch.worlds]
    failure = out_of_room(batch.move([closed(world, 0.3e-3) for world in batch.worlds]), batch, before, 1)
    for words in ("spread over", "nodes (limit", "substeps 0 to", "restore a snapshot"):
        assert words in str(failure)


@pytest.mark.cpu
def test_grid_without_memory_fails_in_its_environment_only(monkeypatch: pytest.MonkeyPatch) -> None:
    batch = Batch(SCENES[:1] * 4)
    zeros = plasticine.aligned_zeros

    def scarce(*shape: int) -> np.ndarray:
        if shape[0] == 4 and len(shape) == 3 and shape[1] > 20_000:
            raise MemoryError("Unable to allocate")
        return zeros(*shape)

    monkeypatch.setattr(plasticine, "aligned_zeros", scarce)  # the second array of the two that grow
    for place in ("position", "reference"):
        batch.worlds[2].arrays()[place][-1] += [0.0, 400.0, 0.0]
    before = [state(world) for world in batch.worlds]
    failure = out_of_room(batch.move([closed(world, 0.3e-3) for world in batch.worlds]), batch, before, 2)
    assert "no memory for the grid around the particles (Unable to allocate)" in str(failure)
    grid = batch.state.particles
    assert grid.masses.shape[2] == grid.velocities.shape[1]


@pytest.mark.cpu
@pytest.mark.parametrize("lacks", ["nodes", "memory"])
def test_mesh_without_memory_fails_in_its_environment_only(
    lacks: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import trimesh

    trimesh.creation.box((4.0, 4.0, 2.0)).export(tmp_path / "plate.stl")
    plate, ball = (
        Scene(body=None, indenter=Indenter(geometry=shape), gel=GEL)
        for shape in (Mesh(path=str(tmp_path / "plate.stl")), Sphere(radius=3e-3))
    )
    batch, alone = Batch([plate, ball]), PressWorld(ball)
    before, counts, params = state(batch.worlds[0]), batch.state.counts.copy(), batch.state.params.copy()
    if lacks == "nodes":
        monkeypatch.setattr(tiles, "MAX_NODES", 1000)
        words = "nodes 0.1 mm apart would be needed where it can touch; the limit is 1,000; "
    else:
        words = "no memory for the distances from the indenter's mesh (Unable to allocate 2 of "

        def scarce(*shape: int) -> np.ndarray:
            raise MemoryError(f"Unable to allocate {shape[0]} of {shape[1:]}")

        monkeypatch.setattr(press_state, "aligned_zeros", scarce)
    down = [
        {"indenter": Pose(world.pose("indenter").position - [0.0, 0.0, 0.4e-3])} for world in (*batch.worlds, alone)
    ]
    failure, stats = batch.move(down[:2])
    assert isinstance(failure, SimulationDiverged) and failure.refine == 1  # no smaller step would help
    assert words in str(failure) and "in a smaller batch each world has more memory" in str(failure)
    assert state(batch.worlds[0]) == before
    assert np.array_equal(batch.state.counts[0], counts[0]) and np.array_equal(batch.state.params[0], params[0])
    assert stats == alone.move(down[2])
    assert_same([batch.worlds[1]], [alone])


def test_loads_are_held_per_environment_and_unreachable_one_is_reported(fresh: Batch) -> None:
    fresh.move([closed(world, 0.3e-3) for world in fresh.worlds])
    before = state(fresh.worlds[2])
    ends = fresh.move([STAY, None, STAY], [{"upper": 0.05}, None, {"upper": 1e6}])
    assert isinstance(ends[0], MoveStats)
    assert -fresh.worlds[0].wrench("upper")[2] == pytest.approx(0.05, rel=0.02)
    assert isinstance(ends[2], LoadNotReached)
    assert state(fresh.worlds[2]) == before


def test_interruption_restores_moving_worlds(fresh: Batch, monkeypatch: pytest.MonkeyPatch) -> None:
    before = [state(world) for world in fresh.worlds]
    launches, advance = 0, type(fresh.state).advance

    def interrupted(kernels: Any, drives: Any) -> None:
        nonlocal launches
        launches += 1
        advance(kernels, drives)
        if launches == 2:
            raise KeyboardInterrupt

    monkeypatch.setattr(type(fresh.state), "advance", interrupted)
    with pytest.raises(KeyboardInterrupt):
        fresh.move([closed(world, 0.4e-3) for world in fresh.worlds])
    assert [state(world) for world in fresh.worlds] == before


@pytest.fixture(scope="module")
def pressing(tmp_path_factory: pytest.TempPathFactory) -> tuple[Scene, ...]:
    import trimesh

    path: Path = tmp_path_factory.mktemp("mesh") / "ball.stl"
    trimesh.creation.icosphere(3, radius=3.0).export(path)
    brick = path.with_name("brick.stl")
    trimesh.creation.box((3.0, 2.0, 4.0)).export(brick)
    shapes: tuple[Shape, ...] = (Sphere(radius=4e-3), Mesh(path=str(path)), Mesh(path=str(brick)))
    return tuple(
        Scene(body=None, indenter=Indenter(geometry=shape, friction=friction), gel=GEL)
        for shape, friction in zip(shapes, (0.3, 0.6, 0.9), strict=True)
    )


def pressed(world: World, by: tuple[float, float, float]) -> dict[str, Pose]:
    pose = world.pose("indenter")
    return {"indenter": Pose(pose.position + by, pose.quaternion)}


@pytest.mark.cpu
def test_presses_of_several_indenters_are_worlds_to_the_bit(pressing: tuple[Scene, ...]) -> None:
    batch, alone = Batch(pressing), [PressWorld(scene) for scene in pressing]
    way = ((0.1e-3, 0, -0.5e-3), (0, 0, -0.3e-3), (0, -0.1e-3, -0.4e-3))
    expected = [world.move(pressed(world, by)) for world, by in zip(alone, way, strict=True)]
    assert batch.move([pressed(world, by) for world, by in zip(batch.worlds, way, strict=True)]) == expected
    assert_same(batch.worlds, alone)
    assert all(world.wrench("lower")[2] < -0.01 for world in alone)
    before = [state(world) for world in batch.worlds]
    batch.move([None, pressed(batch.worlds[1], (0.1e-3, 0, 0)), None])
    after = [state(world) for world in batch.worlds]
    assert [a == b for a, b in zip(before, after, strict=True)] == [True, False, True]


def test_scenes_that_cannot_share_a_launch_are_named() -> None:
    cube, ball = SCENES[0], Scene(body=None, indenter=Indenter(geometry=Sphere(radius=4e-3)), gel=GEL)
    with pytest.raises(ValueError, match="environment 1 with an indenter, environments 0, 2 with a body"):
        Batch([cube, ball, cube])
    with pytest.raises(ValueError, match="environments 1, 2: physics 'seed' does not run in a batch"):
        Batch([cube, *[with_body(Box(size=(3e-3,) * 3), physics="seed")] * 2])
    finer = cube.model_copy(update={"element_size": 0.5e-3})
    with pytest.raises(ValueError, match=r"environment 2 has 16 x 16 x 8 .* 0\.5 mm, environment 0 8 x 8 x 4 .* 1 mm"):
        Batch([cube, cube, finer])
    with pytest.raises(ValueError, match="environment 1 has 10 x 10 x 4"):
        Batch([ball, ball.model_copy(update={"gel": Gel(size=(10e-3, 10e-3, 4e-3))})])
    with pytest.raises(ValueError, match="at least one scene"):
        Batch([])


def test_wrong_targets_are_refused_before_anything_moves(fresh: Batch) -> None:
    before = [state(world) for world in fresh.worlds]
    with pytest.raises(KeyError, match="no driven frame middle") as caught:
        fresh.move([closed(fresh.worlds[0], 0.4e-3), {"middle": Pose()}, None])
    assert caught.value.__notes__ == ["in the motion of environment 1"]
    with pytest.raises(ValueError, match="2 targets for 3 environments"):
        fresh.move([None, None])
    with pytest.raises(ValueError, match="environment 1 rests"):
        fresh.move([None] * 3, [None, {"upper": 1.0}, None])
    with pytest.raises(ValueError, match="load of 'upper' is -1 N"):
        fresh.move([STAY] * 3, [None, {"upper": -1.0}, None])
    assert [state(world) for world in fresh.worlds] == before
