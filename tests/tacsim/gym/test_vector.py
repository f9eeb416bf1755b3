"""Many environments at once give what each gives alone, and keep to gymnasium's conventions."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from tacsim.limits import ActionError
from tacsim.physics.failure.health import SimulationDiverged
from tacsim.physics.worlds.batch import Batch
from tacsim.tasks import GoalOutOfReach
from tests.tacsim.gym.small import NAME, SMALL, VARIANTS, assert_equal, make, make_native

MODES = ("NextStep", "SameStep", "Disabled")
PUSH, STILL = np.array([1.0, -1.0], np.float32), np.zeros(2, np.float32)


def actions(rng: np.random.Generator, number: int) -> np.ndarray:
    return rng.uniform(-1.0, 1.0, (number, 2)).astype(np.float32)


@pytest.fixture
def sync_of() -> Iterator[Any]:
    """Worlds apart, each with launches of its own, by gymnasium's own vector environment."""
    opened: list[SyncVectorEnv] = []

    def make_sync(number: int, mode: str, **options: Any) -> SyncVectorEnv:
        opened.append(SyncVectorEnv([partial(make, **options)] * number, autoreset_mode=AutoresetMode(mode)))
        return opened[-1]

    yield make_sync
    for env in opened:
        env.close()


@pytest.mark.slow
@pytest.mark.cpu
@pytest.mark.parametrize(
    ("mode", "motion"), [("NextStep", "settled"), ("SameStep", "flowing"), ("Disabled", "settled")]
)
def test_a_batch_gives_the_bits_of_worlds_apart(mode: str, motion: str, sync_of: Any) -> None:
    """In all modes, over episodes of unequal length, each with a variant of its own."""
    number, rng = 3, np.random.default_rng(1)
    options = {"overrides": [*SMALL, f"motion={motion}"]}
    batched, apart = make_native(number, mode, **options), sync_of(number, mode, **options)
    assert_equal(batched.reset(seed=7), apart.reset(seed=7))
    played = set()
    for _ in range(7):
        given = actions(rng, number)
        found, wanted = batched.step(given), apart.step(given)
        assert_equal(found, wanted)
        played |= set(found[4]["variant"][found[4]["_variant"]])
        over = found[2] | found[3]
        assert ("final_obs" in found[4]) == (mode == "SameStep" and bool(over.any()))
        if mode == "Disabled" and over.any():
            mask = {"reset_mask": over.copy()}
            assert_equal(batched.reset(options=mask), apart.reset(options=dict(mask)))
    assert played == {0, 1, 2}
    batched.close()


@pytest.mark.cpu
def test_results_depend_neither_on_the_number_nor_on_earlier_episodes() -> None:
    alone = make()
    wanted = [alone.reset(seed=5), *(alone.step(PUSH / 2) for _ in range(2))]
    for variant in (2, 1, 0, 1):  # another history, in which states of contact are kept
        alone.reset(options={"variant": variant})
        alone.step(PUSH)
    assert_equal([alone.reset(seed=5), *(alone.step(PUSH / 2) for _ in range(2))], wanted)
    many = make_native(4)
    many.reset(seed=[11, 12, 13, 14])
    many.step(np.tile(PUSH, (4, 1)))
    flats, infos = many.reset(seed=[1, 2, 5, 4])
    found = [(flats, infos), *(many.step(np.tile(PUSH / 2, (4, 1))) for _ in range(2))]
    for each, one in zip(found, wanted, strict=True):
        assert_equal({key: value[2] for key, value in each[0].items()}, one[0])
        assert {key: each[-1][key][2] for key in one[-1]} == one[-1]
    assert found[-1][1][2] == wanted[-1][1]
    many.close()


def test_reset_mask_leaves_the_others_alone() -> None:
    env = make_native(3, "Disabled")
    env.reset(seed=0)
    before, *_ = env.step(np.tile(PUSH, (3, 1)))
    after, infos = env.reset(seed=[8, 9, 10], options={"reset_mask": np.array([False, True, False])})
    assert infos["_distance"].tolist() == [False, True, False]
    for key, value in after.items():
        assert np.array_equal(value[[0, 2]], before[key][[0, 2]])
    assert not np.array_equal(after["pose_upper"][1], before["pose_upper"][1])
    assert_equal({key: value[1] for key, value in after.items()}, make().reset(seed=9)[0])
    with pytest.raises(TypeError, match="reset_mask"):
        env.reset(options={"reset_mask": [True, False, False]})
    env.close()


