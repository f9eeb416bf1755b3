"""Following error of an arm: the controller's speed scaling, and the joints expected from the targets that were sent.

servoJ moves the joints to the newest target with a first-order lag of time constant `lookahead`, in the time of the
controller's speed scaling: at 0.1 ten times as slowly. A target that ignores the scaling gets far ahead, and the arm
catches up at a speed that none of our limits bounds. So the target runs in the same scaled time.

The model here has a slower lag than servoJ, so an arm that follows is never behind it. The following error is the
distance of the arm from the line between the model and the target; the normal lag does not add to it.
"""

from __future__ import annotations

import numpy as np

from robot.arm.channel import WorkerConfig
from robot.arm.trajectory import PERIOD
from robot.arm.tuning import (
    MAX_PACKAGE_GAP,
    MAX_REST_SPEED,
    MAX_REST_TURN_RATE,
    OTHER_PROGRAM_SHIFT,
    OTHER_PROGRAM_SPEED,
    SCALING_RATE,
    SLOW_LAG_RATIO,
    TARGET_DELAY,
)
from robot.common.kinematics import Kinematics
from robot.common.tcp import ArmFrames, Measured
from tacsim.interface import FloatArray

# The target follows a rising scaling more slowly: an arm that starts while the scaling rises accelerates by both,
# 1.45 times as much as its target.
RISE_RATE = SCALING_RATE / 1.5


class SpeedScaling:
    """The speed scaling that the target uses: the reported one, limited to its real rate of change."""

    def __init__(self) -> None:
        self.value = 1.0

    def update(self, reported: float) -> float:
        """Moves one period towards the reported scaling. Returns the factor for the present speed: below 1 when the
        scaling falls."""
        before = self.value
        change = min(1.0, max(0.0, reported)) - before
        self.value += min(RISE_RATE * PERIOD, max(-SCALING_RATE * PERIOD, change))
        return min(1.0, self.value / before) if before > 0.0 else 1.0

    def speed(self, speed: float, acceleration: float) -> float:
        """Maximum speed [m/s or rad/s] of a target. Below full scaling it is small enough that the arm stays within
        `acceleration` when the scaling rises at its full rate."""
        return speed if self.value == 1.0 else self.value * min(speed, acceleration / SCALING_RATE)


class FollowingMonitor:
    """Compares the measured joints with those that were sent. Times are those of the controller's packages."""

    def __init__(self, config: WorkerConfig, kinematics: Kinematics, frames: ArmFrames) -> None:
        self._kinematics, self._lookahead = kinematics, config.lookahead
        self._flange_from_sensor = frames.flange_from_tool @ frames.tool_from_sensor
        self._expected_joints: FloatArray | None = None  # joints (6,) that the arm has reached or passed
        self._sent_joints: FloatArray | None = None  # joints (6,) of the last target
        self._last_stamp = np.nan
        self._rest_time_constants = 0.0  # rest of the target, in time constants of servoJ

    def restart(self, joints: FloatArray | None) -> None:
        """Restarts the target at the present `joints` (6,) of the arm."""
        self._expected_joints = self._sent_joints = joints
        self._rest_time_constants = 0.0

    def update(self, sent_joints: FloatArray | None, stamp: float, scaling: float) -> None:
        """Takes a new package with time `stamp` [s]. `sent_joints` (6,): the newest target; None: nothing is sent."""
        elapsed = stamp - self._last_stamp
        elapsed = elapsed if 0.0 <= elapsed <= MAX_PACKAGE_GAP else PERIOD
        self._last_stamp = stamp
        if sent_joints is None:
            return
        if self._expected_joints is None or self._sent_joints is None:
            self.restart(sent_joints)
            return
        is_resting = bool((sent_joints == self._sent_joints).all())
        self._rest_time_constants = (
            self._rest_time_constants + scaling * elapsed / self._lookahead if is_resting else 0.0
        )
        share = np.exp(-elapsed / (TARGET_DELAY + SLOW_LAG_RATIO * self._lookahead / max(scaling, 1e-3)))
        self._expected_joints = sent_joints + share * (self._expected_joints - sent_joints)
        self._sent_joints = sent_joints

    def error(self, joints: FloatArray) -> tuple[float, float]:
        """Distance of the sensor at `joints` (6,) from where it was sent [m, rad]."""
        if self._expected_joints is None or self._sent_joints is None:
            return 0.0, 0.0
        jacobian = self._kinematics.jacobian(joints, self._flange_from_sensor)
        to_expected, to_sent = jacobian @ (self._expected_joints - joints), jacobian @ (self._sent_joints - joints)
        return _distance_to_segment(to_expected[:3], to_sent[:3]), _distance_to_segment(to_expected[3:], to_sent[3:])

    @property
    def has_settled(self) -> bool:
        """True if packages have arrived since servoJ moved the joints to a target at rest."""
        time_constants = 8.0  # time constants after which servoJ has moved the joints to a target at rest
        return self._sent_joints is not None and self._rest_time_constants >= time_constants

    def is_moved_from_rest(self, target_joints: FloatArray, target_speeds: FloatArray) -> bool:
        """True if the controller's own target (6,) [rad] moves, with speeds (6,) [rad/s], or differs from ours although
        servoJ has settled: another program moves the arm."""
        if self._sent_joints is None or not self.has_settled:
            return False
        is_moving = float(np.abs(target_speeds).max()) > OTHER_PROGRAM_SPEED
        return is_moving or float(np.abs(target_joints - self._sent_joints).max()) > OTHER_PROGRAM_SHIFT


def _distance_to_segment(begin: FloatArray, end: FloatArray) -> float:
    """Distance of the origin from the segment between two points (3,)."""
    along = end - begin
    share = min(1.0, max(0.0, -float(begin @ along) / max(float(along @ along), 1e-18)))
    return float(np.linalg.norm(begin + share * along))


def is_standing_still(measured: Measured) -> bool:
    """True if the measured speeds of the arm are those of rest."""
    twist = np.abs(measured.twist)
    return bool(twist[:3].max() <= MAX_REST_SPEED and twist[3:].max() <= MAX_REST_TURN_RATE)
