"""PPO and SAC of stable-baselines3, in rounds that begin with new episodes, so a killed run can continue."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import VecEnv

from robot.common.whole_file import write_whole
from robot.rig.sharded_env import Environments
from robot.train.network import FeatureLayers, PolicyNetwork
from robot.train.run_folder import ReportProgress
from tacsim.models.policy import Training

Arrays = dict[str, NDArray[Any]]


class Reinforce:
    """PPO or SAC in `envs`. `actor` is exported as the policy file. SAC stores its replay buffer in `folder`.

    tensorboard: logs for TensorBoard are written to `folder/tensorboard`.
    """

    def __init__(
        self, envs: Environments, training: Training, actor: PolicyNetwork, folder: Path, tensorboard: bool = False
    ) -> None:
        rounds = {"ppo": 70, "sac": 24}  # where the training file names no number
        replay_steps = 50_000  # control steps in the replay buffer of SAC
        warm_up_steps = 1000  # control steps with random actions before SAC learns
        settings = training.reinforce
        self.rounds, self.actor = settings.rounds or rounds[training.algorithm], actor
        self._seed, self._folder, self._rate = training.seed, folder, settings.rate
        self._episode_steps = envs.get_attr("task")[0].config.steps
        # PPO: the gradients of large errors of the value network, which are clipped together with those of the actions,
        # would hide these (docs/measurements/training.md, "From the reward alone").
        ppo = training.algorithm == "ppo"
        self._reward_scale = 0.1 if ppo else 1.0
        self._envs = SharedVecEnv(envs, self._reward_scale)
        self._moments = _RunningMoments()
        self._steps = settings.episodes * self._episode_steps  # of each environment in a round
        shape: dict[str, Any] = {
            "net_arch": [training.width, training.width],
            "activation_fn": torch.nn.ReLU,
            "features_extractor_class": FeaturesExtractor,
        }
        common: dict[str, Any] = {
            "gamma": settings.discount,
            "batch_size": _batch_size(self._steps * envs.num_envs, settings.batch),
            "policy_kwargs": shape,
            "device": "cpu",
            "seed": training.seed,
            "tensorboard_log": str(folder / "tensorboard") if tensorboard else None,
        }
        if ppo:
            shape["log_std_init"] = -1.0  # deviation of the first actions 0.37: at 1 most of them are clipped
            self._model: Any = PPO("MultiInputPolicy", self._envs, n_steps=self._steps, **common)
        else:
            self._model = SAC(
                "MultiInputPolicy", self._envs, learning_starts=warm_up_steps, buffer_size=replay_steps, train_freq=1,
                gradient_steps=envs.num_envs // 2 or 1, **common,
            )  # fmt: skip

    def round(self, number: int, report_progress: ReportProgress) -> dict[str, float]:
        """Plays episodes from their start and learns from them."""
        random = np.random.default_rng([self._seed, number])
        rate = self._rate * (1.0 - number / self.rounds)
        model, total = self._model, self._steps * self._envs.num_envs
        model.set_random_seed(int(random.integers(2**31)))  # of NumPy, torch, and the next reset of the environments
        if number == 0:
            self._envs.reset()
            self._normalise_features(self._play_random_episode(random))
        model.lr_schedule = lambda _: rate
        model._last_obs = None  # so episodes start again
        watch = _EpisodeWatch(lambda done: report_progress(f"round {number + 1} of {self.rounds}", done, total))
        model.learn(total, callback=watch, reset_num_timesteps=False, tb_log_name=type(model).__name__.lower())
        self._copy_actor()  # as it acted, before its features are normalised again
        self._normalise_features(watch.features())
        if isinstance(model, SAC):
            write_whole(self._folder / f"memory-{number % 2}.npz", self._write_memory)
        rewards, distances, successes, forces = np.array(watch.ends).T
        figures = {
            "steps": float(total), "distance": float(distances.mean()), "success": float(successes.mean()),
            "peak_force": float(forces.mean()), "return": float(rewards.mean()) / self._reward_scale,
        }  # fmt: skip
        for name, value in figures.items():
            model.logger.record(f"round/{name}", value)
        model.logger.dump(model.num_timesteps)
        return figures

    def state(self) -> dict[str, Any]:
        return {
            "actor": self.actor.state_dict(),
            "model": self._model.get_parameters(),
            "timesteps": self._model.num_timesteps,
            "updates": self._model._n_updates,
            "moments": self._moments.moments,
            "rounds": self._moments.rounds,
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Restores the state after round n - 1, whose replay buffer is in the file of that round."""
        model, total = self._model, self._steps * self._envs.num_envs
        model.set_parameters(state["model"], device="cpu")
        model.num_timesteps, model._n_updates = int(state["timesteps"]), int(state["updates"])
        self.actor.load_state_dict(state["actor"])
        self._moments.moments, self._moments.rounds = dict(state["moments"]), int(state["rounds"])
        if isinstance(model, SAC):
            self._read_memory(self._folder / f"memory-{(model.num_timesteps // total - 1) % 2}.npz")

    def _play_random_episode(self, random: np.random.Generator) -> Arrays:
        """Features (n, ...) of an episode of random actions in each environment."""
        envs = self._envs
        shape = self._episode_steps, envs.num_envs, *(envs.action_space.shape or ())
        parts = [envs.step(actions)[0] for actions in random.uniform(-1.0, 1.0, shape).astype(np.float32)]
        return {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}

    def _normalise_features(self, features: Arrays) -> None:
        """Normalises the features of all networks by the mean of the moments of all rounds until now. A goal is met
        within a hundredth of a feature's range: with features as they are PPO does not learn to meet it."""
        self._moments.add(features)
        for module in self._model.policy.modules():
            if isinstance(module, FeatureLayers):
                module.set_moments(self._moments.mean_and_deviation())

    def _copy_actor(self) -> None:
        policy = self._model.policy
        extractor: Any = policy.features_extractor if isinstance(self._model, PPO) else policy.actor.features_extractor
        self.actor.layers.load_state_dict(extractor.layers.state_dict())
        hidden, last = (
            (policy.mlp_extractor.policy_net, policy.action_net)
            if isinstance(self._model, PPO)
            else (policy.actor.latent_pi, policy.actor.mu)
        )
        self.actor.head.load_state_dict(torch.nn.Sequential(*hidden, last).state_dict())

    def _write_memory(self, file: Any) -> None:
        memory = self._model.replay_buffer
        count = len(memory.actions) if memory.full else memory.pos
        arrays: dict[str, NDArray[Any]] = {key: getattr(memory, key)[:count] for key in _MEMORY_ARRAYS}
        for what in ("observations", "next_observations"):
            arrays |= {f"{what}/{key}": value[:count] for key, value in getattr(memory, what).items()}
        np.savez(file, allow_pickle=False, at=np.array([memory.pos, memory.full]), **arrays)

    def _read_memory(self, path: Path) -> None:
        memory = self._model.replay_buffer
        with np.load(path, allow_pickle=False) as file:
            memory.pos, memory.full = int(file["at"][0]), bool(file["at"][1])
            for key in file.files:
                what, _, name = key.partition("/")
                if key != "at":
                    (getattr(memory, what)[name] if name else getattr(memory, what))[: len(file[key])] = file[key]


