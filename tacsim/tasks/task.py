"""What a task is: a goal, the free axes of its action, and how a state is judged."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

from tacsim.interface import Needs, Policy, Truth
from tacsim.models.rig import TaskConfig


@dataclass(frozen=True, slots=True)
class Axis:
    """One free axis of a task's action: component i of the action vector moves `arm` along `direction`."""

    arm: str
    direction: tuple[float, float, float]  # unit vector, world


class Task(Protocol):
    """A goal for the body between the sensors. Immutable: the state of an episode is in the two truths."""

    @property
    def config(self) -> TaskConfig: ...
    @property
    def needs(self) -> Needs:
        """What judging needs of a rig; the policy has needs of its own."""
        ...

    @property
    def axes(self) -> tuple[Axis, ...]: ...
    def distance(self, truth: Truth, start: Truth) -> float:
        """Distance of the body from the goal [m]; `start` is the truth just after reset."""
        ...

    def scripted(self, *, through: bool = False) -> Policy:
        """A policy that reaches the goal by touch alone, then holds; with `through` it moves on past the goal."""
        ...


@dataclass(frozen=True, slots=True)
class Outcome:
    """A state, judged."""

    distance: float  # [m]
    reward: float  # -distance / reward_scale
    success: bool  # distance <= config.success
    score: float  # 1 within success, 0.1 one reward_scale further out


def judge(task: Task, truth: Truth, start: Truth) -> Outcome:
    """Distance, reward, success and score of `truth`, in an episode that began at `start`."""
    config, distance = task.config, float(task.distance(truth, start))
    return Outcome(
        distance=distance,
        reward=-distance / config.reward_scale,
        success=distance <= config.success,
        score=tolerance(distance, bounds=(0.0, config.success), margin=config.reward_scale),
    )


def tolerance(
    x: float, bounds: tuple[float, float] = (0.0, 0.0), margin: float = 0.0, value_at_margin: float = 0.1
) -> float:
    """1 for x within `bounds`, falling as a Gaussian to `value_at_margin` at `margin` outside, 0 outside for margin 0.

    The shaping of Tassa et al. 2018 (DeepMind Control Suite, section 3), Gaussian sigmoid.
    Raises ValueError for reversed bounds, a negative margin, or value_at_margin outside (0, 1).
    """
    low, high = bounds
    if not low <= high:
        raise ValueError(f"tolerance: bounds must be (low, high) with low <= high, got {bounds}")
    if not margin >= 0:
        raise ValueError(f"tolerance: margin must be >= 0, got {margin}")
    if not 0 < value_at_margin < 1:
        raise ValueError(f"tolerance: value_at_margin must lie in (0, 1), got {value_at_margin}")
    outside = max(low - x, x - high, 0.0)
    if outside == 0.0:
        return 1.0
    if margin == 0.0:
        return 0.0
    return math.exp(math.log(value_at_margin) * (outside / margin) ** 2)
