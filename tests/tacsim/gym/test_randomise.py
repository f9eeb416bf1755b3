"""Environments whose episodes are drawn from distributions."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tacsim.config import ConfigError, load_rig, shipped_names
from tacsim.config.load import load_model
from tacsim.models.randomisation import Randomisation
from tacsim.tasks import BadDraws, GoalOutOfReach
from tests.tacsim.gym.small import assert_equal, make, make_native, touch_nothing_slippery

DRAWN: dict[str, Any] = {
    "draws": 3,
    "values": {
        "task.goal": {"uniform": ["1.5 mm", "2.5 mm"]},
        "scene.body.material.yield_stress": {"log_uniform": ["5 kPa", "20 kPa"]},
        "sensors.lower.model.lighting.shininess": {"uniform": [2, 30]},
        "sensors.upper.model.texture": {"choice": ["2 um", "20 um"]},
        "arms.upper.error.position": {"uniform": [["-1 mm", "-1 mm", "-0.2 mm"], ["1 mm", "1 mm", "0.2 mm"]]},
        "arms.lower.noise.force": {"uniform": ["10 mN", "50 mN"]},
        "arms.lower.delay": {"choice": [0, 1]},
    },
}
PUSH = np.array([1.0, -1.0], np.float32)


def test_episodes_differ_as_drawn_and_come_again_by_their_seed() -> None:
    env = make(variants=(), randomise=DRAWN)
    seen = {}
    for seed in range(16):
        flat, info = env.reset(seed=seed)
        assert info["drawn"].startswith("task.goal=") and "sensors.lower.model.lighting.shininess=" in info["drawn"]
        assert float(info["drawn"].split("=")[1].split()[0]) == pytest.approx(1e3 * env.task.config.goal)
        seen.setdefault(info["variant"], []).append((seed, flat, info["drawn"], env.step(PUSH)[0]))
    assert len(seen) == 3 and len({each[0][2] for each in seen.values()}) == 3
    pictures = [each[0][3]["tactile_lower"] for each in seen.values()]
    assert any((pictures[0] != other).any() for other in pictures[1:])  # lit otherwise
    for (seed, flat, drawn, after), *_ in seen.values():
        again, info = env.reset(seed=seed)
        assert info["drawn"] == drawn
        assert_equal(again, flat)
        assert_equal(env.step(PUSH)[0], after)


@pytest.mark.slow
def test_what_cannot_be_is_refused_with_its_key_before_anything_is_simulated() -> None:
    with pytest.raises(ConfigError, match=r"scene\.friction\.upper.*-0\.\d+"):
        make(variants=(), randomise={"values": {"scene.friction.upper": {"uniform": [-0.5, -0.1]}}})
    with pytest.raises(ConfigError, match="frictoin"):
        make(variants=(), randomise={"values": {"scene.frictoin.upper": {"uniform": [0.1, 0.5]}}})
    with pytest.raises(ValueError, match="not both"):
        make(randomise=DRAWN)
    with pytest.raises(ValueError, match=r"variant 0 may change nothing but scene, task, light"):
        make(variants=(), randomise={"values": {"sensors.lower.model.geometry.width": {"choice": [24, 32]}}})
    with pytest.raises(ConfigError, match=r"no randomisation 'squeez'; allowed: .*did you mean 'squeeze'"):
        make(variants=(), randomise="squeez")


@pytest.mark.parametrize("name", shipped_names("randomisation"))
def test_every_shipped_one_fits_its_task(name: str) -> None:
    found = load_model(Randomisation, name)
    for overrides in found.draw_overrides()[:3]:
        task = name.removesuffix("-twin")
        rig = "hand" if task in ("hold", "turn", "peg", "drawer") else "mock" if name.endswith("-twin") else "sim"
        assert load_rig(rig, task=task, overrides=overrides).config.scene is not None


# Of 12 draws some ask for a goal above the body (3 mm), and cannot begin.
SOME_BAD = {"draws": 12, "values": {"task.goal": {"choice": ["2 mm", "2.2 mm", "3.3 mm"]}}}


def test_a_draw_that_cannot_begin_is_told_and_drawn_anew() -> None:
    env, began = make(variants=(), randomise=SOME_BAD), {}
    for seed in range(12):
        flat, info = env.reset(seed=seed)
        assert info["distance"] < 1e-3 and "3.3" not in info["drawn"]
        began[seed] = flat, info["drawn"], info.get("refused", "")
    told = [refused for *_, refused in began.values() if refused]
    assert told and all("task.goal=3.3 mm: task.goal: 3.3 mm is above the body" in each for each in told)
    assert len(env.refused) == sum(each.count("above the body") for each in told)
    for seed in reversed(range(12)):  # an episode is its seed's, whatever was refused before it
        flat, info = env.reset(seed=seed)
        assert_equal(flat, began[seed][0])
        assert (info["drawn"], info.get("refused", "")) == began[seed][1:]
    bad = next(number for number, goal in enumerate(Randomisation(**SOME_BAD).draw_overrides()) if "3.3" in goal[0])
    with pytest.raises(GoalOutOfReach):  # a variant that somebody chose is played or not
        env.reset(options={"variant": bad})


def test_bad_draws_end_nothing_in_a_batch() -> None:
    envs = make_native(3, "SameStep", variants=(), randomise=SOME_BAD)
    envs.reset(seed=0)
    for _ in range(12):  # four episodes of each
        envs.step(np.tile(PUSH, (3, 1)))
    assert any(env.refused for env in envs.members)
    envs.close()


def test_too_many_bad_draws_in_a_row_are_an_error() -> None:
    all_bad = {"draws": 4, "values": {"task.goal": {"uniform": ["3.2 mm", "3.4 mm"]}}}
    env = make(variants=(), randomise=all_bad)
    with pytest.raises(BadDraws, match=r"8 draws in a row .*task.goal=3\.\d+ mm: .*above the body.*narrow"):
        env.reset(seed=0)


def test_so_is_one_that_finds_no_gentle_contact(monkeypatch: pytest.MonkeyPatch) -> None:
    touch_nothing_slippery(monkeypatch)
    env = make(variants=(), randomise={"draws": 8, "values": {"scene.friction.upper": {"choice": [0.4, 0.6]}}})
    drawn = [env.reset(seed=seed)[1]["drawn"] for seed in range(8)]
    assert set(drawn) == {"scene.friction.upper=0.4"} and env.refused[0] == "scene.friction.upper=0.6: nothing there"
