"""A policy that finds a hole with the bar in its hand, by the force and moment that the bar exerts on the hand."""

from __future__ import annotations

import numpy as np

from tacsim import pose as se3
from tacsim.geometry.shapes import bounding_size
from tacsim.interface import Action, ArmState, FloatArray, GripperTarget, Needs, Observation, Pose
from tacsim.models.task import PegConfig
from tacsim.tasks import tuning


class ScriptedPeg:
    """Goes down until the bar touches, then presses it here and there, and pushes it down where it falls in.

    Where the block supports the bar, seen from the bar's axis, follows from force and moment on the hand: a bar whose
    end is over the hole but for a strip rests on that strip, so the hole is on the other side. With both directions
    off, it rests on a corner of the hole and stays upright; going along one axis then brings it to where it tips along
    the other. A bar that goes further down than the mouth of the hole without a touch is in it. With `through` it
    pushes on past the goal. With `follows` it moves from where the hand is instead of where it sent the hand, and
    searches on in the direction in which the hand moved last.
    """

    def __init__(self, config: PegConfig, height_of_start: float, through: bool, follows: bool = False) -> None:
        """height_of_start: of the bar's end above the mouth of the hole when an episode begins [m]."""
        assert config.scene.object is not None
        self._height_of_start = height_of_start
        self._config, self._through, self._follows = config, through, follows
        size = bounding_size(config.scene.object.geometry)
        self._half = size[:2] / 2  # of the bar's end [m]
        self._below = size[2] / 2 + config.scene.object.grip[2]  # the bar's end, below the grip [m]
        self.reset()

    @property
    def needs(self) -> Needs:
        config = self._config
        return Needs(arms=frozenset({config.arm}), grippers=frozenset({config.gripper}))

    def reset(self) -> None:
        self._at_rest: FloatArray | None = None  # (6,) wrench before anything touches, world axes [N, N m]
        self._start = np.zeros(3)
        self._target = np.zeros(3)  # of the hand [m]
        self._last = np.zeros(3)  # where the hand was in the last control period [m]
        self._surface: float | None = None  # z of the hand where the bar's end is at the surface [m]
        self._direction = np.zeros(2)  # of the search, along world x and y
        self._place: FloatArray | None = None  # of the hand, before it let the bar lie down (3,) [m]
        self._depths: list[float] = []  # while it pushes the bar down [m]
        self.state = "descend"

    def __call__(self, observation: Observation) -> Action:
        arm = observation.arms[self._config.arm]
        wrench = np.concatenate([se3.rotate(arm.pose, arm.wrench[:3]), se3.rotate(arm.pose, arm.wrench[3:])])
        if self._at_rest is None:
            self._at_rest, self._start, self._target = wrench, arm.pose.position, np.array(arm.pose.position)
            self._last = arm.pose.position
        if self._follows:
            moved = float(arm.pose.position[0] - self._last[0])
            self._target, self._last = np.array(arm.pose.position), arm.pose.position
            if abs(moved) > tuning.SEARCH_STEP / 4:
                self._direction[0] = np.sign(moved)
        force, moment = np.split(wrench - self._at_rest, 2)
        self._target = self._target + self._move(arm, force, moment)
        grip = GripperTarget(0.0, self._config.touch_force)
        return Action({self._config.arm: Pose(self._target, arm.pose.quaternion)}, {self._config.gripper: grip})

    def _move(self, arm: ArmState, force: FloatArray, moment: FloatArray) -> FloatArray:
        """The hand's next displacement (3,), world [m]."""
        step, press, height = self._config.max_step, float(force[2]), float(arm.pose.position[2])
        given_way = press / tuning.GRIP_STIFFNESS
        if self._surface is None:
            mouth = float(self._start[2]) - self._height_of_start
            if press >= tuning.MIN_PRESS:
                self._surface = height + given_way
            elif height > mouth - 2.0 * tuning.MIN_HOLE_DEPTH:
                return np.array([0.0, 0.0, -step])
            else:
                self._surface = mouth
        depth = self._surface - height - given_way
        if depth > tuning.MIN_HOLE_DEPTH:
            self._place = None
            return self._insert(depth, force)
        self._depths = []
        if press < 0.8 * tuning.SEARCH_PRESS:
            self.state = "press"
            return np.array([0.0, 0.0, -min(tuning.SEARCH_PRESS / tuning.GRIP_STIFFNESS - given_way, step)])
        share = self.support(force, moment) / self._half
        is_tipped = abs(share[1]) > tuning.TIPPED_SHARE
        if is_tipped and self._place is None:  # or it stands on an edge because the block is turned: let it lie down
            self.state, self._place = "relax", self._target.copy()
            return np.array([0.0, np.clip(tuning.RELAXATION * force[1], -step, step), 0.0])
        self.state, here = "hop", self._target if self._place is None else self._place
        self._place = None
        next_place = here[:2] + self._next_step(share, here[:2] - self._start[:2])
        return np.array([*(next_place - self._target[:2]), step])

    def _next_step(self, share: FloatArray, moved: FloatArray) -> FloatArray:
        """From this place to the next (2,), world x and y [m]. share: where the bar is supported, over half its
        width; moved: from the start (2,) [m]."""
        if self._direction[0] == 0.0:
            self._direction[0] = -np.sign(share[0]) if abs(share[0]) > tuning.TIPPED_SHARE else 1.0
        if abs(share[1]) > tuning.TIPPED_SHARE:
            if self._direction[1] == 0.0:
                self._direction[1] = -np.sign(share[1])
            if abs(moved[1]) > tuning.TIPPED_RANGE:
                self._direction[1] = -np.sign(moved[1])
            return np.array([0.0, tuning.SEARCH_STEP * self._direction[1]])
        self._direction[1] = 0.0
        if abs(moved[1]) > tuning.TIPPED_RANGE:  # a learned policy went too far
            return np.array([0.0, -tuning.SEARCH_STEP * np.sign(moved[1])])
        if abs(moved[0]) > tuning.SEARCH_RANGE:
            self._direction[0] = -np.sign(moved[0])
        return np.array([tuning.SEARCH_STEP * self._direction[0], 0.0])

    def _insert(self, depth: float, force: FloatArray) -> FloatArray:
        """Down with a limited force, sideways as the hole wants it; up again where it goes no further."""
        self.state, goal = "insert", np.inf if self._through else self._config.goal
        self._depths.append(depth)
        latest = self._depths[-tuning.STUCK_STEPS :]
        stuck = len(latest) == tuning.STUCK_STEPS and max(latest) - latest[0] < tuning.MIN_PROGRESS
        if stuck and depth < self._config.goal - self._config.success:
            self._depths = []
            return np.array([0.0, 0.0, self._config.max_step])
        room = (tuning.INSERTION_PRESS - float(force[2])) / tuning.GRIP_STIFFNESS
        down = float(np.clip(min(goal - depth, room), -0.3e-3, self._config.max_step))
        sideways = np.clip(force[:2] * np.array(tuning.COMPLIANCE), -tuning.MAX_CORRECTION, tuning.MAX_CORRECTION)
        return np.array([*sideways, -down])

    def support(self, force: FloatArray, moment: FloatArray) -> FloatArray:
        """(2,) where the bar's end is pressed, from its middle, world x and y [m]."""
        x = -(moment[1] + self._below * force[0]) / force[2]
        y = (moment[0] - self._below * force[1]) / force[2]
        return np.array([x, y])
