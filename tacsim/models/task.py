"""What a task file may say: the goal of an episode, its actions, and how it is judged."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, Self, Union, get_args

from pydantic import Field, model_validator

from tacsim.models.hardware import Name
from tacsim.models.quantity import Angle, Config, Force, Length, Stiffness
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


class LengthenConfig(TaskConfig):
    """Press the body to a length along world x: distance = |length - goal|; actions move both sensors along world z."""

    kind: Literal["lengthen"]
    goal: Annotated[Length, Field(gt=0)] = 11e-3  # desired length along x [m]
    success: Annotated[Length, Field(gt=0)] = 0.3e-3


class ReliefConfig(TaskConfig):
    """Press dents into the body: distance = rms over the dents of (depth - goal); actions move the upper sensor along
    world x and z."""

    kind: Literal["relief"]
    places: tuple[Length, Length] = (-4.5e-3, 4.5e-3)  # of the dents, along world x from the body's middle [m]
    goal: tuple[Annotated[Length, Field(gt=0)], Annotated[Length, Field(gt=0)]] = (0.6e-3, 0.4e-3)  # depths at rest [m]
    max_step: Annotated[Length, Field(gt=0)] = 0.4e-3
    success: Annotated[Length, Field(gt=0)] = 0.12e-3
    steps: Annotated[int, Field(ge=1, le=1_000_000)] = 300


class RigidTaskConfig(TaskConfig):
    """A task for a gripper with a rigid object between its fingers. `touch_force` is the grip at the start."""

    arm: Name = "hand"  # that carries the gripper
    gripper: Name = "hand"
    # The grip force of an action, at -1 and at 1 [N]
    force_range: tuple[Annotated[Force, Field(gt=0)], Annotated[Force, Field(gt=0)]] = (0.2, 8.0)
    max_slip: Annotated[Length, Field(gt=0)] = 3e-3  # of the object in the grip; beyond it nothing is reached [m]
    touch_force: Annotated[Force, Field(gt=0)] = 6.0

    @model_validator(mode="after")
    def _require_force_range(self) -> Self:
        low, high = self.force_range
        if not low < high:
            raise ValueError(f"force_range runs from {low:g} to {high:g} N: the first must be below the second")
        return self


class HoldConfig(RigidTaskConfig):
    """Hold an object of unknown mass and friction with the least force: distance = |force / least force - margin|;
    actions are the grip force."""

    unit: ClassVar[Unit] = SHARE

    kind: Literal["hold"]
    margin: Annotated[float, Field(gt=1)] = 1.25  # desired grip force over the least that holds
    success: Annotated[float, Field(gt=0)] = 0.2
    reward_scale: Annotated[float, Field(gt=0)] = 1.0
    steps: Annotated[int, Field(ge=1, le=1_000_000)] = 60


class DrawerConfig(RigidTaskConfig):
    """Pull a drawer of unknown resistance by its handle: distance = |travel - goal|, and more where the grip is not
    between the least that pulls and `max_excess` times that; actions move the hand along the drawer's axis, and are the
    grip force."""

    kind: Literal["drawer"]
    goal: Annotated[Length, Field(gt=0)] = 30e-3  # travel [m]
    margin: Annotated[float, Field(gt=1)] = 1.3  # desired grip force over the least that pulls
    max_excess: Annotated[float, Field(gt=1)] = 1.7  # of the grip force over the least
    grip_scale: Annotated[Length, Field(gt=0)] = 10e-3  # distance of a grip that is off by the least force [m]
    max_step: Annotated[Length, Field(gt=0)] = 0.5e-3
    success: Annotated[Length, Field(gt=0)] = 1e-3
    reward_scale: Annotated[Length, Field(gt=0)] = 10e-3
    steps: Annotated[int, Field(ge=1, le=1_000_000)] = 100

    @model_validator(mode="after")
    def _require_margin(self) -> Self:
        if not self.margin < self.max_excess:
            raise ValueError(f"margin {self.margin:g} must be below max_excess, {self.max_excess:g}")
        return self


class TurnConfig(RigidTaskConfig):
    """Let an object that is gripped off its centre turn in the grip by an angle: distance = |angle - goal|; actions
    are the grip force, gravity turns."""

    unit: ClassVar[Unit] = ANGLE

    kind: Literal["turn"]
    goal: Annotated[Angle, Field(gt=0, le=math.pi / 2)] = math.radians(30)  # about the line between the fingers [rad]
    success: Annotated[Angle, Field(gt=0)] = math.radians(3)
    reward_scale: Annotated[Angle, Field(gt=0)] = math.radians(30)
    steps: Annotated[int, Field(ge=1, le=1_000_000)] = 80


class PegConfig(RigidTaskConfig):
    """Put the gripped object into a socket: distance = that of the middle of its lower end from where it should be,
    `goal` below the mouth on the axis of the hole; actions move the hand along x, y and z, and are the grip force."""

    kind: Literal["peg"]
    goal: Annotated[Length, Field(gt=0)] = 10e-3  # depth of the object's lower end in the hole [m]
    max_step: Annotated[Length, Field(gt=0)] = 1e-3
    success: Annotated[Length, Field(gt=0)] = 1e-3
    reward_scale: Annotated[Length, Field(gt=0)] = 10e-3
    force_range: tuple[Annotated[Force, Field(gt=0)], Annotated[Force, Field(gt=0)]] = (0.2, 20.0)
    touch_force: Annotated[Force, Field(gt=0)] = 12.0
    steps: Annotated[int, Field(ge=1, le=1_000_000)] = 150


# Shipped ones, and those made known
TASKS: list[type[TaskConfig]] = [
    SqueezeConfig,
    RepositionConfig,
    KneadConfig,
    LengthenConfig,
    ReliefConfig,
    HoldConfig,
    TurnConfig,
    PegConfig,
    DrawerConfig,
]


def task_annotation() -> Any:
    """The annotation of a task of any known kind."""
    return Annotated[Union[tuple(TASKS)], Field(discriminator="kind")]  # noqa: UP007  # of as many as there are


def unit_of(kind: str | None) -> Unit:
    """The unit of the distances of a kind of task; of a kind that is not known here: a length."""
    known = {name: config.unit for config in TASKS for name in get_args(config.model_fields["kind"].annotation)}
    return known.get(kind or "", LENGTH)
