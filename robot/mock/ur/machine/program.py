"""A program that runs on the robot: its text, its registers, and the threads that it has started."""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import cache

import numpy as np

from robot.common.kinematics import matrix
from robot.mock.ur.machine.arm import Arm, MotionSteps, ProgramError
from robot.mock.ur.machine.state import MachineState
from tacsim.interface import FloatArray

CONTROL_SCRIPT = "rtde_control"
READY, DONE = 1, 2  # answers in output_int_register_0
LARGEST = 1e6  # of a number in a command; what a controller takes is not known, and no arm needs more [SI]
_ENDED = object()


class Program:
    """One program. `step` is one control period. `main` is given to it by `script.make_program`."""

    def __init__(self, machine: MachineState, text: str) -> None:
        self.machine: MachineState = machine
        self.arm: Arm = machine.arm
        self.text = _of_version(text, machine.version)
        named = re.search(r"^[ \t]*(def|sec)[ \t]+(\w+)", self.text, re.M)
        self.kind, self.name = named.groups() if named else ("", "?")
        self.int_offset, self.float_offset = (self._offset(kind) for kind in ("int", "float"))
        self.threads: dict[str, MotionSteps] = {}
        self.calls: dict[str, Callable[[], MotionSteps]] = {}  # what a repeating thread does next
        self.stops_linear = False  # whether stopJ and stopL are stopl: see motion_commands.stop
        self.speeds_linear = True  # whether the last speed command was speedl
        self.force_gain, self.force_damping = 0.5, 0.025  # the script begins with these
        self.internal = 0  # a command that the script gives itself
        self.contact_steps = 0
        self.servo_target: tuple[tuple[float, ...], FloatArray] | None = None  # pose asked for, its joints
        self._writes = self._operation = 0  # of the asynchronous word
        self.main: MotionSteps = iter(())  # what it does, in addition to its threads

    def step(self) -> None:
        """Main program, then its threads. Raises ProgramError where the program ends with an error."""
        if not _go_on(self.main):
            self.machine.stop("stopped by its client" if self.name == CONTROL_SCRIPT else "it has come to its end")
            return
        for name, thread in list(self.threads.items()):
            if self.threads.get(name) is thread and not _go_on(thread):
                self.threads.pop(name, None)

    # -- registers ---------------------------------------------------------------------------------------------------

    def double(self, index: int) -> float:
        return float(self.doubles(index, 1)[0])

    def doubles(self, first: int, count: int = 6) -> FloatArray:
        """Numbers of a command (count,). Raises ProgramError for any that no arm could follow."""
        begin = first + self.float_offset
        values = np.array(self.machine.in_double[begin : begin + count])
        if not float(np.abs(values).max()) <= LARGEST:
            raise ProgramError(f"command with a number that is not finite, or beyond {LARGEST:g}: {values.tolist()}")
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
        """Starts a thread. `tracked`: its progress is in the asynchronous word."""

        def tracking() -> MotionSteps:
            self.signal(0)
            yield from work
            self.signal(-1)

        self.threads[name] = tracking() if tracked else work

    def repeat(self, name: str, call: Callable[[], MotionSteps]) -> None:
        """What the thread does for ever from its next round on; starts it where it does not run."""

        def rounds() -> MotionSteps:
            while True:
                yield from self.calls[name]()

        self.calls[name] = call
        if name not in self.threads:
            self.run(name, rounds())

    def kill(self, name: str) -> bool:
        """Ends a thread; False where it does not run."""
        killed = self.threads.pop(name, None) is not None
        if killed and name in ("move", "stop"):
            self.signal(-1)
            self.arm.waypoint = None
        return killed

    def signal(self, progress: int) -> None:
        """The asynchronous word: 0 begins an operation, more is its progress, -1 its end."""
        self._writes = (self._writes + 1) % 128
        if progress == 0:
            self._operation = (self._operation + 1) % 128
        word = self._writes << 16 | self._operation << 24
        self.answer_integer(word | (min(progress, 32767) | 1 << 15 if progress >= 0 else 0), 2)


def _go_on(work: MotionSteps) -> bool:
    """One control period of `work`; False when it has ended."""
    return next(work, _ENDED) is not _ENDED


def _of_version(text: str, version: tuple[int, ...]) -> str:
    """The text without lines for newer controllers. `$5.10|3.15 line` needs 5.10, or 3.15 of that major version."""

    @cache
    def has(needed: str) -> bool:
        leasts = (tuple(int(number) for number in least.split(".") if number) for least in needed.split("|"))
        return any(least[:1] == version[:1] and version >= least for least in leasts)

    def kept(line: re.Match[str]) -> str:
        return line[2] if has(line[1]) else ""

    return re.sub(r"^[ \t]*\$([\d.|]{1,99})(.*)", kept, text, flags=re.M)
