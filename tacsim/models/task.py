"""What a task file may say: the goal of an episode, its actions, and how it is judged."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, Self, Union, get_args

from pydantic import Field, model_validator

from tacsim.models.hardware import Name
from tacsim.models.quantity import Config, Force, Length, Stiffness
from tacsim.models.scene import Scene


class Unit(NamedTuple):
    """What distances of a task are shown in."""

    symbol: str
    factor: float  # number shown over SI value

    def show(self, value: float) -> str:
        """An SI value as text."""
        return f"{self.factor * value:.3f} {self.symbol}"


LENGTH, ANGLE, SHARE = Unit("mm", 1e3), Unit("°", 180.0 / math.pi), Unit("%", 100.0)


class TaskConfig(Config):
    """What every task has. A user-defined one derives from it, says its `kind: Literal["..."]`, adds what it is about,
    and is made known by `tacsim.register_task`."""

    unit: ClassVar[Unit] = LENGTH  # of its distances

    kind: str
    scene: Scene = Scene()
    max_step: Annotated[Length, Field(gt=0)] = 0.2e-3  # largest motion of one sensor in a control step, each axis [m]
    touch_force: Annotated[Force, Field(gt=0)] = 0.05  # reset approaches until this [N]
    placement: Annotated[Length, Field(ge=0)] = 0.0  # reset starts at most this far off the body, by the seed [m]
    success: Annotated[Length, Field(gt=0)] = 0.1e-3  # distance that counts as reached [m]
    reward_scale: Annotated[Length, Field(gt=0)] = 1e-3  # reward = -distance / reward_scale
    force_limit: Annotated[Force, Field(gt=0)] | None = (
        None  # of a normal force: an environment's episode fails beyond it (arms have limits of their own)
    )
    steps: Annotated[int, Field(ge=1, le=1_000_000)] = 40  # length of an episode

    @property
    def held_loads(self) -> Mapping[str, float]:
        """Normal forces that arms hold while they move, by arm [N]."""
        return {}

    @model_validator(mode="after")
    def _require_touch_below_limit(self) -> Self:
        if self.force_limit is not None and not self.touch_force < self.force_limit:
            raise ValueError(
                f"force_limit {self.force_limit:g} N: a reset presses by touch_force, {self.touch_force:g} N; give more"
            )
        return self


class SqueezeConfig(TaskConfig):
    """Squeeze the body to a height: distance = |height - goal|; actions move both sensors along world z."""

    kind: Literal["squeeze"]
    goal: Annotated[Length, Field(gt=0)] = 7e-3  # desired height [m]
    # Of the mount of each sensor, as rules without learning assume it (`arms.NAME.mount` is the real one); None: rigid
    assumed_stiffness: Annotated[Stiffness, Field(gt=0)] | None = None  # [N/m]


class RepositionConfig(TaskConfig):
    """Move the body in the plane: distance = |position - goal|_2; actions move the upper sensor in world x, y."""

    kind: Literal["reposition"]
    goal: tuple[Length, Length] = (2e-3, 2e-3)  # desired displacement of the centre of mass, world x, y [m]
    # Normal forces along the z of their sensors (tacsim.control), by arm; an arm without one holds its
    # height. [N]
    loads: dict[Name, Annotated[Force, Field(gt=0)]] = {}
    touch_force: Annotated[Force, Field(gt=0)] = 1.0  # at less, the upper gel slides

    @property
    def held_loads(self) -> Mapping[str, float]:
        return self.loads


class KneadConfig(TaskConfig):
    """Knead the body to a rod or a ball of its volume: distance = Chamfer's, between them; actions move both sensors
    along world z, and the upper one in x, y."""

    kind: Literal["knead"]
    shape: Literal["rod", "ball"] = "rod"  # a rod lies along world x
    slenderness: Annotated[float, Field(ge=0.5, le=10)] = 2.0  # of a rod: length over diameter
    max_step: Annotated[Length, Field(gt=0)] = 0.5e-3
    touch_force: Annotated[Force, Field(gt=0)] = 0.2
    success: Annotated[Length, Field(gt=0)] = 0.2e-3
    steps: Annotated[int, Field(ge=1, le=1_000_000)] = 200


TASKS: list[type[TaskConfig]] = [SqueezeConfig, RepositionConfig, KneadConfig]  # shipped ones, and those made known


def task_annotation() -> Any:
    """The annotation of a task of any known kind."""
    return Annotated[Union[tuple(TASKS)], Field(discriminator="kind")]  # noqa: UP007  # of as many as there are


def unit_of(kind: str | None) -> Unit:
    """The unit of the distances of a kind of task; of a kind that is not known here: a length."""
    known = {name: config.unit for config in TASKS for name in get_args(config.model_fields["kind"].annotation)}
    return known.get(kind or "", LENGTH)
