"""Gymnasium environments: Env = Rig + Task.

Where tacsim is installed, ``gymnasium.make("tacsim/Squeeze-v0")`` finds them without an import (see
tacsim.gym.plugin); from sources, ``gymnasium.make("tacsim.gym.env:tacsim/Squeeze-v0")`` does.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium.error import ResetNeeded
from numpy.typing import NDArray

from tacsim.gym import encode
from tacsim.gym.plugin import register_envs
from tacsim.interface import Needs, Pose, Truth
from tacsim.limits import LimitExceeded
from tacsim.physics.failure.health import SimulationDiverged
from tacsim.rig import Rig
from tacsim.tasks.task import Task, judge


class TacsimEnv(gymnasium.Env[encode.Flat, NDArray[np.float32]]):
    """A rig with a task. Observations: `tacsim.gym.encode.flatten`. Actions: Box(-1, 1), one component for each free
    axis of the task, in units of its max_step from where the arm was last sent.

    An episode terminates only when a limit of an arm is exceeded (info["limit"] says which). It is truncated after the
    task's steps, or when the simulation diverges (info["diverged"] says why; the observation is the last good one).

    info: distance [m], success, score, body_height [m], and the rig's diagnostics.
    Raises IncompatibleRig when the rig lacks what the task needs. Resets the rig once to learn the shapes.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}

    def __init__(self, rig: Rig, task: Task, render_mode: str | None = None) -> None:
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(f"render_mode must be None or 'rgb_array', got {render_mode!r}")
        rig.require(Needs(truth=True), "an environment")
        rig.require(task.needs, f"task '{task.config.kind}'")
        self.rig, self.task, self.render_mode = rig, task, render_mode
        self._begin(seed=0)
        self.observation_space = encode.space_of(self._flat)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (len(task.axes),), np.float32)
        self._finished = True  # until the user's own reset

    def _begin(self, seed: int) -> None:
        observation = self.rig.reset(seed)
        self._start: dict[str, Pose] = {name: arm.pose for name, arm in observation.arms.items()}
        self._targets = dict(self._start)  # where each arm was last sent
        self._truth_at_start = self._truth()
        self._count = 0
        self._finished = False
        self._flat: encode.Flat = encode.flatten(observation, self._start)

    def _truth(self) -> Truth:
        truth = self.rig.truth()
        if truth is None:
            raise RuntimeError(f"rig '{self.rig.name}' promises ground truth in its spec, but delivers none")
        return truth

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[encode.Flat, dict[str, Any]]:
        """The same seed gives the same episode. There are no options."""
        super().reset(seed=seed)
        if options:
            raise ValueError(f"reset knows no options, got {sorted(options)}")
        self._begin(seed=int(self.np_random.integers(2**31)))
        return self._flat, self._judged()[1]

    def step(self, action: NDArray[np.float32]) -> tuple[encode.Flat, float, bool, bool, dict[str, Any]]:
        """One control period. Raises ActionError for an action outside the space, ResetNeeded after the end."""
        if self._finished:
            raise ResetNeeded("call reset() before step(): no episode is running")
        asked = encode.action_from(action, self.task.axes, self.task.config.max_step, self._targets)
        self._count += 1
        try:
            observation, sent = self.rig.step(asked)
        except (LimitExceeded, SimulationDiverged) as failure:
            self._finished = True
            exceeded = isinstance(failure, LimitExceeded)
            reward, info = self._judged()
            flat = {key: value.copy() for key, value in self._flat.items()}
            return flat, reward, exceeded, not exceeded, info | {"limit" if exceeded else "diverged": str(failure)}
        self._targets |= {name: pose for name, pose in sent.items() if pose is not None}
        self._flat = encode.flatten(observation, self._start)
        reward, info = self._judged()
        return self._flat, reward, False, self._count >= self.task.config.steps, info

    def _judged(self) -> tuple[float, dict[str, Any]]:
        truth = self._truth()
        outcome = judge(self.task, truth, self._truth_at_start)
        info: dict[str, Any] = {
            "distance": outcome.distance,
            "success": outcome.success,
            "score": outcome.score,
            "body_height": truth.height,
        }
        return outcome.reward, info | dict(self.rig.diagnostics())

    def render(self) -> NDArray[np.uint8] | None:
        """The native pictures of all sensors side by side, (H, W, 3) uint8 RGB, in the order of the rig; smaller ones
        are padded with black below."""
        if self.render_mode is None:
            return None
        images = [frame.image for frame in self.rig.frames.values()]
        rows = max(image.shape[0] for image in images)
        padded = [np.pad(image, ((0, rows - image.shape[0]), (0, 0), (0, 0))) for image in images]
        return np.concatenate(padded, axis=1)

    def close(self) -> None:
        self.rig.close()


register_envs()
