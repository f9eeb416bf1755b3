"""Constant load on any rig: an arm follows its targets except along the z of its sensor, where a force is held.

An arm that takes poses holds a force by moving until it feels it (position-based force control: Villani and De
Schutter, Force Control, in Springer Handbook of Robotics, 2nd ed., 2016, ch. 9). Each control period the force gives
the next correction, by a stiffness that is learned from what the corrections before did. It needs poses and wrenches
alone, so it is the same for simulated, mock and real arms, and every command still passes their limits.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from tacsim import pose as se3
from tacsim.control.tuning import LOAD_TOLERANCE, MAX_TRAVEL
from tacsim.interface import Action, ArmState, FloatArray, Pose
from tacsim.limits import LimitExceeded
from tacsim.models.rig import TaskConfig


@dataclass
class _AxisState:
    """One arm's z: where it began, its last force, and where it was last sent."""

    began: FloatArray  # (3,) [m]
    before: tuple[FloatArray, float]  # (3,) position [m] and force [N] of the period before
    sent: Pose
    stiffness: float | None = None  # [N/m]


class LoadController:
    """Secant force control: changes the actions of a policy so that arms hold `loads` along the z of their sensors.

    Call it once a control period with the action and the latest arm states, then `record_sent_poses` with the poses
    that were sent. It replaces only the displacement along z; an arm without a target still follows its load.
    """

    def __init__(self, loads: Mapping[str, float], max_correction: float) -> None:
        """loads: normal force by arm name, > 0 when pressed [N]; longest: correction of one period, > 0 [m]."""
        self.loads, self._max_correction = dict(loads), max_correction
        self._axes: dict[str, _AxisState] = {}

    def reset(self) -> None:
        """For a new episode: forgets stiffness and travel."""
        self._axes = {}

    def __call__(self, action: Action, arms: Mapping[str, ArmState]) -> Action:
        """`action` with each loaded arm's displacement along z replaced. Raises LimitExceeded when a load is out of
        reach, or a force is not finite."""
        held = {name: self._loaded_target(name, action.tool.get(name), arms[name]) for name in self.loads}
        return Action({**action.tool, **held})

    def record_sent_poses(self, poses: Mapping[str, Pose | None]) -> None:
        """What the arms were really sent, after their limits; None: nothing was executed."""
        for name, axis in self._axes.items():
            axis.sent = poses.get(name) or axis.sent

    def _loaded_target(self, name: str, requested: Pose | None, arm: ArmState) -> Pose:
        force = -float(arm.wrench[2])
        if not math.isfinite(force):
            raise LimitExceeded(f"arm '{name}' holds a load of {self.loads[name]:g} N, but feels {force} N")
        here = arm.pose.position
        axis = self._axes.setdefault(name, _AxisState(here, (here, force), arm.pose))
        normal = se3.rotation_matrix(arm.pose)[:, 2]
        self._update_stiffness(axis, float(normal @ (here - axis.before[0])), force)
        axis.before = here, force
        requested = axis.sent if requested is None else requested
        normal = se3.rotation_matrix(requested)[:, 2]
        step = self._next_correction(axis, self.loads[name], force)
        if abs(travel := float(normal @ (axis.sent.position - axis.began)) + step) > MAX_TRAVEL:
            raise LimitExceeded(
                f"arm '{name}' does not reach its load of {self.loads[name]:g} N: it feels {force:.3g} N after "
                f"{1e3 * travel:+.3g} mm along its sensor's z (limit {1e3 * MAX_TRAVEL:g} mm); is there anything to "
                "press?"
            )
        along = normal @ (axis.sent.position - requested.position) + step
        return Pose(requested.position + along * normal, requested.quaternion)

    def _update_stiffness(self, axis: _AxisState, displacement: float, force: float) -> None:
        """The stiffness from the last displacement along z [m] and the force after it [N]; a force that fell as the
        sensor pressed came from elsewhere (the body slid, tipped or yielded) and teaches nothing."""
        # Largest change of stiffness a period, as forces are noisy; smaller towards soft, where corrections are longer
        down = 1.25
        # Largest change of stiffness a period, as forces are noisy; smaller towards soft, where corrections are longer
        up = 2.0
        min_displacement = 1e-6  # a shorter displacement gives no stiffness [m]
        change = force - axis.before[1]
        if abs(displacement) < min_displacement or not change / displacement > 0:
            return
        found = change / displacement
        known = axis.stiffness
        axis.stiffness = found if known is None else min(max(found, known / down), known * up)

    def _next_correction(self, axis: _AxisState, load: float, force: float) -> float:
        """The next correction, positive towards the object [m]."""
        probe_share = 0.1  # of the longest correction: the length of one while no stiffness is known
        error = load - force
        if abs(error) <= LOAD_TOLERANCE * load:
            return 0.0
        if axis.stiffness is None:
            return math.copysign(probe_share * self._max_correction, error)
        return max(-self._max_correction, min(self._max_correction, error / axis.stiffness))


def load_controller(task: TaskConfig | None) -> LoadController | None:
    """The controller of the loads of a rig's task; None if it asks for none."""
    return None if task is None or not task.held_loads else LoadController(task.held_loads, task.max_step)
