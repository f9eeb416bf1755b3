"""A task for tests: to lift an object, with a grip force of 0.05 to 6 N."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from tacsim import Axis, GripAxis, Task, TaskConfig, Truth, register_task
from tacsim.config import load_scene
from tacsim.models.scene import Scene


class LiftConfig(TaskConfig):
    kind: Literal["lift"] = "lift"
    scene: Scene = load_scene("hold")
    goal: float = 10e-3  # [m]
    max_step: float = 1e-3
    touch_force: float = 3.0


@dataclass(frozen=True)
class Lift(Task):
    config: LiftConfig

    @property
    def axes(self) -> tuple[Axis | GripAxis, ...]:
        return Axis("hand", (0.0, 0.0, 1.0)), GripAxis("hand", 0.05, 6.0)

    @property
    def goal(self) -> float:
        return self.config.goal

    def distance(self, truth: Truth, start: Truth) -> float:
        return abs(truth.position[2] - start.position[2] - self.config.goal)


register_task(LiftConfig, Lift)
