"""Drawer: pull a drawer of unknown resistance by its handle, with little more than the grip that just holds it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from tacsim.geometry.shapes import bounding_size
from tacsim.interface import (
    Action,
    FloatArray,
    GripperTarget,
    Needs,
    Observation,
    Policy,
    Pose,
    TactileObservation,
    Truth,
)
from tacsim.models.shape import RigidObject
from tacsim.models.task import DrawerConfig
from tacsim.tasks import tuning
from tacsim.tasks.rigid import RigidTask, grip_component, grip_force, object_pose
from tacsim.tasks.task import Axis, GoalOutOfReach, GripAxis


@dataclass(frozen=True, slots=True)
class Drawer(RigidTask):
    """distance = |travel - goal|, travel along the axis of the drawer's guide; and more where the grip is not between
    the least that holds and `max_excess` times that."""

    config: DrawerConfig

    def __post_init__(self) -> None:
        item = guided_object(self.config)
        assert item.guide is not None
        if item.guide.travel < self.config.goal:
            raise ValueError(
                f"task.goal: the drawer opens by {item.guide.travel:g} m (object.guide.travel), not by "
                f"{self.config.goal:g} m"
            )

    @property
    def axes(self) -> tuple[Axis | GripAxis, ...]:
        return (*self.hand_axes(guide_axis(self.config)), self.grip_axis)

    @property
    def goal(self) -> float:
        return self.config.goal

    def require_reachable(self, start: Truth) -> None:
        least, (low, high) = min_pulling_grip(self.config), self.config.force_range
        if not low <= self.config.margin * least <= high:
            raise GoalOutOfReach(
                f"task.margin: this drawer needs a grip of {self.config.margin * least:.3g} N, and the task's "
                f"force_range is {low:g} to {high:g} N; give a wider range, or another drawer"
            )

    def travel(self, truth: Truth, start: Truth) -> float:
        """How far the drawer is open [m]."""
        moved = object_pose(truth).position - object_pose(start).position
        return float(moved["xyz".index(guide_axis(self.config))])

    def remaining(self, truth: Truth, start: Truth) -> float:
        ratio, config = grip_force(truth) / min_pulling_grip(self.config), self.config
        outside = max(1.0 - ratio, ratio - config.max_excess, 0.0)
        return abs(self.travel(truth, start) - config.goal) + outside * config.grip_scale

    def measures(self, truth: Truth, start: Truth) -> dict[str, float]:
        measured = RigidTask.measures(self, truth, start)
        return {**measured, "travel": self.travel(truth, start), "min_grip": min_pulling_grip(self.config)}

    def expert(self, truth: Truth, start: Truth) -> FloatArray:
        """As far as is left. Lowers the grip as the scripted policy does, down to the middle of what is wanted and what
        is allowed: only near its limit does friction show in a gel, so that a student can learn where to stop."""
        left = (self.config.goal - self.travel(truth, start)) / self.config.max_step
        config = self.config
        wanted = 0.5 * (config.margin + config.max_excess) * min_pulling_grip(config)
        grip = max(wanted, tuning.GRIP_DECREASE * grip_force(truth))
        return np.array([float(np.clip(left, -1.0, 1.0)), grip_component(config, grip)])

    def scripted(self, *, through: bool = False) -> Policy:
        return ScriptedDrawer(self.config, through)


def guided_object(config: DrawerConfig) -> RigidObject:
    """The drawer. Raises ValueError for a scene without one."""
    item = config.scene.object
    if item is None or item.guide is None:
        raise ValueError("task 'drawer' needs a scene whose object has a guide; give scene: drawer, or object.guide")
    if item.guide.friction <= 0.0 or item.friction <= 0.0:
        raise ValueError("task 'drawer' needs resistance and grip: object.guide.friction and object.friction above 0")
    return item


def guide_axis(config: DrawerConfig) -> str:
    """Along which the drawer opens: "x", "y" or "z"."""
    guide = guided_object(config).guide
    assert guide is not None
    return str(guide.axis)


def min_pulling_grip(config: DrawerConfig) -> float:
    """Force of each of two fingers that just pulls the drawer as fast as the task allows, by Coulomb [N]."""
    item = guided_object(config)
    assert item.guide is not None
    resistance = item.guide.friction + item.guide.damping * config.max_step / tuning.USUAL_PERIOD
    return float(resistance / (2.0 * item.friction))


class ScriptedDrawer:
    """Pulls, and lowers the grip force step by step until the handle slips, then grips with `margin` times the force at
    which that began; harder again, should it slip once more. Needs the height and the flow of the gels.

    How far the handle lags behind the hand, by the gels' shear and by slip, is seen in the gels: where the middle of
    the contact has moved along the tactile flow of the first pull. With `through` it pulls on past the goal.
    """

    def __init__(self, config: DrawerConfig, through: bool) -> None:
        self._config, self._through = config, through
        size = bounding_size(guided_object(config).geometry)
        self._direction = np.eye(3)["xyz".index(guide_axis(config))]
        self._face = float(size[1] * size[2])  # of the handle, on a gel [m^2]
        self.reset()

    @property
    def needs(self) -> Needs:
        config = self._config
        return Needs(arms=frozenset({config.arm}), grippers=frozenset({config.gripper}), height=True, flow=True)

    def reset(self) -> None:
        self._force = self._config.touch_force
        self._start: Pose | None = None
        self._first: dict[str, FloatArray] = {}  # middle of the contact at the start, by sensor (2,) [cells]
        self._pitch: dict[str, float] = {}  # of the grid, by sensor [m]
        self._drag: dict[str, FloatArray] = {}  # unit vector of the first tactile flow, by sensor (2,)
        self._lag = 0.0  # of the handle behind the hand [m]
        self.slipped = self._pulling = self._arrived = False

    def __call__(self, observation: Observation) -> Action:
        arm = observation.arms[self._config.arm]
        lag, before = 0.0, self._lag
        if self._start is None:
            self._start = arm.pose
            for name, touch in observation.tactile.items():
                self._first[name] = middle_of_contact(touch)
                self._pitch[name] = math.sqrt(self._face / max(int(touch.contact.sum()), 1))
        else:  # before the first pull, the flow does not show its direction
            lag = self._measure_lag(observation)
        self._lag = lag
        if not self._arrived:
            self._change_force(lag - before)
        hand_travel = float((arm.pose.position - self._start.position) @ self._direction)
        left = np.inf if self._through else self._config.goal - (hand_travel - lag)
        grip = GripperTarget(0.0, self._force)
        self._arrived = self._arrived or left < tuning.ARRIVAL_LEFT
        if self._arrived:
            return Action({}, {self._config.gripper: grip})
        target = Pose(arm.pose.position + min(left, self._config.max_step) * self._direction, arm.pose.quaternion)
        return Action({self._config.arm: target}, {self._config.gripper: grip})

    def _change_force(self, change: float) -> None:
        """change: of the lag since the last observation [m]."""
        slips = change > tuning.SLIP_SHARE * self._config.max_step
        if not self._pulling:  # the gels are sheared until the drawer moves
            self._pulling = self._lag > 0.0 and not slips
        elif slips:
            self._force *= tuning.SECOND_INCREASE if self.slipped else self._config.margin / tuning.GRIP_DECREASE
            self.slipped = True
        elif not self.slipped:
            self._force *= tuning.GRIP_DECREASE
        low, high = self._config.force_range
        self._force = min(max(self._force, low), high)

    def _measure_lag(self, observation: Observation) -> float:
        """[m]; 0 where no gel is touched."""
        lags = []
        for name, touch in observation.tactile.items():
            if touch.flow is None or not touch.contact.any():
                continue
            flow = touch.flow.mean(axis=(0, 1)).astype(np.float64)
            length = float(np.linalg.norm(flow))
            if name not in self._drag and length > tuning.MIN_FLOW:
                self._drag[name] = flow / length
            if name in self._drag:
                moved = middle_of_contact(touch) - self._first[name]
                lags.append(self._pitch[name] * float(moved @ self._drag[name]))
        return float(np.mean(lags)) if lags else 0.0


def middle_of_contact(touch: TactileObservation) -> FloatArray:
    """(2,) mean place of the indented volume: column and row, in cells of the grid; 0 without height or contact."""
    if touch.height is None:
        return np.zeros(2)
    weights = np.where(touch.contact, np.maximum(touch.height, 0.0), 0.0).astype(np.float64)
    total = float(weights.sum())
    if total <= 0.0:
        return np.zeros(2)
    rows, columns = weights.sum(axis=1), weights.sum(axis=0)
    return np.array([columns @ np.arange(columns.size), rows @ np.arange(rows.size)]) / total
