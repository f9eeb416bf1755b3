"""Whether an arm follows: the speed scaling of its controller, and where the arm must be by what it was sent.

servoJ leads the joints to the newest target like a lag of first order with the time constant `lookahead`, and runs in
the time of the controller's speed scaling: at 0.1 ten times as slowly. A target that ignores the scaling gets far
ahead, and the arm catches up at a speed that no limit of ours bounds. So the target runs in the same time.

The model here is a slower lag than servoJ has: an arm that follows is never behind it. How far the arm is from the line
between the model and the target is its following error; the usual lag is no part of it.
"""

from __future__ import annotations

import numpy as np

from robot.arm.channel import WorkerConfig
from robot.arm.trajectory import PERIOD
from robot.arm.tuning import (
    MAX_FOREIGN_SHIFT,
    MAX_FOREIGN_SPEED,
    MAX_PACKAGE_GAP,
    MAX_REST_SPEED,
    MAX_REST_TURN_RATE,
    MODEL_LAG,
    SCALING_RATE,
    TARGET_DELAY,
)
from robot.common.kinematics import Kinematics
from robot.common.tcp import ArmFrames, Measured
from tacsim.interface import FloatArray

# Up, the target follows more slowly: an arm that begins to move while the scaling rises speeds up by the rate of
# both, 1.45 times as much as its target.
RISE_RATE = SCALING_RATE / 1.5


class SpeedScaling:
    """The speed scaling that a target has to reckon with: as reported, with the rate that it can really change at."""

    def __init__(self) -> None:
        self.value = 1.0

    def update(self, reported: float) -> float:
        """One period nearer to what the controller reports. Returns the part of the speed that is left: below 1 when
        the scaling falls."""
        before = self.value
        change = min(1.0, max(0.0, reported)) - before
        self.value += min(RISE_RATE * PERIOD, max(-SCALING_RATE * PERIOD, change))
        return min(1.0, self.value / before) if before > 0.0 else 1.0

    def speed(self, speed: float, acceleration: float) -> float:
        """Top speed [m/s or rad/s] of a target: below full scaling, no more than lets the arm speed up within
        `acceleration` when the scaling rises at its full rate."""
        return speed if self.value == 1.0 else self.value * min(speed, acceleration / SCALING_RATE)


class FollowingMonitor:
    """Where the arm is, against where it was sent. Times are those of the controller's packages."""

    def __init__(self, config: WorkerConfig, kinematics: Kinematics, frames: ArmFrames) -> None:
        self._kinematics, self._lookahead = kinematics, config.lookahead
        self._flange_from_sensor = frames.flange_from_tool @ frames.tool_from_sensor
        self._expected: FloatArray | None = None  # joints (6,) that the arm has at least come to
        self._target: FloatArray | None = None  # joints (6,) sent last
        self._stamp = np.nan
        self._rested = 0.0  # for how many time constants of servoJ the target has rested

    def restart(self, joints: FloatArray | None) -> None:
        """The target begins anew at `joints` (6,), where the arm is."""
        self._expected = self._target = joints
        self._rested = 0.0

    def update(self, sent: FloatArray | None, stamp: float, scaling: float) -> None:
        """A new package, of the time `stamp` [s]; `sent` (6,): joints of the newest target; None: nothing is sent."""
        passed = stamp - self._stamp
        passed = passed if 0.0 <= passed <= MAX_PACKAGE_GAP else PERIOD
        self._stamp = stamp
        if sent is None:
            return
        if self._expected is None or self._target is None:
            self.restart(sent)
            return
        rests = bool((sent == self._target).all())
        self._rested = self._rested + scaling * passed / self._lookahead if rests else 0.0
        share = np.exp(-passed / (TARGET_DELAY + MODEL_LAG * self._lookahead / max(scaling, 1e-3)))
        self._expected = sent + share * (self._expected - sent)
        self._target = sent

    def error(self, joints: FloatArray) -> tuple[float, float]:
        """How far the sensor of an arm with these joints (6,) is from where it was sent [m, rad]."""
        if self._expected is None or self._target is None:
            return 0.0, 0.0
        jacobian = self._kinematics.jacobian(joints, self._flange_from_sensor)
        behind, ahead = jacobian @ (self._expected - joints), jacobian @ (self._target - joints)
        return _distance(behind[:3], ahead[:3]), _distance(behind[3:], ahead[3:])

    @property
    def has_settled(self) -> bool:
        """True if packages have arrived since servoJ led the joints to a target that rests."""
        time_constants = 8.0  # time constants after which servoJ has led the joints to a target that rests
        return self._target is not None and self._rested >= time_constants

    def is_moved_from_rest(self, target: FloatArray, speeds: FloatArray) -> bool:
        """True if the controller's own target (6,) [rad] moves, at speeds (6,) [rad/s], or lies elsewhere, where servoJ
        has come to rest: another program moves it."""
        if self._target is None or not self.has_settled:
            return False
        moves = float(np.abs(speeds).max()) > MAX_FOREIGN_SPEED
        return moves or float(np.abs(target - self._target).max()) > MAX_FOREIGN_SHIFT


def _distance(begin: FloatArray, end: FloatArray) -> float:
    """From the origin to the segment between two points (3,)."""
    along = end - begin
    share = min(1.0, max(0.0, -float(begin @ along) / max(float(along @ along), 1e-18)))
    return float(np.linalg.norm(begin + share * along))


def is_standing(measured: Measured) -> bool:
    """True if the arm itself does not move."""
    twist = np.abs(measured.twist)
    return bool(twist[:3].max() <= MAX_REST_SPEED and twist[3:].max() <= MAX_REST_TURN_RATE)
