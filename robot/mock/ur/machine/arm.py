"""The arm of the mock: target joints, set point, and actual joints.

The program's motion gives the target. The set point of the joint servos is the target, changed by compliance in force
mode. The actual joints follow the set point like a critically damped servo of second order. With a servo rate of
500 rad/s they lag behind a steady motion by 4 ms and settle within about 20 ms. Real arms have similar values; their
dynamics are not modelled (no masses, friction or flexibility).
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from robot.common.kinematics import JOINT_RANGE, Kinematics, displacement, pose, rotation
from tacsim.interface import FloatArray

if TYPE_CHECKING:
    from tacsim.models.hardware import Model  # pydantic and SciPy: half a second of start-up

PERIOD = 0.002  # one control period [s]
JOINT_ACCELERATION = 40.0  # maximum in servo motion [rad/s^2]
COAST_DECELERATION = 8.0  # of the leading joint without a command [rad/s^2]
BRAKE_DECELERATION = 20.0  # of the leading joint in a protective or emergency stop [rad/s^2]
HOME = (0.0, -math.pi / 2, math.pi / 2, -math.pi / 2, -math.pi / 2, 0.0)  # tool down, in front of the base
HISTORY_LENGTH = 2500  # stored control periods of joint positions
MAX_REST_SPEED = 1e-9  # of a joint of an arm at rest [rad/s]
MAX_SPEED_RATIO = 1.001  # of a joint's maximum speed; a faster motion is refused (the excess allows for rounding)

MotionSteps = Iterator[None]  # a motion as a generator: one `yield` is one control period


class ProgramError(Exception):
    """A run-time error of the program: on the controller it ends the program."""


class TooFast(ProgramError):
    """A motion exceeds a joint's maximum speed: on the controller a protective stop."""


