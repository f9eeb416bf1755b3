"""The commands of ur_rtde's control script that set something or ask something; none of them moves the arm."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from robot.common.kinematics import pose
from robot.mock.ur.machine.arm import PERIOD, ProgramError
from tacsim.interface import FloatArray

if TYPE_CHECKING:
    from robot.mock.ur.machine.script import Program

NEAR_SINGULAR, SINGULAR = 0.05, 0.02  # of Kinematics.singularity, for get_freedrive_status

# -- settings --------------------------------------------------------------------------------------------------------


def zero_sensor(p: Program) -> None:
    p.machine.load.zero(p.arm)


def payload(p: Program) -> None:
    """A centre of gravity that is all zero keeps the one before: the script has it so."""
    mass, centre = p.double(0), p.doubles(1, 3)
    if not mass >= 0 or not np.isfinite(centre).all():
        raise ProgramError(f"set_payload: mass {mass:g} kg, centre {centre.tolist()} m")
    p.machine.payload = mass
    if centre.any():
        p.machine.payload_centre = centre


def target_payload(p: Program) -> None:
    payload(p)
    p.machine.payload_inertia = p.doubles(4)


def tool(p: Program) -> None:
    p.arm.tool = p.frame(0)
    p.arm.look()
    p.machine.load.look(p.arm)


def gravity(p: Program) -> None:
    p.machine.gravity = p.doubles(0, 3)


def watchdog(p: Program) -> None:
    frequency = p.double(0)
    if not frequency > 0:
        raise ProgramError(f"rtde_set_watchdog: frequency must be positive, got {frequency:g}")
    p.machine.watchdog, p.machine.fed = (p.int_offset, 1.0 / frequency), p.machine.ticks


def teach(p: Program) -> None:
    p.machine.freedrive = np.eye(4), (1,) * 6


def freedrive(p: Program) -> None:
    p.machine.freedrive = p.frame(0), tuple(p.integer(index) for index in range(1, 7))


def freedrive_end(p: Program) -> None:
    p.machine.freedrive = None


def freedrive_status(p: Program) -> None:
    measure = p.arm.kinematics.singularity(p.arm.q)
    p.answer_integer((measure < NEAR_SINGULAR) + (measure < SINGULAR))


def protective_stop(p: Program) -> None:
    p.machine.protective_stop("asked for by the program")


def external_sensor(p: Program) -> None:
    if p.integer(1) == 1:
        raise ProgramError("external force sensors are not modelled by the mock: give the wrench by its fault client")


# -- questions -------------------------------------------------------------------------------------------------------


def joints(p: Program, first: int = 0) -> FloatArray:
    q = p.doubles(first)
    if not np.isfinite(q).all():
        raise ProgramError("joints with a number that is not finite")
    return q


def inverse(p: Program) -> None:
    p.answer(p.arm.solve(p.frame(0)))


def inverse_near(p: Program) -> None:
    p.answer(p.arm.solve(p.frame(0), joints(p, 6)))


def reaches(p: Program) -> None:
    p.answer_integer(p.arm.kinematics.inverse(p.frame(0), p.arm.target_q, p.arm.tool) is not None)


def reaches_near(p: Program) -> None:
    p.answer_integer(p.arm.kinematics.inverse(p.frame(0), joints(p, 6), p.arm.tool) is not None)


def joints_allowed(p: Program) -> None:
    p.answer_integer(bool(np.abs(p.doubles(0)).max() <= 2 * np.pi))


def compose(p: Program) -> None:
    p.answer(pose(p.frame(0) @ p.frame(6)))


def forward(p: Program) -> None:
    p.answer(pose(p.arm.kinematics.forward(joints(p), p.frame(6))))


def waypoint(p: Program) -> None:
    p.answer(pose(p.arm.target_frame if p.arm.waypoint is None else p.arm.waypoint))


def torques(p: Program) -> None:
    """What the joints bear of the load on the tool."""
    p.answer(-p.arm.kinematics.jacobian(p.arm.q, p.arm.tool).T @ p.machine.load.true)


def _answer_matrix(p: Program, values: FloatArray) -> None:
    """A 6 x 6 matrix by columns: registers 0 to 23, then 36 to 47."""
    flat = values.T.ravel().tolist()
    p.machine.out_double[:24], p.machine.out_double[36:48] = flat[:24], flat[24:]


def jacobian(p: Program) -> None:
    _answer_matrix(p, p.arm.kinematics.jacobian(p.arm.q, p.arm.tool))


def jacobian_rate(p: Program) -> None:
    arm, h = p.arm, 1e-5  # central difference along the motion [s]
    before, after = (arm.kinematics.jacobian(arm.q + step * arm.qd, arm.tool) for step in (-h, h))
    _answer_matrix(p, (after - before) / (2 * h))


ANSWERS: dict[int, Callable[[Program], None]] = {
    8: zero_sensor,
    17: payload,
    18: teach,
    19: freedrive_end,
    26: lambda p: p.answer(np.array([PERIOD])),
    28: waypoint,
    29: tool,
    30: inverse_near,
    31: protective_stop,
    35: watchdog,
    36: reaches,
    37: joints_allowed,
    38: torques,
    39: compose,
    40: lambda p: p.answer(pose(p.arm.tool)),
    43: lambda p: p.answer(pose(p.arm.target_frame)),
    44: forward,
    46: inverse,
    47: lambda p: p.answer_integer(p.machine.steady),
    52: freedrive,
    53: freedrive_end,
    54: freedrive_status,
    56: external_sensor,
    57: external_sensor,
    58: lambda p: p.answer(pose(p.arm.kinematics.forward(p.arm.q))),
    59: gravity,
    60: reaches,
    61: reaches_near,
    65: target_payload,
    69: lambda p: p.answer(p.arm.target_qdd),
    70: jacobian,
    71: jacobian_rate,
}
