"""LeRobot's environment `tacsim`: a task in simulation, in the numbers of a data set; and a policy of `lerobot-train`
as a policy of tacsim (docs/lerobot.md)."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.configs.policies import PreTrainedConfig
from lerobot.envs import EnvConfig
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_IMAGES, OBS_STATE

from robot import LeRobotRig
from robot.export.lerobot_mapping import ENVIRONMENT, IMAGE, OTHER, STATE, LeRobotMapping, Row
from robot.open import load_with_task, rig_spec
from tacsim import Action, Observation
from tacsim.tasks import make_task

GYM_ID = "lerobot_env_tacsim/Task-v0"


@EnvConfig.register_subclass("tacsim")
@dataclass
class TacsimEnvConfig(EnvConfig):
    """task: squeeze, reposition, knead or a file; rig, overrides: as for `tacsim run`; randomise: a file that draws
    variants. fps: refused when it is not the rig's."""

    task: str | None = "squeeze"
    fps: int = 10
    rig: str = "sim"
    overrides: list[str] = field(default_factory=list)
    randomise: str | None = None

    def __post_init__(self) -> None:
        seen = LeRobotRig(self.rig, task=self.task, overrides=self.overrides, fps=self.fps)
        pictures = {name: shape for name, shape in seen.observation_features.items() if isinstance(shape, tuple)}
        numbers = (len(seen.observation_features) - len(pictures),)
        environment = (sum(name.endswith(OTHER) for name in seen.observation_features),)
        self.features = {
            ACTION: PolicyFeature(type=FeatureType.ACTION, shape=(len(seen.action_features),)),
            "agent_pos": PolicyFeature(type=FeatureType.STATE, shape=numbers),
            "environment_state": PolicyFeature(type=FeatureType.ENV, shape=environment),
        }
        self.features_map = {ACTION: ACTION, "agent_pos": OBS_STATE, "environment_state": OBS_ENV_STATE}
        for name, shape in pictures.items():
            self.features[f"pixels/{name}"] = PolicyFeature(type=FeatureType.VISUAL, shape=shape)
            self.features_map[f"pixels/{name}"] = f"{OBS_IMAGES}.{name}"

    @property
    def gym_id(self) -> str:
        return GYM_ID

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        return {
            "task": self.task,
            "rig": self.rig,
            "overrides": self.overrides,
            "randomise": self.randomise,
            "render_mode": "rgb_array",
        }


class TrainedPolicy:
    """A policy of `lerobot-train` as a policy of tacsim. With
    `mine = TrainedPolicy("out/checkpoints/last/pretrained_model")` in a module my_act.py it is `--policy my_act:mine`
    of `tacsim run`, `tacsim benchmark run`, and of pytest.

    rig, task, overrides: with which its data were recorded; they tell its sensors, arms and grid.

    Raises ValueError for a folder without a policy, and the errors of loading a rig.
    """

    def __init__(
        self, folder: str | Path, rig: str = "sim", task: str = "squeeze", overrides: Sequence[str] = ()
    ) -> None:
        if not (Path(folder) / "model.safetensors").is_file():
            raise ValueError(f"{folder} has no model.safetensors; name a folder checkpoints/last/pretrained_model")
        config = load_with_task(rig, task, overrides).config
        assert config.task is not None
        goal = make_task(config.task).goal
        self._mapping = LeRobotMapping(rig_spec(config), config.canonical, maps=False, goal=goal, environment=True)
        self.needs = self._mapping.needs
        loaded = PreTrainedConfig.from_pretrained(str(folder))
        loaded.device = "cpu"
        self._policy = get_policy_class(loaded.type).from_pretrained(str(folder), config=loaded)
        self._policy.eval()
        self._before, self._after = make_pre_post_processors(
            loaded, str(folder), preprocessor_overrides={"device_processor": {"device": "cpu"}}
        )
        self._is_new = True

    def set_goal(self, goal: float | tuple[float, ...]) -> None:
        """The goal [m] of the next episode."""
        self._mapping.set_goal(goal)

    def reset(self) -> None:
        self._policy.reset()
        self._is_new = True

    def __call__(self, observation: Observation) -> Action:
        first, self._is_new = self._is_new, False
        row = self._mapping.begin(observation) if first else self._mapping.encode_observation(observation)
        with torch.inference_mode():
            numbers = self._after(self._policy.select_action(self._before(_batch(row))))
        return self._mapping.decode_action(numbers.to("cpu").numpy()[0])


def _batch(row: Row) -> dict[str, torch.Tensor]:
    """A row of the mapping as LeRobot's policies take it: pictures (1, 3, H, W) from 0 to 1, numbers (1, n)."""
    pictures = {
        name: torch.from_numpy(np.ascontiguousarray(value.transpose(2, 0, 1))[None]).float() / 255
        for name, value in row.items()
        if name.startswith(IMAGE)
    }
    numbers = {name: torch.from_numpy(row[name])[None] for name in (STATE, ENVIRONMENT)}
    return {**numbers, **pictures}


if GYM_ID not in gymnasium.registry:
    gymnasium.register(GYM_ID, entry_point="robot:LeRobotEnv")