class Arm:
    """Joints (6,) [rad], their speeds [rad/s], and the resulting frames. All poses and twists are in base axes."""

    def __init__(self, model: Model = "ur5e", joints: Sequence[float] = HOME) -> None:
        servo_rate = 500.0  # of the joint servos [rad/s]
        self.kinematics = Kinematics(model)
        self.tool = np.eye(4)  # flange_from_tcp
        self.target_q = np.array(joints, dtype=np.float64)
        if self.target_q.shape != (6,) or not np.isfinite(self.target_q).all():
            raise ValueError(f"joints must be 6 finite angles [rad], got {list(joints)}")
        if float(np.abs(self.target_q).max()) > JOINT_RANGE:
            raise ValueError(f"joints must be within +-2 pi rad, got {list(joints)}")
        self.target_qd, self.target_qdd = np.zeros(6), np.zeros(6)
        self.set_q, self.set_qd = self.target_q.copy(), np.zeros(6)
        self.q, self.qd = self.target_q.copy(), np.zeros(6)
        self.scale = 1.0  # present speed scaling, 0 to 1
        self.servo_rates = np.full(6, servo_rate)  # of each joint [rad/s]; a fault may reduce one
        self.held = False  # the tool is held: the joints do not move, whatever their servos command
        self.waypoint: FloatArray | None = None  # (4, 4) at the end of the present move
        self.history: deque[FloatArray] = deque([self.q] * HISTORY_LENGTH, maxlen=HISTORY_LENGTH)
        self._next: FloatArray | None = None
        self.acceleration, self.target_acceleration = np.zeros(6), np.zeros(6)  # of the TCP, over the last period
        self.update()

    # -- commands of a motion: at most one a control period ----------------------------------------------------------

    def follow(self, q: FloatArray) -> None:
        """Commands joints q at the end of this control period."""
        speeds = np.abs(q - self.target_q) / PERIOD
        fast = ~(speeds <= MAX_SPEED_RATIO * self.kinematics.joint_speeds)  # also refuses NaN
        if fast.any():
            joint = int(np.argmax(fast))
            raise TooFast(f"joint {joint + 1} at {speeds[joint]:.2f} rad/s, too fast")
        if self._next is not None:
            raise ProgramError("another thread is already controlling the robot")
        self._next = q

    def drive(self, qd: FloatArray) -> None:
        """Commands joint speeds qd [rad/s] during this control period."""
        self.follow(self.target_q + qd * PERIOD)

    def solve(self, frame: FloatArray, seed: FloatArray | None = None) -> FloatArray:
        """Joints for a frame of the TCP. Raises ProgramError if it is out of reach."""
        q = self.kinematics.inverse(frame, self.target_q if seed is None else seed, self.tool)
        if q is None:
            where = ", ".join(f"{value:.4g}" for value in frame[:3, 3])
            raise ProgramError(f"get_inverse_kin: no solution for the pose at ({where}) m")
        return q

    def joint_speeds_of(self, twist: FloatArray) -> FloatArray:
        """Joint speeds that give the TCP this twist. Raises ProgramError in a singular pose."""
        try:
            speeds = np.linalg.solve(self.jacobian, twist)
        except np.linalg.LinAlgError:
            raise ProgramError("the arm is in a singular pose") from None
        return np.asarray(speeds, dtype=np.float64)

    # -- one control period ------------------------------------------------------------------------------------------

    @property
    def commanded(self) -> bool:
        """True once a motion has commanded joints in this control period."""
        return self._next is not None

    def advance(
        self, deceleration: float = COAST_DECELERATION, compliance: Callable[[FloatArray], FloatArray] | None = None
    ) -> bool:
        """Ends the control period; an arm without a command is braked.

        compliance: in force mode, converts the program's twist to that of the set point. Returns False if the set point
        is out of reach, and holds it.
        """
        wanted, before, begin, frame = self._next, self.target_qd, self.set_q, self.target_frame
        twist, target_twist = self.twist, self.target_twist
        self._next = None
        if wanted is not None:
            self.target_qd = (wanted - self.target_q) / PERIOD
            self.target_q = wanted
        elif before.any():
            self.target_qd = brake_speeds(before, deceleration)
            self.target_q = self.target_q + self.target_qd * PERIOD
        self.target_qdd = (self.target_qd - before) / PERIOD
        self._update_target()
        reached: FloatArray | None = self.target_q
        if compliance is not None:
            step = PERIOD * compliance(displacement(frame, self.target_frame) / PERIOD)
            goal = self.kinematics.forward(begin, self.tool)
            goal[:3, :3], goal[:3, 3] = rotation(step[3:]) @ goal[:3, :3], goal[:3, 3] + step[:3]
            reached = self.kinematics.inverse(goal, begin, self.tool)
        self.set_q = begin if reached is None else reached
        self.set_qd = (self.set_q - begin) / PERIOD
        self._servo(begin)
        self.history.append(self.q)
        self._update_actual()
        self.acceleration = (self.twist - twist) / PERIOD
        self.target_acceleration = (self.target_twist - target_twist) / PERIOD
        return reached is not None

    def settle(self) -> None:
        """Sets the target to the set point: the program continues from there after force mode."""
        self.target_q, self.target_qd = self.set_q, self.set_qd
        self._update_target()

    def halt(self) -> None:
        """Closes the brakes: speeds are zero, and the target is at the actual joints."""
        self.target_q, self.target_qd, self.target_qdd = self.q.copy(), np.zeros(6), np.zeros(6)
        self.set_q, self.set_qd, self.qd = self.target_q, np.zeros(6), np.zeros(6)
        self._next = None
        self.update()

    def update(self) -> None:
        """Computes frames, Jacobian and twists again after the joints or the tool have changed."""
        self._update_target()
        self._update_actual()

    def _update_target(self) -> None:
        self.target_frame, self.jacobian = self.kinematics.forward_and_jacobian(self.target_q, self.tool)
        self.target_twist: FloatArray = self.jacobian @ self.target_qd

    def _update_actual(self) -> None:
        self.frame, actual_jacobian = self.kinematics.forward_and_jacobian(self.q, self.tool)
        self.twist: FloatArray = actual_jacobian @ self.qd

    @property
    def pose(self) -> FloatArray:
        """UR pose (6,) of the TCP."""
        return pose(self.frame)

    @property
    def rests(self) -> bool:
        """True if target, set point and actual joints do not move."""
        return not self.target_qd.any() and not self.set_qd.any() and float(np.abs(self.qd).max()) < MAX_REST_SPEED

    def _servo(self, before: FloatArray) -> None:
        """One period of q'' = w^2 (set - q) - 2 w q', solved exactly for a set point in steady motion."""
        if self.held:
            self.qd = np.zeros(6)
            return
        rates = self.servo_rates
        speed, trail = self.set_qd, 2.0 / rates * self.set_qd
        error, rate = self.q - before + trail, self.qd - speed
        drift, decay = (rate + rates * error) * PERIOD, np.exp(-rates * PERIOD)
        error, rate = (error + drift) * decay, (rate - rates * drift) * decay
        self.q, self.qd = self.set_q - trail + error, rate + speed
        if not speed.any() and float(np.abs(rate).max()) < MAX_REST_SPEED and float(np.abs(error).max()) < 1e-12:
            self.q, self.qd = self.set_q.copy(), np.zeros(6)  # ends the exponential decay


def brake_speeds(speeds: FloatArray, deceleration: float) -> FloatArray:
    """Speeds after one period of braking: the largest falls by `deceleration`, the others in proportion."""
    fastest = float(np.abs(speeds).max())
    left = fastest - deceleration * PERIOD
    return speeds * (left / fastest) if left > 1e-12 else np.zeros_like(speeds)
