"""Force mode: along and about the compliant axes of a task frame the tool gives way until it exerts the wrench that is
wanted; along the others it follows the program (force_mode in the URScript manual, which does not say how).

Here the tool gives way like a mass with a damper that the missing wrench pushes:
MASS dv/dt = gain (wanted + felt) - damping FULL_DAMPING v, within the speeds given. So, as the manual has it, a damping
of 0 keeps the speed where no force acts, and a gain beyond 1 gets restless on hard surfaces. With what ur_rtde's script
sets (gain 0.5, damping 0.025) 10 N in the air make 17 mm/s, and contacts of up to 50 N/mm come to rest.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from robot.common.kinematics import rotation
from robot.mock.ur.machine.arm import PERIOD, Arm, ProgramError
from tacsim.interface import FloatArray

MASS = np.repeat([2.0, 0.04], 3)  # [kg, kg m^2]
FULL_DAMPING = np.repeat([12e3, 240.0], 3)  # [N/(m/s), N m/(rad/s)]
ACCELERATION = np.repeat([5.0, 50.0], 3)  # top [m/s^2, rad/s^2]


@dataclass
class ForceMode:
    """What force_mode was called with, and how the tool gives way at present. Wrenches and twists (6,)."""

    kind: int  # how the task frame follows the TCP: 1 point, 2 as given, 3 motion
    frame: FloatArray  # the task frame as given (4, 4), base axes
    free: FloatArray  # (6,) whether compliant, task axes
    wrench: FloatArray  # what the tool shall exert, task axes
    limits: FloatArray  # top speeds of the compliant axes
    gain: float  # of force_mode_set_gain_scaling, 0 to 2
    damping: float  # of force_mode_set_damping, 0 to 1
    twist: FloatArray = field(default_factory=lambda: np.zeros(6))  # of giving way, base axes
    turn: FloatArray | None = None  # base_from_task (3, 3) now; None while type 3 has seen no motion yet

    def update(self, arm: Arm, felt: FloatArray) -> None:
        """One control period. Raises ProgramError where there is no task frame."""
        self._orient(arm)
        if self.turn is None:
            return
        missing = self.wrench + _turned(self.turn.T, felt)
        before = np.where(self.free, _turned(self.turn.T, self.twist), 0.0)
        # implicit Euler: stable for any damping
        wanted = (before + PERIOD * self.gain * missing / MASS) / (1.0 + PERIOD * self.damping * FULL_DAMPING / MASS)
        change = np.clip(wanted - before, -PERIOD * ACCELERATION, PERIOD * ACCELERATION)
        local = np.where(self.free, np.clip(before + change, -self.limits, self.limits), 0.0)
        self.twist = _turned(self.turn, local)

    def mix(self, program: FloatArray, scale: float) -> FloatArray:
        """What the tool does where the program moves it by the twist `program`; scale: the speed scaling."""
        if self.turn is None:
            return program
        rigid = np.where(self.free, 0.0, _turned(self.turn.T, program))
        return _turned(self.turn, rigid) + scale * self.twist

    def _orient(self, arm: Arm) -> None:
        min_speed = 1e-6  # a TCP faster than this moves, in type 3 [m/s]
        # least distance of TCP and task frame in type 1 [m] (UR5e user manual, force mode "Point")
        point_distance = 0.01
        turn = self.frame[:3, :3]
        if self.kind == 1:
            towards = self.frame[:3, 3] - arm.frame[:3, 3]
            distance = float(np.linalg.norm(towards))
            if distance < point_distance:
                near = f"the TCP is {1e3 * distance:.1f} mm from the point, at least 10 mm are needed"
                raise ProgramError(f"force_mode of type 1: {near}")
            self.turn = _least_turn(turn[:, 1], towards / distance) @ turn
        elif self.kind == 2:
            self.turn = turn
        else:
            x, y = turn[:, :2].T @ arm.target_twist[:3]  # of the program: giving way is no motion
            speed = float(np.hypot(x, y))
            if speed > min_speed:
                c, s = x / speed, y / speed
                self.turn = turn @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _turned(turn: FloatArray, twist: FloatArray) -> FloatArray:
    return np.concatenate([turn @ twist[:3], turn @ twist[3:]])


def _least_turn(a: FloatArray, b: FloatArray) -> FloatArray:
    """The smallest rotation (3, 3) that takes the unit vector a to b."""
    axis, cosine = np.cross(a, b), float(a @ b)
    sine = float(np.linalg.norm(axis))
    if sine < 1e-9:
        if cosine > 0:
            return np.eye(3)
        axis, sine = np.cross(a, np.eye(3)[int(np.argmin(np.abs(a)))]), 0.0
    return rotation(axis / np.linalg.norm(axis) * np.arctan2(sine, cosine))
