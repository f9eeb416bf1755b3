"""What a task is: a goal, the free axes of its action, and how a state is judged and what it takes of the
arms."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tacsim import pose as se3
from tacsim.interface import Action, ArmState, FloatArray, GripperTarget, Needs, Observation, Policy, Pose, Truth
from tacsim.limits import ActionError
from tacsim.models.sensor import CanonicalGrid
from tacsim.models.task import TaskConfig

# Takes the observations of one episode in their order, from the reset on. Returns the distance from the goal, estimated
# from touch alone [m]; None where no sensor measures it.
Estimator = Callable[[Observation], float | None]


@dataclass(frozen=True, slots=True)
class Axis:
    """One free axis of a task's action: component i of the action vector moves `arm` along `direction`."""

    arm: str
    direction: tuple[float, float, float]  # unit vector, world


@dataclass(frozen=True, slots=True)
class GripAxis:
    """The grip force as one component of an action vector: -1 is `min_force` and 1 is `max_force`, in between evenly in
    the logarithm, since least forces of objects differ by their ratio. It does not depend on the force before."""

    gripper: str
    min_force: float  # above 0 [N]
    max_force: float  # [N]

    def target(self, component: float) -> GripperTarget:
        """To grip with the force of a component."""
        return GripperTarget(0.0, self.min_force * (self.max_force / self.min_force) ** (0.5 * (component + 1.0)))

    def component(self, target: GripperTarget) -> float:
        """The component that asks for the force of a target."""
        force = max(target.force, self.min_force)
        return 2.0 * math.log(force / self.min_force) / math.log(self.max_force / self.min_force) - 1.0


ActionAxes = Sequence[Axis | GripAxis]


class BadDraws(ValueError):
    """Distributions from which too many episodes are drawn that cannot begin."""


class GoalOutOfReach(ValueError):
    """No policy can reach this goal with this body."""


class Task(ABC):
    """A goal for the body between the sensors. Immutable: the state of an episode is in the two truths.

    A user-defined task derives from it, and must have `config`, `axes`, `goal` and `distance`; all else has a default.
    """

    config: TaskConfig

    @property
    @abstractmethod
    def axes(self) -> tuple[Axis | GripAxis, ...]:
        """Of its action."""

    @property
    @abstractmethod
    def goal(self) -> float | tuple[float, ...]:
        """In numbers [m]: an input of learned policies."""

    @abstractmethod
    def distance(self, truth: Truth, start: Truth) -> float:
        """Distance of the body from the goal [m]; `start` is the truth just after reset."""

    def require_reachable(self, start: Truth) -> None:
        """Raises GoalOutOfReach where no policy could bring the body there from `start`."""
        return

    @property
    def needs(self) -> Needs:
        """What it needs of a rig, the arms and grippers that it moves by default; the policy has needs of its own."""
        return needs_of_axes(self.axes)

    @property
    def touch_needs(self) -> Needs:
        """What `estimator` needs in addition; a rig that does not know the truth must have it."""
        return Needs(truth=True)

    def measures(self, truth: Truth, start: Truth) -> Mapping[str, float]:
        """What else is said of the body at the end of an episode."""
        return {}

    def estimator(self, canonical: CanonicalGrid) -> Estimator:
        """The distance by touch alone, as it exists on hardware: a new one for each episode."""
        return lambda observation: None

    def expert(self, truth: Truth, start: Truth) -> FloatArray | None:
        """The best action vector, by the truth; None where no rule for it is known."""
        return None

    def scripted(self, *, through: bool = False) -> Policy:
        """A policy that reaches the goal by touch alone, then holds; with `through` it moves on past the goal. Raises
        ValueError where there is none."""
        raise ValueError(f"task '{self.config.kind}' has no scripted policy; give a user-defined one")

    def analytic(self) -> Policy:
        """A rule of one or two formulas on what a policy observes, without memory of earlier touches: what learning has
        to be compared with. Raises ValueError where there is none."""
        raise ValueError(f"task '{self.config.kind}' has no analytic rule; define Task.analytic")

    def teacher(self) -> Policy:
        """A policy that may know what only a simulation does: shows what to do where `expert` knows no rule."""
        return self.scripted()


@dataclass(frozen=True, slots=True)
class Outcome:
    """A state, judged."""

    distance: float  # [m]
    reward: float  # -distance / reward_scale
    success: bool  # distance <= config.success
    score: float  # 1 within success, 0.1 one reward_scale further out


def evaluate_outcome(task: Task, truth: Truth, start: Truth) -> Outcome:
    """Distance, reward, success and score of `truth`, in an episode that began at `start`."""
    config, distance = task.config, float(task.distance(truth, start))
    return Outcome(
        distance=distance,
        reward=-distance / config.reward_scale,
        success=distance <= config.success,
        score=tolerance_reward(distance, bounds=(0.0, config.success), margin=config.reward_scale),
    )


