"""Action vectors keep what they encode."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tacsim.interface import Action, GripperTarget, Pose
from tacsim.limits import ActionError
from tacsim.tasks.task import Axis, GripAxis, action_of_vector, vector_of_action

AXES = (Axis("lower", (0.0, 0.0, 1.0)), Axis("upper", (1.0, 0.0, 0.0)), Axis("upper", (0.0, 1.0, 0.0)))
POSES = {
    "lower": Pose(np.array([0.1, 0.2, 0.3])),
    "upper": Pose(np.array([1.0, 2.0, 3.0]), Rotation.from_euler("xyz", [3.0, 0.2, -0.4]).as_quat()),
}


def test_a_vector_moves_each_arm_along_its_axes() -> None:
    vector = np.array([0.5, -1.0, 0.25], np.float32)
    action = action_of_vector(vector, AXES, 2e-4, POSES)
    assert action.tool["lower"].position == pytest.approx([0.1, 0.2, 0.3 + 1e-4], abs=1e-12)  # type: ignore[union-attr]
    assert action.tool["upper"].position == pytest.approx([1.0 - 2e-4, 2.0 + 5e-5, 3.0], abs=1e-12)  # type: ignore[union-attr]
    assert np.array_equal(action.tool["upper"].quaternion, POSES["upper"].quaternion)  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("vector", "message"),
    [
        ([0.0, 0.0], r"shape \(3,\)"),
        ([0.0, np.nan, 0.0], "finite"),
        ([0.0, 1.01, 0.0], r"within \[-1, 1\], got \[0.0, 1.01, 0.0\]"),
        ([0.0, -np.inf, 0.0], "finite"),
        ("up", "3 real numbers, got .*'up'"),
        (np.array([1j, 0.0, 0.0]), "real numbers"),
    ],
)
def test_a_vector_that_is_no_action_is_refused(vector: Any, message: str) -> None:
    with pytest.raises(ActionError, match=message):
        action_of_vector(np.array(vector), AXES, 2e-4, POSES)


def test_the_vector_of_an_action_asks_for_it_as_far_as_axes_and_lengths_allow() -> None:
    vector = np.array([0.5, -1.0, 0.25], np.float32)
    assert vector_of_action(action_of_vector(vector, AXES, 2e-4, POSES), AXES, 2e-4, POSES) == pytest.approx(
        vector, abs=1e-6
    )
    far = Pose(POSES["upper"].position + [1e-3, -1e-4, 5e-3], POSES["upper"].quaternion)
    assert vector_of_action(Action({"upper": far, "lower": None}), AXES, 2e-4, POSES).tolist() == [0.0, 1.0, -0.5]


def test_a_component_of_a_gripper_is_its_force() -> None:
    axes = (Axis("upper", (0.0, 0.0, 1.0)), GripAxis("hand", 1.0, 9.0))
    action = action_of_vector(np.array([1.0, -0.5]), axes, 2e-4, POSES)
    assert action.grippers["hand"].force == pytest.approx(9.0**0.25) and set(action.tool) == {"upper"}
    assert vector_of_action(action, axes, 2e-4, POSES) == pytest.approx([1.0, -0.5])
    # A gripper that holds keeps the force of its last target; before the first it has the least force.
    assert vector_of_action(Action(), axes, 2e-4, POSES, {"hand": GripperTarget(0.0, 9.0)})[1] == 1.0
    assert vector_of_action(Action(), axes, 2e-4, POSES)[1] == -1.0
    # Forces beyond the axis are cut to it.
    assert vector_of_action(Action({}, {"hand": GripperTarget(0.0, 50.0)}), axes, 2e-4, POSES)[1] == 1.0
