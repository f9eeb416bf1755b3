"""A world is one thing: no copies, one motion at a time, and frames by their names."""

from __future__ import annotations

import copy
import pickle
import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from tacsim.interface import Pose
from tacsim.models.material import BodyMaterial
from tacsim.models.scene import Body, Box, Gel, Indenter, Scene, Sphere
from tacsim.physics.move import MoveCommand
from tacsim.physics.seed.world import SeedWorld
from tacsim.physics.world import World, make_world
from tacsim.physics.worlds.batch import Batch
from tacsim.physics.worlds.hybrid import HybridWorld
from tacsim.physics.worlds.press import PressWorld

GEL = Gel(size=(8e-3, 8e-3, 4e-3))
BALL = Scene(body=None, indenter=Indenter(geometry=Sphere(radius=3e-3)), gel=GEL)
CUBE = Scene(body=Body(geometry=Box(size=(3e-3,) * 3), material=BodyMaterial(yield_stress=30e3)), gel=GEL)
SEED = CUBE.model_copy(update={"physics": "seed"})


@pytest.fixture(params=[BALL, CUBE, pytest.param(SEED, marks=pytest.mark.cpu)], ids=["press", "hybrid", "seed"])
def world(request: pytest.FixtureRequest) -> World:
    return make_world(request.param)


def down(world: World, by: float = 0.3e-3) -> dict[str, Pose]:
    name = "indenter" if world.sensors == ("lower",) else "upper"
    return {name: Pose(world.pose(name).position - [0.0, 0.0, by], world.pose(name).quaternion)}


def state(world: World) -> dict[str, bytes]:
    return {name: a.tobytes() for name, a in world.snapshot().items()}


@pytest.mark.parametrize("copied", [copy.copy, copy.deepcopy, pickle.dumps])
def test_a_world_cannot_be_copied(world: World, copied: Callable[[object], object]) -> None:
    with pytest.raises(TypeError, match=r"make_world\(scene\) and restore\(world.snapshot\(\)\)"):
        copied(world)


def test_nor_can_a_batch_be() -> None:
    with pytest.raises(TypeError, match=r"a Batch cannot be copied or pickled: Batch\(scenes\)"):
        copy.deepcopy(Batch([BALL]))


@pytest.mark.cpu
def test_a_world_makes_one_motion_at_a_time() -> None:
    """Its numbers are those of a motion on its way: whoever else moves it is told, and that motion is not disturbed."""
    batch, alone = Batch([BALL, BALL]), PressWorld(BALL)
    world = batch.worlds[0]
    motion = world.motion(MoveCommand(down(world)))
    next(motion)
    with pytest.raises(RuntimeError, match="this world is already moving"):
        world.move({})
    with pytest.raises(RuntimeError, match="this world is already moving"):
        batch.move([{}, {}])
    batch.move([None, {}])
    motion.close()
    world.move(down(world))
    alone.move(down(alone))
    assert state(world) == state(alone)


@pytest.mark.parametrize("kind", [PressWorld, HybridWorld, pytest.param(SeedWorld, marks=pytest.mark.cpu)])
def test_a_motion_that_fails_leaves_the_world_free(kind: type, monkeypatch: pytest.MonkeyPatch) -> None:
    world = make_world({PressWorld: BALL, HybridWorld: CUBE, SeedWorld: SEED}[kind])
    with monkeypatch.context() as patched:

        def interrupted(*arguments: object) -> None:
            raise KeyboardInterrupt

        patched.setattr(kind, "_advance", interrupted)
        with pytest.raises(KeyboardInterrupt):
            world.move(down(world))
    with pytest.raises(KeyError):
        world.move({"middle": Pose()})
    assert world.move({}).settled


@pytest.mark.cpu
def test_worlds_of_a_batch_move_in_threads_of_their_own() -> None:
    """They share the arrays that say who takes part in a launch."""
    batch, alone = Batch([BALL] * 3), PressWorld(BALL)
    steps = 6

    def press(world: World) -> None:
        for _ in range(steps):
            world.move(down(world, 0.1e-3))

    threads = [threading.Thread(target=press, args=(world,)) for world in batch.worlds]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    press(alone)
    assert [state(world) == state(alone) for world in batch.worlds] == [True] * 3


def test_frames_that_are_not_there_are_named(world: World) -> None:
    for asked in (world.wrench, world.surface):
        with pytest.raises(KeyError, match="no sensor 'indenter'; this world has lower"):
            asked("indenter")
    with pytest.raises(KeyError, match="no driven frame middle; this world drives lower, "):
        world.pose("middle")


@pytest.mark.slow
@pytest.mark.cpu
def test_a_snapshot_makes_a_second_world(world: World) -> None:
    """As the error of a copy advises."""
    world.move(down(world))
    other = make_world(world.scene)  # type: ignore[attr-defined]
    other.restore(world.snapshot())
    assert state(other) == state(world)
    for one in (world, other):
        one.move(down(one))
    assert np.array_equal(other.wrench("lower"), world.wrench("lower"))


def test_a_snapshot_that_does_not_fit_changes_nothing(world: World) -> None:
    world.move(down(world))
    good = dict(world.snapshot())
    before = state(world)

    def refused(kind: type[Exception], words: str, given: Any) -> None:
        with pytest.raises(kind, match=words):
            world.restore(given)
        assert state(world) == before

    for name, array in good.items():
        if name != "grid_velocity":  # without it particles say how a body moves
            refused(
                ValueError, f"'{name}' must have shape .*, found nothing", {k: a for k, a in good.items() if k != name}
            )
        refused(ValueError, f"'{name}' must have shape", {**good, name: np.zeros((2, *array.shape))})
        refused(ValueError, f"'{name}' must hold", {**good, name: array.astype(complex)})
    for numbers in (np.full_like(good["poses"], np.nan), np.zeros_like(good["poses"])):
        refused(ValueError, "snapshot: 'poses' of 'lower': Pose", {**good, "poses": numbers})
    for name in {"rates", "true_inertia", "speed"} & set(good):
        refused(ValueError, f"'{name}' is not finite", {**good, name: np.full_like(good[name], np.nan)})
    world.restore({name: array.tolist() for name, array in good.items()})  # type: ignore[misc]
    assert state(world) == before


@pytest.mark.parametrize(
    "command",
    [
        {"targets": None},
        {"targets": {"lower": [0, 0, 0]}},
        {"targets": {}, "loads": {"lower": "1"}},
        {"targets": {3: Pose()}},
        {"targets": {}, "loads": {"lower": -1.0}},
    ],
)
def test_a_command_that_makes_no_sense_changes_nothing(world: World, command: dict[str, Any]) -> None:
    before = state(world)
    with pytest.raises((TypeError, AttributeError, KeyError, ValueError)):
        world.move(**command)
    assert state(world) == before
