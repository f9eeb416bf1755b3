"""One period of an arm: what was measured and asked goes in, the joints that are sent next come out.

No sockets and no clock: :class:`Servo` is the whole judgement of the worker's loop, so it is tested without either.

Targets go out as joints (servoJ) of our own inverse kinematics, not as poses (servoL): the joint step that is checked
is the one that is sent, the controller cannot choose another branch, and no pose out of reach ends its program. The
calibration of a real arm, which our nominal lengths do not know, is taken from the package itself: the flange as the
controller computed it against the flange of our own forward kinematics at the same joints.

There are two ways to stop. Where nothing is wrong (no fresh action, `stop`) the servo target brakes within the limits
of the arm. After a fault it is drawn back to where the arm is *measured*, with the speed that is measured, and brakes
with HARD: the target runs ahead of the arm by the servo's lag, and that way must not be gone on against a limit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from robot.arm.channel import ArmStatus, Kind, Orders
from robot.arm.shared_ring import Record
from robot.arm.trajectory import PERIOD, Motion, braking, resting, stopping_point, towards
from robot.common.kinematics import Kinematics, inverse_frame, rotation, rotation_vector
from robot.common.tcp import ArmFrames, Measured
from tacsim.interface import FloatArray
from tacsim.limits import (
    braking_end,
    exceeds,
    exceeds_wrench,
    finite_targets,
    fraction_inside,
    joint_step_excess,
    region,
    segment_distance,
)

HARD = 5.0  # least deceleration after a fault [m/s^2]
HARD_TURN = 50.0  # the same of rotations [rad/s^2]
BARRIER = 0.5e-3  # so far beyond a wall the arm itself may come to rest; the target never goes beyond [m]
LEAST_SINGULAR_VALUE = 0.02  # of the Jacobian, lengths in reaches: nearer to a singularity it only may move away
# The least singular value changes by no more than so much for each radian that a joint turns: each of the six columns
# has a length of at most sqrt(2) in these units, and turns with the joints before it.
STEEPEST = math.sqrt(12.0)
RESTING, RESTING_TURN = 1e-3, 10e-3  # slower than this an arm stands [m/s, rad/s]
MOVED, MOVED_TURN = 0.2e-3, 2e-3  # farther than this from where it was held, something moved it [m, rad]
SKEW = 2 * PERIOD  # between the loops of two arms [s]


def measured(record: Record, frames: ArmFrames) -> Measured:
    """What a state record says of the sensor."""
    return frames.measure(record["joints"].copy(), record["tcp_pose"], record["tcp_speed"], record["tcp_force"])


def frames_of(orders: Orders) -> ArmFrames:
    return ArmFrames(
        np.array(orders.world_from_base), np.array(orders.flange_from_tool), np.array(orders.tool_from_sensor)
    )


class Servo:
    """The servo target of one arm and what keeps it from moving. `status` is its judgement after each call."""

    def __init__(self, orders: Orders, taken: int = 0, touches: int = 0) -> None:
        self.orders, self.frames = orders, frames_of(orders)
        self.kinematics = Kinematics(orders.model)  # type: ignore[arg-type]  # a Model, from JSON
        self.region = region(orders.lower, orders.upper, [(point, normal) for point, normal in orders.planes])
        self.status = ArmStatus.CONNECTING  # until `watch` has looked once: nobody may take the arm for well before
        self.motion: Motion | None = None  # of the servo target; None: nothing is sent, the controller holds
        self.taken, self.rejected, self.shortened, self.zero_asked = taken, 0, 0, False
        self.close_asked = False
        self._sent: FloatArray | None = None  # joints
        self._goal: tuple[FloatArray, FloatArray] | None = None  # position, rotation
        self._goal_time = -math.inf
        self._touches, self._seen = touches, math.nan  # records read; exposure of the oldest picture [s]
        self._clear: tuple[FloatArray, float] | None = None  # joints far from a singularity, and how far
        self._hard = max(HARD, orders.acceleration), max(HARD_TURN, orders.turn_acceleration)

    @property
    def resting(self) -> bool:
        return self.motion is None or self.motion.at_rest

    @property
    def stop(self) -> FloatArray | None:
        """(3,) where the servo target comes to rest if it is stopped now [m]; None while nothing is sent."""
        return None if self.motion is None else stopping_point(self.motion, self.orders.acceleration)

    def fault(self, status: ArmStatus, now: Measured | None) -> None:
        """Stops hard, and stays so. A worse fault replaces a lesser one."""
        if not self.status.is_fault and self.motion is not None and now is not None:
            self.motion = Motion(now.sensor[:3, 3], now.sensor[:3, :3], now.twist[:3], now.twist[3:])
            self._sent = now.joints
        self.status = max(self.status, status)
        self._goal = None

    def watch(self, now: Measured, partners: Sequence[Record | None]) -> None:
        """Looks for faults in what is measured: force, walls, the other arms."""
        orders = self.orders
        if exceeds_wrench(now.wrench, orders.force, orders.torque):
            self.fault(ArmStatus.FORCE_LIMIT, now)
        here = now.sensor[:3, 3]
        if self.region.excess(braking_end(here, now.twist[:3], self._hard[0])) > BARRIER:
            self.fault(ArmStatus.WORKSPACE_LIMIT, now)
        if not all(map(well, partners)):
            if self.resting and not self.status.is_fault:
                self.status, self._goal = ArmStatus.WAITING, None
            else:
                self.fault(ArmStatus.PARTNER_STOPPED, now)
        elif self.status in (ArmStatus.CONNECTING, ArmStatus.WAITING):
            self.status = ArmStatus.HOLD
        for partner, other in zip(orders.partners, partners, strict=True):
            if other is not None and float(np.linalg.norm(here - other["position"])) < partner.distance - BARRIER:
                approach = float(now.twist[:3] @ (other["position"] - here))
                if approach > 0.0 and not self.resting:
                    self.fault(ArmStatus.KEEP_OUT, now)

    def look(self, number: int, touch: Record | None, now: Measured) -> None:
        """Takes the newest that the sensors showed, once: a gel that is pressed or dragged too far stops the arm."""
        if touch is None or number == self._touches:
            return
        self._touches, self._seen = number, float(touch["seen"])
        orders = self.orders
        if not math.isnan(self._seen) and (
            exceeds(float(touch["depth"]), orders.depth) or exceeds(float(touch["shear"]), orders.shear)
        ):
            self.fault(ArmStatus.GEL_LIMIT, now)

    def hear(self, number: int, command: Record | None) -> None:
        """Takes the newest command, once; what is no pose, or too late to be followed, is not."""
        if command is None or number == self.taken:
            return
        self.taken, kind = number, int(command["kind"])
        if kind == Kind.TARGET and not bool(finite_targets(command["pose"])):
            self.rejected += 1
            self._goal = None
        elif kind == Kind.TARGET and not self.status.is_fault and self.status != ArmStatus.WAITING:
            pose = command["pose"]
            self._goal = pose[:3].copy(), _rotation(pose[3:])
            self._goal_time = float(command["time"])
            if self.motion is not None:
                self._cut_at_walls(self.motion)
        elif kind in (Kind.HOLD, Kind.CLOSE, Kind.ZERO_WRENCH):
            self._goal = None
            self.close_asked |= kind == Kind.CLOSE
            self.zero_asked |= kind == Kind.ZERO_WRENCH

    def step(self, time: float, now: Measured, partners: Sequence[Record | None]) -> FloatArray | None:
        """The joints (6,) to be sent in this period; None: nothing, the controller holds by itself."""
        orders = self.orders
        goal = self._goal if time - self._goal_time <= orders.action_timeout else None
        blind = time - self._seen > orders.observation_timeout  # False where nothing is watched
        if self.status.is_fault or goal is None or blind:
            if not self.status.is_fault and self.status != ArmStatus.WAITING:
                self.status = ArmStatus.HOLD if goal is None else ArmStatus.BLIND
            return self._slow_down(now)
        if self.motion is None or (
            self.status in (ArmStatus.HOLD, ArmStatus.BLIND) and self._was_moved(self.motion, now)
        ):
            self.motion, self._sent = resting(now.sensor[:3, 3], now.sensor[:3, :3]), now.joints
            goal = self._cut_at_walls(self.motion) or goal
        elif self._sent is not None and self.motion.at_rest and _is_at(self.motion, goal):
            self.status = ArmStatus.OK
            return self._sent  # nothing is left to be computed
        gaps = self._gaps(self.motion, partners)

        def admissible(motion: Motion) -> bool:
            """It still could be stopped inside the walls and clear of the other arms; or at least it leads away."""
            assert self.motion is not None
            reach = self.region.excess(stopping_point(motion, self.orders.acceleration))
            if reach > max(1e-9, float(self.region.excess(self.motion.position))):
                return False
            return all(new >= 0.0 or new >= old for new, old in zip(self._gaps(motion, partners), gaps, strict=True))

        wanted = towards(self.motion, *goal, self.orders, admissible)
        joints = self._joints(wanted, now)
        if joints is not None:
            self.status = ArmStatus.OK
            return self._send(wanted, joints)
        self.status = ArmStatus.OUT_OF_REACH
        return self._slow_down(now)

    def _was_moved(self, held: Motion, now: Measured) -> bool:
        """True if the arm stands elsewhere than it was held: it goes on from where it is, not from where it once was
        asked to be. What the servo has not settled yet, or gives way to a contact, is no reason for a jump."""
        if not held.at_rest or np.abs(now.twist[:3]).max() > RESTING or np.abs(now.twist[3:]).max() > RESTING_TURN:
            return False
        away = np.abs(now.sensor[:3, 3] - held.position).max()
        turned = np.abs(rotation_vector(now.sensor[:3, :3] @ held.rotation.T)).max()
        return bool(away > MOVED or turned > MOVED_TURN)

    def _slow_down(self, now: Measured) -> FloatArray | None:
        """A period of braking; the same joints again where even that finds none."""
        if self.motion is None or self._sent is None:
            return None
        if self.motion.at_rest:
            return self._sent
        limits = self._hard if self.status.is_fault else (self.orders.acceleration, self.orders.turn_acceleration)
        slower = braking(self.motion, *limits)
        joints = self._joints(slower, now)
        if joints is None:
            self.motion = resting(self.motion.position, self.motion.rotation)
            return self._sent
        return self._send(slower, joints)

    def _send(self, motion: Motion, joints: FloatArray) -> FloatArray:
        self.motion, self._sent = motion, joints
        return joints

    def _joints(self, motion: Motion, now: Measured) -> FloatArray | None:
        """The joints for a motion's pose, if they are near, slow enough, and not in a singularity."""
        assert self._sent is not None
        sensor = np.eye(4)
        sensor[:3, :3], sensor[:3, 3] = motion.rotation, motion.position
        wanted = self.frames.flange(sensor)
        nominal = inverse_frame(now.flange) @ self.kinematics.forward(now.joints)  # controller's to our own flange
        joints = self.kinematics.inverse(wanted @ nominal, self._sent)
        if joints is None or joint_step_excess(self._sent, joints, self.orders.joint_speed, PERIOD) > 1.0:
            return None
        return None if self._nears_singularity(joints) else joints

    def _nears_singularity(self, joints: FloatArray) -> bool:
        """True if `joints` are too near to a singularity, and nearer than those that were sent last."""
        assert self._sent is not None
        if self._clear is not None:
            there, room = self._clear
            if STEEPEST * float(np.abs(joints - there).sum()) < room:
                return False
        distance = self.kinematics.singularity(joints)
        self._clear = joints, distance - LEAST_SINGULAR_VALUE
        return distance < LEAST_SINGULAR_VALUE and distance < self.kinematics.singularity(self._sent)

    def _gaps(self, motion: Motion, partners: Sequence[Record | None]) -> list[float]:
        """Room [m] between the braking way of `motion` and that of each other arm, beyond what is to be kept. What the
        other may do within SKEW is taken off: the end of a braking way moves at most twice as fast as the arm."""
        end = stopping_point(motion, self.orders.acceleration)
        gaps = []
        for partner, other in zip(self.orders.partners, partners, strict=True):
            assert other is not None  # else the arm waits
            gap = segment_distance(motion.position, end, other["position"], other["stop"])
            gaps.append(gap - partner.distance - 2.0 * float(other["top_speed"]) * SKEW)
        return gaps

    def _cut_at_walls(self, start: Motion) -> tuple[FloatArray, FloatArray] | None:
        """Shortens the goal on the straight way from `start`, so that the arm lands at a wall instead of braking there.

        The driver has done the same with what it knew; this is the last look, and it is counted."""
        if self._goal is None:
            return None
        end, turn = self._goal
        share = fraction_inside(start.position, end, self.region)
        if share < 1.0:
            self.shortened += 1
            turn = rotation(share * rotation_vector(turn @ start.rotation.T)) @ start.rotation
            self._goal = start.position + share * (end - start.position), turn
        return self._goal


def well(other: Record | None) -> bool:
    """True if the other arm of a keep-out can be seen and has no fault."""
    if other is None:
        return False
    status = ArmStatus(int(other["status"]))
    return not status.is_fault and status != ArmStatus.CONNECTING


def _is_at(motion: Motion, goal: tuple[FloatArray, FloatArray]) -> bool:
    position, rotation = goal
    return np.array_equal(motion.position, position) and np.array_equal(motion.rotation, rotation)


def _rotation(quaternion: FloatArray) -> FloatArray:
    """(3, 3) of a quaternion x y z w of about unit length."""
    x, y, z, w = (quaternion / np.linalg.norm(quaternion)).tolist()
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
