"""Hold: grip an object of unknown mass and friction with little more than the force that just holds it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tacsim.interface import Action, FloatArray, GripperTarget, Needs, Observation, Policy, Truth
from tacsim.models.task import HoldConfig
from tacsim.tasks.rigid import RigidTask, grip_component, grip_force, min_grip_force
from tacsim.tasks.task import GoalOutOfReach, GripAxis
from tacsim.tasks.tuning import FORCE_DECREASE, GRIP_RULE, MIN_FLOW, MIN_WEIGHT, SLIP_FLOW_CHANGE


@dataclass(frozen=True, slots=True)
class Hold(RigidTask):
    """distance = |grip force / least force - margin|, least force = m g / (2 mu)."""

    config: HoldConfig

    @property
    def axes(self) -> tuple[GripAxis, ...]:
        return (self.grip_axis,)

    @property
    def goal(self) -> float:
        return self.config.margin

    def require_reachable(self, start: Truth) -> None:
        force, (low, high) = self.config.margin * min_grip_force(self.config), self.config.force_range
        if not low <= force <= high:
            raise GoalOutOfReach(
                f"task.margin: this object needs a grip of {force:.3g} N, and the task's force_range is {low:g} to "
                f"{high:g} N; give a wider range, or another object"
            )

    def remaining(self, truth: Truth, start: Truth) -> float:
        return abs(grip_force(truth) / min_grip_force(self.config) - self.config.margin)

    def expert(self, truth: Truth, start: Truth) -> FloatArray:
        """Lowers the force as the scripted policy does, down to what is wanted: only near its limit does friction show
        in a gel, so that a student can learn where to stop."""
        wanted = self.config.margin * min_grip_force(self.config)
        return np.array([grip_component(self.config, max(wanted, FORCE_DECREASE * grip_force(truth)))])

    def scripted(self, *, through: bool = False) -> Policy:
        return ScriptedHold(self.config, through)

    def analytic(self) -> Policy:
        return AnalyticHold(self.config)


class ScriptedHold:
    """Lowers the grip force step by step until the markers of the gels move, so the object begins to slip, then grips
    with `margin` times the force at which that began. Needs tactile flow. With `through` it lowers on, and drops it."""

    def __init__(self, config: HoldConfig, through: bool) -> None:
        self._config, self._through = config, through
        self.reset()

    @property
    def needs(self) -> Needs:
        return Needs(flow=True, grippers=frozenset({self._config.gripper}))

    def reset(self) -> None:
        self._force = self._config.touch_force
        self._flows: dict[str, FloatArray] = {}
        self._slipped = False

    def __call__(self, observation: Observation) -> Action:
        changed = self._flow_change(observation)
        if not self._slipped or self._through:
            if changed > SLIP_FLOW_CHANGE and not self._through:
                self._slipped = True
                self._force *= self._config.margin / FORCE_DECREASE  # the force before the last decrease held
            else:
                self._force *= FORCE_DECREASE
        return Action({}, {self._config.gripper: GripperTarget(0.0, self._force)})

    def _flow_change(self, observation: Observation) -> float:
        """Largest change of the mean flow of a sensor since the last observation, over that flow; 0 at first. While the
        object sticks, its weight drags the markers equally far, whatever the force."""
        flows = {
            name: touch.flow.mean(axis=(0, 1)).astype(np.float64)
            for name, touch in observation.tactile.items()
            if touch.flow is not None
        }
        before, self._flows = self._flows, flows
        changes = [
            float(np.linalg.norm(flow - before[name])) / max(float(np.linalg.norm(flow)), MIN_FLOW)
            for name, flow in flows.items()
            if name in before
        ]
        return max(changes, default=0.0)


class AnalyticHold:
    """Grip force over the least that holds = A * (force / weight)^B * (greatest difference of the flow of neighbouring
    markers / greatest flow)^C, with the constants of GRIP_RULE: the rim of the contact slips first, and there
    neighbours part. It asks for `margin` times the least, and lowers the force in steps, because only near the limit
    does the rule tell anything."""

    def __init__(self, config: HoldConfig) -> None:
        self._config = config

    @property
    def needs(self) -> Needs:
        return Needs(arms=frozenset({self._config.arm}), flow=True, grippers=frozenset({self._config.gripper}))

    def reset(self) -> None:
        """It has no memory."""

    def __call__(self, observation: Observation) -> Action:
        config = self._config
        force = observation.grippers[config.gripper].force
        if force is None:
            raise ValueError(f"the rule for '{config.kind}' needs a gripper that measures its force")
        weight = max(float(np.linalg.norm(observation.arms[config.arm].wrench[:3])), MIN_WEIGHT)
        scale, of_force, of_flow = GRIP_RULE
        excess = scale * (force / weight) ** of_force * _flow_difference(observation) ** of_flow
        wanted = force * config.margin / excess
        return Action({}, {config.gripper: GripperTarget(0.0, max(wanted, FORCE_DECREASE * force))})


def _flow_difference(observation: Observation) -> float:
    """Greatest difference of the flow of two neighbouring markers over the greatest flow, mean of the sensors [-]."""
    shares = []
    for touch in observation.tactile.values():
        if touch.flow is None:
            continue
        flow = touch.flow.astype(np.float64)
        parted = max(float(np.linalg.norm(np.diff(flow, axis=axis), axis=-1).max()) for axis in (0, 1))
        shares.append(parted / max(float(np.linalg.norm(flow, axis=-1).max()), MIN_FLOW))
    return float(np.mean(shares)) if shares else 1.0
