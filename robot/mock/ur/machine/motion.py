"""Motions of URScript as generators: one `yield` is one control period.

Behaviour that is not published for a real controller is modelled as simply as possible:

* movej, movel, paths: trapezoidal speed. In movel the length of a rotation is its angle, so that `a` and `v` are in
  rad/s^2 and rad/s if the angle is the larger number. A move that begins while the arm moves brakes first.
* paths: waypoints with a blend radius are rounded by a parabola that begins and ends that far from the waypoint.
  A blended section is run at the smallest speed and acceleration of its waypoints. movej in a path stops at each one.
* servoj: a lag of first order with the time constant `lookahead_time`, within maximum joint speeds and 40 rad/s^2.
  `gain` has no effect. The speed scaling slows it too: "the robot will only make half of the way towards the target
  configuration when a scaling factor of 0.5 is given" (ros2_controllers, "Speed scaling", of UR arms).
* freedrive, teach mode: an admittance to the wrench on the tool.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from robot.common.kinematics import displacement, rotation, rotation_vector
from robot.mock.ur.machine.arm import JOINT_ACCELERATION, PERIOD, Arm, MotionSteps, ProgramError, brake_speeds
from tacsim.interface import FloatArray

FREEDRIVE_DAMPING = 200.0  # [N/(m/s)]
FREEDRIVE_TURN_DAMPING = 20.0  # [N m/(rad/s)]


def interpolate_frames(a: FloatArray, b: FloatArray, s: float) -> FloatArray:
    """The frame (4, 4) a fraction s of the path from a to b: straight line, one axis of rotation."""
    frame = np.eye(4)
    frame[:3, 3] = a[:3, 3] + s * (b[:3, 3] - a[:3, 3])
    frame[:3, :3] = rotation(s * rotation_vector(b[:3, :3] @ a[:3, :3].T)) @ a[:3, :3]
    return frame


def path_length(a: FloatArray, b: FloatArray) -> float:
    """Length of the path between two frames: metres, or radians if those are more."""
    step = displacement(a, b)
    return max(float(np.linalg.norm(step[:3])), float(np.linalg.norm(step[3:])))


def trapezoid(arm: Arm, length: float, speed: float, acceleration: float) -> Iterator[float]:
    """Distances from 0 to `length`, one per period, with trapezoidal speed. Time runs with the speed scaling."""
    if not (speed > 0 and acceleration > 0 and math.isfinite(length + speed + acceleration)):
        raise ProgramError(f"speed and acceleration must be positive, got v={speed:g}, a={acceleration:g}")
    if length < 1e-9:
        return
    ramp = min(speed / acceleration, math.sqrt(length / acceleration))
    top = acceleration * ramp
    total = ramp + length / top
    time = 0.0
    while (time := time + PERIOD * arm.scale) < total:
        if time < ramp:
            yield 0.5 * acceleration * time * time
        elif time < total - ramp:
            yield top * (time - 0.5 * ramp)
        else:
            yield length - 0.5 * acceleration * (total - time) ** 2
    yield length


def movej(arm: Arm, q: FloatArray, acceleration: float, speed: float) -> MotionSteps:
    """Moves all joints so that they arrive together; speed [rad/s], acceleration [rad/s^2] of the leading joint."""
    yield from stopj(arm, acceleration)
    start, step = arm.target_q, np.asarray(q, dtype=np.float64) - arm.target_q
    length = float(np.abs(step).max())
    arm.waypoint = arm.kinematics.forward(q, arm.tool)
    for s in trapezoid(arm, length, speed, acceleration):
        arm.follow(start + s / length * step)
        yield
    arm.waypoint = None


def movel(arm: Arm, goal: FloatArray, acceleration: float, speed: float) -> MotionSteps:
    """Moves the TCP on a straight line to the frame `goal`."""
    return path(arm, [Waypoint(goal, acceleration, speed, 0.0)])


@dataclass(frozen=True)
class Waypoint:
    """One corner of a path of straight lines."""

    frame: FloatArray  # (4, 4)
    acceleration: float  # [m/s^2]
    speed: float  # [m/s]
    blend: float  # radius [m]


def path(arm: Arm, waypoints: Sequence[Waypoint]) -> MotionSteps:
    """Moves on straight lines from waypoint to waypoint; stops at waypoints without a blend radius."""
    first = 0
    while first < len(waypoints):
        last = first
        while last + 1 < len(waypoints) and waypoints[last].blend > 0:
            last += 1
        stretch = waypoints[first : last + 1]
        acceleration = min(point.acceleration for point in stretch)
        yield from stopl(arm, acceleration)
        corners = [arm.target_frame, *(point.frame for point in stretch)]
        pieces: list[Piece] = []
        for some in _pieces(corners, [point.blend for point in stretch]):
            pieces += some
            if len(some) > 1:  # planning a rounding takes a millisecond, and a path may have a thousand
                yield
        arm.waypoint = stretch[-1].frame
        ends = np.cumsum([piece.length for piece in pieces])
        for s in trapezoid(arm, float(ends[-1]), min(point.speed for point in stretch), acceleration):
            index = min(int(np.searchsorted(ends, s)), len(pieces) - 1)
            piece = pieces[index]
            arm.follow(arm.solve(piece.at(piece.length - (float(ends[index]) - s))))
            yield
        arm.waypoint = None
        first = last + 1


@dataclass(frozen=True)
class Piece:
    """A line, or the rounding of a corner, by its length."""

    length: float
    at: Callable[[float], FloatArray]  # distance to frame (4, 4)


def _pieces(corners: list[FloatArray], blends: list[float]) -> Iterator[list[Piece]]:
    """The pieces up to each corner: a line, or a line and the rounding of the corner."""
    here = corners[0]
    for index, corner in enumerate(corners[1:]):
        radius = blends[index] if index + 2 < len(corners) else 0.0
        if radius > 0:
            following = corners[index + 2]
            arriving, leaving = (float(np.linalg.norm((a - corner)[:3, 3])) for a in (here, following))
            # A rounding uses at most half of each of its two lines, so that neighbours do not overlap.
            radius = min(radius, 0.5 * min(arriving, leaving))
        if radius < 1e-9:
            yield [_line(here, corner)]
            here = corner
            continue
        begin, end = (
            interpolate_frames(corner, here, radius / arriving),
            interpolate_frames(corner, following, radius / leaving),
        )
        yield [_line(here, begin), _rounding(begin, corner, end)]
        here = end


def _line(a: FloatArray, b: FloatArray) -> Piece:
    length = path_length(a, b)
    return Piece(length, lambda s: interpolate_frames(a, b, s / length if length > 0 else 1.0))


def _rounding(a: FloatArray, corner: FloatArray, b: FloatArray) -> Piece:
    def at(u: float) -> FloatArray:
        return interpolate_frames(interpolate_frames(a, corner, u), interpolate_frames(corner, b, u), u)

    share = np.linspace(0.0, 1.0, 33)
    frames = [at(float(u)) for u in share]
    lengths = np.concatenate([[0.0], np.cumsum([path_length(p, q) for p, q in pairwise(frames)])])
    return Piece(float(lengths[-1]), lambda s: at(float(np.interp(s, lengths, share))))


def stopj(arm: Arm, deceleration: float) -> MotionSteps:
    """Brakes the joints, the leading one at `deceleration` [rad/s^2]."""
    rate = _require_positive(deceleration, "deceleration")
    while arm.target_qd.any():
        arm.drive(brake_speeds(arm.target_qd, rate))
        yield


def stopl(arm: Arm, deceleration: float) -> MotionSteps:
    """Brakes the TCP along its direction at `deceleration` [m/s^2], or [rad/s^2] if its rotation is faster."""
    rate = _require_positive(deceleration, "deceleration")
    while arm.target_qd.any():
        twist = arm.target_twist
        size = max(float(np.linalg.norm(twist[:3])), float(np.linalg.norm(twist[3:])))
        left = size - rate * PERIOD
        if left < 1e-12:
            arm.drive(np.zeros(6))
        else:
            arm.drive(arm.joint_speeds_of(twist * (left / size)))
        yield


def servoj(arm: Arm, q: FloatArray, time: float, lookahead: float) -> MotionSteps:
    """Follows joints q for `time` [s]."""
    if not (math.isfinite(time) and lookahead > 0):
        raise ProgramError(f"servoj: lookahead_time must be positive and t finite, got {lookahead:g}, {time:g}")
    for _ in range(max(1, round(time / PERIOD))):
        left = q - arm.target_q
        # The speed of the lag, limited so that the joint can still brake in time.
        brakable = np.sqrt(JOINT_ACCELERATION * np.abs(left))
        top = arm.scale * np.minimum(arm.kinematics.joint_speeds, brakable)
        wanted = np.clip(arm.scale * left / max(lookahead, PERIOD), -top, top)
        change = np.clip(wanted - arm.target_qd, -JOINT_ACCELERATION * PERIOD, JOINT_ACCELERATION * PERIOD)
        arm.drive(arm.target_qd + change)
        yield


def speedj(arm: Arm, qd: FloatArray, acceleration: float, time: float) -> MotionSteps:
    """Joint speeds qd [rad/s]; ends after `time` [s], or with time 0 once they are reached."""
    return _follow_speed(
        acceleration,
        time,
        lambda: _limit_acceleration(arm.target_qd, arm.scale * qd, acceleration, joint=True),
        arm.drive,
    )


def speedl(arm: Arm, twist: FloatArray, acceleration: float, time: float) -> MotionSteps:
    """Twist of the TCP in base axes; ends after `time` [s], or with time 0 once it is reached."""

    def drive(wanted: FloatArray) -> None:
        arm.drive(arm.joint_speeds_of(wanted))

    return _follow_speed(
        acceleration,
        time,
        lambda: _limit_acceleration(arm.target_twist, arm.scale * twist, acceleration, joint=False),
        drive,
    )


def _follow_speed(
    acceleration: float, time: float, step: Callable[[], tuple[FloatArray, bool]], drive: Callable[[FloatArray], None]
) -> MotionSteps:
    _require_positive(acceleration, "acceleration")
    if not math.isfinite(time):
        raise ProgramError(f"time must be finite, got {time:g}")
    periods = 0
    while True:
        wanted, reached = step()
        drive(wanted)
        periods += 1
        yield
        if reached if time <= 0 else periods * PERIOD >= time - 1e-9:
            return


def _limit_acceleration(
    now: FloatArray, wanted: FloatArray, acceleration: float, *, joint: bool
) -> tuple[FloatArray, bool]:
    """The speed after one control period, limited by `acceleration`; and whether `wanted` is reached."""
    change = wanted - now
    size = float(np.abs(change).max()) if joint else max(map(float, (_norm(change[:3]), _norm(change[3:]))))
    limit = acceleration * PERIOD
    return (wanted, True) if size <= limit else (now + change * (limit / size), False)


def servoc(arm: Arm, goal: FloatArray, acceleration: float, speed: float) -> MotionSteps:
    """Moves towards a frame at a limited speed and brakes in time; one control period."""
    step = displacement(arm.target_frame, goal)
    size = max(_norm(step[:3]), _norm(step[3:]))
    pace = min(speed, math.sqrt(acceleration * size), size / (4 * PERIOD))
    twist, _ = _limit_acceleration(
        arm.target_twist, step * (pace / size if size > 1e-12 else 0.0), acceleration, joint=False
    )
    arm.drive(arm.joint_speeds_of(arm.scale * twist))
    yield


def move_with_compliance(
    arm: Arm, frame: FloatArray, free: Sequence[float], push: FloatArray, limits: FloatArray
) -> None:
    """Runs one control period of compliance: the free axes of `frame` move at `push` (a twist in base axes), at most
    `limits`; the other axes do not move."""
    max_acceleration = 2.0  # [m/s^2, rad/s^2]
    turn = frame[:3, :3]
    local = np.concatenate([turn.T @ push[:3], turn.T @ push[3:]])
    local = np.where(np.asarray(free) != 0, np.clip(local, -limits, limits), 0.0)
    wanted = np.concatenate([turn @ local[:3], turn @ local[3:]])
    twist, _ = _limit_acceleration(arm.target_twist, arm.scale * wanted, max_acceleration, joint=False)
    arm.drive(arm.joint_speeds_of(twist))


def _norm(vector: FloatArray) -> float:
    return float(np.linalg.norm(vector))


def _require_positive(value: float, name: str) -> float:
    if not (value > 0 and math.isfinite(value)):
        raise ProgramError(f"{name} must be positive, got {value:g}")
    return value
