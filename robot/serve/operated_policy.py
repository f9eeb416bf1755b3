"""The policy of a served rig: a policy that may be paused or stepped, and motions of the operator."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from typing import Literal

import numpy as np

from tacsim import pose as se3
from tacsim.interface import Action, FloatArray, Needs, Observation, Policy, Pose

Mode = Literal["policy", "paused", "step", "teleoperation"]
JOG_LIFETIME = 0.5  # the arm holds when no jog came for so long [s]; a page repeats it every 0.1 s
MAX_JOG_SPEED = 5e-3  # by hand, at full deflection; the limits of the rig apply, too [m/s]
MAX_JOG_TURN_RATE = 0.2  # [rad/s]
MAX_LEAD = 2e-3  # of the target by hand before the measured pose: an arm that is held back does not catch up [m]
MAX_TURN_LEAD = 0.05  # [rad]


class OperatedPolicy:
    """Acts as `policy` in the modes "policy" and "step" (one step, then "paused"), holds in "paused", and moves an arm
    by the operator's jog in "teleoperation". All methods but `__call__` may be called in any thread.

    Args:
        policy: None: only the operator moves the arms.
        mode: at the start.
        max_step: longest motion of an arm by hand in a control period [m].
        max_turn: the same of its rotation [rad].
        max_steps: the policy has ended after so many steps; None: it does not end by itself.
        is_live: time passes by itself, so that it holds while there is nothing to do; otherwise it waits.
    """

    def __init__(
        self,
        policy: Policy | None,
        mode: Mode,
        max_step: float,
        max_turn: float,
        max_steps: int | None,
        *,
        is_live: bool,
    ) -> None:
        self.needs: Needs = Needs() if policy is None else policy.needs
        self._policy, self._max_step, self._max_turn, self._is_live = policy, max_step, max_turn, is_live
        self._max_steps, self._steps = max_steps, 0
        self._lock = threading.Condition()
        self._is_ended = False
        self._mode: Mode = mode
        self._jog: tuple[str, FloatArray] | None = None
        self._jog_time = 0.0
        self._targets: dict[str, Pose] = {}

    @property
    def inner(self) -> Policy | None:
        """The policy that acts in the modes "policy" and "step"."""
        return self._policy

    @property
    def mode(self) -> Mode:
        return self._mode

    @property
    def has_ended(self) -> bool:
        """It was ended, or has done its steps; those in which the arms held while it was paused do not count."""
        return self._is_ended or (self._max_steps is not None and self._steps >= self._max_steps)

    def set_mode(self, mode: Mode) -> None:
        """Raises ValueError where there is no policy for it."""
        if self._policy is None and mode in ("policy", "step"):
            raise ValueError("no episode runs; end the motion by hand, then start one")
        with self._lock:
            self._mode = mode
            self._jog = None
            self._lock.notify_all()

    def end(self) -> None:
        """Ends it; nothing is waited for any more."""
        with self._lock:
            self._is_ended = True
            self._lock.notify_all()

    def set_jog(self, arm: str, jog: FloatArray) -> None:
        """What the next steps move an arm by, for JOG_LIFETIME: (6,) translation along and rotation about the axes of
        its sensor, each as a share of the largest step, within -1 and 1; zeros hold. Raises ValueError for other
        numbers."""
        if jog.shape != (6,) or not np.isfinite(jog).all() or np.abs(jog).max() > 1.0:
            raise ValueError(f"a jog is 6 numbers from -1 to 1, got {jog.tolist()}")
        with self._lock:
            self._jog, self._jog_time = (arm, jog), time.monotonic()
            self._lock.notify_all()

    def reset(self) -> None:
        if self._policy is not None:
            self._policy.reset()
        self._targets = {}

    def __call__(self, observation: Observation) -> Action:
        with self._lock:
            if not self._is_live:
                self._lock.wait_for(self._has_work)
            mode, jog = self._mode, self._present_jog()
            if mode == "step":
                self._mode = "paused"
        if mode in ("policy", "step") and self._policy is not None and not self._is_ended:
            self._targets = {}
            self._steps += 1
            return self._policy(observation)
        if mode != "teleoperation" or jog is None:
            self._targets = {}
            return Action()
        return Action(self._next_target(observation.arms[jog[0]].pose, *jog))

    def _present_jog(self) -> tuple[str, FloatArray] | None:
        """None where there is none, it is zero, or it is too old."""
        jog = self._jog
        if jog is None or not jog[1].any() or time.monotonic() - self._jog_time > JOG_LIFETIME:
            return None
        return jog

    def _has_work(self) -> bool:
        if self._mode == "teleoperation":
            return self._is_ended or self._present_jog() is not None
        return self._is_ended or self._mode != "paused"

    def _next_target(self, measured: Pose, arm: str, jog: FloatArray) -> Mapping[str, Pose | None]:
        """The arm's next target: from its last one, or from the measured pose if the arm is held back from that."""
        last = self._targets.get(arm, measured)
        lead, turn_lead = se3.pose_distance(last, measured)
        if lead > max(MAX_LEAD, 2.0 * self._max_step) or turn_lead > max(MAX_TURN_LEAD, 2.0 * self._max_turn):
            last = measured
        shift, turn = jog[:3] * self._max_step, jog[3:] * self._max_turn
        target = se3.compose(last, se3.from_rotation_vector(shift, turn))
        self._targets = {arm: target}
        return {arm: target}


def make_operated_policy(
    policy: Policy | None, mode: Mode, period: float, max_step: float | None, max_steps: int | None, *, is_live: bool
) -> OperatedPolicy:
    """An OperatedPolicy whose motions by hand keep MAX_JOG_SPEED at this control period [s], and `max_step` [m] of a
    task, if there is one."""
    step = MAX_JOG_SPEED * period if max_step is None else min(MAX_JOG_SPEED * period, max_step)
    return OperatedPolicy(policy, mode, step, MAX_JOG_TURN_RATE * period, max_steps, is_live=is_live)
