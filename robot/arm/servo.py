"""One servo period of one arm: computes the next joints from measured state, newest command, limits and other arms.

:class:`Servo` makes every decision of the worker's loop. It uses no socket and no clock, so tests need neither.

A commanded target is clipped to the limits (`allowed target`). The servo target moves towards it, one period at a time.
Targets are sent as joints (servoJ) from our own inverse kinematics, not as poses (servoL): the joint step that is
checked is the one that is sent, the controller cannot choose another branch, and no unreachable pose ends its program.
Each package gives the factory calibration of a real arm, which our nominal lengths do not contain: the flange as the
controller computes it, compared with our forward kinematics at the same joints.

There are two kinds of stop. Without a fault (no fresh action, `stop`) the servo target brakes within the limits of
the arm. After a fault the servo target is reset to the *measured* pose and velocity of the arm and brakes with at least
FAULT_DECELERATION: the target leads the arm by the servo's lag, and an arm at a limit must not travel that distance.

After missed periods (the process was suspended or late) the servo target continues from the pose that the controller
has, with the present speed of the arm. During the stall the controller holds the last target and the arm approaches it
with the time constant `lookahead`: the arm lags behind the target by its speed times that time, before and after the
stall. So nothing jumps, and a target that changes its speed within a limit moves the arm within the same limit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from robot.arm import tuning
from robot.arm.channel import CommandKind, Record, WorkerConfig
from robot.arm.status import ArmStatus, is_healthy
from robot.arm.trajectory import (
    PERIOD,
    FollowingMonitor,
    MotionLimits,
    MotionState,
    SpeedScaling,
    find_min_gap,
    find_stopping_point,
    is_at_target,
    is_standing_still,
    limit_speed,
    motion_at_rest,
    rotation_from_quaternion,
    step_braking,
    step_towards,
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

PACKAGE_DELAY = 3 * PERIOD  # from a change of the arm's speed until its package reaches the servo [s]


class Servo:
    """The servo target of one arm, and whether it may move. Every call updates `status`."""

    def __init__(self, config: WorkerConfig, commands_read: int = 0, tactile_read: int = 0) -> None:
        self.config, self.frames = config, config.frames
        self.kinematics = Kinematics(config.model)  # type: ignore[arg-type]  # a Model, from JSON
        self.region = box_region(config.lower, config.upper, [(point, normal) for point, normal in config.planes])
        self.status = ArmStatus.CONNECTING  # until the first `check_faults`
        self.motion: MotionState | None = None  # servo target; None: nothing is sent, the controller holds
        self.commands_read, self.rejected, self.clipped = commands_read, 0, 0
        self.close_requested = False
        self._zero_request_time = -math.inf  # [s]
        self._sent_joints: FloatArray | None = None  # (6,) [rad]
        self._last_step_time = math.nan  # of the last step that did not wait [s]
        self._last_package = math.nan, math.nan  # time of reading and stamp of the package of that step [s]
        self._waited_periods = 0  # for a package with the present state of the arm
        self._allowed_target: tuple[FloatArray, FloatArray] | None = None  # position (3,), rotation (3, 3)
        self._target_time = -math.inf
        self._motion_limits: MotionLimits = config  # of the present command
        self._tactile_read, self._exposure_time = tactile_read, math.nan  # reports read; oldest exposure [s]
        self._singularity = SingularityGuard(self.kinematics)
        self._hard_braking = (
            max(tuning.FAULT_DECELERATION, config.acceleration),
            max(tuning.FAULT_TURN_DECELERATION, config.turn_acceleration),
        )
        self._fault_braking: tuple[float, float] | None = None  # None: not yet reset after a fault
        self._scaling = SpeedScaling()
        self._following = FollowingMonitor(config, self.kinematics, self.frames)
        self._previous_step: tuple[MotionState | None, FloatArray | None, tuple[float, float] | None] = None, None, None

    @property
    def is_at_rest(self) -> bool:
        return self.motion is None or self.motion.is_at_rest

    @property
    def stopping_point(self) -> FloatArray | None:
        """(3,) where the servo target stops if it brakes now [m]; None while nothing is sent."""
        return None if self.motion is None else find_stopping_point(self.motion, self.config.acceleration)

    def enter_fault(self, status: ArmStatus) -> None:
        """Enters a fault: from the next step the target brakes hard and then stands. The first fault is kept, because
        later ones may be its consequences. Only a stop of the controller, or a worse one, replaces it: it needs more to
        recover from."""
        if not self.status.is_fault:
            self._zero_request_time = -math.inf
        if not self.status.is_fault or status >= ArmStatus.PROGRAM_STOPPED:
            self.status = max(self.status, status)
        self._allowed_target = None

    def on_speed_scaling(self, reported: float) -> None:
        """Takes the controller's speed scaling, 0 to 1, once a period. When it falls, the target slows down at once by
        the same factor, so the arm's lag and its speed in the controller's own time do not change."""
        factor = self._scaling.update(reported)
        if factor < 1.0 and self.motion is not None and not self.motion.is_at_rest:
            self._scale_velocity(factor)

    def _scale_velocity(self, factor: float) -> None:
        assert self.motion is not None
        self.motion = replace(self.motion, velocity=factor * self.motion.velocity, spin=factor * self.motion.spin)

    def check_following(self, measured: Measured, target: FloatArray, target_speeds: FloatArray) -> None:
        """Checks a new package. Enters a fault if the arm is not where it was sent, or the controller's own target (6,)
        [rad, rad/s] is not the one that was sent."""
        self._following.update(self._sent_joints, measured.stamp, self._scaling.value)
        if self._following.is_moved_from_rest(target, target_speeds):
            self.enter_fault(ArmStatus.OTHER_PROGRAM)
        shift, turn = self._following.error(measured.joints)
        if shift > self.config.following_error or turn > self.config.following_turn:
            self.enter_fault(ArmStatus.NOT_FOLLOWING)

    def check_faults(self, measured: Measured, partners: Sequence[Record | None]) -> None:
        """Enters a fault by the measured state: force, region, keep-out, faults of the other arms."""
        config = self.config
        if exceeds_wrench(measured.wrench, config.force, config.torque):
            self.enter_fault(ArmStatus.FORCE_LIMIT)
        here = measured.sensor[:3, 3]
        self._check_position(measured)
        if not all(map(is_healthy, partners)):
            if self.is_at_rest and not self.status.is_fault:
                self.status, self._allowed_target = ArmStatus.WAITING, None
            else:
                self.enter_fault(ArmStatus.PARTNER_STOPPED)
        elif self.status in (ArmStatus.CONNECTING, ArmStatus.WAITING):
            self.status = ArmStatus.HOLD
        for partner, record in zip(config.partners, partners, strict=True):
            min_gap = partner.distance - tuning.MAX_OVERSHOOT
            if record is not None and float(np.linalg.norm(here - record["position"])) < min_gap:
                approach = float(measured.twist[:3] @ (record["position"] - here))
                if approach > 0.0 and not self.is_at_rest:
                    self.enter_fault(ArmStatus.KEEP_OUT)

    def _check_position(self, measured: Measured) -> None:
        end = stopping_position(measured.sensor[:3, 3], measured.twist[:3], self._hard_braking[0])
        if self.region.excess(end) > tuning.MAX_OVERSHOOT:
            self.enter_fault(ArmStatus.WORKSPACE_LIMIT)

    def on_tactile(self, number: int, report: Record | None) -> None:
        """Reads the newest tactile report, once. A gel pressed or sheared beyond its limit is a fault."""
        if report is None or number == self._tactile_read:
            return
        self._tactile_read, self._exposure_time = number, float(report["exposed"])
        config = self.config
        if not math.isnan(self._exposure_time) and (
            exceeds_limit(float(report["depth"]), config.depth) or exceeds_limit(float(report["shear"]), config.shear)
        ):
            self.enter_fault(ArmStatus.GEL_LIMIT)

    def on_command(self, number: int, command: Record | None) -> None:
        """Reads the newest command, once. A target that is not a pose or has no speed is rejected; the arm holds."""
        if command is None or number == self.commands_read:
            return
        self.commands_read, kind = number, int(command["kind"])
        self._zero_request_time = float(command["time"]) if kind == CommandKind.ZERO_WRENCH else -math.inf
        if kind == CommandKind.TARGET and not (bool(finite_targets(command["target"])) and command["speed"] > 0.0):
            self.rejected += 1
            self._allowed_target = None
        elif kind == CommandKind.TARGET and not self.status.is_fault and self.status != ArmStatus.WAITING:
            target = command["target"]
            self._allowed_target = target[:3].copy(), rotation_from_quaternion(target[3:])
            self._target_time = float(command["time"])
            max_speed = float(command["speed"])
            is_slower = max_speed < self.config.speed
            self._motion_limits = replace(self.config, speed=max_speed) if is_slower else self.config
            if self.motion is not None:
                self._clip_target(self.motion)
        elif kind in (CommandKind.HOLD, CommandKind.CLOSE, CommandKind.ZERO_WRENCH):
            self._allowed_target = None
            self.close_requested |= kind == CommandKind.CLOSE

    def take_zero_request(self, time: float) -> bool:
        """True, once, if the newest command is a recent request to zero the wrench and the target is at rest."""
        is_due = self.is_at_rest and time - self._zero_request_time <= tuning.ZERO_REQUEST_TIMEOUT
        if is_due:
            self._zero_request_time = -math.inf
        return is_due

    def step(self, time: float, measured: Measured, partners: Sequence[Record | None]) -> FloatArray | None:
        """The joints (6,) to send in this period; None: send nothing, the controller holds."""
        config = self.config
        self._previous_step = self.motion, self._sent_joints, self._fault_braking
        if self._is_waiting_for_package(time, measured):
            return self._sent_joints
        if time - self._target_time > config.action_timeout:
            self._allowed_target = None
        is_blind = time - self._exposure_time > config.observation_timeout  # False without a guard by pictures (NaN)
        if is_blind and self._allowed_target is not None:  # dropped: no motion resumes by itself with new pictures
            self.status, self._allowed_target = ArmStatus.OBSERVATION_STALE, None
        if self._allowed_target is None:
            is_still_blind = is_blind and self.status == ArmStatus.OBSERVATION_STALE
            if not (self.status.is_fault or self.status == ArmStatus.WAITING or is_still_blind):
                self.status = ArmStatus.HOLD
            return self._brake(measured)
        target = self._allowed_target
        if self.motion is None or (
            self.status in (ArmStatus.HOLD, ArmStatus.OBSERVATION_STALE) and self._was_pushed(self.motion, measured)
        ):
            self._clip_target(self._start_at(measured))
        elif self._sent_joints is not None and self.motion.is_at_rest and is_at_target(self.motion, target):
            self.status = ArmStatus.OK
            return self._sent_joints
        elif self._scaling.value == 0.0 and is_standing_still(
            measured
        ):  # so no target lies ahead when the arm moves again
            self._start_at(measured)
        assert self.motion is not None
        gaps = self._braking_gaps(self.motion, partners)

        def is_allowed(motion: MotionState) -> bool:
            """True if the arm can still stop inside its region and clear of the other arms, or moves away from them."""
            assert self.motion is not None
            excess = self.region.excess(find_stopping_point(motion, self.config.acceleration))
            if excess > max(1e-9, float(self.region.excess(self.motion.position))):
                return False
            new_gaps = self._braking_gaps(motion, partners)
            return all(new >= 0.0 or new >= old for new, old in zip(new_gaps, gaps, strict=True))

        next_motion = step_towards(self.motion, *self._allowed_target, self._scaled_limits(), is_allowed)
        joints = self._solve_joints(next_motion, measured)
        if joints is not None:
            self.status = ArmStatus.OK
            return self._set_target(next_motion, joints)
        self.status = ArmStatus.OUT_OF_REACH
        return self._brake(measured)

    def _scaled_limits(self) -> MotionLimits:
        limits, scaling = self._motion_limits, self._scaling
        if scaling.value == 1.0:
            return limits
        return replace(
            self.config,
            speed=scaling.speed(limits.speed, limits.acceleration),
            turn_rate=scaling.speed(limits.turn_rate, limits.turn_acceleration),
        )

    def _start_at(self, measured: Measured) -> MotionState:
        """Sets the target at rest at the measured pose."""
        here = measured.sensor
        self.motion, self._sent_joints = motion_at_rest(here[:3, 3], here[:3, :3]), measured.joints
        self._following.restart(self._sent_joints)
        return self.motion

    def undo_last_step(self) -> FloatArray | None:
        """Undoes the last step, which could not be sent in its period. Returns the joints of the step before."""
        self.motion, self._sent_joints, self._fault_braking = self._previous_step
        return self._sent_joints

    def _is_waiting_for_package(self, time: float, measured: Measured) -> bool:
        """True while the target must stand, after missed periods or a fault, because no package with the present state
        of the arm has arrived. When it has, the target continues from that state."""
        motion = self.motion
        missed = time - self._last_step_time - PERIOD
        # one missed period alone stays within the limits
        is_late = motion is not None and not motion.is_at_rest and missed > 1.5 * PERIOD
        is_new_fault = motion is not None and self.status.is_fault and self._fault_braking is None
        if is_late or is_new_fault:
            new, stamp = self._last_package
            age = 0.5 * PERIOD if is_new_fault else PACKAGE_DELAY  # longer than usual
            is_fresh = measured.stamp - stamp > max(0.0, time - new - PERIOD - age)
            self._waited_periods += not is_fresh
            if not is_fresh and self._waited_periods < tuning.MAX_STALL_PERIODS:
                return True
            if is_new_fault:
                self._reset_after_fault(measured if is_fresh else None)
            else:
                self._slow_after_stall(missed, measured.twist if is_fresh else np.zeros(6))
        if measured.stamp != self._last_package[1]:
            self._last_package = time, measured.stamp
        self._last_step_time, self._waited_periods = time, 0
        return False

    def _reset_after_fault(self, measured: Measured | None) -> None:
        """The target brakes from the measured pose. Without one (None) it stands: an older pose would lead back."""
        assert self.motion is not None
        if measured is None:
            self.motion = motion_at_rest(self.motion.position, self.motion.rotation)
            self._fault_braking = self._hard_braking
            return
        here, twist = measured.sensor, measured.twist
        self.motion, self._sent_joints = MotionState(here[:3, 3], here[:3, :3], twist[:3], twist[3:]), measured.joints
        self._following.restart(self._sent_joints)
        # It stops within half of the lookahead: a target ahead of the arm, which lags, must not pull it on.
        decelerations = 2.0 * np.linalg.norm(twist.reshape(2, 3), axis=1) / self.config.lookahead
        hard, hard_turn = self._hard_braking
        self._fault_braking = max(hard, float(decelerations[0])), max(hard_turn, float(decelerations[1]))

    def _slow_after_stall(self, missed: float, twist: FloatArray) -> None:
        """The target continues with the speed that the arm still has along its path, never faster than before and in no
        other direction, so its stopping point is as safe as before."""
        assert self.motion is not None
        arm_twist = math.exp(-min(missed, PACKAGE_DELAY) / self.config.lookahead) * twist
        lead_time = 0.5 * self.config.lookahead  # a target that accelerates at its limit leads the arm by twice this
        self.motion = replace(
            self.motion,
            velocity=limit_speed(self.motion.velocity, arm_twist[:3], lead_time * self.config.acceleration),
            spin=limit_speed(self.motion.spin, arm_twist[3:], lead_time * self.config.turn_acceleration),
        )

    def _was_pushed(self, held: MotionState, measured: Measured) -> bool:
        """True if the arm rests away from its held pose, because something moved it: the next target starts at the
        measured pose. Servo lag and deflection by a contact are smaller than these limits and cause no jump. A package
        from before the arm came to rest shows another pose and does not count."""
        if not (held.is_at_rest and self._following.has_settled and is_standing_still(measured)):
            return False
        shift = np.abs(measured.sensor[:3, 3] - held.position).max()
        turn = np.abs(rotation_vector(measured.sensor[:3, :3] @ held.rotation.T)).max()
        return bool(shift > tuning.MAX_HELD_DISPLACEMENT or turn > tuning.MAX_HELD_ROTATION)

    def _brake(self, measured: Measured) -> FloatArray | None:
        """Brakes for one period. Sends the last joints again if the next pose has no allowed joints."""
        if self.motion is None or self._sent_joints is None:
            return None
        if self.motion.is_at_rest:
            return self._sent_joints
        limits = self._fault_braking or (self.config.acceleration, self.config.turn_acceleration)
        braked = step_braking(self.motion, *limits)
        joints = self._solve_joints(braked, measured)
        if joints is None:
            self.motion = motion_at_rest(self.motion.position, self.motion.rotation)
            return self._sent_joints
        return self._set_target(braked, joints)

    def _set_target(self, motion: MotionState, joints: FloatArray) -> FloatArray:
        self.motion, self._sent_joints = motion, joints
        return joints

    def _solve_joints(self, motion: MotionState, measured: Measured) -> FloatArray | None:
        """Joints (6,) of a pose; None if it is out of reach, too fast for a joint, or too near to a singularity."""
        assert self._sent_joints is not None
        sensor = np.eye(4)
        sensor[:3, :3], sensor[:3, 3] = motion.rotation, motion.position
        flange = self.frames.flange(sensor)
        controller_from_model = inverse_frame(measured.flange) @ self.kinematics.forward(measured.joints)
        joints = self.kinematics.inverse(flange @ controller_from_model, self._sent_joints)
        if joints is None or joint_speed_ratio(self._sent_joints, joints, self.config.joint_speed, PERIOD) > 1.0:
            return None
        return None if self._singularity.is_nearer(joints, self._sent_joints) else joints

    def _braking_gaps(
        self, motion: MotionState, partners: Sequence[Record | None], end: FloatArray | None = None
    ) -> list[float]:
        """Distance [m] between the braking path of `motion` and that of each other arm, minus the gap to keep
        (`find_min_gap`)."""
        end = find_stopping_point(motion, self.config.acceleration) if end is None else end
        gaps = []
        for partner, record in zip(self.config.partners, partners, strict=True):
            assert record is not None  # without it the arm waits
            gap = segment_distance(motion.position, end, record["position"], record["stopping_point"])
            gaps.append(gap - find_min_gap(partner.distance, float(record["top_speed"])))
        return gaps

    def _clip_target(self, start: MotionState) -> None:
        """Clips the target on the straight path from `start`: to the region, so that the arm stops exactly on the
        boundary (the driver has clipped it from an older state; a further change is counted), and to the distance that
        can be covered within `action_timeout`, so that an arm without further commands stops within that distance."""
        if self._allowed_target is None:
            return
        target_position, target_rotation = self._allowed_target
        turn = rotation_vector(target_rotation @ start.rotation.T)
        inside_fraction = float(fraction_inside(start.position, target_position, self.region))
        self.clipped += inside_fraction < 1.0
        path_length, angle = math.dist(target_position, start.position), math.sqrt(float(turn @ turn))
        limits = self._motion_limits
        max_length, max_angle = (rate * self.config.action_timeout for rate in (limits.speed, limits.turn_rate))
        fraction = min(inside_fraction, max_length / max(path_length, max_length), max_angle / max(angle, max_angle))
        if fraction < 1.0:
            position = start.position + fraction * (target_position - start.position)
            self._allowed_target = position, rotation(fraction * turn) @ start.rotation
