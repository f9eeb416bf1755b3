"""Forces at the tool: the load on it, the part of it that the controller reports, and force mode.

The flange measures the sum of the external wrench, an elastic table, and the weight of the masses on it. The controller
subtracts the weight of the configured payload in the configured gravity, then the offset of zero_ftsensor:
"subtracting the current measurement from the subsequent" (URScript manual). That offset stays fixed to the sensor until
the next zeroing, so the complete weight of a payload that is configured later appears at once.

In force mode the tool moves along and about the compliant axes of a task frame until it exerts the desired wrench;
along the other axes it follows the program (force_mode in the URScript manual, which does not give the control law).
Here the compliant axes move like a mass with a damper, driven by the missing wrench:
MASS dv/dt = gain (desired + measured) - damping FULL_DAMPING v, within the given speeds. As in the manual, a damping of
0 keeps the speed where no force acts, and a gain above 1 oscillates on hard surfaces. With the values of ur_rtde's
script (gain 0.5, damping 0.025), 10 N without contact give 17 mm/s, and contacts of up to 50 N/mm come to rest.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from robot.common.kinematics import inverse_frame, rotation
from robot.mock.ur.machine.arm import HISTORY_LENGTH, PERIOD, Arm, ProgramError
from tacsim.interface import FloatArray

GRAVITY = 9.82  # default of the controller [m/s^2] (URScript manual, set_gravity)
MAX_PAYLOAD = 100.0  # mass [kg] and coordinates [m] of a payload; the strongest UR arm carries 35 kg
FORCE_LIMIT = 250.0  # |force| beyond which the mock stops for protection [N]
GRAVITY_REACTION = np.array([0.0, 0.0, GRAVITY])  # acceleration that a resting arm measures, base axes [m/s^2]


@dataclass(frozen=True)
class Wall:
    """A horizontal spring: pushes the TCP up, by `stiffness` [N/m] times its depth below `z` [m], base axes."""

    z: float
    stiffness: float


@dataclass(frozen=True)
class Mass:
    """A mass on the flange [kg] and its centre of gravity, flange axes [m]. Raises ValueError."""

    mass: float = 0.0
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @classmethod
    def of(cls, numbers: Sequence[float]) -> Mass:
        """From mass [kg] and centre [m] (4,)."""
        if len(numbers) != 4 or not float(np.abs(numbers).max()) <= MAX_PAYLOAD:
            limit = f"none beyond {MAX_PAYLOAD:g}"
            raise ValueError(f"a payload is a mass [kg] and its centre x, y, z [m], {limit}, got {list(numbers)}")
        mass, x, y, z = (float(number) for number in numbers)
        return cls(mass, (x, y, z))


NO_MASS = Mass()


@dataclass
class Load:
    """Wrenches (6,) [N, N m] on the tool, with the signs of UR: of the environment on the robot, about the TCP, in base
    axes; pressing down on a table gives a positive z force."""

    tool: Mass = NO_MASS  # on the flange since power-on
    hidden: Mass = NO_MASS  # on the flange in addition, unknown to the controller
    wrench: FloatArray = field(default_factory=lambda: np.zeros(6))  # external
    wall: Wall | None = None
    configured_payload: Mass = NO_MASS  # which the controller compensates
    inertia: FloatArray = field(default_factory=lambda: np.zeros(6))  # of that payload [kg m^2]
    gravity: FloatArray = field(default_factory=GRAVITY_REACTION.copy)  # as set by set_gravity [m/s^2]
    force_limit: float = FORCE_LIMIT
    bias: FloatArray = field(default_factory=lambda: np.zeros(6))  # of zero_ftsensor: about the flange, in its axes
    measured: FloatArray = field(default_factory=lambda: np.zeros(6))  # total
    unexplained: FloatArray = field(default_factory=lambda: np.zeros(6))  # total minus configured payload
    zeroed_wrench: FloatArray = field(default_factory=lambda: np.zeros(6))  # also minus bias: actual_TCP_force
    history: deque[FloatArray] = field(
        default_factory=lambda: deque(maxlen=HISTORY_LENGTH)
    )  # `zeroed_wrench` of each control period

    def update(self, arm: Arm) -> None:
        """Computes the wrenches at the arm's present pose."""
        measured = self.wrench.copy()
        if self.wall is not None:
            measured[2] += self.wall.stiffness * max(0.0, self.wall.z - float(arm.frame[2, 3]))
        self.measured = self.unexplained = self.zeroed_wrench = measured
        if self.configured_payload.mass == self.tool.mass == self.hidden.mass == 0.0 and not self.bias.any():
            return
        flange = arm.frame @ inverse_frame(arm.tool)
        for each in (self.tool, self.hidden):
            measured += _weight_wrench(each, GRAVITY_REACTION, flange, arm.frame)
        self.unexplained = measured - _weight_wrench(self.configured_payload, self.gravity, flange, arm.frame)
        self.zeroed_wrench = self.unexplained - _transform_wrench(self.bias, flange, arm.frame[:3, 3])

    def zero(self, arm: Arm) -> None:
        """zero_ftsensor: makes the present wrench the bias. The bias is fixed to the sensor and rotates with it."""
        self.bias = at_flange(self.unexplained, arm)
        self.update(arm)


