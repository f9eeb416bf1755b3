"""Threads of one environment: what comes out does not depend on them, and nobody waits for ever."""

import numpy as np
import pytest

from tacsim.compute.runtime import start_taichi, ti
from tacsim.compute.threads import core_count
from tacsim.interface import Pose
from tacsim.models.scene import Gel, Indenter, Scene, Sphere
from tacsim.physics.exec import team
from tacsim.physics.exec.lanes import PARTS
from tacsim.physics.worlds.batch import Batch
from tacsim.physics.worlds.press import PressWorld

pytestmark = pytest.mark.cpu


Found = ti.types.ndarray(dtype=ti.i32, ndim=1)


def scene(radius: float) -> Scene:
    return Scene(body=None, indenter=Indenter(geometry=Sphere(radius=radius)), gel=Gel(size=(8e-3, 8e-3, 4e-3)))


def down(world: PressWorld) -> dict[str, Pose]:
    return {"indenter": Pose(world.pose("indenter").position - [0.0, 0.0, 0.3e-3])}


@pytest.mark.skipif(core_count() < 2, reason="one processor: no team to compare")
def test_any_team_gives_the_same_bits(monkeypatch: pytest.MonkeyPatch) -> None:
    states = []
    for size in (1, 2):
        monkeypatch.setattr(team, "team_size", lambda environments, size=size: size)
        world = PressWorld(scene(3e-3))
        world.move(down(world))
        states.append(world.snapshot())
    assert all(states[0][name].tobytes() == states[1][name].tobytes() for name in states[0])


@pytest.mark.parametrize("moving", [0, 2])
@pytest.mark.parametrize("size", [2, 4])
def test_one_of_three_moves_with_any_team(moving: int, size: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also with more members than threads: nobody waits for one that has not begun."""
    monkeypatch.setattr(team, "team_size", lambda environments: size)
    batch = Batch([scene(radius) for radius in (2e-3, 3e-3, 4e-3)])
    targets = [down(world) if index == moving else None for index, world in enumerate(batch.worlds)]  # type: ignore[arg-type]
    ends = batch.move(targets)
    assert [end is not None for end in ends] == [index == moving for index in range(3)]
    assert np.isfinite(batch.worlds[moving].wrench("lower")).all()


@pytest.mark.parametrize(
    ("taken", "done", "own", "expected"),
    [
        ([1, 0, 0, 0], 0, 0, 1),  # the first stage has begun
        ([1, 0, 0, 0], 0, 2, 2),  # own parts first
        ([1, 0, 1, 1], 2, 2, 1),  # then what others have left
        ([1, 1, 1, 1], PARTS, 2, PARTS + 2),  # the second stage
        ([1, 1, 1, 1], PARTS - 1, 0, 2 * PARTS),  # another member has the last piece of the first, too long: leave
        ([2, 2, 2, 2], 2 * PARTS - 1, 0, 2 * PARTS),  # nothing is left
    ],
)
def test_the_next_piece(taken: list[int], done: int, own: int, expected: int) -> None:
    sync, found = np.zeros((1, 16), np.int32), np.zeros(1, np.int32)
    sync[0, team.CLAIMED : team.CLAIMED + PARTS], sync[0, team.DONE] = taken, done
    start_taichi()
    ask(sync, found, own)
    assert found[0] == expected
    assert sync[0, team.CLAIMED : team.CLAIMED + PARTS].sum() == sum(taken) + (expected < 2 * PARTS)


@ti.kernel
def ask(sync: team.Sync, found: Found, own: ti.i32):
    ti.loop_config(serialize=True)
    for n in range(1):
        found[n] = team.claim_work(sync, n, own, 2)


def test_teams_fit_the_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tacsim.compute.threads.core_count", lambda: 4)
    monkeypatch.delenv("TACSIM_THREADS", raising=False)
    assert [team.team_size(n) for n in (1, 2, 3, 8)] == [4, 2, 1, 1]
    monkeypatch.setenv("TACSIM_THREADS", "1")
    assert team.team_size(1) == 1
