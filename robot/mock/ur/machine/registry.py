"""The commands of ur_rtde's control script (ur_rtde 1.6.5), by the number that the client writes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from robot.mock.ur.machine.arm import MotionSteps
from robot.mock.ur.machine.program import Program

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
