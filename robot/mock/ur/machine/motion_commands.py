"""Commands of ur_rtde's control script that move the arm or detect a contact.

Commands without a valid model end the program with a line in the log, like a run-time error on a controller: direct
torque, mass matrix, Coriolis torques, external force sensors.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from itertools import takewhile

import numpy as np

from robot.common.kinematics import matrix
from robot.mock.ur.machine import motion
from robot.mock.ur.machine.arm import PERIOD, MotionSteps, ProgramError
from robot.mock.ur.machine.forces import ForceMode
from robot.mock.ur.machine.motion import Waypoint
from robot.mock.ur.machine.program import MAX_NUMBER, Program, command
from tacsim.interface import FloatArray

CONTACT_FOUND = 254  # the script sets it itself

_MOVE = re.compile(r"(movej|movel|movep)\((p?)\[([^\]]*)\],\s*a=([^,]+),\s*v=([^,]+)(?:,\s*r=([^,)]+))?\)")
_PROGRESS = re.compile(r"signal_async_progress\((\d{1,9})\)")

# -- moves -----------------------------------------------------------------------------------------------------------


def _move(number: int, motion_of: Callable[[Program], MotionSteps]) -> None:
    """Registers a move: the script waits for its end, unless the client requests it to be asynchronous."""

    @command(number)
    def move(p: Program) -> MotionSteps:
        steps = motion_of(p)
        p.kill("move")
        if p.integer(1) == 1:
            p.run("move", steps, tracked=True)
        else:
            yield from steps


def _frame_at(p: Program, q: FloatArray) -> FloatArray:
    """The frame of the TCP (4, 4) at joints q."""
    return p.arm.kinematics.forward(q, p.arm.tool)


def _parse_numbers(texts: Sequence[str | None], count: int) -> FloatArray:
    """Numbers of a line of a path; missing numbers are 0."""
    try:
        values = np.array([float(text or 0) for text in texts])
    except ValueError:
        values = np.array([])
    if len(values) != count or not float(np.abs(values).max()) <= MAX_NUMBER:
        raise ProgramError(f"path: a waypoint needs six numbers, a, v and r, got {texts}"[:200])
    return values


def _follow_path(p: Program) -> MotionSteps:
    """Moves along the path in the text. Blended waypoints are one motion; progress is signalled at its start."""
    max_lines = 16  # lines of a path that are read in one control period
    lines = map(str.strip, p.text.partition("# inject move path\n")[2].splitlines())
    block = takewhile(lambda line: not line.startswith("end"), lines)
    waiting: list[Waypoint] = []
    for number, line in enumerate(filter(None, block), 1):
        if number % max_lines == 0:
            yield
        if progress := _PROGRESS.fullmatch(line):
            p.signal(int(progress.group(1)))
            continue
        move = _MOVE.fullmatch(line)
        if move is None:
            raise ProgramError(f"path: the mock does not know '{line[:80]}'")
        kind, is_pose, numbers, *rest = move.groups()
        target, (acceleration, speed, blend) = _parse_numbers(numbers.split(","), 6), _parse_numbers(rest, 3)
        if kind == "movej":
            yield from motion.path(p.arm, waiting)
            waiting = []
            yield from motion.movej(p.arm, p.arm.solve(matrix(target)) if is_pose else target, acceleration, speed)
            continue
        frame = matrix(target) if is_pose else _frame_at(p, target)
        waiting.append(Waypoint(frame, acceleration, speed, blend))
        if blend <= 0:
            yield from motion.path(p.arm, waiting)
            waiting = []
    yield from motion.path(p.arm, waiting)


_move(1, lambda p: motion.movej(p.arm, p.doubles(0), p.double(7), p.double(6)))
_move(2, lambda p: motion.movej(p.arm, p.arm.solve(p.frame(0)), p.double(7), p.double(6)))
_move(3, lambda p: motion.movel(p.arm, p.frame(0), p.double(7), p.double(6)))
_move(4, lambda p: motion.movel(p.arm, _frame_at(p, p.doubles(0)), p.double(7), p.double(6)))
_move(45, _follow_path)


@command(33, 34)
def stop(p: Program) -> MotionSteps:
    """stopL and stopJ. As in the script: stopj before the first asynchronous stop, stopl after it."""
    if not p.kill("stop"):
        p.kill("move")
    if p.integer(1) == 1:
        p.stops_linear = True
        p.run("stop", motion.stopl(p.arm, p.double(0)), tracked=True)
    else:
        yield from (motion.stopl if p.stops_linear else motion.stopj)(p.arm, p.double(0))


# -- servo, speed, force, jog ----------------------------------------------------------------------------------------


@command(11, every_cycle=True)
def servoj(p: Program) -> None:
    _servo(p, p.doubles(0))


@command(24, every_cycle=True)
def servol(p: Program) -> None:
    requested = tuple(p.doubles(0).tolist())
    if p.servo_target is None or p.servo_target[0] != requested:
        p.servo_target = requested, p.arm.solve(p.frame(0))
    _servo(p, p.servo_target[1])


def _servo(p: Program, q: FloatArray) -> None:
    time, lookahead = p.double(8), p.double(9)
    p.repeat("servo", lambda: motion.servoj(p.arm, q, time, lookahead))


@command(12)
def servoc(p: Program) -> None:
    goal, acceleration, speed = p.frame(0), p.double(7), p.double(6)
    p.repeat("servoc", lambda: motion.servoc(p.arm, goal, acceleration, speed))


@command(16)
def servo_stop(p: Program) -> MotionSteps:
    p.kill("servo")
    p.kill("servoc")
    p.servo_target = None
    return motion.stopl(p.arm, p.double(0))


@command(9, every_cycle=True)
def speedj(p: Program) -> None:
    qd, acceleration, time, p.speeds_linear = p.doubles(0), p.double(6), p.double(7), False
    p.repeat("speed", lambda: motion.speedj(p.arm, qd, acceleration, time))


@command(10, every_cycle=True)
def speedl(p: Program) -> None:
    twist, acceleration, time, p.speeds_linear = p.doubles(0), p.double(6), p.double(7), True
    p.repeat("speed", lambda: motion.speedl(p.arm, twist, acceleration, time))


@command(15)
def speed_stop(p: Program) -> MotionSteps:
    p.kill("speed")
    return (motion.stopl if p.speeds_linear else motion.stopj)(p.arm, p.double(0))


@command(6, every_cycle=True)
def force_begin(p: Program) -> None:
    kind, free = p.integer(1), np.array([p.integer(index) != 0 for index in range(2, 8)])
    wrench, limits = p.doubles(6), np.abs(p.doubles(12))
    if kind not in (1, 2, 3) or not np.isfinite([wrench, limits]).all():
        raise ProgramError(f"force_mode: type {kind}, wrench {wrench.tolist()}, limits {limits.tolist()}")
    made = ForceMode(kind, p.frame(0), free, wrench, limits, p.force_gain, p.force_damping)
    if p.machine.force_mode is not None:
        made.twist, made.turn = p.machine.force_mode.twist, p.machine.force_mode.turn
    p.machine.force_mode = made


@command(7)
def force_end(p: Program) -> MotionSteps:
    p.machine.end_force_mode()
    return motion.stopl(p.arm, 10.0)


@command(20, needs="force_mode_set_damping(")
def force_damping(p: Program) -> None:
    p.force_damping = _require_within(p.double(0), 1.0, "force_mode_set_damping")


@command(21, needs="force_mode_set_gain_scaling(")
def force_gain(p: Program) -> None:
    p.force_gain = _require_within(p.double(0), 2.0, "force_mode_set_gain_scaling")


def _require_within(value: float, high: float, call: str) -> float:
    if not 0 <= value <= high:
        raise ProgramError(f"{call}: {value:g} is not within 0 and {high:g}")
    return value


@command(41)
def jog_start(p: Program) -> None:
    speed, feature, acceleration, custom = p.doubles(0), int(p.double(6)), p.double(7), p.frame(8)
    if feature not in (0, 1, 2):
        raise ProgramError(f"jog: feature {feature} is none of 0 (base), 1 (tool), 2 (custom)")

    def jog() -> MotionSteps:
        turn = (np.eye(3), p.arm.frame[:3, :3], custom[:3, :3])[feature]
        twist = np.concatenate([turn @ speed[:3], turn @ speed[3:]])
        return motion.speedl(p.arm, twist, acceleration, 0.01)

    p.repeat("jog", jog)


@command(42)
def jog_stop(p: Program) -> MotionSteps | None:
    return motion.stopl(p.arm, 1.2) if p.kill("jog") else None


# -- contact ---------------------------------------------------------------------------------------------------------


def _steps_since_contact(p: Program, direction: FloatArray) -> int:
    """tool_contact(): control periods since the contact against `direction` (3,) began; 0 without contact."""
    contact_force, onset_force = 5.0, 1.0  # a contact is detected above the first force, and began at the second [N]
    size = float(np.linalg.norm(direction[:3]))

    def against(force: FloatArray) -> float:
        return float(np.linalg.norm(force[:3])) if size == 0 else -float(force[:3] @ direction[:3]) / size

    history = p.machine.load.history
    if not history or against(history[-1]) < contact_force:
        return 0
    steps = 0
    for force in reversed(history):
        if against(force) < onset_force:
            break
        steps += 1
    return steps


def _past_joints(p: Program, steps: int) -> FloatArray:
    history = p.arm.history
    if not 0 <= steps < len(history):
        raise ProgramError(f"joint positions {steps} steps ago are not stored, only {len(history)}")
    return history[-1 - steps]


@command(25, needs="tool_contact(", every_cycle=True)
def tool_contact(p: Program) -> None:
    p.answer_integer(_steps_since_contact(p, p.doubles(0)))


@command(27, needs="get_actual_joint_positions_history(", every_cycle=True)
def joint_history(p: Program) -> None:
    p.answer(_past_joints(p, p.integer(1)))


def _return_to_contact(p: Program, steps: int) -> MotionSteps:
    q = _past_joints(p, steps)
    yield from motion.stopl(p.arm, 3.0)
    yield from motion.movel(p.arm, _frame_at(p, q), 1.2, 0.25)


@command(51, needs="tool_contact(")
def move_until_contact(p: Program) -> MotionSteps:
    speed, direction, acceleration = p.doubles(0), p.doubles(6), p.double(12)
    while (steps := _steps_since_contact(p, direction)) == 0:
        yield from motion.speedl(p.arm, speed, acceleration, PERIOD)
    yield from _return_to_contact(p, steps)


@command(62, needs="tool_contact(")
def contact_start(p: Program) -> None:
    direction = p.doubles(0)
    p.kill("contact")

    def steps() -> int:
        # the script's own test of "no direction given": the sum of the vector
        return _steps_since_contact(p, p.arm.target_twist if direction.sum() < 1e-10 else direction)

    def wait() -> MotionSteps:
        while steps() > 0:
            yield
        while steps() == 0:
            yield
        p.contact_steps, p.internal = steps(), CONTACT_FOUND

    p.contact_steps = 0
    p.run("contact", wait())


@command(63)
def contact_stop(p: Program) -> None:
    p.kill("contact")
    contact_read(p)


@command(64)
def contact_read(p: Program) -> None:
    p.answer_integer(p.contact_steps)


@command(CONTACT_FOUND)
def contact_found(p: Program) -> MotionSteps:
    p.kill("move")
    return _return_to_contact(p, p.contact_steps)


def _refuse(number: int, call: str) -> None:
    @command(number, needs=f"{call}(", every_cycle=True)
    def refuse(p: Program) -> None:
        raise ProgramError(f"{call} is not modelled by the mock")


_refuse(66, "direct_torque")
_refuse(67, "get_mass_matrix")
_refuse(68, "get_coriolis_and_centrifugal_torques")
