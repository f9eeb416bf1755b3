"""Threads of one environment: what comes out does not depend on them, and nobody waits for ever."""

from __future__ import annotations

import numpy as np
import pytest

from tacsim.compute.threads import cores
from tacsim.interface import Pose
from tacsim.models.scene import Gel, Indenter, Scene, Sphere
from tacsim.physics.exec import team
from tacsim.physics.worlds.batch import Batch
from tacsim.physics.worlds.press import PressWorld

pytestmark = pytest.mark.cpu


def scene(radius: float) -> Scene:
    return Scene(body=None, indenter=Indenter(geometry=Sphere(radius=radius)), gel=Gel(size=(8e-3, 8e-3, 4e-3)))


def down(world: PressWorld) -> dict[str, Pose]:
    return {"indenter": Pose(world.pose("indenter").position - [0.0, 0.0, 0.3e-3])}


@pytest.mark.skipif(cores() < 2, reason="one processor: no team to compare")
def test_any_team_gives_the_same_bits(monkeypatch: pytest.MonkeyPatch) -> None:
    states = []
    for chosen in (min, max):
        monkeypatch.setattr(team._Pace, "choose", lambda pace, chosen=chosen: chosen(pace.sizes))
        world = PressWorld(scene(3e-3))
        world.move(down(world))
        states.append(world.snapshot())
    assert all(states[0][name].tobytes() == states[1][name].tobytes() for name in states[0])


@pytest.mark.parametrize("moving", [0, 2])
def test_one_of_three_moves_with_the_largest_team(moving: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Members of a team must never share a thread: they would wait for each other for ever."""
    monkeypatch.setattr(team._Pace, "choose", lambda pace: max(pace.sizes))
    batch = Batch([scene(radius) for radius in (2e-3, 3e-3, 4e-3)])
    targets = [down(world) if index == moving else None for index, world in enumerate(batch.worlds)]  # type: ignore[arg-type]
    ends = batch.move(targets)
    assert [end is not None for end in ends] == [index == moving for index in range(3)]
    assert np.isfinite(batch.worlds[moving].wrench("lower")).all()


def test_the_launch_that_compiles_says_nothing_about_pace() -> None:
    pace = team._Pace((1, 2))
    for seconds in (100.0, 2.0, 1.0, 2.0, 1.0):
        size = pace.choose()
        pace.note(size, seconds if seconds == 100.0 else {1: 2.0, 2: 1.0}[size])
    assert run_paced(pace, {1: 2.0, 2: 1.0}, 20).count(2) >= 16


def run_paced(pace: team._Pace, seconds: dict[int, float], launches: int) -> list[int]:
    """Sizes of the next launches, which take so long."""
    chosen = []
    for _ in range(launches):
        chosen.append(pace.choose())
        pace.note(chosen[-1], seconds[chosen[-1]])
    return chosen


def test_a_size_that_was_slow_once_is_back_at_once() -> None:
    pace = team._Pace((1, 2))
    run_paced(pace, {1: 2.0, 2: 1.0}, 200)
    run_paced(pace, {1: 2.0, 2: 8.0}, 5)  # another program had the other processor
    assert run_paced(pace, {1: 2.0, 2: 1.0}, 20).count(2) >= 14


def test_a_size_that_is_slow_is_tried_less_and_less_and_never_given_up() -> None:
    pace = team._Pace((1, 2))
    early, late = run_paced(pace, {1: 1.0, 2: 10.0}, 60), run_paced(pace, {1: 1.0, 2: 10.0}, 260)
    assert early.count(2) < 10 and late.count(2) == 10
    assert run_paced(pace, {1: 1.0, 2: 0.5}, 300)[-20:].count(2) >= 19  # the machine is free again


def test_teams_fit_the_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tacsim.compute.threads.cores", lambda: 4)
    assert [team.team_sizes(n) for n in (1, 2, 3, 8)] == [(1, 2, 4), (1, 2), (1,), (1,)]
    monkeypatch.setenv("TACSIM_THREADS", "1")
    assert team.team_sizes(1) == (1,)
