"""The commands of ur_rtde's control script by their numbers, those that move first.

Whatever has no sound model ends the program with a line in the log, as a run-time error does on a controller: direct
torque, mass matrix, Coriolis torques, external force sensors, force modes 1 and 3, motion during force mode.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from robot.common.kinematics import matrix
from robot.mock.ur.machine import motion
from robot.mock.ur.machine.answers import ANSWERS, joints
from robot.mock.ur.machine.arm import PERIOD, Motion, ProgramError
from robot.mock.ur.machine.motion import Waypoint
from tacsim.interface import FloatArray

if TYPE_CHECKING:
    from robot.mock.ur.machine.script import Program

# Commands that the script takes up in every cycle; all others once, until the client writes 0.
REALTIME = frozenset({6, 9, 10, 11, 24, 25, 26, 27, 38, 58, 66, 67, 68, 69, 70, 71})
CONTACT_FOUND = 254  # the script gives it itself

# Calls that older controllers lack: without them in the text, the command does nothing.
NEEDS = {
    20: "force_mode_set_damping(",
    21: "force_mode_set_gain_scaling(",
    25: "tool_contact(",
    26: "get_steptime(",
    27: "get_actual_joint_positions_history(",
    28: "get_target_waypoint(",
    31: "protective_stop()",
    40: "get_tcp_offset(",
    51: "tool_contact(",
    52: "freedrive_mode(",
    53: "end_freedrive_mode(",
    54: "get_freedrive_status(",
    60: "get_inverse_kin_has_solution(",
    61: "get_inverse_kin_has_solution(",
    62: "tool_contact(",
    66: "direct_torque(",
    67: "get_mass_matrix(",
    68: "get_coriolis_and_centrifugal_torques(",
    69: "get_target_joint_accelerations(",
    70: "get_jacobian(",
    71: "get_jacobian_time_derivative(",
}
NOT_MODELLED = {66: "direct_torque", 67: "get_mass_matrix", 68: "get_coriolis_and_centrifugal_torques"}
CONTACT_FORCE, CONTACT_ONSET = 5.0, 1.0  # a contact is felt from the one, and began at the other [N]

_MOVE = re.compile(r"(movej|movel|movep)\((p?)\[([^\]]*)\],\s*a=([^,]+),\s*v=([^,]+)(?:,\s*r=([^,)]+))?\)")
_PROGRESS = re.compile(r"signal_async_progress\((\d+)\)")

# -- moves -----------------------------------------------------------------------------------------------------------


def _move(p: Program, work: Motion) -> Motion:
    p.kill("move")
    if p.integer(1) == 1:
        p.run("move", work, tracked=True)
    else:
        yield from work


def movej(p: Program) -> Motion:
    return _move(p, motion.movej(p.arm, p.doubles(0), p.double(7), p.double(6)))


def movej_ik(p: Program) -> Motion:
    return _move(p, motion.movej(p.arm, p.arm.solve(p.frame(0)), p.double(7), p.double(6)))


def movel(p: Program) -> Motion:
    return _move(p, motion.movel(p.arm, p.frame(0), p.double(7), p.double(6)))


def movel_fk(p: Program) -> Motion:
    goal = p.arm.kinematics.forward(joints(p), p.arm.tool)
    return _move(p, motion.movel(p.arm, goal, p.double(7), p.double(6)))


def move_path(p: Program) -> Motion:
    return _move(p, _path(p))


def _path(p: Program) -> Motion:
    """The path in the text. Blended waypoints are one motion; their progress is signalled when it begins."""
    block = re.search(r"# inject move path\n(.*?)\n\s*end", p.text, re.S)
    waiting: list[Waypoint] = []
    for line in filter(None, map(str.strip, block.group(1).splitlines() if block else ())):
        if progress := _PROGRESS.fullmatch(line):
            p.signal(int(progress.group(1)))
            continue
        move = _MOVE.fullmatch(line)
        if move is None:
            raise ProgramError(f"path: the mock does not know '{line}'")
        kind, is_pose, numbers, *rest = move.groups()
        target = np.array([float(number) for number in numbers.split(",")])
        acceleration, speed, blend = (float(number or 0) for number in rest)
        if kind == "movej":
            yield from motion.path(p.arm, waiting)
            waiting = []
            yield from motion.movej(p.arm, p.arm.solve(matrix(target)) if is_pose else target, acceleration, speed)
            continue
        frame = matrix(target) if is_pose else p.arm.kinematics.forward(target, p.arm.tool)
        waiting.append(Waypoint(frame, acceleration, speed, blend))
        if blend <= 0:
            yield from motion.path(p.arm, waiting)
            waiting = []
    yield from motion.path(p.arm, waiting)


def stop(p: Program) -> Motion:
    """stopL and stopJ. As in the script: stopj until a first asynchronous stop, stopl ever after."""
    if not p.kill("stop"):
        p.kill("move")
    if p.integer(1) == 1:
        p.stops_linear = True
        p.run("stop", motion.stopl(p.arm, p.double(0)), tracked=True)
    else:
        yield from (motion.stopl if p.stops_linear else motion.stopj)(p.arm, p.double(0))


# -- servo, speed, force, jog ----------------------------------------------------------------------------------------


def servoj(p: Program) -> None:
    _servo(p, p.doubles(0))


def servol(p: Program) -> None:
    asked = tuple(p.doubles(0).tolist())
    if p.servo_target is None or p.servo_target[0] != asked:
        p.servo_target = asked, p.arm.solve(p.frame(0))
    _servo(p, p.servo_target[1])


def _servo(p: Program, q: FloatArray) -> None:
    time, lookahead = p.double(8), p.double(9)
    p.repeat("servo", lambda: motion.servoj(p.arm, q, time, lookahead))


def servoc(p: Program) -> None:
    goal, acceleration, speed = p.frame(0), p.double(7), p.double(6)
    p.repeat("servoc", lambda: motion.servoc(p.arm, goal, acceleration, speed))


def servo_stop(p: Program) -> Motion:
    p.kill("servo")
    p.kill("servoc")
    p.servo_target = None
    return motion.stopl(p.arm, p.double(0))


def speedj(p: Program) -> None:
    qd, acceleration, time, p.speeds_linear = p.doubles(0), p.double(6), p.double(7), False
    p.repeat("speed", lambda: motion.speedj(p.arm, qd, acceleration, time))


def speedl(p: Program) -> None:
    twist, acceleration, time, p.speeds_linear = p.doubles(0), p.double(6), p.double(7), True
    p.repeat("speed", lambda: motion.speedl(p.arm, twist, acceleration, time))


def speed_stop(p: Program) -> Motion:
    p.kill("speed")
    return (motion.stopl if p.speeds_linear else motion.stopj)(p.arm, p.double(0))


def force(p: Program) -> None:
    kind = p.integer(1)
    if kind != 2:
        raise ProgramError(f"force_mode of type {kind} is not modelled by the mock, only type 2")
    frame, selection = p.frame(0), [p.integer(index) for index in range(2, 8)]
    turn, wrench, limits = frame[:3, :3], p.doubles(6), np.abs(p.doubles(12))
    wanted = np.concatenate([turn @ wrench[:3], turn @ wrench[3:]])

    def comply() -> Motion:
        if p.arm.commanded:
            raise ProgramError("motion during force_mode is not modelled by the mock")
        motion.admit(p.arm, frame, selection, (wanted + p.machine.load.felt) / motion.FORCE_DAMPING, limits)
        yield

    p.repeat("force", comply)


def force_stop(p: Program) -> Motion:
    p.kill("force")
    return motion.stopl(p.arm, 10.0)


def force_damping(p: Program) -> None:
    _within(p.double(0), 1.0, "force_mode_set_damping")


def force_gain(p: Program) -> None:
    _within(p.double(0), 2.0, "force_mode_set_gain_scaling")


def _within(value: float, most: float, call: str) -> None:
    if not 0 <= value <= most:
        raise ProgramError(f"{call}: {value:g} is not within 0 and {most:g}")


def jog_start(p: Program) -> None:
    speed, feature, acceleration, custom = p.doubles(0), int(p.double(6)), p.double(7), p.frame(8)
    if feature not in (0, 1, 2):
        raise ProgramError(f"jog: feature {feature} is none of 0 (base), 1 (tool), 2 (custom)")

    def jog() -> Motion:
        turn = (np.eye(3), p.arm.frame[:3, :3], custom[:3, :3])[feature]
        twist = np.concatenate([turn @ speed[:3], turn @ speed[3:]])
        return motion.speedl(p.arm, twist, acceleration, 0.01)

    p.repeat("jog", jog)


def jog_stop(p: Program) -> Motion | None:
    return motion.stopl(p.arm, 1.2) if p.kill("jog") else None


# -- contact ---------------------------------------------------------------------------------------------------------


def _steps_since_contact(p: Program, direction: FloatArray) -> int:
    """tool_contact(): periods since the contact against `direction` (3,) began; 0 without contact."""
    size = float(np.linalg.norm(direction[:3]))

    def against(force: FloatArray) -> float:
        return float(np.linalg.norm(force[:3])) if size == 0 else -float(force[:3] @ direction[:3]) / size

    history = p.machine.load.history
    if not history or against(history[-1]) < CONTACT_FORCE:
        return 0
    steps = 0
    for felt in reversed(history):
        if against(felt) < CONTACT_ONSET:
            break
        steps += 1
    return steps


def _past_joints(p: Program, steps: int) -> FloatArray:
    history = p.arm.history
    if not 0 <= steps < len(history):
        raise ProgramError(f"joint positions {steps} steps ago are not kept, only {len(history)}")
    return history[-1 - steps]


def tool_contact(p: Program) -> None:
    p.answer_integer(_steps_since_contact(p, p.doubles(0)))


def joint_history(p: Program) -> None:
    p.answer(_past_joints(p, p.integer(1)))


def _return_to_contact(p: Program, steps: int) -> Motion:
    q = _past_joints(p, steps)
    yield from motion.stopl(p.arm, 3.0)
    yield from motion.movel(p.arm, p.arm.kinematics.forward(q, p.arm.tool), 1.2, 0.25)


def move_until_contact(p: Program) -> Motion:
    speed, direction, acceleration = p.doubles(0), p.doubles(6), p.double(12)
    while (steps := _steps_since_contact(p, direction)) == 0:
        yield from motion.speedl(p.arm, speed, acceleration, PERIOD)
    yield from _return_to_contact(p, steps)


def contact_start(p: Program) -> None:
    direction = p.doubles(0)
    p.kill("contact")

    def steps() -> int:
        # the script's own test of "no direction given": the sum of the vector
        return _steps_since_contact(p, p.arm.target_twist if direction.sum() < 1e-10 else direction)

    def wait() -> Motion:
        while steps() > 0:
            yield
        while steps() == 0:
            yield
        p.contact_steps, p.internal = steps(), CONTACT_FOUND

    p.contact_steps = 0
    p.run("contact", wait())


def contact_stop(p: Program) -> None:
    p.kill("contact")
    contact_read(p)


def contact_read(p: Program) -> None:
    p.answer_integer(p.contact_steps)


def contact_found(p: Program) -> Motion:
    p.kill("move")
    return _return_to_contact(p, p.contact_steps)


COMMANDS: dict[int, Callable[[Program], Motion | None]] = {
    **ANSWERS,
    1: movej,
    2: movej_ik,
    3: movel,
    4: movel_fk,
    6: force,
    7: force_stop,
    9: speedj,
    10: speedl,
    11: servoj,
    12: servoc,
    15: speed_stop,
    16: servo_stop,
    20: force_damping,
    21: force_gain,
    24: servol,
    25: tool_contact,
    27: joint_history,
    33: stop,
    34: stop,
    41: jog_start,
    42: jog_stop,
    45: move_path,
    51: move_until_contact,
    62: contact_start,
    63: contact_stop,
    64: contact_read,
    CONTACT_FOUND: contact_found,
}