def _batch_size(total: int, max_size: int) -> int:
    """Maximum size of equal batches, at least 2: PPO divides by the deviation within each."""
    return next((size for size in range(min(total, max_size), 1, -1) if total % size == 0), total)


_MEMORY_ARRAYS = ("actions", "rewards", "dones", "timeouts")


class _RunningMoments:
    """Mean and mean square of each channel of features, over rounds of equal weight."""

    def __init__(self) -> None:
        self.rounds = 0
        self.moments: dict[str, torch.Tensor] = {}  # (2, channels)

    def add(self, features: Arrays) -> None:
        """A round with features (n, ...)."""
        self.rounds += 1
        for key, values in features.items():
            channels = np.moveaxis(values, 1, 0).reshape(values.shape[1], -1).astype(np.float64)
            found = torch.from_numpy(np.stack([channels.mean(axis=1), (channels**2).mean(axis=1)]))
            before = self.moments.get(key, found)
            self.moments[key] = before + (found - before) / self.rounds

    def mean_and_deviation(self) -> dict[str, tuple[torch.Tensor, torch.Tensor]]:
        """Mean and standard deviation of each channel."""
        return {key: (mean, (square - mean**2).clamp(min=0.0).sqrt()) for key, (mean, square) in self.moments.items()}


class _EpisodeWatch(BaseCallback):
    """Collects the end of each episode (sum of rewards, distance [m], success, peak force [N]), and all features."""

    def __init__(self, report_progress: Any) -> None:
        super().__init__()
        self.ends: list[tuple[float, float, float, float]] = []
        self._observations: list[Arrays] = []
        self._tell, self._done = report_progress, 0

    def _on_step(self) -> bool:
        rewards = self.locals["rewards"]
        self._observations.append(self.locals["new_obs"])
        self._sums = getattr(self, "_sums", 0.0) + np.asarray(rewards, float)
        self._done += len(rewards)
        for index in np.flatnonzero(self.locals["dones"]).tolist():
            info = self.locals["infos"][index]
            self.ends.append((self._sums[index], info["distance"], float(info["is_success"]), info["peak_force"]))
            self._sums[index] = 0.0
        self._tell(self._done)
        return True

    def features(self) -> Arrays:
        """(n, ...) of all steps."""
        return {key: np.concatenate([arrays[key] for arrays in self._observations]) for key in self._observations[0]}


