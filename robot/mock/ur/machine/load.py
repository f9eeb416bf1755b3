"""What pulls and pushes on the tool, and what of it the controller shows.

The flange measures everything: wrenches given from outside, a spring table, the weight of what hangs there. The
controller takes off the weight of the payload that it was told of, in the gravity that it was told of, then what
zero_ftsensor has found: "subtracting the current measurement from the subsequent" (URScript manual). That offset is the
sensor's and stays until the next zeroing, so a payload told afterwards shows at once, with its whole weight.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from robot.common.kinematics import inverse_frame
from robot.mock.ur.machine.arm import HISTORY, Arm
from tacsim.interface import FloatArray

GRAVITY = 9.82  # what the controller compensates with by default [m/s^2] (URScript manual, set_gravity)
HEAVIEST = 100.0  # mass that a payload may have; the strongest UR arm bears 35 kg [kg]
FORCE_LIMIT = 250.0  # |force| beyond which the mock stops for protection [N]
UP = np.array([0.0, 0.0, GRAVITY])  # acceleration that a standing arm feels, base axes [m/s^2]


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
        """From mass and centre (4,)."""
        if len(numbers) != 4 or not float(np.abs(numbers).max()) <= HEAVIEST:
            limit = f"none beyond {HEAVIEST:g}"
            raise ValueError(f"a payload is a mass [kg] and its centre x, y, z [m], {limit}, got {list(numbers)}")
        mass, x, y, z = (float(number) for number in numbers)
        return cls(mass, (x, y, z))


NOTHING = Mass()


@dataclass
class Load:
    """Wrenches (6,) [N, N m] on the tool. Signs as UR has them: what the surroundings do to the robot, about the TCP,
    in base axes; pressing down on a table gives a positive z force."""

    tool: Mass = NOTHING  # hangs on the flange from power-on
    hidden: Mass = NOTHING  # hangs there too
    wrench: FloatArray = field(default_factory=lambda: np.zeros(6))  # given from outside
    wall: Wall | None = None
    told: Mass = NOTHING  # the payload that the controller reckons with
    inertia: FloatArray = field(default_factory=lambda: np.zeros(6))  # told with it [kg m^2]
    gravity: FloatArray = field(default_factory=UP.copy)  # as set_gravity has it [m/s^2]
    force_limit: float = FORCE_LIMIT
    bias: FloatArray = field(default_factory=lambda: np.zeros(6))  # of zero_ftsensor: about the flange, in its axes
    measured: FloatArray = field(default_factory=lambda: np.zeros(6))  # all of it
    unexplained: FloatArray = field(default_factory=lambda: np.zeros(6))  # less the payload told of
    felt: FloatArray = field(default_factory=lambda: np.zeros(6))  # less the bias too: actual_TCP_force
    history: deque[FloatArray] = field(default_factory=lambda: deque(maxlen=HISTORY))  # of `felt`, a period each

    def update(self, arm: Arm) -> None:
        """Renews what is measured and felt at the arm's present pose."""
        measured = self.wrench.copy()
        if self.wall is not None:
            measured[2] += self.wall.stiffness * max(0.0, self.wall.z - float(arm.frame[2, 3]))
        self.measured = self.unexplained = self.felt = measured
        if self.told.mass == self.tool.mass == self.hidden.mass == 0.0 and not self.bias.any():
            return
        flange = arm.frame @ inverse_frame(arm.tool)
        for each in (self.tool, self.hidden):
            measured += _weight(each, UP, flange, arm.frame)
        self.unexplained = measured - _weight(self.told, self.gravity, flange, arm.frame)
        self.felt = self.unexplained - _moved(self.bias, flange, arm.frame[:3, 3])

    def zero(self, arm: Arm) -> None:
        """zero_ftsensor: what is felt now counts as nothing. The bias belongs to the sensor and turns with it."""
        self.bias = at_flange(self.unexplained, arm)
        self.update(arm)


def at_flange(wrench: FloatArray, arm: Arm) -> FloatArray:
    """A wrench about the TCP in base axes as one about the flange in its axes."""
    flange = arm.frame @ inverse_frame(arm.tool)
    torque = wrench[3:] + cross(arm.frame[:3, 3] - flange[:3, 3], wrench[:3])
    return np.concatenate([flange[:3, :3].T @ wrench[:3], flange[:3, :3].T @ torque])


def cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """a x b of two (3,); np.cross takes ten times as long for so few numbers."""
    (ax, ay, az), (bx, by, bz) = a.tolist(), b.tolist()
    return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


def _weight(of: Mass, gravity: FloatArray, flange: FloatArray, frame: FloatArray) -> FloatArray:
    """Weight of a mass about the TCP, in base axes."""
    if of.mass == 0.0:
        return np.zeros(6)
    force = -of.mass * gravity
    centre = flange[:3, :3] @ np.array(of.centre) + flange[:3, 3]
    return np.concatenate([force, cross(centre - frame[:3, 3], force)])


def _moved(wrench: FloatArray, flange: FloatArray, point: FloatArray) -> FloatArray:
    """A wrench about the flange in its axes as one about `point` in base axes."""
    force, torque = flange[:3, :3] @ wrench[:3], flange[:3, :3] @ wrench[3:]
    return np.concatenate([force, torque + cross(flange[:3, 3] - point, force)])
