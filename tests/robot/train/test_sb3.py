"""stable-baselines3 on our environments: its own checks, and the infos at the end of episodes."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from typing import Any

import gymnasium
import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("stable_baselines3")

from stable_baselines3 import PPO  # noqa: E402
from stable_baselines3.common.env_checker import check_env  # noqa: E402
from stable_baselines3.common.evaluation import evaluate_policy  # noqa: E402
from stable_baselines3.common.vec_env import VecMonitor  # noqa: E402

from robot.train.reinforce import FeaturesExtractor, SharedVecEnv  # noqa: E402
from tests.tacsim.gym.small import assert_equal, make, make_native  # noqa: E402

FEATURES = {
    "maps": ["height"],
    "grid": {"rows": 4, "columns": 4, "pitch": 2e-3},
    "touch": ["depth", "wrench"],
    "frames": 2,
}


@pytest.fixture
def envs() -> Iterator[SharedVecEnv]:
    opened = SharedVecEnv(make_native(3, "SameStep", features=FEATURES))
    yield opened
    opened.close()


def test_extractor_default_observation_is_small() -> None:
    """10.2 million parameters where pictures and maps of 64 x 64 are seen."""
    env = gymnasium.make("tacsim/Squeeze-v0")
    policy = PPO("MultiInputPolicy", env, device="cpu").policy
    assert sum(each.numel() for each in policy.parameters()) < 100_000
    env.close()


@pytest.mark.parametrize("features", [{**FEATURES, "maps": []}, {**FEATURES, "maps": ["height", "picture"]}, "default"])
def test_env_checker_warns_only_about_maps(features: Any) -> None:
    """It treats arrays with three axes as pictures and expects bytes; for heights bytes are too coarse."""
    env = make(features=features)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check_env(env, warn=True)
    said = [str(each.message) for each in caught]
    assert bool(said) == (features == "default" or bool(features["maps"]))
    assert all("image" in words for words in said)


def test_shared_vec_env_returns_infos_of_environments(envs: SharedVecEnv) -> None:
    """The same arrays; at an episode's end (after 3 steps, or 2) its last observation and the next one's first."""
    twin = make_native(3, "SameStep", features=FEATURES)
    envs.seed(5)
    seen, (same, _) = envs.reset(), twin.reset(seed=5)
    assert_equal(seen, same)
    assert all(set(info) >= {"is_success", "distance", "variant"} for info in envs.reset_infos)
    random, ended = np.random.default_rng(1), 0
    for _ in range(4):
        actions = random.uniform(-1, 1, (3, 2)).astype(np.float32)
        seen, rewards, done, infos = envs.step(actions)
        same, wanted, terminated, truncated, told = twin.step(actions)
        assert_equal(seen, same)
        assert rewards.tolist() == wanted.astype(np.float32).tolist()
        assert done.tolist() == (terminated | truncated).tolist()
        for index, info in enumerate(infos):
            if done[index]:
                ended += 1
                assert_equal(info["terminal_observation"], told["final_obs"][index])
                assert info["TimeLimit.truncated"] is True
                assert info["distance"] == told["final_info"]["distance"][index]
                assert not np.array_equal(info["terminal_observation"]["touch"], seen["touch"][index])
            else:
                assert "terminal_observation" not in info
                assert info["distance"] == told["distance"][index]
    assert ended >= 3
    twin.close()


def test_shared_vec_env_termination_is_not_time_limit() -> None:
    envs = SharedVecEnv(make_native(2, "SameStep", features=FEATURES, variants=[["task.force_limit=51 mN"]]))
    envs.reset()
    _, rewards, done, infos = envs.step(np.tile(np.float32([1.0, -1.0]), (2, 1)))
    assert done.all()
    assert [info["TimeLimit.truncated"] for info in infos] == [False, False]
    assert all("force_limit" in info["limit"] for info in infos)
    assert (rewards < -2).all()
    envs.close()


def test_shared_vec_env_works_with_sb3_tools(envs: SharedVecEnv) -> None:
    watched: Any = VecMonitor(envs)
    model = PPO(
        "MultiInputPolicy", watched, n_steps=4, batch_size=12, n_epochs=1, seed=1, device="cpu",
        policy_kwargs={"features_extractor_class": FeaturesExtractor},
    )  # fmt: skip
    model.learn(24)
    assert len(model.ep_info_buffer or ()) >= 3
    mean, _ = evaluate_policy(model, watched, n_eval_episodes=3)
    assert np.isfinite(mean)
    assert envs.get_attr("phase") == ["running"] * 3
    assert len(envs.env_method("expert", indices=[0, 2])) == 2
    assert envs.env_is_wrapped(VecMonitor) == [False] * 3
    watched.seed(3)
    watched.set_options({"variant": 1})
    with pytest.raises(ValueError, match="reset options apply to all environments"):
        watched.reset()


def test_shared_vec_env_other_autoreset_mode_raises() -> None:
    envs = make_native(2, "NextStep", features=FEATURES)
    with pytest.raises(ValueError, match="needs autoreset_mode 'SameStep', got 'NextStep'"):
        SharedVecEnv(envs)
    envs.close()
