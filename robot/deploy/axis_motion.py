"""Action vectors of a policy as actions of a rig."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tacsim import pose as se3
from tacsim.interface import Action, Observation, Pose
from tacsim.tasks.task import ActionAxes, action_of_vector, needs_of_axes

MAX_DEVIATION = 2.0  # between target and pose of an arm, in longest steps; beyond it the next target starts at the pose


class AxisMotion:
    """Moves each arm from its last target, as in training, or from its pose if a limit has kept it from the target."""

    def __init__(self, axes: ActionAxes, max_step: float) -> None:
        self._axes, self._max_step = axes, max_step
        self._targets: dict[str, Pose] = {}

    def begin(self) -> None:
        """A new episode."""
        self._targets = {}

    def action(self, vector: NDArray[np.floating], observation: Observation) -> Action:
        """The action of a vector, one number for each axis. Raises ActionError as `action_of_vector`."""
        for arm in sorted(needs_of_axes(self._axes).arms):
            now, target = observation.arms[arm].pose, self._targets.get(arm)
            if target is None or se3.pose_distance(target, now)[0] > MAX_DEVIATION * self._max_step:
                self._targets[arm] = now
        action = action_of_vector(vector, self._axes, self._max_step, self._targets)
        self._targets = {arm: pose for arm, pose in action.tool.items() if pose is not None}
        return action