@pytest.mark.parametrize("mode", MODES)
def test_one_that_diverges_ends_its_own_episode(mode: str, monkeypatch: pytest.MonkeyPatch) -> None:
    env, other = (make_native(2, mode, overrides=[*SMALL, "task.steps=9"], variants=()) for _ in range(2))
    env.reset(seed=3)
    other.reset(seed=3)
    both = np.tile(PUSH / 2, (2, 1))
    before, *_ = env.step(both)
    other.step(both)
    move = Batch.move

    def fail_first(self: Batch, targets: Any, *given: Any, **options: Any) -> Any:
        ends = move(self, [None, *targets[1:]], *given, **options)
        return [SimulationDiverged("NaN", "substep 3", "move less"), *ends[1:]]

    monkeypatch.setattr(Batch, "move", fail_first)
    found = env.step(both)
    monkeypatch.undo()
    wanted = other.step(both)
    flats, rewards, terminated, truncated, infos = found
    assert truncated.tolist() == [True, False] and not terminated.any()
    info = infos["final_info"] if mode == "SameStep" else infos
    assert "NaN; substep 3" in info["diverged"][0] and info["_diverged"].tolist() == [True, False]
    last = infos["final_obs"][0] if mode == "SameStep" else {key: value[0] for key, value in flats.items()}
    assert_equal(last, {key: value[0] for key, value in before.items()})
    assert_equal({key: value[1] for key, value in flats.items()}, {k: v[1] for k, v in wanted[0].items()})
    assert rewards[1] == wanted[1][1]
    if mode == "Disabled":
        with pytest.raises(ResetNeeded, match=r"environment 0: .* reset_mask"):
            env.step(both)
        env.reset(options={"reset_mask": np.array([True, False])})
    assert env.step(both)[3].tolist() == [False, False]
    for each in (env, other):
        each.close()


def test_a_limit_of_one_arm_ends_one_episode() -> None:
    box = "{lower: [-1 m, -1 m, -1 m], upper: [1 m, 1 m, 1 m]}"
    limits = f"arms.upper.limits={{workspace: {box}, force: 0.3 N}}"
    env = make_native(2, overrides=[*SMALL, limits, "task.steps=30"], variants=())
    env.reset(seed=0)
    for _ in range(20):
        _, _, terminated, truncated, infos = env.step(np.array([PUSH, STILL]))
        if terminated.any():
            break
    assert terminated.tolist() == [True, False] and not truncated.any()
    assert "limits.force" in infos["limit"][0] and infos["_limit"].tolist() == [True, False]
    _, rewards, terminated, _, infos = env.step(
        np.array([PUSH, STILL])
    )  # the first is reset, and its action is not used
    assert rewards[0] == 0.0 and rewards[1] < 0.0 and not terminated.any() and "limit" not in infos
    env.close()


def test_a_bad_action_is_refused_before_anything_moves() -> None:
    env, other = make_native(2), make_native(2)
    env.reset(seed=3)
    other.reset(seed=3)
    for bad, error in (([[0.5, -0.5], [1.5, 0.0]], ActionError), ([[0.5, -0.5]], ValueError)):
        with pytest.raises(error):
            env.step(np.array(bad, np.float32))
    both = np.tile(PUSH / 2, (2, 1))
    assert_equal(env.step(both), other.step(both))
    for each in (env, other):
        each.close()


def test_a_step_before_the_first_reset_is_refused() -> None:
    env = make_native(2)
    with pytest.raises(ResetNeeded, match="environment 0, 1"):
        env.step(np.zeros((2, 2), np.float32))
    with pytest.raises(ResetNeeded, match="environment 1 has no episode yet"):
        env.reset(seed=1, options={"reset_mask": np.array([True, False])})
    env.close()


@pytest.mark.parametrize("mode", MODES)
def test_what_it_declares(mode: str) -> None:
    env = make_native(3, mode, render_mode="rgb_array")
    assert isinstance(env, SyncVectorEnv) and env.num_envs == 3 and env.spec.id == NAME
    assert env.metadata["autoreset_mode"] is AutoresetMode(mode) and env.metadata["reset_mask"] is True
    assert env.single_action_space == gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)
    flats, _ = env.reset(seed=4)
    assert flats in env.observation_space
    assert [each.np_random_seed for each in env.envs] == [4, 5, 6] == list(env.np_random_seed)
    assert [picture.shape for picture in env.render()] == [(16, 40, 3)] * 3
    env.close()
    env.close()


