"""One servo period of one arm: from the measured state, the newest command, the limits and the other arms to the joints
to send next.

No sockets and no clock: :class:`Servo` makes every decision of the worker's loop, so it is tested without either.

Targets are sent as joints (servoJ) from our own inverse kinematics, not as poses (servoL): the joint step that is
checked is the one that is sent, the controller cannot choose another branch, and no unreachable pose ends its program.
The factory calibration of a real arm, which our nominal lengths do not contain, follows from each package: the flange
as computed by the controller against the flange of our own forward kinematics at the same joints.

There are two ways to stop. When nothing is wrong (no fresh action, `stop`) the servo target brakes within the limits of
the arm. After a fault the target is reset to the *measured* pose and velocity of the arm, and brakes at least with
FAULT_DECELERATION: the target leads the arm by the servo's lag, and an arm at a limit must not travel that distance
too.

After missed periods (the process was suspended, or came late) the target goes on from where the controller has it,
with the speed that the arm has kept. The controller holds the last target meanwhile and lets the arm run out towards it
with the time constant `lookahead`: the arm lags behind the target by its speed times that time, before the stall as
after it, so nothing jumps, and a target that changes its speed within a limit moves the arm within the same limit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from robot.arm.channel import CommandKind, WorkerConfig
from robot.arm.following import FollowingMonitor, SpeedScaling, is_standing
from robot.arm.shared_ring import Record
from robot.arm.status import ArmStatus, is_healthy
from robot.arm.trajectory import (
    PERIOD,
    MotionState,
    Rates,
    braking,
    is_at,
    no_faster,
    resting,
    rotation_of,
    stopping_point,
    towards,
)
from robot.arm.tuning import (
    FAULT_DECELERATION,
    FAULT_TURN_DECELERATION,
    MAX_HELD_SHIFT,
    MAX_HELD_TURN,
    MAX_OVERSHOOT,
    MAX_STALL_PERIODS,
    MAX_ZERO_AGE,
)
from robot.common.kinematics import Kinematics, SingularityGuard, inverse_frame, rotation, rotation_vector
from robot.common.tcp import Measured
from tacsim.interface import FloatArray
from tacsim.limits import (
    box_region,
    exceeds_limit,
    exceeds_wrench,
    finite_targets,
    fraction_inside,
    joint_speed_ratio,
    segment_distance,
    stopping_position,
)

LOOP_OFFSET = 2 * PERIOD  # between the loops of two arms [s]
PACKAGE_DELAY = 3 * PERIOD  # from a change of the arm's speed on the controller to the target that knows of it [s]


class Servo:
    """The servo target of one arm, and whether it may move; `status` is updated by every call."""

    def __init__(self, config: WorkerConfig, commands_read: int = 0, tactile_read: int = 0) -> None:
        self.config, self.frames = config, config.frames
        self.kinematics = Kinematics(config.model)  # type: ignore[arg-type]  # a Model, from JSON
        self.region = box_region(config.lower, config.upper, [(point, normal) for point, normal in config.planes])
        self.status = ArmStatus.CONNECTING  # until the first `check_faults`
        self.motion: MotionState | None = None  # of the servo target; None: nothing is sent and the controller holds
        self.commands_read, self.rejected, self.shortened = commands_read, 0, 0
        self.close_requested = False
        self._zero_asked = -math.inf  # when the wrench was to be zeroed [s]
        self._sent: FloatArray | None = None  # joints
        self._in_time = math.nan  # when the last step went on [s]
        self._package = math.nan, math.nan  # when its package was new, and that one's stamp [s]
        self._waited = 0  # periods for a package that tells what the arm does now
        self._goal: tuple[FloatArray, FloatArray] | None = None  # position (3,), rotation (3, 3)
        self._goal_time = -math.inf
        self._rates: Rates = config  # of the way to the goal
        self._tactile_read, self._exposed = tactile_read, math.nan  # reports read; exposure of the oldest picture [s]
        self._singularity = SingularityGuard(self.kinematics)
        self._hard = (
            max(FAULT_DECELERATION, config.acceleration),
            max(FAULT_TURN_DECELERATION, config.turn_acceleration),
        )
        self._fault_braking: tuple[float, float] | None = None  # None: the target was not yet reset after a fault
        self._scaling = SpeedScaling()
        self._following = FollowingMonitor(config, self.kinematics, self.frames)
        # of the last period
        self._before: tuple[MotionState | None, FloatArray | None, tuple[float, float] | None] = None, None, None

    @property
    def resting(self) -> bool:
        return self.motion is None or self.motion.at_rest

    @property
    def stop(self) -> FloatArray | None:
        """(3,) where the servo target comes to rest if it brakes now [m]; None while nothing is sent."""
        return None if self.motion is None else stopping_point(self.motion, self.config.acceleration)

    def trip(self, status: ArmStatus) -> None:
        """Enters a fault: from the next step on it brakes hard and moves no more. A fault stays, for what comes later
        may be its consequence; only a stop of the controller replaces it, and a worse one that, because it takes more
        to recover from."""
        if not self.status.is_fault:
            self._zero_asked = -math.inf
        if not self.status.is_fault or status >= ArmStatus.PROGRAM_STOPPED:
            self.status = max(self.status, status)
        self._goal = None

    def on_scaling(self, reported: float) -> None:
        """Takes over the controller's speed scaling, 0 to 1, once a period. When it falls, the target slows down at
        once by the same part: the arm's lag stays as it was, and so does its speed in the controller's own time."""
        left = self._scaling.update(reported)
        if left < 1.0 and self.motion is not None and not self.motion.at_rest:
            self._slow_target(left)

    def _slow_target(self, share: float) -> None:
        assert self.motion is not None
        self.motion = replace(self.motion, velocity=share * self.motion.velocity, spin=share * self.motion.spin)

    def check_following(self, measured: Measured, target: FloatArray, target_speeds: FloatArray) -> None:
        """Trips on a new package: the arm is not where it was sent, or the controller's own target (6,) [rad, rad/s] is
        not what was sent."""
        self._following.update(self._sent, measured.stamp, self._scaling.value)
        if self._following.is_moved_from_rest(target, target_speeds):
            self.trip(ArmStatus.OTHER_PROGRAM)
        shift, turn = self._following.error(measured.joints)
        if shift > self.config.following_error or turn > self.config.following_turn:
            self.trip(ArmStatus.NOT_FOLLOWING)

    def check_faults(self, measured: Measured, partners: Sequence[Record | None]) -> None:
        """Trips on the measured state: force, region, keep-out, faults of the other arms."""
        config = self.config
        if exceeds_wrench(measured.wrench, config.force, config.torque):
            self.trip(ArmStatus.FORCE_LIMIT)
        here = measured.sensor[:3, 3]
        self._check_place(measured)
        if not all(map(is_healthy, partners)):
            if self.resting and not self.status.is_fault:
                self.status, self._goal = ArmStatus.WAITING, None
            else:
                self.trip(ArmStatus.PARTNER_STOPPED)
        elif self.status in (ArmStatus.CONNECTING, ArmStatus.WAITING):
            self.status = ArmStatus.HOLD
        for partner, other in zip(config.partners, partners, strict=True):
            if other is not None and float(np.linalg.norm(here - other["position"])) < partner.distance - MAX_OVERSHOOT:
                approach = float(measured.twist[:3] @ (other["position"] - here))
                if approach > 0.0 and not self.resting:
                    self.trip(ArmStatus.KEEP_OUT)

    def _check_place(self, measured: Measured) -> None:
        if (
            self.region.excess(stopping_position(measured.sensor[:3, 3], measured.twist[:3], self._hard[0]))
            > MAX_OVERSHOOT
        ):
            self.trip(ArmStatus.WORKSPACE_LIMIT)

    def on_tactile(self, number: int, report: Record | None) -> None:
        """Reads the newest tactile report, once: a gel pressed or sheared beyond its limit trips."""
        if report is None or number == self._tactile_read:
            return
        self._tactile_read, self._exposed = number, float(report["exposed"])
        config = self.config
        if not math.isnan(self._exposed) and (
            exceeds_limit(float(report["depth"]), config.depth) or exceeds_limit(float(report["shear"]), config.shear)
        ):
            self.trip(ArmStatus.GEL_LIMIT)

    def on_command(self, number: int, command: Record | None) -> None:
        """Reads the newest command, once. A target that is no pose or has no speed is rejected, and the arm holds."""
        if command is None or number == self.commands_read:
            return
        self.commands_read, kind = number, int(command["kind"])
        self._zero_asked = float(command["time"]) if kind == CommandKind.ZERO_WRENCH else -math.inf
        if kind == CommandKind.TARGET and not (bool(finite_targets(command["pose"])) and command["speed"] > 0.0):
            self.rejected += 1
            self._goal = None
        elif kind == CommandKind.TARGET and not self.status.is_fault and self.status != ArmStatus.WAITING:
            pose = command["pose"]
            self._goal = pose[:3].copy(), rotation_of(pose[3:])
            self._goal_time = float(command["time"])
            slow = float(command["speed"])
            self._rates = replace(self.config, speed=slow) if slow < self.config.speed else self.config
            if self.motion is not None:
                self._clip_goal(self.motion)
        elif kind in (CommandKind.HOLD, CommandKind.CLOSE, CommandKind.ZERO_WRENCH):
            self._goal = None
            self.close_requested |= kind == CommandKind.CLOSE

    def zero_due(self, time: float) -> bool:
        """True, once, if the wrench is to be zeroed: the newest command says so, a moment ago, and the target rests."""
        due = self.resting and time - self._zero_asked <= MAX_ZERO_AGE
        if due:
            self._zero_asked = -math.inf
        return due

    def step(self, time: float, measured: Measured, partners: Sequence[Record | None]) -> FloatArray | None:
        """The joints (6,) to send in this period; None: send nothing, the controller holds."""
        config = self.config
        self._before = self.motion, self._sent, self._fault_braking
        if self._waits_for_package(time, measured):
            return self._sent
        if time - self._goal_time > config.action_timeout:
            self._goal = None
        blind = time - self._exposed > config.observation_timeout  # False without a guard by pictures (NaN)
        if blind and self._goal is not None:  # forgotten: nothing goes on by itself when pictures come again
            self.status, self._goal = ArmStatus.OBSERVATION_STALE, None
        if self._goal is None:
            still_blind = blind and self.status == ArmStatus.OBSERVATION_STALE
            if not (self.status.is_fault or self.status == ArmStatus.WAITING or still_blind):
                self.status = ArmStatus.HOLD
            return self._slow_down(measured)
        if self.motion is None or (
            self.status in (ArmStatus.HOLD, ArmStatus.OBSERVATION_STALE) and self._was_moved(self.motion, measured)
        ):
            self._clip_goal(self._begin_at(measured))
        elif self._sent is not None and self.motion.at_rest and is_at(self.motion, self._goal):
            self.status = ArmStatus.OK
            return self._sent
        elif self._scaling.value == 0.0 and is_standing(measured):  # no target ahead when it goes on
            self._begin_at(measured)
        assert self.motion is not None
        gaps = self._gaps(self.motion, partners)

        def allowed(motion: MotionState) -> bool:
            """The arm could still stop inside its region and clear of the other arms, or it moves away from them."""
            assert self.motion is not None
            reach = self.region.excess(stopping_point(motion, self.config.acceleration))
            if reach > max(1e-9, float(self.region.excess(self.motion.position))):
                return False
            return all(new >= 0.0 or new >= old for new, old in zip(self._gaps(motion, partners), gaps, strict=True))

        wanted = towards(self.motion, *self._goal, self._scaled_rates(), allowed)
        joints = self._joints(wanted, measured)
        if joints is not None:
            self.status = ArmStatus.OK
            return self._send(wanted, joints)
        self.status = ArmStatus.OUT_OF_REACH
        return self._slow_down(measured)

    def _scaled_rates(self) -> Rates:
        rates, scaling = self._rates, self._scaling
        if scaling.value == 1.0:
            return rates
        return replace(
            self.config,
            speed=scaling.speed(rates.speed, rates.acceleration),
            turn_rate=scaling.speed(rates.turn_rate, rates.turn_acceleration),
        )

    def _begin_at(self, measured: Measured) -> MotionState:
        """The target rests where the arm is."""
        self.motion, self._sent = resting(measured.sensor[:3, 3], measured.sensor[:3, :3]), measured.joints
        self._following.restart(self._sent)
        return self.motion

    def withdraw(self) -> FloatArray | None:
        """Takes the last step back, which could not be sent in its period; returns the joints of the one before."""
        self.motion, self._sent, self._fault_braking = self._before
        return self._sent

    def _waits_for_package(self, time: float, measured: Measured) -> bool:
        """True while the target must stand, because no package is there that tells what the arm does now: after missed
        periods, and after a fault. With one, the target is led on from there."""
        motion = self.motion
        missed = time - self._in_time - PERIOD
        late = motion is not None and not motion.at_rest and missed > 1.5 * PERIOD  # one alone is within the limits
        tripped = motion is not None and self.status.is_fault and self._fault_braking is None
        if late or tripped:
            new, stamp = self._package
            age = 0.5 * PERIOD if tripped else PACKAGE_DELAY  # more than is usual
            fresh = measured.stamp - stamp > max(0.0, time - new - PERIOD - age)
            self._waited += not fresh
            if not fresh and self._waited < MAX_STALL_PERIODS:
                return True
            if tripped:
                self._reset_after_fault(measured if fresh else None)
            else:
                self._slow_after_stall(missed, measured.twist if fresh else np.zeros(6))
        if measured.stamp != self._package[1]:
            self._package = time, measured.stamp
        self._in_time, self._waited = time, 0
        return False

    def _reset_after_fault(self, measured: Measured | None) -> None:
        """The target brakes from where the arm is; None: nobody knows, and it stays. An older place would be a way
        back."""
        assert self.motion is not None
        if measured is None:
            self.motion, self._fault_braking = resting(self.motion.position, self.motion.rotation), self._hard
            return
        here, twist = measured.sensor, measured.twist
        self.motion, self._sent = MotionState(here[:3, 3], here[:3, :3], twist[:3], twist[3:]), measured.joints
        self._following.restart(self._sent)
        # It stands within half of the lookahead: the arm, which lags, must not be drawn on by a target ahead of it.
        fast = 2.0 * np.linalg.norm(twist.reshape(2, 3), axis=1) / self.config.lookahead
        self._fault_braking = max(self._hard[0], float(fast[0])), max(self._hard[1], float(fast[1]))

    def _slow_after_stall(self, missed: float, twist: FloatArray) -> None:
        """The target goes on with the speed that the arm has kept along its path: no faster than before and in no other
        direction, so where it could stop is as safe as it was."""
        assert self.motion is not None
        kept = math.exp(-min(missed, PACKAGE_DELAY) / self.config.lookahead) * twist
        lead = 0.5 * self.config.lookahead  # a target that speeds up at its limit is ahead of the arm by twice this
        self.motion = replace(
            self.motion,
            velocity=no_faster(self.motion.velocity, kept[:3], lead * self.config.acceleration),
            spin=no_faster(self.motion.spin, kept[3:], lead * self.config.turn_acceleration),
        )

    def _was_moved(self, held: MotionState, measured: Measured) -> bool:
        """True if the arm rests away from its held pose (somebody moved it): the next target starts at the measured
        pose. Servo lag and the deflection by a contact are smaller than that, and cause no jump. A package from before
        the arm came to rest, which shows it elsewhere, says nothing."""
        if not (held.at_rest and self._following.has_settled and is_standing(measured)):
            return False
        away = np.abs(measured.sensor[:3, 3] - held.position).max()
        turned = np.abs(rotation_vector(measured.sensor[:3, :3] @ held.rotation.T)).max()
        return bool(away > MAX_HELD_SHIFT or turned > MAX_HELD_TURN)

    def _slow_down(self, measured: Measured) -> FloatArray | None:
        """One period of braking; repeats the last joints where the braking pose has no allowed ones."""
        if self.motion is None or self._sent is None:
            return None
        if self.motion.at_rest:
            return self._sent
        limits = self._fault_braking or (self.config.acceleration, self.config.turn_acceleration)
        slower = braking(self.motion, *limits)
        joints = self._joints(slower, measured)
        if joints is None:
            self.motion = resting(self.motion.position, self.motion.rotation)
            return self._sent
        return self._send(slower, joints)

    def _send(self, motion: MotionState, joints: FloatArray) -> FloatArray:
        self.motion, self._sent = motion, joints
        return joints

    def _joints(self, motion: MotionState, measured: Measured) -> FloatArray | None:
        """Joints (6,) of a pose, if within reach, joint speed, and clear of singularities; else None."""
        assert self._sent is not None
        sensor = np.eye(4)
        sensor[:3, :3], sensor[:3, 3] = motion.rotation, motion.position
        wanted = self.frames.flange(sensor)
        controller_from_model = inverse_frame(measured.flange) @ self.kinematics.forward(measured.joints)
        joints = self.kinematics.inverse(wanted @ controller_from_model, self._sent)
        if joints is None or joint_speed_ratio(self._sent, joints, self.config.joint_speed, PERIOD) > 1.0:
            return None
        return None if self._singularity.is_nearer(joints, self._sent) else joints

    def _gaps(
        self, motion: MotionState, partners: Sequence[Record | None], end: FloatArray | None = None
    ) -> list[float]:
        """Distance [m] between the braking path of `motion` and that of each other arm, less the keep-out distance and
        less what the other arm may cover within LOOP_OFFSET (the end of a braking path moves at most twice as fast as
        the arm)."""
        end = stopping_point(motion, self.config.acceleration) if end is None else end
        gaps = []
        for partner, other in zip(self.config.partners, partners, strict=True):
            assert other is not None  # else the arm waits
            gap = segment_distance(motion.position, end, other["position"], other["stopping_point"])
            gaps.append(gap - partner.distance - 2.0 * float(other["top_speed"]) * LOOP_OFFSET)
        return gaps

    def _clip_goal(self, start: MotionState) -> None:
        """Clips the goal on the straight path from `start`: to the region, so that the arm lands on the boundary
        instead of braking at it (the driver has done so from an older state; what this changes is counted), and to what
        can be gone within `action_timeout`, so that an arm that is asked nothing more comes to rest within that way."""
        if self._goal is None:
            return
        end, rotation_end = self._goal
        turn = rotation_vector(rotation_end @ start.rotation.T)
        inside = float(fraction_inside(start.position, end, self.region))
        self.shortened += inside < 1.0
        way, angle = math.dist(end, start.position), math.sqrt(float(turn @ turn))
        longest, most = (rate * self.config.action_timeout for rate in (self._rates.speed, self._rates.turn_rate))
        share = min(inside, longest / max(way, longest), most / max(angle, most))
        if share < 1.0:
            self._goal = start.position + share * (end - start.position), rotation(share * turn) @ start.rotation
