"""Trajectories from the present pose to a target, one servo period at a time, within limits of speed and acceleration.

The sensor's origin and its axes are planned separately, each with limits of its own: in every period the velocity
changes by at most acceleration times period, and the speed still allows a stop on the target. The laws are in discrete
time, so they hold exactly for the poses that are sent: the second difference of the positions is within the
acceleration, and the target is met without overshoot.
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


class Rates(Protocol):
    """Limits of a motion; tacsim.models.hardware.ArmLimits has them."""

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
    def at_rest(self) -> bool:
        return not self.velocity.any() and not self.spin.any()


def resting(position: FloatArray, rotation: FloatArray) -> MotionState:
    """At rest at `position` (3,) [m] with axes `rotation` (3, 3)."""
    return MotionState(
        np.array(position, dtype=np.float64), np.array(rotation, dtype=np.float64), np.zeros(3), np.zeros(3)
    )


def landing_speed(distance: float, acceleration: float) -> float:
    """The highest speed of the next period that still allows a stop `distance` [m] ahead, exactly there [m/s].

    n periods that each brake by a = acceleration * period cover, from speed u, period * (n u - a n (n - 1) / 2). The
    least n whose last speed is at most a gives u; between whole n the law is linear, so it has no steps.
    """
    slowing = acceleration * PERIOD
    n = max(1, math.ceil(0.5 * (math.sqrt(1.0 + 8.0 * distance / (slowing * PERIOD)) - 1.0)))
    return distance / (n * PERIOD) + 0.5 * slowing * (n - 1)


def stopping_distance(speed: float, acceleration: float) -> float:
    """Distance [m] covered from `speed` when every further period brakes as hard as allowed; at most v^2 / 2a."""
    slowing = acceleration * PERIOD
    n = math.floor(speed / slowing)
    return PERIOD * (n * speed - 0.5 * slowing * n * (n + 1))


def towards(
    now: MotionState,
    position: FloatArray,
    rotation: FloatArray,
    rates: Rates,
    allowed: Callable[[MotionState], bool] | None = None,
) -> MotionState:
    """One period nearer to the target `position` (3,) [m] and `rotation` (3, 3).

    `allowed` says whether a motion state is allowed, judged by where it could still be stopped. Where it is not, the
    origin brakes straight on instead: its stopping point stays the one that was allowed before.
    """
    velocity, moved, arrived = advance(position - now.position, now.velocity, rates.speed, rates.acceleration)
    spin, turned, rotation_arrived = advance(
        rotation_vector(rotation @ now.rotation.T), now.spin, rates.turn_rate, rates.turn_acceleration
    )
    step = MotionState(
        position.copy() if arrived else now.position + moved,
        rotation.copy() if rotation_arrived else turn(turned) @ now.rotation,
        velocity,
        spin,
    )
    if allowed is None or allowed(step):
        return step
    held = braking(now, rates.acceleration, rates.turn_acceleration)
    return replace(held, rotation=step.rotation, spin=step.spin)  # limits hold for the origin; it may still turn


def braking(now: MotionState, deceleration: float, turn_deceleration: float) -> MotionState:
    """One period nearer to rest, straight on."""
    velocity = slower(now.velocity, deceleration * PERIOD)
    spin = slower(now.spin, turn_deceleration * PERIOD)
    return MotionState(now.position + velocity * PERIOD, turn(spin * PERIOD) @ now.rotation, velocity, spin)


def stopping_point(motion: MotionState, deceleration: float) -> FloatArray:
    """(3,) where the origin comes to rest when it brakes from now on [m]."""
    speed = math.sqrt(float(motion.velocity @ motion.velocity))
    if speed == 0.0:
        return motion.position
    point: FloatArray = motion.position + motion.velocity * (stopping_distance(speed, deceleration) / speed)
    return point


def advance(
    error: FloatArray, velocity: FloatArray, top: float, acceleration: float
) -> tuple[FloatArray, FloatArray, bool]:
    """The next velocity towards a point `error` away, its displacement, and whether that arrives; vectors of any length
    alike, `top` and `acceleration` bound their norms."""
    distance = math.sqrt(float(error @ error))
    speed = min(top, landing_speed(distance, acceleration))
    wanted = error * (speed / distance) if distance > 0.0 else np.zeros_like(velocity)
    change = wanted - velocity
    excess = math.sqrt(float(change @ change)) / (acceleration * PERIOD)
    if excess > 1.0 + 1e-12:
        wanted = velocity + change / excess
        return wanted, wanted * PERIOD, False
    return wanted, wanted * PERIOD, speed * PERIOD >= distance * (1.0 - 1e-12)


def slower(velocity: FloatArray, change: float) -> FloatArray:
    speed = math.sqrt(float(velocity @ velocity))
    return np.zeros_like(velocity) if speed <= change else velocity * (1.0 - change / speed)


def no_faster(velocity: FloatArray, kept: FloatArray, more: float) -> FloatArray:
    """`velocity` (3,), in its direction no faster than `kept` (3,) is, and so much `more`."""
    speed = math.sqrt(float(velocity @ velocity))
    if speed == 0.0:
        return velocity
    return velocity * min(1.0, (max(0.0, float(velocity @ kept) / speed) + more) / speed)


def is_at(motion: MotionState, goal: tuple[FloatArray, FloatArray]) -> bool:
    return np.array_equal(motion.position, goal[0]) and np.array_equal(motion.rotation, goal[1])


def rotation_of(quaternion: FloatArray) -> FloatArray:
    """(3, 3) of a quaternion x y z w of about unit length."""
    x, y, z, w = (quaternion / np.linalg.norm(quaternion)).tolist()
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