def test_what_cannot_be_a_batch_says_so() -> None:
    with pytest.raises(ValueError, match="physics 'seed' does not run in a batch"):
        make_native(2, overrides=["scene.physics=seed"], variants=())
    with pytest.raises(ValueError, match="rig 'mock' is not simulated"):
        make_native(2, rig="mock", overrides=(), variants=())
    with pytest.raises(ValueError, match="one of NextStep, SameStep, Disabled, got 'Sometimes'"):
        make_native(2, "Sometimes")
    with pytest.raises(ValueError, match="1 to 10,000"):
        make_native(0)
    with pytest.raises(ValueError, match=r"variant 0: a new scene must keep gel\.size"):
        make_native(2, variants=[["scene.gel.size=[10 mm, 10 mm, 4 mm]"]])
    with pytest.raises(ValueError, match=r"variant 0: a new scene must keep gel\.size of sensor 'upper'"):
        make_native(2, variants=[["scene.gels.upper.size=[10 mm, 10 mm, 4 mm]"]])
    with pytest.raises(ValueError, match="variant 1 may change nothing but scene, task"):
        make_native(2, variants=[[], ["period=50 ms"]])
    with pytest.raises(ValueError, match="variant 0: a new task must keep touch_force"):
        make_native(2, variants=[["task.touch_force=0.1 N"]])


def test_variants_are_drawn_by_the_seed_or_chosen() -> None:
    env = make()
    drawn = [env.reset(seed=seed)[1]["variant"] for seed in range(12)]
    assert set(drawn) == {0, 1, 2} and drawn == [env.reset(seed=seed)[1]["variant"] for seed in range(12)]
    assert env.reset(options={"variant": 1})[1]["body_height"] == pytest.approx(5e-3, rel=0.02)
    assert "variant" not in env.reset(options={"scene": env.scene})[1]
    with pytest.raises(ValueError, match=f"variants 0 to {len(VARIANTS) - 1}, got 3"):
        env.reset(options={"variant": 3})
    env.close()


def test_a_scene_that_is_given_is_seen_by_the_environments_own_sensors() -> None:
    """Whatever the variant before it looked like."""
    env = make(variants=[["sensors.lower.model.texture=20 um"]])
    given = {"scene": env.scene, "task": env.task.config}
    own, _ = env.reset(seed=3, options=given)
    other, _ = env.reset(seed=3, options={"variant": 0})
    again, _ = env.reset(seed=3, options=given)
    assert not np.array_equal(other["tactile_lower"], own["tactile_lower"])
    for key, value in own.items():
        np.testing.assert_array_equal(again[key], value)
    env.close()


def test_a_reset_with_a_new_body_and_goal() -> None:
    env = make(variants=())
    _, before = env.reset(seed=0)
    body = env.scene.body
    taller = body.model_copy(update={"geometry": body.geometry.model_copy(update={"size": (3e-3, 3e-3, 4e-3)})})
    scene = env.scene.model_copy(update={"body": taller})
    task = env.task.config.model_copy(update={"goal": 3.5e-3})
    _, info = env.reset(seed=0, options={"scene": scene, "task": task})
    assert info["body_height"] == pytest.approx(before["body_height"] + 1e-3, rel=0.01)
    assert info["distance"] == pytest.approx(info["body_height"] - 3.5e-3)
    _, info = env.reset(seed=0)  # they hold until others are given
    assert info["distance"] == pytest.approx(info["body_height"] - 3.5e-3)
    with pytest.raises(ValueError, match=r"must keep gel\.size"):
        env.reset(
            options={"scene": scene.model_copy(update={"gel": scene.gel.model_copy(update={"size": (9e-3,) * 3})})}
        )
    with pytest.raises(ValueError, match="must keep touch_force"):  # and the scene stays, too
        env.reset(options={"scene": env.scene.model_copy(update={"body": body}),
                           "task": task.model_copy(update={"touch_force": 0.1})})  # fmt: skip
    assert env.scene == scene
    with pytest.raises(ValueError, match="has some"):
        env.reset(options={"variant": 0})
    env.close()


def test_a_goal_that_nobody_can_reach_is_refused_at_reset_alone_and_in_a_batch() -> None:
    beyond = [*SMALL, "task.goal=3.2 mm"]
    env, batch = make(overrides=beyond, variants=()), make_native(2, overrides=beyond, variants=())
    for each in (env, batch):
        with pytest.raises(GoalOutOfReach, match=r"task.goal: 3.2 mm is above the body, which is 2"):
            each.reset(seed=1)
    with pytest.raises(ResetNeeded):
        env.step(np.zeros(2, np.float32))
    batch.close()
