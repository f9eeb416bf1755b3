"""Trajectories from the present pose to a target, in steps of one servo period, limited in speed and acceleration.

Position and rotation of the sensor are planned separately, each with its own limits: in every period the velocity
changes by at most acceleration times period, and the speed still allows a stop on the target. The laws use discrete
time, so they hold exactly for the poses that are sent: the second difference of the positions is within the
acceleration, and the target is reached without overshoot.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from robot.common.kinematics import rotation as turn
from robot.common.kinematics import rotation_vector
from tacsim.interface import FloatArray

PERIOD = 2e-3  # of the servo loop [s]


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
