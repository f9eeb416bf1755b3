"""Small steps by keys or a gamepad, summed up to where the arms shall be."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from robot.export.lerobot_rig import LeRobotRig
from tacsim.gym.features import SCALES
from tacsim.interface import IncompatibleRig


class Jog:
    """Steps along the axes of the sensors at reset, as actions of a `LeRobotRig`; none turns. z is into what is felt.

    Args:
        rig: that the actions are for; it need not be connected.
        step: of a full stroke [m].
        arms: that move, each along its own sensor's axes; none named: all.

    Raises IncompatibleRig for an arm that the rig has not, ValueError for a step that is none.
    """

    def __init__(self, rig: LeRobotRig, step: float, arms: Sequence[str] = ()) -> None:
        there = rig.config.arms
        if unknown := sorted(set(arms) - set(there)):
            raise IncompatibleRig(f"rig '{rig.config.name}' has no arm '{unknown[0]}'; it has {', '.join(there)}")
        if not 0.0 < step < 0.01:
            raise ValueError(f"step must be a length below 10 mm, in m, got {step!r}")
        self.names = tuple(rig.action_features)
        self._step, self._arms = step, tuple(arms or there)
        self._gone = np.zeros(3)  # [m]

    def __call__(self, strokes: Sequence[float]) -> dict[str, float]:
        """The action after one more step of (x, y, z) strokes, each within -1 and 1."""
        self._gone = self._gone + self._step * np.clip(np.asarray(strokes, np.float64), -1.0, 1.0)
        action = dict.fromkeys(self.names, 0.0)
        for arm in self._arms:
            for axis, gone in zip("xyz", self._gone / SCALES["moved"], strict=True):
                action[f"moved_{axis}_{arm}.pos"] = float(gone)
        return action

    def reset(self) -> None:
        """Starts again from the pose at reset."""
        self._gone = np.zeros(3)
