"""Tasks: what the two sensors shall do with the body between them, and policies that need no task."""

from __future__ import annotations

from tacsim.rigfile import SqueezeFacts, TaskFacts
from tacsim.tasks.reposition import Reposition
from tacsim.tasks.squeeze import Squeeze
from tacsim.tasks.task import Axis, Outcome, Task, judge, tolerance

__all__ = ["Axis", "Outcome", "Reposition", "Squeeze", "Task", "judge", "make_task", "tolerance"]


def make_task(facts: TaskFacts) -> Task:
    """The task that the facts describe."""
    return Squeeze(facts) if isinstance(facts, SqueezeFacts) else Reposition(facts)
