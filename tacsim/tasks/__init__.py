"""Tasks for two sensors with a body between them, and scripted policies."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from tacsim.models.rig import register_task_config
from tacsim.models.task import (
    DrawerConfig,
    HoldConfig,
    KneadConfig,
    LengthenConfig,
    PegConfig,
    ReliefConfig,
    RepositionConfig,
    SqueezeConfig,
    TaskConfig,
    TurnConfig,
)
from tacsim.tasks.drawer import Drawer
from tacsim.tasks.hold import Hold
from tacsim.tasks.knead import Knead
from tacsim.tasks.lengthen import Lengthen
from tacsim.tasks.peg import Peg
from tacsim.tasks.relief import Relief
from tacsim.tasks.reposition import Reposition
from tacsim.tasks.squeeze import Squeeze
from tacsim.tasks.task import (
    Axis,
    BadDraws,
    Estimator,
    GoalOutOfReach,
    GripAxis,
    Outcome,
    Task,
    evaluate_outcome,
    tolerance_reward,
)
from tacsim.tasks.turn import Turn

__all__ = [
    "Axis",
    "BadDraws",
    "Estimator",
    "GoalOutOfReach",
    "GripAxis",
    "Knead",
    "Lengthen",
    "Outcome",
    "Relief",
    "Reposition",
    "Squeeze",
    "Task",
    "evaluate_outcome",
    "make_task",
    "register_task",
    "tolerance_reward",
]

_TASK_OF_CONFIG: dict[type[TaskConfig], Callable[[Any], Task]] = {
    SqueezeConfig: Squeeze,
    RepositionConfig: Reposition,
    KneadConfig: Knead,
    HoldConfig: Hold,
    TurnConfig: Turn,
    DrawerConfig: Drawer,
    LengthenConfig: Lengthen,
    ReliefConfig: Relief,
    PegConfig: Peg,
}


def register_task(config: type[TaskConfig], task: Callable[[Any], Task]) -> None:
    """Registers a user-defined task: files, rigs and environments may name it from now on, in this process.

    config: derives from TaskConfig, says ``kind: Literal["..."]`` and has a default for all else.
    task: makes the task of such a config; a class that derives from Task and takes the config alone.

    Raises ValueError for a config without a kind of its own.
    """
    register_task_config(config)
    _TASK_OF_CONFIG[config] = task


def make_task(config: TaskConfig) -> Task:
    """The task that `config` describes. Raises ValueError for a kind that is not registered."""
    if type(config) not in _TASK_OF_CONFIG:
        raise ValueError(f"no task is made of {type(config).__name__}: register_task makes yours known")
    return _TASK_OF_CONFIG[type(config)](config)
