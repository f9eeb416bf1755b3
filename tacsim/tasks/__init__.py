"""Tasks: what the two sensors shall do with the body between them, and policies that need no task."""

from __future__ import annotations

from tacsim.models.rig import SqueezeConfig, TaskConfig
from tacsim.tasks.reposition import Reposition
from tacsim.tasks.squeeze import Squeeze
from tacsim.tasks.task import Axis, Outcome, Task, judge, tolerance

__all__ = ["Axis", "Outcome", "Reposition", "Squeeze", "Task", "judge", "make_task", "tolerance"]


def make_task(config: TaskConfig) -> Task:
    """The task that the facts describe."""
    return Squeeze(config) if isinstance(config, SqueezeConfig) else Reposition(config)
