"""Squeeze: bring the body to a desired height by moving both sensors along world z. Grip: close the sensors until they
feel a firm contact, then hold; it needs images only, and so runs on any rig."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from tacsim import pose as se3
from tacsim.control import contact_signal
from tacsim.interface import (
    Action,
    FloatArray,
    GripperState,
    GripperTarget,
    Needs,
    Observation,
    Policy,
    Pose,
    RigSpec,
    TactileObservation,
    Truth,
)
from tacsim.models.sensor import CanonicalGrid
from tacsim.models.task import SqueezeConfig
from tacsim.tasks.task import Axis, Estimator, GoalOutOfReach, Task
from tacsim.tasks.tuning import ARRIVAL_HEIGHT_ERROR, CLOSING_STEP, FIRM_GRIP_SIGNAL, MAX_GRIP_FORCE, MIN_BODY_SHARE

BOTH = frozenset({"lower", "upper"})


@dataclass(frozen=True, slots=True)
class Squeeze(Task):
    """distance = |height - goal|, height = z-extent of the body."""

    config: SqueezeConfig

    def require_reachable(self, start: Truth) -> None:
        if self.config.goal > start.height + self.config.success:
            goal, height = 1e3 * self.config.goal, 1e3 * start.height
            raise GoalOutOfReach(
                f"task.goal: {goal:g} mm is above the body, which is {height:.3g} mm high: squeezing makes it lower; "
                "give a lower goal"
            )

    @property
    def touch_needs(self) -> Needs:
        return Needs(BOTH, BOTH, height=True)

    @property
    def axes(self) -> tuple[Axis, ...]:
        return (Axis("lower", (0.0, 0.0, 1.0)), Axis("upper", (0.0, 0.0, 1.0)))

    @property
    def goal(self) -> float:
        return self.config.goal

    def distance(self, truth: Truth, start: Truth) -> float:
        return abs(truth.height - self.config.goal)

    def estimator(self, canonical: CanonicalGrid) -> Estimator:
        def tactile_estimate(observation: Observation) -> float | None:
            touched = all(observation.tactile[name].contact.any() for name in BOTH)
            return abs(estimated_height(observation) - self.config.goal) if touched else None

        return tactile_estimate

    def expert(self, truth: Truth, start: Truth) -> FloatArray:
        """Both sensors close by the height that is left, divided by the share of their displacement since `start` that
        compressed the body (the gels take the rest), at most by `max_step`. No policy is faster while this share is
        constant."""
        closed, taken = _sensor_gap(start) - _sensor_gap(truth), start.height - truth.height
        share = min(max(taken / closed, MIN_BODY_SHARE), 1.0) if closed > 0 else 1.0
        half = np.clip((truth.height - self.config.goal) / share / 2 / self.config.max_step, -1.0, 1.0)
        return np.array([half, -half])

    def scripted(self, *, through: bool = False) -> Policy:
        return ScriptedSqueeze(self.config, through)

    def analytic(self) -> Policy:
        return AnalyticSqueeze(self.config)


class ScriptedSqueeze:
    """Closes both sensors alike at half of max_step until the estimated height of the body is the goal, then holds.

    The last step is shortened to end at the goal. With `through` it then moves on at the full rate.
    """

    def __init__(self, config: SqueezeConfig, through: bool) -> None:
        self._goal, self._rate, self._through = config.goal, config.max_step / 2, through
        self._reached = False

    @property
    def needs(self) -> Needs:
        return Needs(BOTH, BOTH, height=True)

    def reset(self) -> None:
        self._reached = False

    def __call__(self, observation: Observation) -> Action:
        above = estimated_height(observation) - self._goal
        self._reached = self._reached or above <= ARRIVAL_HEIGHT_ERROR
        if self._reached and not self._through:
            return Action({"lower": None, "upper": None})
        step = self._rate if self._reached else min(self._rate, above / 2)
        up = np.array([0.0, 0.0, step])
        lower, upper = observation.arms["lower"].pose, observation.arms["upper"].pose
        return Action(
            {"lower": Pose(lower.position + up, lower.quaternion), "upper": Pose(upper.position - up, upper.quaternion)}
        )


class AnalyticSqueeze:
    """Height = gap between the sensors + both depths + what both mounts give way if they have the assumed stiffness;
    each sensor moves by half of what is left to the goal. It opens
    again if the body is too low."""

    def __init__(self, config: SqueezeConfig) -> None:
        self._goal, self._max_step = config.goal, config.max_step
        self._compliance = 0.0 if config.assumed_stiffness is None else 1.0 / config.assumed_stiffness

    @property
    def needs(self) -> Needs:
        return Needs(BOTH, BOTH, height=True)

    def reset(self) -> None:
        """It has no memory."""

    def __call__(self, observation: Observation) -> Action:
        force = -float(observation.arms["lower"].wrench[2] + observation.arms["upper"].wrench[2])
        height = estimated_height(observation) + self._compliance * force
        step = float(np.clip((height - self._goal) / 2, -self._max_step, self._max_step))
        up = np.array([0.0, 0.0, step])
        lower, upper = observation.arms["lower"].pose, observation.arms["upper"].pose
        return Action(
            {"lower": Pose(lower.position + up, lower.quaternion), "upper": Pose(upper.position - up, upper.quaternion)}
        )


def estimated_height(observation: Observation) -> float:
    """Height of the body [m], estimated by touch: the gap between the gels' rest surfaces plus the depth in each."""
    gap = float(observation.arms["upper"].pose.position[2] - observation.arms["lower"].pose.position[2])
    return gap + max_depth(observation.tactile["lower"]) + max_depth(observation.tactile["upper"])


