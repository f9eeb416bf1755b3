"""Loads on the tool: wrenches given from outside, a spring table, a payload that the controller does not know of."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np

from robot.common.kinematics import inverse_frame
from robot.mock.ur.machine.arm import HISTORY, Arm
from tacsim.interface import FloatArray

GRAVITY = 9.82  # what the controller compensates with by default [m/s^2] (URScript manual, set_gravity)
FORCE_LIMIT = 250.0  # |force| beyond which the mock stops for protection [N]


@dataclass(frozen=True)
class Wall:
    """A horizontal spring: pushes the TCP up, by `stiffness` [N/m] times its depth below `z` [m], base axes."""

    z: float
    stiffness: float


@dataclass
class Load:
    """Wrenches (6,) [N, N m] on the tool. Signs as UR has them: what the surroundings do to the robot, about the TCP,
    in base axes; pressing down on a table gives a positive z force."""

    wrench: FloatArray = field(default_factory=lambda: np.zeros(6))  # given from outside
    wall: Wall | None = None
    hidden_mass: float = 0.0  # hangs on the flange, and the controller does not know of it [kg]
    hidden_centre: FloatArray = field(default_factory=lambda: np.zeros(3))  # its centre, flange axes [m]
    force_limit: float = FORCE_LIMIT
    bias: FloatArray = field(default_factory=lambda: np.zeros(6))  # of zero_ftsensor: about the flange, in its axes
    true: FloatArray = field(default_factory=lambda: np.zeros(6))  # all of it, at the present pose
    felt: FloatArray = field(default_factory=lambda: np.zeros(6))  # the same less the bias: actual_TCP_force
    history: deque[FloatArray] = field(default_factory=lambda: deque(maxlen=HISTORY))  # of `felt`, a period each

    def update(self, arm: Arm) -> None:
        """Renews `true` and `felt` at the arm's present pose."""
        true = self.wrench.copy()
        if self.wall is not None:
            true[2] += self.wall.stiffness * max(0.0, self.wall.z - float(arm.frame[2, 3]))
        if self.hidden_mass != 0.0:
            flange = arm.kinematics.forward(arm.q)
            weight = np.array([0.0, 0.0, -self.hidden_mass * GRAVITY])
            centre = flange[:3, :3] @ self.hidden_centre + flange[:3, 3]
            true[:3] += weight
            true[3:] += cross(centre - arm.frame[:3, 3], weight)
        self.true = true
        if self.bias.any():
            self.felt = true - _moved(self.bias, arm.frame @ inverse_frame(arm.tool), arm.frame[:3, 3])
        else:
            self.felt = true

    def zero(self, arm: Arm) -> None:
        """zero_ftsensor: what is felt now counts as nothing. The bias belongs to the sensor and turns with it."""
        flange = arm.frame @ inverse_frame(arm.tool)
        self.bias = self.at_flange(self.true, arm, flange)
        self.update(arm)

    @staticmethod
    def at_flange(wrench: FloatArray, arm: Arm, flange: FloatArray | None = None) -> FloatArray:
        """A wrench about the TCP in base axes as one about the flange in its axes."""
        if flange is None:
            flange = arm.frame @ inverse_frame(arm.tool)
        torque = wrench[3:] + cross(arm.frame[:3, 3] - flange[:3, 3], wrench[:3])
        return np.concatenate([flange[:3, :3].T @ wrench[:3], flange[:3, :3].T @ torque])


def cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """a x b of two (3,); np.cross takes ten times as long for so few numbers."""
    (ax, ay, az), (bx, by, bz) = a.tolist(), b.tolist()
    return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


def _moved(wrench: FloatArray, flange: FloatArray, point: FloatArray) -> FloatArray:
    """A wrench about the flange in its axes as one about `point` in base axes."""
    force, torque = flange[:3, :3] @ wrench[:3], flange[:3, :3] @ wrench[3:]
    return np.concatenate([force, torque + cross(flange[:3, 3] - point, force)])