class SharedVecEnv(VecEnv):
    """Environments that share kernel launches, as a VecEnv of stable-baselines3.

    envs = SharedVecEnv(robot.make_sharded_env(16, "squeeze", features={}, autoreset_mode="SameStep",
                                              randomise="squeeze"))
    PPO("MultiInputPolicy", envs, policy_kwargs={"features_extractor_class": FeaturesExtractor}).learn(10_000)

    infos have `terminal_observation`, `TimeLimit.truncated` and `is_success` at the end of an episode, and the other
    entries of `TacsimEnv.step`. Raises ValueError for environments that are not reset in the step in which they end.

    reward_scale: factor of all rewards.
    """

    def __init__(self, envs: Environments, reward_scale: float = 1.0) -> None:
        if envs.autoreset_mode != AutoresetMode.SAME_STEP:
            raise ValueError(f"stable-baselines3 needs autoreset_mode 'SameStep', got '{envs.autoreset_mode.value}'")
        self.envs, self._reward_scale = envs, reward_scale
        self._actions: NDArray[np.float32] | None = None
        super().__init__(envs.num_envs, envs.single_observation_space, envs.single_action_space)

    def reset(self) -> Arrays:
        # stable-baselines3 passes seeds and options by `seed` and `set_options`, one entry per environment.
        seeds = list(self._seeds)
        if any(self._options):
            raise ValueError("reset options apply to all environments: set them on the environments themselves")
        arrays, infos = self.envs.reset(seed=None if all(seed is None for seed in seeds) else seeds)
        self.reset_infos = [select_environment(infos, index) for index in range(self.num_envs)]
        self._reset_seeds()
        self._reset_options()
        return copy_arrays(arrays)

    def step_async(self, actions: NDArray[np.float32]) -> None:
        self._actions = actions

    def step_wait(self) -> tuple[Arrays, NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        arrays, rewards, terminated, truncated, step_info = self.envs.step(self._actions)
        done = terminated | truncated
        infos = []
        for index in range(self.num_envs):
            if done[index]:
                info = select_environment(step_info["final_info"], index)
                info["terminal_observation"] = step_info["final_obs"][index]
                info["TimeLimit.truncated"] = bool(truncated[index] and not terminated[index])
            else:
                info = select_environment(step_info, index)
            infos.append(info)
        return copy_arrays(arrays), (self._reward_scale * rewards).astype(np.float32), done, infos

    def close(self) -> None:
        self.envs.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return list(self.envs.call_selected(list(self._get_indices(indices)), attr_name))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        values = list(self.envs.get_attr(attr_name))
        for index in self._get_indices(indices):
            values[index] = value
        self.envs.set_attr(attr_name, values)

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> list[Any]:
        indices = list(self._get_indices(indices))
        return list(self.envs.call_selected(indices, method_name, *method_args, **method_kwargs))

    def env_is_wrapped(self, wrapper_class: type[Any], indices: Any = None) -> list[bool]:
        return [False for _ in self._get_indices(indices)]

    def get_images(self) -> Sequence[NDArray[np.uint8] | None]:
        return list(self.envs.call("render"))


class FeaturesExtractor(BaseFeaturesExtractor):
    """Features of maps by a small CNN, joined with the numbers; normalised by `FeatureLayers`."""

    def __init__(self, observation_space: spaces.Dict) -> None:
        layers = FeatureLayers({key: tuple(box.shape or ()) for key, box in observation_space.items()})
        super().__init__(observation_space, layers.size)
        self.layers = layers

    def forward(self, observations: Mapping[str, torch.Tensor]) -> torch.Tensor:
        found: torch.Tensor = self.layers(*(observations[key] for key in self.layers.keys))
        return found


def select_environment(infos: Mapping[str, Any], index: int) -> dict[str, Any]:
    """Entries of one environment in the infos of a vector environment."""
    return {
        key: value[index]
        for key, value in infos.items()
        if f"_{key}" in infos and infos[f"_{key}"][index] and key not in ("final_obs", "final_info")
    }


def copy_arrays(arrays: Mapping[str, NDArray[Any]]) -> Arrays:
    return {key: value.copy() for key, value in arrays.items()}
