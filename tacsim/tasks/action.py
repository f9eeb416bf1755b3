"""Vectors of learned policies as actions of a rig."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tacsim.interface import Action, Pose
from tacsim.limits import ActionError
from tacsim.tasks.task import Axis


def action_of_vector(
    vector: NDArray[np.floating[Any]], axes: Sequence[Axis], max_step: float, poses: Mapping[str, Pose]
) -> Action:
    """Component i moves its arm from `poses` by vector[i] * max_step [m] along its axis, rotation kept.

    Raises ActionError for a wrong shape, a component that is not finite, or one outside [-1, 1].
    """
    given = np.asarray(vector)
    if given.dtype.kind not in "fiub":
        raise ActionError(f"action must be an array of {len(axes)} real numbers, got {vector!r}")
    values = given.astype(np.float64)
    if values.shape != (len(axes),):
        raise ActionError(f"action must have shape ({len(axes)},), one number for each free axis, got {values.shape}")
    # The margin admits 1.0 in any float precision.
    if not np.isfinite(values).all() or float(np.abs(values).max(initial=0.0)) > 1.0 + 1e-6:
        raise ActionError(
            f"action components must be finite and within [-1, 1], got {values.tolist()}; "
            "bound the policy's output (gymnasium.wrappers.ClipAction does it)"
        )
    positions = {axis.arm: np.array(poses[axis.arm].position) for axis in axes}
    for axis, value in zip(axes, values, strict=True):
        positions[axis.arm] += value * max_step * np.array(axis.direction)
    return Action({arm: Pose(position, poses[arm].quaternion) for arm, position in positions.items()})


def vector_of_action(
    action: Action, axes: Sequence[Axis], max_step: float, poses: Mapping[str, Pose]
) -> NDArray[np.float32]:
    """The vector that asks for `action` from `poses`: the inverse of `action_of_vector`. A motion longer than
    max_step is cut to it, and a component along no axis is left out; an arm that holds has zeros."""
    vector = np.zeros(len(axes), np.float32)
    for number, axis in enumerate(axes):
        target = action.tool.get(axis.arm)
        if target is not None:
            vector[number] = (target.position - poses[axis.arm].position) @ np.array(axis.direction) / max_step
    return vector.clip(-1.0, 1.0)