def at_flange(wrench: FloatArray, arm: Arm) -> FloatArray:
    """Converts a wrench about the TCP in base axes to one about the flange in its axes."""
    flange = arm.frame @ inverse_frame(arm.tool)
    torque = wrench[3:] + cross(arm.frame[:3, 3] - flange[:3, 3], wrench[:3])
    return np.concatenate([flange[:3, :3].T @ wrench[:3], flange[:3, :3].T @ torque])


def cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """a x b of two vectors (3,); np.cross takes ten times as long."""
    (ax, ay, az), (bx, by, bz) = a.tolist(), b.tolist()
    return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


def _weight_wrench(of: Mass, gravity: FloatArray, flange: FloatArray, frame: FloatArray) -> FloatArray:
    """Weight of a mass about the TCP, in base axes."""
    if of.mass == 0.0:
        return np.zeros(6)
    force = -of.mass * gravity
    centre = flange[:3, :3] @ np.array(of.centre) + flange[:3, 3]
    return np.concatenate([force, cross(centre - frame[:3, 3], force)])


def _transform_wrench(wrench: FloatArray, flange: FloatArray, point: FloatArray) -> FloatArray:
    """Converts a wrench about the flange in its axes to one about `point` in base axes."""
    force, torque = flange[:3, :3] @ wrench[:3], flange[:3, :3] @ wrench[3:]
    return np.concatenate([force, torque + cross(flange[:3, 3] - point, force)])


MASS = np.repeat([2.0, 0.04], 3)  # [kg, kg m^2]
FULL_DAMPING = np.repeat([12e3, 240.0], 3)  # [N/(m/s), N m/(rad/s)]
ACCELERATION = np.repeat([5.0, 50.0], 3)  # maximum [m/s^2, rad/s^2]


@dataclass
class ForceMode:
    """Arguments of force_mode, and the present compliant motion of the tool. Wrenches and twists are (6,)."""

    kind: int  # of the task frame: 1 axis from the TCP to a point, 2 fixed, 3 axis along the motion
    frame: FloatArray  # given task frame (4, 4), base axes
    free: FloatArray  # (6,) whether compliant, task axes
    wrench: FloatArray  # to be exerted by the tool, task axes
    limits: FloatArray  # maximum speeds of the compliant axes
    gain: float  # of force_mode_set_gain_scaling, 0 to 2
    damping: float  # of force_mode_set_damping, 0 to 1
    twist: FloatArray = field(default_factory=lambda: np.zeros(6))  # of the compliant motion, base axes
    turn: FloatArray | None = None  # present base_from_task (3, 3); None for type 3 before the first motion

    def update(self, arm: Arm, measured: FloatArray) -> None:
        """Computes one control period. Raises ProgramError if there is no task frame."""
        self._orient(arm)
        if self.turn is None:
            return
        missing = self.wrench + _rotate_twist(self.turn.T, measured)
        before = np.where(self.free, _rotate_twist(self.turn.T, self.twist), 0.0)
        # implicit Euler: stable for any damping
        wanted = (before + PERIOD * self.gain * missing / MASS) / (1.0 + PERIOD * self.damping * FULL_DAMPING / MASS)
        change = np.clip(wanted - before, -PERIOD * ACCELERATION, PERIOD * ACCELERATION)
        local = np.where(self.free, np.clip(before + change, -self.limits, self.limits), 0.0)
        self.twist = _rotate_twist(self.turn, local)

    def mix(self, program: FloatArray, scale: float) -> FloatArray:
        """Twist of the tool if the program moves it by the twist `program`; scale: the speed scaling."""
        if self.turn is None:
            return program
        rigid = np.where(self.free, 0.0, _rotate_twist(self.turn.T, program))
        return _rotate_twist(self.turn, rigid) + scale * self.twist

    def _orient(self, arm: Arm) -> None:
        min_speed = 1e-6  # a TCP faster than this moves, in type 3 [m/s]
        # minimum distance of TCP and task frame in type 1 [m] (UR5e user manual, force mode "Point")
        point_distance = 0.01
        turn = self.frame[:3, :3]
        if self.kind == 1:
            towards = self.frame[:3, 3] - arm.frame[:3, 3]
            distance = float(np.linalg.norm(towards))
            if distance < point_distance:
                near = f"the TCP is {1e3 * distance:.1f} mm from the point, at least 10 mm are needed"
                raise ProgramError(f"force_mode of type 1: {near}")
            self.turn = _smallest_rotation(turn[:, 1], towards / distance) @ turn
        elif self.kind == 2:
            self.turn = turn
        else:
            x, y = turn[:, :2].T @ arm.target_twist[:3]  # of the program; compliant motion does not count
            speed = float(np.hypot(x, y))
            if speed > min_speed:
                c, s = x / speed, y / speed
                self.turn = turn @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _rotate_twist(turn: FloatArray, twist: FloatArray) -> FloatArray:
    return np.concatenate([turn @ twist[:3], turn @ twist[3:]])


def _smallest_rotation(a: FloatArray, b: FloatArray) -> FloatArray:
    """The smallest rotation (3, 3) that takes the unit vector a to b."""
    axis, cosine = np.cross(a, b), float(a @ b)
    sine = float(np.linalg.norm(axis))
    if sine < 1e-9:
        if cosine > 0:
            return np.eye(3)
        axis, sine = np.cross(a, np.eye(3)[int(np.argmin(np.abs(a)))]), 0.0
    return rotation(axis / np.linalg.norm(axis) * np.arctan2(sine, cosine))
