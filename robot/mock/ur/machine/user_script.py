"""Programs of a user: a list of calls with numbers, which run one after the other.

    def open_gripper():
      set_tool_digital_out(0, True)
      sleep(0.5)
    end

Variables, conditions, loops, threads and functions are not supported. The mock runs no part of a program with any other
line. Like a controller that cannot compile a program, it reports the line, in a controller's words (CompileError).
"""

from __future__ import annotations

import ast
import operator
import re
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from robot.common.kinematics import matrix
from robot.mock.ur.machine import motion
from robot.mock.ur.machine.arm import PERIOD, MotionSteps, ProgramError
from robot.mock.ur.machine.forces import Mass
from robot.mock.ur.machine.program import MAX_NUMBER, Program
from tacsim.interface import FloatArray

CALLS: dict[str, Callable[..., MotionSteps | None]] = {}
_SUMS: dict[type, Callable[[float, float], float]] = {ast.Add: operator.add, ast.Sub: operator.sub}


class CompileError(ProgramError):
    """A program that cannot be compiled: the reason in a controller's words; line and column, from 1."""

    def __init__(self, reason: str, text: str, line: int) -> None:
        super().__init__(
            f"{reason}:{text.rstrip()[:80]}: line {line}; the mock runs ur_rtde's control script, and lists of calls "
            f"with numbers: {', '.join(CALLS)}"
        )
        self.line, self.column = line, len(text) - len(text.lstrip()) + 1


class Pose(tuple[float, ...]):
    """p[...] of URScript, a pose; a list contains joints."""


def parse_calls(text: str) -> list[tuple[str, list[Any], dict[str, Any]]]:
    """The calls of a program: names and arguments. Raises CompileError for the first line that is not a call."""
    max_calls = 5000  # of one program
    max_line = 1000  # characters
    found = []
    for number, line in enumerate(text.strip().splitlines(), start=1):
        words = line.partition("#")[0].strip()
        if not words or words == "end" or re.fullmatch(r"def\s+\w+\s*\(\s*\)\s*:", words):
            continue
        try:
            if len(words) > max_line:
                raise ValueError
            call = ast.parse(words, mode="eval").body
            if not isinstance(call, ast.Call) or not isinstance(call.func, ast.Name):
                raise ValueError
            if call.func.id not in CALLS:
                raise CompileError(f"compile_error_name_not_found:{call.func.id}", line, number)
            named = {each.arg or "": _parse_value(each.value) for each in call.keywords}
            found.append((call.func.id, [_parse_value(each) for each in call.args], named))
            if len(found) > max_calls:
                raise CompileError(f"compile_error: more than {max_calls} calls", line, number)
        except (SyntaxError, ValueError, TypeError, OverflowError, RecursionError, MemoryError):
            raise CompileError(f"syntax_error_on_line:{number}", line, number) from None
    return found


def run(program: Program) -> MotionSteps:
    """Runs the calls of the program. Raises ProgramError at once if it cannot be compiled."""
    max_burst = 16  # calls without motion in one control period
    calls = parse_calls(program.text)

    def steps() -> MotionSteps:
        for number, (name, arguments, named) in enumerate(calls, start=1):
            if number % max_burst == 0:
                yield
            try:
                yield from CALLS[name](program, *arguments, **named) or ()
            except (TypeError, ValueError, IndexError) as error:
                raise ProgramError(f"{name}: {error}") from None

    return steps()


def _parse_value(node: ast.expr) -> Any:
    match node:
        case ast.Constant(value=str() as text):
            return text
        case ast.List():
            return [_parse_number(each) for each in node.elts]
        case ast.Subscript(value=ast.Name(id="p"), slice=ast.Tuple() as numbers):
            return Pose(_parse_number(each) for each in numbers.elts)
    return _parse_number(node)


def _parse_number(node: ast.expr) -> float:
    match node:
        case ast.Constant(value=bool() | int() | float() as value) if abs(value) <= MAX_NUMBER:
            return value
        case ast.UnaryOp(op=ast.USub()):
            return -_parse_number(node.operand)
        case ast.BinOp() if type(node.op) in _SUMS:
            return _SUMS[type(node.op)](_parse_number(node.left), _parse_number(node.right))
    raise ValueError


# -- calls -----------------------------------------------------------------------------------------------------------


def _register_call(work: Callable[..., MotionSteps | None]) -> Callable[..., MotionSteps | None]:
    CALLS[work.__name__] = work
    return work


def _six_numbers(values: list[float] | Pose) -> FloatArray:
    if len(values) != 6:
        raise ValueError(f"needs six numbers, got {len(values)}")
    return np.array(values)


@_register_call
def movej(p: Program, to: list[float] | Pose, a: float = 1.4, v: float = 1.05) -> MotionSteps:
    q = p.arm.solve(matrix(_six_numbers(to))) if isinstance(to, Pose) else _six_numbers(to)
    return motion.movej(p.arm, q, float(a), float(v))


@_register_call
def movel(p: Program, to: list[float] | Pose, a: float = 1.2, v: float = 0.25) -> MotionSteps:
    frame = matrix(_six_numbers(to)) if isinstance(to, Pose) else p.arm.kinematics.forward(_six_numbers(to), p.arm.tool)
    return motion.movel(p.arm, frame, float(a), float(v))


@_register_call
def stopj(p: Program, a: float) -> MotionSteps:
    return motion.stopj(p.arm, float(a))


@_register_call
def stopl(p: Program, a: float) -> MotionSteps:
    return motion.stopl(p.arm, float(a))


@_register_call
def sleep(p: Program, t: float) -> Iterator[None]:
    for _ in range(round(float(t) / PERIOD)):
        yield


@_register_call
def sync(p: Program) -> Iterator[None]:
    yield


@_register_call
def textmsg(p: Program, *texts: object) -> None:
    p.machine.write_log("textmsg: " + "".join(map(str, texts)))


@_register_call
def zero_ftsensor(p: Program) -> None:
    p.machine.load.zero(p.arm)


@_register_call
def set_tcp(p: Program, pose: Pose) -> None:
    p.arm.tool = matrix(_six_numbers(pose))
    p.arm.update()


@_register_call
def set_payload(p: Program, m: float, cog: list[float] | None = None) -> None:
    if m < 0:
        raise ValueError(f"mass {m:g} kg")
    p.machine.load.configured_payload = Mass.of(
        [m, *(p.machine.load.configured_payload.centre if cog is None else cog)]
    )


def _set_output(first: int, count: int) -> Callable[[Program, int, bool], None]:
    def work(p: Program, n: int, b: bool) -> None:
        if not 0 <= int(n) < count:
            raise ValueError(f"output {n} is not within 0 and {count - 1}")
        bit, outputs = 1 << (first + int(n)), p.machine.outputs
        outputs.digital = outputs.digital | bit if b else outputs.digital & ~bit

    return work


for _kind, _first, _count in (("standard", 0, 8), ("configurable", 8, 8), ("tool", 16, 2)):
    CALLS[f"set_{_kind}_digital_out"] = _set_output(_first, _count)


@_register_call
def write_output_integer_register(p: Program, address: int, value: int) -> None:
    p.machine.out_int[_register_number(p, address)] = int(value)


@_register_call
def write_output_float_register(p: Program, address: int, value: float) -> None:
    p.machine.out_double[_register_number(p, address)] = float(value)


def _register_number(p: Program, address: int) -> int:
    if not 0 <= int(address) < len(p.machine.out_int):
        raise ValueError(f"no register {address}")
    return int(address)
