"""Peg: put a bar that the gripper holds into a hole that is hardly wider, and whose place is not known exactly."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tacsim import pose as se3
from tacsim.geometry.shapes import bounding_size
from tacsim.interface import FloatArray, Policy, Pose, Truth
from tacsim.models.shape import Mesh, Socket, Sphere
from tacsim.models.task import PegConfig
from tacsim.tasks.peg_policy import ScriptedPeg
from tacsim.tasks.rigid import RigidTask, grip_component, grip_of, object_pose, steps_towards
from tacsim.tasks.task import Axis, GripAxis
from tacsim.tasks.tuning import MAX_LATERAL_ERROR, MAX_PEG_SHIFT, PEG_LIFT


@dataclass(frozen=True, slots=True)
class Peg(RigidTask):
    """distance = that of the middle of the bar's lower end from the point `goal` below the mouth on the hole's axis."""

    config: PegConfig

    def __post_init__(self) -> None:
        scene = self.config.scene
        if scene.object is None or isinstance(scene.object.geometry, Mesh | Sphere):
            raise ValueError("task 'peg' needs a scene whose object is a box or a cylinder; give scene: peg")
        bar, socket = bounding_size(scene.object.geometry), self._socket
        if max(bar[0] - socket.opening[0], bar[1] - socket.opening[1]) >= 0.0:
            opening, size = (" x ".join(f"{1e3 * side:.4g}" for side in each) for each in (socket.opening, bar[:2]))
            raise ValueError(
                f"task 'peg': the object is {size} mm wide and its hole {opening} mm; make object.geometry smaller, or "
                "the opening of the socket larger"
            )
        if self.config.goal > bar[2]:
            raise ValueError(
                f"task.goal: a depth of {self.config.goal:g} m is more than the object's length, {bar[2]:g} m"
            )

    @property
    def _socket(self) -> Socket:
        return self._find_hole()[0]

    def _find_hole(self) -> tuple[Socket, Pose]:
        """The socket, and world_from_socket."""
        found = [
            (each.geometry, Pose(np.array(each.position), each.turn))
            for each in self.config.scene.fixtures.values()
            if isinstance(each.geometry, Socket)
        ]
        if len(found) != 1:
            raise ValueError(
                f"task 'peg' needs a scene with one fixture of shape socket, this one has {len(found)}; give scene: peg"
            )
        return found[0]

    @property
    def _height_of_start(self) -> float:
        """Of the bar's lower end above the mouth of the hole when an episode begins [m]."""
        item = self.config.scene.object
        assert item is not None
        return item.pedestal + item.lift - float(self._find_hole()[1].position[2])

    @property
    def axes(self) -> tuple[Axis | GripAxis, ...]:
        return (*self.hand_axes("xyz"), self.grip_axis)

    @property
    def goal(self) -> float:
        return self.config.goal

    def end_in_hole(self, truth: Truth) -> FloatArray:
        """(3,) the middle of the bar's lower end, in the frame of the socket [m]."""
        item = self.config.scene.object
        assert item is not None
        end = se3.transform(object_pose(truth), np.array([0.0, 0.0, -bounding_size(item.geometry)[2] / 2]))
        return se3.transform(se3.inverse(self._find_hole()[1]), end)

    def remaining(self, truth: Truth, start: Truth) -> float:
        return float(np.linalg.norm(self.end_in_hole(truth) + [0.0, 0.0, self.config.goal]))

    def measures(self, truth: Truth, start: Truth) -> dict[str, float]:
        return {**RigidTask.measures(self, truth, start), "depth": -float(self.end_in_hole(truth)[2])}

    def expert(self, truth: Truth, start: Truth) -> FloatArray:
        """Over the hole, sideways above the block; then down, with the hand going to the hole's axis."""
        hole, goal, step = self._find_hole()[1], self.config.goal, self.config.max_step
        end = self.end_in_hole(truth)
        if end[2] > 0.0 and float(np.hypot(end[0], end[1])) > MAX_LATERAL_ERROR:
            offset = np.array([0.0, 0.0, max(end[2], PEG_LIFT)]) - end
        else:
            aside = end if end[2] > -PEG_LIFT else se3.relative_position(hole, grip_of(truth))
            sideways = np.clip(-aside[:2], -MAX_PEG_SHIFT, MAX_PEG_SHIFT)
            offset = np.array([*sideways, max(-step, -goal - end[2])])
        offset = se3.rotate(hole, offset)
        return np.array([*steps_towards(offset, step), grip_component(self.config, self.config.touch_force)])

    def scripted(self, *, through: bool = False) -> Policy:
        return ScriptedPeg(self.config, self._height_of_start, through)

    def teacher(self) -> Policy:
        """The scripted policy, which goes on from where the hand is, even if a learned policy moved it."""
        return ScriptedPeg(self.config, self._height_of_start, through=False, follows=True)
