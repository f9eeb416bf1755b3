"""LeRobot's environment `tacsim`: a task in simulation, in the numbers of a data set (docs/lerobot.md)."""

from dataclasses import dataclass, field
from typing import Any

import gymnasium
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs import EnvConfig
from lerobot.utils.constants import ACTION, OBS_IMAGES, OBS_STATE

from robot import LeRobotRig

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
        self.features = {
            ACTION: PolicyFeature(type=FeatureType.ACTION, shape=(len(seen.action_features),)),
            "agent_pos": PolicyFeature(type=FeatureType.STATE, shape=numbers),
        }
        self.features_map = {ACTION: ACTION, "agent_pos": OBS_STATE}
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


if GYM_ID not in gymnasium.registry:
    gymnasium.register(GYM_ID, entry_point="robot:LeRobotEnv")