def max_depth(touch: TactileObservation) -> float:
    """Greatest depth of the body in the gel [m]; 0 without contact."""
    if touch.height is None:
        raise ValueError("the depth of an indentation needs a sensor that delivers the height of its surface")
    return max(0.0, float(touch.height.max(where=touch.valid, initial=0.0)))


def _sensor_gap(truth: Truth) -> float:
    """Between the sensors, along world z [m]."""
    return float(truth.poses["upper"].position[2] - truth.poses["lower"].position[2])


class Grip:
    """Moves every sensor along its own z until the mean contact signal reaches the target, then holds to the end.

    On a recording, its actions are what it would have done. A sensor that no arm carries is addressed by its own name,
    with a target relative to where it is. Sensors on a gripper are closed by it.

    Args:
        spec: of the rig; says which arm or gripper carries which sensor.
        target: contact signal (tacsim.control) that ends the closing [-].
        step: motion of each sensor in a control period [m].
    """

    def __init__(self, spec: RigSpec, target: float = FIRM_GRIP_SIGNAL, step: float = CLOSING_STEP) -> None:
        if not target > 0 or not step > 0:
            raise ValueError(f"grip: target and step must be positive, got target {target}, step {step} m")
        self._carriers: Mapping[str, str | None] = {
            name: sensor.arm for name, sensor in spec.sensors.items() if sensor.gripper is None
        }
        self._grippers = sorted({each.gripper for each in spec.sensors.values() if each.gripper is not None})
        self._target, self._step = target, step
        self._holding = False
        self._widths: dict[str, float] = {}  # that grippers were sent to [m]

    @property
    def needs(self) -> Needs:
        return Needs()

    def reset(self) -> None:
        self._holding, self._widths = False, {}

    def __call__(self, observation: Observation) -> Action:
        signals = [contact_signal(touch) for touch in observation.tactile.values()]
        self._holding = self._holding or float(np.mean(signals)) >= self._target
        if self._holding:
            return Action({arm or sensor: None for sensor, arm in self._carriers.items()})
        return Action(
            {
                arm or sensor: se3.translated_along_z(Pose() if arm is None else observation.arms[arm].pose, self._step)
                for sensor, arm in self._carriers.items()
            },
            {name: self._next_grip(name, observation.grippers[name]) for name in self._grippers},
        )

    def _next_grip(self, name: str, gripper: GripperState) -> GripperTarget:
        """A step narrower than before: each finger goes as far as an arm would."""
        self._widths[name] = max(self._widths.get(name, gripper.width) - 2 * self._step, 0.0)
        return GripperTarget(self._widths[name], MAX_GRIP_FORCE)
