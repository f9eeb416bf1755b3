"""PPO learns from the reward alone, in an environment without physics."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("stable_baselines3")

from gymnasium import spaces  # noqa: E402
from gymnasium.vector import AutoresetMode  # noqa: E402
from numpy.typing import NDArray  # noqa: E402

from robot.train.network import PolicyNetwork  # noqa: E402
from robot.train.reinforce import Reinforce  # noqa: E402
from tests.robot.train.short import training  # noqa: E402

COUNT, STEPS = 16, 20  # environments; control steps of an episode


class Closing:
    """A body of 10 mm is closed by up to 0.4 mm a step, never opened, to a goal of 6 to 8.5 mm."""

    autoreset_mode = AutoresetMode.SAME_STEP
    num_envs = COUNT
    single_observation_space = spaces.Dict({key: spaces.Box(-np.inf, np.inf, (1,)) for key in ("goal", "touch")})
    single_action_space = action_space = spaces.Box(-1.0, 1.0, (1,))

    def __init__(self) -> None:
        self._random = np.random.default_rng(0)

    def get_attr(self, name: str) -> list[Any]:
        return [{"task": SimpleNamespace(config=SimpleNamespace(steps=STEPS))}[name]] * COUNT

    def call_selected(self, indices: list[int], name: str) -> list[Any]:
        return [{"render_mode": None}[name]] * len(indices)

    def reset(self, **_: Any) -> tuple[dict[str, NDArray[np.float32]], dict[str, Any]]:
        self._height, self._goal = np.full(COUNT, 10.0), self._random.uniform(6.0, 8.5, COUNT)
        self._step = 0
        return self._observe(), {}

    def step(self, actions: NDArray[np.float32]) -> tuple[Any, ...]:
        self._height = self._height - 0.4 * actions[:, 0].clip(0.0, 1.0)
        self._step += 1
        distance, each = np.abs(self._height - self._goal), np.ones(COUNT, np.bool_)
        known = {"distance": 1e-3 * distance, "is_success": distance < 0.1, "peak_force": distance}
        infos: dict[str, Any] = known | {f"_{key}": each for key in known}
        seen, done = self._observe(), self._step == STEPS
        if done:
            ends = [{key: value[index] for key, value in seen.items()} for index in range(COUNT)]
            infos = {"final_obs": ends, "final_info": infos}
            seen, _ = self.reset()
        return seen, -distance, ~each, each & done, infos

    def _observe(self) -> dict[str, NDArray[np.float32]]:
        return {
            "goal": (self._goal[:, None] / 10.0).astype(np.float32),
            "touch": (self._height[:, None] / 10.0).astype(np.float32),
        }


@pytest.mark.slow
def test_ppo_learns_to_stop_at_the_goal(tmp_path: Path) -> None:
    """0.08 mm after 25,600 steps. With features as they are it ends at 0.5 mm, with rewards as they are at 0.2 mm."""
    torch.set_num_threads(1)
    settings = training(algorithm="ppo", width=32, reinforce={"rounds": 40, "batch": 128, "rate": 1e-3})
    envs: Any = Closing()
    learner = Reinforce(envs, settings, PolicyNetwork({"goal": (1,), "touch": (1,)}, 1, 32, clip=True), tmp_path)
    ends = [learner.round(number, lambda words, done, of: None)["distance"] for number in range(learner.rounds)]
    assert ends[0] > 1e-3
    assert np.mean(ends[-4:]) < 0.15e-3
