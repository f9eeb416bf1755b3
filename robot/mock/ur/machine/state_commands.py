"""Commands of ur_rtde's control script that set or read values; none of them moves the arm."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from robot.common.kinematics import pose
from robot.mock.ur.machine.arm import PERIOD, ProgramError
from robot.mock.ur.machine.forces import MAX_PAYLOAD, Mass
from robot.mock.ur.machine.program import Program, command
from tacsim.interface import FloatArray

# -- settings --------------------------------------------------------------------------------------------------------


@command(8)
def zero_sensor(p: Program) -> None:
    p.machine.load.zero(p.arm)


@command(17)
def payload(p: Program) -> None:
    """A centre of gravity of zeros keeps the previous one, as in the script."""
    mass, centre, load = p.double(0), p.doubles(1, 3), p.machine.load
    if not (0 <= mass <= MAX_PAYLOAD and np.abs(centre).max() <= MAX_PAYLOAD):
        raise ProgramError(f"set_payload: mass {mass:g} kg, centre {centre.tolist()} m")
    load.configured_payload = Mass.of([mass, *(centre if centre.any() else load.configured_payload.centre)])


@command(65, needs="set_target_payload(")
def target_payload(p: Program) -> None:
    payload(p)
    p.machine.load.inertia = p.doubles(4)


@command(29)
def tool(p: Program) -> None:
    p.arm.tool = p.frame(0)
    p.arm.update()
    p.machine.load.update(p.arm)


@command(59)
def gravity(p: Program) -> None:
    max_gravity = 100.0  # of set_gravity [m/s^2]
    towards = p.doubles(0, 3)
    if np.abs(towards).max() > max_gravity:
        raise ProgramError(f"set_gravity: {towards.tolist()} m/s^2")
    p.machine.load.gravity = towards


@command(35)
def watchdog(p: Program) -> None:
    frequency = p.double(0)
    if not frequency > 0:
        raise ProgramError(f"rtde_set_watchdog: frequency must be positive, got {frequency:g}")
    p.machine.watchdog, p.machine.watchdog_reset = (p.int_offset, 1.0 / frequency), p.machine.ticks


@command(18)
def teach(p: Program) -> None:
    p.machine.freedrive = np.eye(4), (1,) * 6


@command(52, needs="freedrive_mode(")
def freedrive(p: Program) -> None:
    p.machine.freedrive = p.frame(0), tuple(p.integer(index) for index in range(1, 7))


@command(19)
@command(53, needs="end_freedrive_mode(")
def freedrive_end(p: Program) -> None:
    p.machine.freedrive = None


@command(31, needs="protective_stop()")
def protective_stop(p: Program) -> None:
    p.machine.protective_stop("requested by the program")


@command(56, 57)
def external_sensor(p: Program) -> None:
    if p.integer(1) == 1:
        raise ProgramError("external force sensors are not modelled by the mock: give the wrench by its fault client")


# -- queries ---------------------------------------------------------------------------------------------------------


def _has_solution(p: Program, seed: FloatArray) -> bool:
    return p.arm.kinematics.inverse(p.frame(0), seed, p.arm.tool) is not None


def _freedrive_status(p: Program) -> int:
    near_singular, fully_singular = 0.05, 0.02  # of Kinematics.singularity, for get_freedrive_status
    measure = p.arm.kinematics.singularity(p.arm.q)
    return (measure < near_singular) + (measure < fully_singular)


def _query(
    *numbers: int, read: Callable[[Program], FloatArray | int], needs: str = "", every_cycle: bool = False
) -> None:
    """Registers a command that answers with the result of `read`: numbers, or one integer."""

    @command(*numbers, needs=needs, every_cycle=every_cycle)
    def work(p: Program) -> None:
        value = read(p)
        p.answer(value) if isinstance(value, np.ndarray) else p.answer_integer(value)


_query(46, read=lambda p: p.arm.solve(p.frame(0)))
_query(30, read=lambda p: p.arm.solve(p.frame(0), p.doubles(6)))
_query(36, read=lambda p: _has_solution(p, p.arm.target_q))
_query(60, read=lambda p: _has_solution(p, p.arm.target_q), needs="get_inverse_kin_has_solution(")
_query(61, read=lambda p: _has_solution(p, p.doubles(6)), needs="get_inverse_kin_has_solution(")
_query(37, read=lambda p: bool(np.abs(p.doubles(0)).max() <= 2 * np.pi))
_query(39, read=lambda p: pose(p.frame(0) @ p.frame(6)))
_query(44, read=lambda p: pose(p.arm.kinematics.forward(p.doubles(0), p.frame(6))))
_query(40, read=lambda p: pose(p.arm.tool), needs="get_tcp_offset(")
_query(43, read=lambda p: pose(p.arm.target_frame))
_query(58, read=lambda p: pose(p.arm.kinematics.forward(p.arm.q)), every_cycle=True)
_query(
    28,
    read=lambda p: pose(p.arm.target_frame if p.arm.waypoint is None else p.arm.waypoint),
    needs="get_target_waypoint(",
)
_query(47, read=lambda p: p.machine.steady)
_query(54, read=_freedrive_status, needs="get_freedrive_status(")
_query(26, read=lambda p: np.array([PERIOD]), needs="get_steptime(", every_cycle=True)
_query(69, read=lambda p: p.arm.target_qdd, needs="get_target_joint_accelerations(", every_cycle=True)


@command(38, every_cycle=True)
def torques(p: Program) -> None:
    """Joint torques from the load on the tool, without the configured payload [N m]."""
    p.answer(-p.arm.kinematics.jacobian(p.arm.q, p.arm.tool).T @ p.machine.load.unexplained)


def _answer_matrix(p: Program, values: FloatArray) -> None:
    """A 6 x 6 matrix by columns: registers 0 to 23, then 36 to 47."""
    flat = values.T.ravel().tolist()
    p.machine.out_double[:24], p.machine.out_double[36:48] = flat[:24], flat[24:]


@command(70, needs="get_jacobian(", every_cycle=True)
def jacobian(p: Program) -> None:
    _answer_matrix(p, p.arm.kinematics.jacobian(p.arm.q, p.arm.tool))


@command(71, needs="get_jacobian_time_derivative(", every_cycle=True)
def jacobian_rate(p: Program) -> None:
    arm, h = p.arm, 1e-5  # central difference along the motion [s]
    before, after = (arm.kinematics.jacobian(arm.q + step * arm.qd, arm.tool) for step in (-h, h))
    _answer_matrix(p, (after - before) / (2 * h))
