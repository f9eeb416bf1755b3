"""Trajectories from the present pose to a target, in steps of one servo period, limited in speed and acceleration; and
the following error of an arm: the controller's speed scaling, and the joints expected from the targets that were sent.

Position and rotation of the sensor are planned separately, each with its own limits: in every period the velocity
changes by at most acceleration times period, and the speed still allows a stop on the target. The laws use discrete
time, so they hold exactly for the poses that are sent: the second difference of the positions is within the
acceleration, and the target is reached without overshoot.

servoJ moves the joints to the newest target with a first-order lag of time constant `lookahead`, in the time of the
controller's speed scaling: at 0.1 ten times as slowly. A target that ignores the scaling gets far ahead, and the arm
catches up at a speed that none of our limits bounds. So the target runs in the same scaled time.

The model here has a slower lag than servoJ, so an arm that follows is never behind it. The following error is the
distance of the arm from the line between the model and the target; the normal lag does not add to it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from robot.arm import tuning
from robot.arm.channel import WorkerConfig
from robot.common.kinematics import Kinematics, rotation_vector
from robot.common.kinematics import rotation as turn
from robot.common.tcp import ArmFrames, Measured
from tacsim.interface import FloatArray

PERIOD = 2e-3  # of the servo loop [s]
MAX_LOOP_OFFSET = 2 * PERIOD  # between the loops of two arms [s]


def find_min_gap(keep_out: float, partner_speed: float) -> float:
    """Smallest gap [m] that the servo keeps to the braking path of another arm: the keep-out distance [m], plus what
    that path covers within MAX_LOOP_OFFSET (its end moves at most twice as fast as the arm, whose limit is
    `partner_speed` [m/s])."""
    return keep_out + 2.0 * partner_speed * MAX_LOOP_OFFSET


class MotionLimits(Protocol):
    """Limits of a motion. tacsim.models.hardware.ArmLimits and WorkerConfig follow this protocol."""

    @property
    def speed(self) -> float: ...  # [m/s]
    @property
    def acceleration(self) -> float: ...  # [m/s^2]
    @property
    def turn_rate(self) -> float: ...  # [rad/s]
    @property
    def turn_acceleration(self) -> float: ...  # [rad/s^2]


@dataclass(frozen=True, slots=True, eq=False)
class MotionState:
    """Pose and velocity of a frame, in the axes of the world."""

    position: FloatArray  # (3,) [m]
    rotation: FloatArray  # (3, 3) world_from_sensor
    velocity: FloatArray  # (3,) [m/s]
    spin: FloatArray  # (3,) angular velocity [rad/s]

    @property
    def is_at_rest(self) -> bool:
        return not self.velocity.any() and not self.spin.any()


def motion_at_rest(position: FloatArray, rotation: FloatArray) -> MotionState:
    """A motion state at rest at `position` (3,) [m] with axes `rotation` (3, 3)."""
    return MotionState(
        np.array(position, dtype=np.float64), np.array(rotation, dtype=np.float64), np.zeros(3), np.zeros(3)
    )


def max_landing_speed(distance: float, acceleration: float) -> float:
    """The maximum speed of the next period [m/s] that still allows a stop exactly `distance` [m] ahead.

    From speed u, n periods that each brake by a = acceleration * period cover period * (n u - a n (n - 1) / 2). The
    smallest n whose last speed is at most a gives u. Between whole n the law is linear, so it is continuous.
    """
    speed_step = acceleration * PERIOD
    n = max(1, math.ceil(0.5 * (math.sqrt(1.0 + 8.0 * distance / (speed_step * PERIOD)) - 1.0)))
    return distance / (n * PERIOD) + 0.5 * speed_step * (n - 1)


def stopping_distance(speed: float, acceleration: float) -> float:
    """Distance [m] covered from `speed` [m/s] when every period brakes by the maximum; at most v^2 / 2a."""
    speed_step = acceleration * PERIOD
    n = math.floor(speed / speed_step)
    return PERIOD * (n * speed - 0.5 * speed_step * n * (n + 1))


def step_towards(
    motion: MotionState,
    target_position: FloatArray,
    target_rotation: FloatArray,
    limits: MotionLimits,
    is_allowed: Callable[[MotionState], bool] | None = None,
) -> MotionState:
    """The motion state one period later, on the path to `target_position` (3,) [m] and `target_rotation` (3, 3).

    `is_allowed` decides by the stopping point of a motion state. If the next state is not allowed, the origin brakes
    straight ahead instead: its stopping point stays the one that was allowed before.
    """
    velocity, shift, arrived = step_velocity(
        target_position - motion.position, motion.velocity, limits.speed, limits.acceleration
    )
    spin, rotation_step, rotation_arrived = step_velocity(
        rotation_vector(target_rotation @ motion.rotation.T), motion.spin, limits.turn_rate, limits.turn_acceleration
    )
    step = MotionState(
        target_position.copy() if arrived else motion.position + shift,
        target_rotation.copy() if rotation_arrived else turn(rotation_step) @ motion.rotation,
        velocity,
        spin,
    )
    if is_allowed is None or is_allowed(step):
        return step
    braked = step_braking(motion, limits.acceleration, limits.turn_acceleration)
    return replace(braked, rotation=step.rotation, spin=step.spin)  # the limits apply to the origin; it may still turn


def step_braking(motion: MotionState, deceleration: float, turn_deceleration: float) -> MotionState:
    """The motion state one period later when it brakes straight ahead; decelerations in [m/s^2] and [rad/s^2]."""
    velocity = reduce_speed(motion.velocity, deceleration * PERIOD)
    spin = reduce_speed(motion.spin, turn_deceleration * PERIOD)
    return MotionState(motion.position + velocity * PERIOD, turn(spin * PERIOD) @ motion.rotation, velocity, spin)


def find_stopping_point(motion: MotionState, deceleration: float) -> FloatArray:
    """(3,) where the origin stops when it brakes from now on [m]."""
    speed = math.sqrt(float(motion.velocity @ motion.velocity))
    if speed == 0.0:
        return motion.position
    point: FloatArray = motion.position + motion.velocity * (stopping_distance(speed, deceleration) / speed)
    return point


def step_velocity(
    error: FloatArray, velocity: FloatArray, max_speed: float, acceleration: float
) -> tuple[FloatArray, FloatArray, bool]:
    """The next velocity towards a point at distance vector `error`, its displacement in one period, and whether that
    reaches the point. Vectors may have any length; `max_speed` and `acceleration` bound their norms."""
    distance = math.sqrt(float(error @ error))
    speed = min(max_speed, max_landing_speed(distance, acceleration))
    new_velocity = error * (speed / distance) if distance > 0.0 else np.zeros_like(velocity)
    change = new_velocity - velocity
    excess = math.sqrt(float(change @ change)) / (acceleration * PERIOD)
    if excess > 1.0 + 1e-12:
        new_velocity = velocity + change / excess
        return new_velocity, new_velocity * PERIOD, False
    return new_velocity, new_velocity * PERIOD, speed * PERIOD >= distance * (1.0 - 1e-12)


def reduce_speed(velocity: FloatArray, max_change: float) -> FloatArray:
    speed = math.sqrt(float(velocity @ velocity))
    return np.zeros_like(velocity) if speed <= max_change else velocity * (1.0 - max_change / speed)


def limit_speed(velocity: FloatArray, reference: FloatArray, margin: float) -> FloatArray:
    """`velocity` (3,) limited to the speed of `reference` (3,) along it plus `margin`."""
    speed = math.sqrt(float(velocity @ velocity))
    if speed == 0.0:
        return velocity
    return velocity * min(1.0, (max(0.0, float(velocity @ reference) / speed) + margin) / speed)


def is_at_target(motion: MotionState, target: tuple[FloatArray, FloatArray]) -> bool:
    return np.array_equal(motion.position, target[0]) and np.array_equal(motion.rotation, target[1])


def rotation_from_quaternion(quaternion: FloatArray) -> FloatArray:
    """Rotation matrix (3, 3) of a quaternion x y z w of about unit length."""
    x, y, z, w = (quaternion / np.linalg.norm(quaternion)).tolist()
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


# The target follows a rising scaling more slowly: an arm that starts while the scaling rises accelerates by both,
# 1.45 times as much as its target.
RISE_RATE = tuning.SCALING_RATE / 1.5


class SpeedScaling:
    """The speed scaling that the target uses: the reported one, limited to its real rate of change."""

    def __init__(self) -> None:
        self.value = 1.0

    def update(self, reported: float) -> float:
        """Moves one period towards the reported scaling. Returns the factor for the present speed: below 1 when the
        scaling falls."""
        before = self.value
        change = min(1.0, max(0.0, reported)) - before
        self.value += min(RISE_RATE * PERIOD, max(-tuning.SCALING_RATE * PERIOD, change))
        return min(1.0, self.value / before) if before > 0.0 else 1.0

    def speed(self, speed: float, acceleration: float) -> float:
        """Maximum speed [m/s or rad/s] of a target. Below full scaling it is small enough that the arm stays within
        `acceleration` when the scaling rises at its full rate."""
        return speed if self.value == 1.0 else self.value * min(speed, acceleration / tuning.SCALING_RATE)


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
        elapsed = elapsed if 0.0 <= elapsed <= tuning.MAX_PACKAGE_GAP else PERIOD
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
        share = np.exp(-elapsed / (tuning.TARGET_DELAY + tuning.SLOW_LAG_RATIO * self._lookahead / max(scaling, 1e-3)))
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
        is_moving = float(np.abs(target_speeds).max()) > tuning.OTHER_PROGRAM_SPEED
        return is_moving or float(np.abs(target_joints - self._sent_joints).max()) > tuning.OTHER_PROGRAM_SHIFT


def _distance_to_segment(begin: FloatArray, end: FloatArray) -> float:
    """Distance of the origin from the segment between two points (3,)."""
    along = end - begin
    share = min(1.0, max(0.0, -float(begin @ along) / max(float(along @ along), 1e-18)))
    return float(np.linalg.norm(begin + share * along))


def is_standing_still(measured: Measured) -> bool:
    """True if the measured speeds of the arm are those of rest."""
    twist = np.abs(measured.twist)
    return bool(twist[:3].max() <= tuning.MAX_REST_SPEED and twist[3:].max() <= tuning.MAX_REST_TURN_RATE)
