"""Tasks for two sensors with a body between them, and scripted policies."""

from __future__ import annotations

from tacsim.models.rig import KneadConfig, RepositionConfig, SqueezeConfig, TaskConfig
from tacsim.tasks.knead import Knead
from tacsim.tasks.reposition import Reposition
from tacsim.tasks.squeeze import Squeeze
from tacsim.tasks.task import Axis, Outcome, Task, judge, tolerance

__all__ = ["Axis", "Knead", "Outcome", "Reposition", "Squeeze", "Task", "judge", "make_task", "tolerance"]


def make_task(config: TaskConfig) -> Task:
    """The task that `config` describes."""
    match config:
        case SqueezeConfig():
            return Squeeze(config)
        case RepositionConfig():
            return Reposition(config)
        case KneadConfig():
            return Knead(config)
