"""A task on a rig as a LeRobot environment: pictures, the numbers of the state, and actions as in recordings."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from robot.export.lerobot_mapping import ENVIRONMENT, IMAGE, STATE, LeRobotMapping, Row, task_in_words
from robot.export.lerobot_rig import picture_shape
from robot.open import RandomiseSettings, load_with_task, make_env
from tacsim.interface import Action, Needs, Observation
from tacsim.limits import ActionError
from tacsim.models.task import TaskConfig


class LeRobotEnv(gymnasium.Env[dict[str, Any], NDArray[np.floating[Any]]]):
    """`robot.make_env` in the numbers of a data set, so that a policy of `lerobot-train` fits it.

    Observation: `pixels`, the canonical picture of each sensor by name; `agent_pos`, the `observation.state` of a data
    set; and `environment_state`, the part of it that is no pose of an arm. Action: target pose of each arm relative to
    reset, the `action` of a data set; the arms move along the free axes of the task, by at most its max_step. info:
    that of `TacsimEnv`, with `is_success` at reset and each step.

    Raises:
        IncompatibleRig: as by `LeRobotMapping`; and the errors of `make_env`.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}

    def __init__(
        self,
        task: str | TaskConfig = "squeeze",
        rig: str | Path = "sim",
        overrides: Sequence[str] = (),
        render_mode: str | None = None,
        randomise: RandomiseSettings = None,
    ) -> None:
        canonical = load_with_task(rig, task, overrides).config.canonical
        # motion as in the rig file, with which the training data were recorded
        self._env = make_env(task, rig, overrides, render_mode, randomise=randomise, features=None, learning=False)
        spec, config = self._env.rig.spec, self._env.task.config
        self._mapping = LeRobotMapping(spec, canonical, maps=False, goal=self._env.task.goal, environment=True)
        self.metadata = {**self.metadata, "render_fps": round(1.0 / spec.period)}
        self.render_mode = render_mode
        picture = spaces.Box(0, 255, picture_shape(canonical), np.uint8)
        state, action = ((len(each.names),) for each in (self._mapping.state, self._mapping.action))
        environment = (len(self._mapping.environment),)
        self.observation_space = spaces.Dict(
            {
                "pixels": spaces.Dict(dict.fromkeys(spec.sensors, picture)),
                "agent_pos": spaces.Box(-np.inf, np.inf, state, np.float32),
                "environment_state": spaces.Box(-np.inf, np.inf, environment, np.float32),
            }
        )
        self.action_space = spaces.Box(-np.inf, np.inf, action, np.float32)
        self.task = config.kind
        self._max_episode_steps = config.steps  # LeRobot reads this name

    @property
    def task_description(self) -> str:
        """Description of the task, with the goal of this episode."""
        return task_in_words(self.task, self._env.task.goal)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Starts an episode; the same seed gives the same episode. options: of LeRobot; they are ignored."""
        super().reset(seed=seed)
        _, info = self._env.reset(seed=seed)
        self._mapping.set_goal(self._env.task.goal)
        return _env_observation(self._mapping.begin(self._env.observation)), info

    def step(self, action: NDArray[np.floating[Any]]) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """One control period. Raises ActionError for numbers that are no pose, ResetNeeded after the end."""
        if np.shape(action) != self.action_space.shape:
            raise ActionError(f"an action has shape {self.action_space.shape}, got {np.shape(action)}")
        action_of_task = self._env.policy_action(_Fixed(self._mapping.decode_action(action)))
        _, reward, terminated, truncated, info = self._env.step(action_of_task)
        return (
            _env_observation(self._mapping.encode_observation(self._env.observation)),
            reward,
            terminated,
            truncated,
            info,
        )

    def render(self) -> NDArray[np.uint8] | None:
        """The camera images of all sensors in a row, (H, W, 3); None without a render_mode."""
        return self._env.render()

    def close(self) -> None:
        self._env.close()


class _Fixed:
    """A policy that returns one action for every observation."""

    needs = Needs()

    def __init__(self, action: Action) -> None:
        self._action = action

    def reset(self) -> None: ...

    def __call__(self, observation: Observation) -> Action:
        return self._action


def _env_observation(row: Row) -> dict[str, Any]:
    pictures = {name.removeprefix(IMAGE): value for name, value in row.items() if name.startswith(IMAGE)}
    return {"pixels": pictures, "agent_pos": row[STATE], "environment_state": row[ENVIRONMENT]}
