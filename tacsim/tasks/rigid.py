"""What tasks with a rigid object between the fingers of a gripper share."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass

import numpy as np

from tacsim import pose as se3
from tacsim.interface import FloatArray, GripperTarget, Needs, Pose, Truth
from tacsim.models.task import RigidTaskConfig
from tacsim.tasks.task import Axis, GripAxis, Task


@dataclass(frozen=True, slots=True)
class RigidTask(Task):
    """Moves a gripper and its grip force. What is reached with more than `max_slip` of slip does not count."""

    config: RigidTaskConfig

    @property
    def grip_axis(self) -> GripAxis:
        return GripAxis(self.config.gripper, *self.config.force_range)

    def hand_axes(self, directions: str) -> tuple[Axis, ...]:
        """Of the arm that carries the gripper, along some of world "xyz"."""
        vectors = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
        return tuple(Axis(self.config.arm, vectors[direction]) for direction in directions)

    @property
    def touch_needs(self) -> Needs:
        return Needs(truth=True)  # touch alone does not tell the distance

    @abstractmethod
    def remaining(self, truth: Truth, start: Truth) -> float:
        """The distance of an object that has not slipped."""

    def distance(self, truth: Truth, start: Truth) -> float:
        """`remaining`, and for an object that has slipped more than `max_slip` at least what does not count as reached,
        more by the share of the excess."""
        excess = slip_of(truth, start) / self.config.max_slip - 1.0
        remaining = self.remaining(truth, start)
        if excess <= 0.0:
            return remaining
        return max(remaining, self.config.success) + excess * self.config.reward_scale

    def measures(self, truth: Truth, start: Truth) -> dict[str, float]:
        return {"slip": slip_of(truth, start), "grip_force": grip_force(truth)}


def object_pose(truth: Truth) -> Pose:
    """world_from_object of the only object. Raises ValueError where there is none."""
    if len(truth.objects) != 1:
        raise ValueError(f"this task has one rigid object, the scene has {len(truth.objects)}")
    return next(iter(truth.objects.values()))


def grip_of(truth: Truth) -> Pose:
    """world_from_grip: in the middle between the pads, with the axes of the first."""
    pads = list(truth.poses.values())
    if len(pads) != 2:
        raise ValueError(f"a gripper has two pads, the scene has {len(pads)} sensors")
    return Pose((pads[0].position + pads[1].position) / 2, pads[0].quaternion)


def grip_force(truth: Truth) -> float:
    """Mean normal force of the pads [N]; 0 where nothing is gripped."""
    return float(np.mean(list(truth.forces.values()))) if truth.forces else 0.0


def slip_of(truth: Truth, start: Truth) -> float:
    """How far the point of the object that was between the pads at `start` has moved along their surfaces [m]."""
    gripped = se3.relative_position(object_pose(start), grip_of(start))  # in the object
    point = se3.transform(se3.relative_pose(grip_of(truth), object_pose(truth)), gripped)
    return float(np.hypot(point[0], point[1]))


def turn_in_grip(truth: Truth, start: Truth) -> float:
    """How far the object has turned about the line between the pads since `start`, right-handed about the z axis of the
    first pad [rad]."""
    now, before = (se3.relative_pose(grip_of(each), object_pose(each)) for each in (truth, start))
    return float(se3.pose_difference(before, now)[5])


def min_grip_force(config: RigidTaskConfig) -> float:
    """Force of each of two fingers that just holds the scene's object against gravity, by Coulomb [N]: m g / (2 mu)."""
    item, gravity = config.scene.object, np.linalg.norm(config.scene.gravity)
    assert item is not None
    return float(item.mass * gravity / (2.0 * item.friction))


def grip_component(config: RigidTaskConfig, force: float) -> float:
    """The component of an action that asks for a grip force [N], as far as the task allows."""
    axis = GripAxis(config.gripper, *config.force_range)
    return float(np.clip(axis.component(GripperTarget(0.0, force)), -1.0, 1.0))


def steps_towards(offset: FloatArray, max_step: float) -> FloatArray:
    """Components (n,) that move along a straight line by `offset` (n,) [m], as fast as the longest may go."""
    return offset / max(max_step, float(np.abs(offset).max()))
