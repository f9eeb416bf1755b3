"""What stable-baselines3 needs of our environments: a VecEnv, and an extractor for maps and numbers together.

envs = SharedVecEnv(robot.make_vector_env(16, "squeeze", features={}, autoreset_mode="SameStep", randomise="squeeze"))
PPO("MultiInputPolicy", envs, policy_kwargs={"features_extractor_class": FeaturesExtractor}).learn(10_000)
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import VecEnv

from robot.train.network import FeatureLayers
from tacsim.gym.vector import TacsimVectorEnv

Arrays = dict[str, NDArray[Any]]


class SharedVecEnv(VecEnv):
    """Environments that share launches, as stable-baselines3 calls them.

    infos have `terminal_observation`, `TimeLimit.truncated` and `is_success` where an episode ends, and what
    `TacsimEnv.step` tells besides. Raises ValueError for environments that are not reset in the step in which they end.
    """

    def __init__(self, envs: TacsimVectorEnv) -> None:
        if envs.autoreset_mode != AutoresetMode.SAME_STEP:
            raise ValueError(f"stable-baselines3 needs autoreset_mode 'SameStep', got '{envs.autoreset_mode.value}'")
        self.envs = envs
        self._actions: NDArray[np.float32] | None = None
        super().__init__(envs.num_envs, envs.single_observation_space, envs.single_action_space)

    def reset(self) -> Arrays:
        # stable-baselines3 hands over seeds and options by `seed` and `set_options`, an entry an environment.
        seeds = list(self._seeds)
        if any(self._options):
            raise ValueError("options of a reset are those of all environments: use the environments themselves")
        seen, infos = self.envs.reset(seed=None if all(seed is None for seed in seeds) else seeds)
        self.reset_infos = [one(infos, index) for index in range(self.num_envs)]
        self._reset_seeds()
        self._reset_options()
        return copied(seen)

    def step_async(self, actions: NDArray[np.float32]) -> None:
        self._actions = actions

    def step_wait(self) -> tuple[Arrays, NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        seen, rewards, terminated, truncated, told = self.envs.step(self._actions)
        done = terminated | truncated
        infos = []
        for index in range(self.num_envs):
            if done[index]:
                info = one(told["final_info"], index)
                info["terminal_observation"] = told["final_obs"][index]
                info["TimeLimit.truncated"] = bool(truncated[index] and not terminated[index])
            else:
                info = one(told, index)
            infos.append(info)
        return copied(seen), rewards.astype(np.float32), done, infos

    def close(self) -> None:
        self.envs.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [getattr(self.envs.members[index], attr_name) for index in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        for index in self._get_indices(indices):
            setattr(self.envs.members[index], attr_name, value)

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> list[Any]:
        chosen = (self.envs.members[index] for index in self._get_indices(indices))
        return [getattr(member, method_name)(*method_args, **method_kwargs) for member in chosen]

    def env_is_wrapped(self, wrapper_class: type[Any], indices: Any = None) -> list[bool]:
        return [False for _ in self._get_indices(indices)]

    def get_images(self) -> Sequence[NDArray[np.uint8] | None]:
        return [member.render() for member in self.envs.members]


class FeaturesExtractor(BaseFeaturesExtractor):
    """Maps through a small CNN, numbers as they are, side by side; normalised as `FeatureLayers` says."""

    def __init__(self, observation_space: spaces.Dict) -> None:
        layers = FeatureLayers({key: tuple(box.shape or ()) for key, box in observation_space.items()})
        super().__init__(observation_space, layers.size)
        self.layers = layers

    def forward(self, observations: Mapping[str, torch.Tensor]) -> torch.Tensor:
        found: torch.Tensor = self.layers(*(observations[key] for key in self.layers.keys))
        return found


def one(infos: Mapping[str, Any], index: int) -> dict[str, Any]:
    """Of what a vector environment tells, what it tells of one of its environments."""
    return {
        key: value[index]
        for key, value in infos.items()
        if f"_{key}" in infos and infos[f"_{key}"][index] and key not in ("final_obs", "final_info")
    }


def copied(seen: Mapping[str, NDArray[Any]]) -> Arrays:
    return {key: value.copy() for key, value in seen.items()}
