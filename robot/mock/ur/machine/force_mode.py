"""Force mode: along and about the compliant axes of a task frame the tool moves until it exerts the desired wrench;
along the other axes it follows the program (force_mode in the URScript manual, which does not give the control law).

Here the compliant axes move like a mass with a damper, driven by the missing wrench:
MASS dv/dt = gain (desired + measured) - damping FULL_DAMPING v, within the given speeds. As in the manual, a damping of
0 keeps the speed where no force acts, and a gain above 1 oscillates on hard surfaces. With the values of ur_rtde's
script (gain 0.5, damping 0.025), 10 N without contact give 17 mm/s, and contacts of up to 50 N/mm come to rest.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from robot.common.kinematics import rotation
from robot.mock.ur.machine.arm import PERIOD, Arm, ProgramError
from tacsim.interface import FloatArray

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
