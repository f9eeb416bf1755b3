"""Drawer: pull a drawer of unknown resistance by its handle, without losing it."""

from __future__ import annotations

from dataclasses import dataclass

from tacsim.interface import Truth
from tacsim.models.task import DrawerConfig
from tacsim.tasks.rigid import RigidTask, object_pose
from tacsim.tasks.task import Axis, GripAxis


@dataclass(frozen=True, slots=True)
class Drawer(RigidTask):
    """distance = |travel - goal|, travel along the axis of the drawer's guide."""

    config: DrawerConfig

    @property
    def _guide_axis(self) -> str:
        item = self.config.scene.object
        if item is None or item.guide is None:
            raise ValueError("task 'drawer' needs a scene whose object has a guide")
        return str(item.guide.axis)

    @property
    def axes(self) -> tuple[Axis | GripAxis, ...]:
        return (*self.hand_axes(self._guide_axis), self.grip_axis)

    @property
    def goal(self) -> float:
        return self.config.goal

    def travel(self, truth: Truth, start: Truth) -> float:
        """How far the drawer is open [m]."""
        moved = object_pose(truth).position - object_pose(start).position
        return float(moved["xyz".index(self._guide_axis)])

    def remaining(self, truth: Truth, start: Truth) -> float:
        return abs(self.travel(truth, start) - self.config.goal)