def tolerance_reward(x: float, bounds: tuple[float, float], margin: float) -> float:
    """1 for x within `bounds` (low, high), falling as a Gaussian to 0.1 at `margin` > 0 outside.

    The shaping of Tassa et al. 2018 (DeepMind Control Suite, section 3), Gaussian sigmoid.
    """
    outside = max(bounds[0] - x, x - bounds[1], 0.0)
    return math.exp(math.log(0.1) * (outside / margin) ** 2)


def needs_of_axes(axes: ActionAxes) -> Needs:
    """The arms and grippers that axes move."""
    return Needs(
        arms=frozenset(axis.arm for axis in axes if isinstance(axis, Axis)),
        grippers=frozenset(axis.gripper for axis in axes if isinstance(axis, GripAxis)),
    )


def action_of_vector(
    vector: NDArray[np.floating[Any]], axes: ActionAxes, max_step: float, poses: Mapping[str, Pose]
) -> Action:
    """Component i moves its arm from `poses` by vector[i] * max_step [m] along its axis, rotation kept; of a
    GripAxis it is the grip force.

    Raises ActionError for a wrong shape, a component that is not finite, or one outside [-1, 1].
    """
    given = np.asarray(vector)
    if given.dtype.kind not in "fiub":
        raise ActionError(f"action must be an array of {len(axes)} real numbers, got {vector!r}")
    values = given.astype(np.float64)
    if values.shape != (len(axes),):
        raise ActionError(f"action must have shape ({len(axes)},), one number for each free axis, got {values.shape}")
    # The margin admits 1.0 in any float precision.
    if not np.isfinite(values).all() or float(np.abs(values).max(initial=0.0)) > 1.0 + 1e-6:
        raise ActionError(
            f"action components must be finite and within [-1, 1], got {values.tolist()}; "
            "bound the policy's output (gymnasium.wrappers.ClipAction does it)"
        )
    positions: dict[str, FloatArray] = {}
    grips: dict[str, GripperTarget | None] = {}
    for axis, value in zip(axes, values, strict=True):
        if isinstance(axis, GripAxis):
            grips[axis.gripper] = axis.target(float(value.clip(-1.0, 1.0)))
        else:
            before = positions.get(axis.arm, poses[axis.arm].position)
            positions[axis.arm] = before + value * max_step * np.array(axis.direction)
    return Action({arm: Pose(position, poses[arm].quaternion) for arm, position in positions.items()}, grips)


def vector_of_action(
    action: Action,
    axes: ActionAxes,
    max_step: float,
    poses: Mapping[str, Pose],
    grips: Mapping[str, GripperTarget] | None = None,
) -> NDArray[np.float32]:
    """The vector that asks for `action` from `poses` and the grippers' last targets: the inverse of `action_of_vector`.
    What is longer than max_step, or beyond the forces of an axis, is cut, and what is not along an axis is left out; an
    arm that holds has zeros."""
    vector = np.zeros(len(axes), np.float32)
    for number, axis in enumerate(axes):
        if isinstance(axis, GripAxis):
            grip = action.grippers.get(axis.gripper) or (grips or {}).get(axis.gripper)
            vector[number] = -1.0 if grip is None else axis.component(grip)
            continue
        target = action.tool.get(axis.arm)
        if target is not None:
            vector[number] = (target.position - poses[axis.arm].position) @ np.array(axis.direction) / max_step
    return vector.clip(-1.0, 1.0)


class Effort:
    """The greatest normal force of a sensor, and the work that the arms do, from the states after each control step.

    Work is the sum over arms and steps of the force on the body times the displacement of its sensor, the force taken
    as the mean of before and after (trapezoidal rule); turns are left out.
    """

    def __init__(self, arms: Mapping[str, ArmState]) -> None:
        self._before, self._forces = arms, _world_forces(arms)
        self.peak = _max_normal_force(arms)  # [N]
        self.work = 0.0  # [J]

    def add(self, arms: Mapping[str, ArmState]) -> None:
        """The next states of the same arms."""
        forces = _world_forces(arms)
        for name, now in arms.items():
            force = -0.5 * (self._forces[name] + forces[name])  # on the body
            self.work += float(force @ (now.pose.position - self._before[name].pose.position))
        self._before, self._forces = arms, forces
        self.peak = max(self.peak, _max_normal_force(arms))


def _world_forces(arms: Mapping[str, ArmState]) -> dict[str, FloatArray]:
    """(3,) on the sensor of each arm, world axes [N]."""
    return {name: se3.rotate(arm.pose, arm.wrench[:3]) for name, arm in arms.items()}


def _max_normal_force(arms: Mapping[str, ArmState]) -> float:
    return max((abs(float(arm.wrench[2])) for arm in arms.values()), default=0.0)
