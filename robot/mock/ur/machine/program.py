"""A program that runs on the robot: its text, its registers, its threads; and the commands of ur_rtde's control script
(ur_rtde 1.6.5), by the number that the client writes."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np

from robot.common.kinematics import matrix
from robot.mock.ur.machine.arm import Arm, MotionSteps, ProgramError
from robot.mock.ur.machine.state import MachineState
from tacsim.interface import FloatArray

CONTROL_SCRIPT = "rtde_control"
READY, DONE = 1, 2  # answers in output_int_register_0
MAX_NUMBER = 1e6  # maximum of a number in a command; the limit of a controller is unknown, and no arm needs more [SI]
_ENDED = object()


class Program:
    """One program. `step` is one control period. `machine.make_program` sets `main`."""

    def __init__(self, machine: MachineState, text: str) -> None:
        self.machine: MachineState = machine
        self.arm: Arm = machine.arm
        self.text = _filter_by_version(text, machine.version)
        named = re.search(r"^[ \t]*(def|sec)[ \t]+(\w+)", self.text, re.M)
        self.kind, self.name = named.groups() if named else ("", "?")
        self.int_offset, self.float_offset = (self._offset(kind) for kind in ("int", "float"))
        self.threads: dict[str, MotionSteps] = {}
        self.calls: dict[str, Callable[[], MotionSteps]] = {}  # next motion of a repeating thread
        self.stops_linear = False  # True if stopJ and stopL run stopl: see motion_commands.stop
        self.speeds_linear = True  # True if the last speed command was speedl
        self.force_gain, self.force_damping = 0.5, 0.025  # initial values of the script
        self.internal = 0  # a command that the script sets itself
        self.contact_steps = 0
        self.servo_target: tuple[tuple[float, ...], FloatArray] | None = None  # commanded pose, its joints
        self._writes = self._operation = 0  # counters of the asynchronous word
        self.main: MotionSteps = iter(())  # main motion, in addition to the threads

    def step(self) -> None:
        """Runs the main program, then its threads. Raises ProgramError if the program ends with an error."""
        if not _advance(self.main):
            self.machine.stop("stopped by its client" if self.name == CONTROL_SCRIPT else "it has ended")
            return
        for name, thread in list(self.threads.items()):
            if self.threads.get(name) is thread and not _advance(thread):
                self.threads.pop(name, None)

    # -- registers ---------------------------------------------------------------------------------------------------

    def double(self, index: int) -> float:
        return float(self.doubles(index, 1)[0])

    def doubles(self, first: int, count: int = 6) -> FloatArray:
        """Numbers of a command (count,). Raises ProgramError for a number that is not finite or too large."""
        begin = first + self.float_offset
        values = np.array(self.machine.in_double[begin : begin + count])
        if not float(np.abs(values).max()) <= MAX_NUMBER:
            raise ProgramError(f"command with a number that is not finite, or beyond {MAX_NUMBER:g}: {values.tolist()}")
        return values

    def frame(self, first: int) -> FloatArray:
        """The pose in six registers, as frame (4, 4)."""
        return matrix(self.doubles(first))

    def integer(self, index: int) -> int:
        return self.machine.in_int[index + self.int_offset]

    def answer(self, values: FloatArray) -> None:
        begin = self.float_offset
        self.machine.out_double[begin : begin + len(values)] = values.tolist()

    def answer_integer(self, value: int, index: int = 1) -> None:
        self.machine.out_int[index + self.int_offset] = value

    def _offset(self, kind: str) -> int:
        last_offset = 24  # of the registers: ur_rtde uses the 24 of each kind that begin at 0, or at 24
        found = re.search(rf"reg_offset_{kind} = # {kind} register offset\s*(\d+)", self.text)
        offset = found.group(1) if found else "0"
        if len(offset) > 9 or int(offset) > last_offset:
            raise ProgramError(f"{kind} register offset {offset[:9]}: at most {last_offset}")
        return int(offset)

    # -- threads -----------------------------------------------------------------------------------------------------

    def run(self, name: str, work: MotionSteps, *, tracked: bool = False) -> None:
        """Starts a thread. `tracked`: the asynchronous word contains its progress."""

        def tracking() -> MotionSteps:
            self.signal(0)
            yield from work
            self.signal(-1)

        self.threads[name] = tracking() if tracked else work

    def repeat(self, name: str, call: Callable[[], MotionSteps]) -> None:
        """Makes the thread repeat `call` from its next round on; starts the thread if it does not run."""

        def rounds() -> MotionSteps:
            while True:
                yield from self.calls[name]()

        self.calls[name] = call
        if name not in self.threads:
            self.run(name, rounds())

    def kill(self, name: str) -> bool:
        """Ends a thread; returns False if it does not run."""
        killed = self.threads.pop(name, None) is not None
        if killed and name in ("move", "stop"):
            self.signal(-1)
            self.arm.waypoint = None
        return killed

    def signal(self, progress: int) -> None:
        """Writes the asynchronous word: 0 starts an operation, larger numbers are its progress, -1 its end."""
        self._writes = (self._writes + 1) % 128
        if progress == 0:
            self._operation = (self._operation + 1) % 128
        word = self._writes << 16 | self._operation << 24
        self.answer_integer(word | (min(progress, 32767) | 1 << 15 if progress >= 0 else 0), 2)


def _advance(work: MotionSteps) -> bool:
    """Runs one control period of `work`; returns False when it has ended."""
    return next(work, _ENDED) is not _ENDED


def _filter_by_version(text: str, version: tuple[int, ...]) -> str:
    """Removes lines for newer controllers. `$5.10|3.15 line` needs version 5.10, or 3.15 for major version 3."""

    @cache
    def has(needed: str) -> bool:
        minima = (tuple(int(number) for number in minimum.split(".") if number) for minimum in needed.split("|"))
        return any(minimum[:1] == version[:1] and version >= minimum for minimum in minima)

    def select_line(line: re.Match[str]) -> str:
        return line[2] if has(line[1]) else ""

    return re.sub(r"^[ \t]*\$([\d.|]{1,99})(.*)", select_line, text, flags=re.M)


Work = Callable[[Program], MotionSteps | None]


@dataclass(frozen=True)
class Command:
    work: Work
    needs: str  # a call that older controllers lack: if the script's text does not contain it, the command does nothing
    every_cycle: bool  # True: run in every cycle of the script; False: once, until the client writes 0


COMMANDS: dict[int, Command] = {}


def command(*numbers: int, needs: str = "", every_cycle: bool = False) -> Callable[[Work], Work]:
    """Registers a function in COMMANDS. Its result is a motion for which the script waits, or None."""

    def enter(work: Work) -> Work:
        COMMANDS.update(dict.fromkeys(numbers, Command(work, needs, every_cycle)))
        return work

    return enter
