"""The state of the robot at one time, its modes by the numbers that the RTDE sends, and how its program ends.

Programs and their commands change it; `machine.py` computes one control period.
"""

from __future__ import annotations

import math
import re
from collections import deque
from collections.abc import Sequence
from enum import IntEnum
from typing import TYPE_CHECKING, NamedTuple, Protocol

from robot.mock.ur.machine.arm import HOME, PERIOD, Arm
from robot.mock.ur.machine.forces import NO_MASS, ForceMode, Load, Mass
from tacsim.interface import FloatArray
from tacsim.models.text import printable_line

if TYPE_CHECKING:
    from tacsim.models.hardware import Model  # pydantic and SciPy: half a second of start-up

REGISTERS = 48  # of each kind and direction


class Mode(IntEnum):
    """robot_mode of the RTDE."""

    BOOTING = 2
    POWER_OFF = 3
    POWER_ON = 4
    IDLE = 5
    RUNNING = 7


class Safety(IntEnum):
    """safety_mode of the RTDE."""

    NORMAL = 1
    REDUCED = 2
    PROTECTIVE_STOP = 3
    SAFEGUARD_STOP = 5
    ROBOT_EMERGENCY_STOP = 7
    FAULT = 9


SAFETY_BITS = {  # safety_status_bits: bit 10 is "stopped due to safety"
    Safety.NORMAL: 1 << 0,
    Safety.REDUCED: 1 << 1,
    Safety.PROTECTIVE_STOP: 1 << 2 | 1 << 10,
    Safety.SAFEGUARD_STOP: 1 << 4 | 1 << 10,
    Safety.ROBOT_EMERGENCY_STOP: 1 << 6 | 1 << 7 | 1 << 10,
    Safety.FAULT: 1 << 9 | 1 << 10,
}


class Runtime(IntEnum):
    """runtime_state of the RTDE."""

    STOPPED = 1
    PLAYING = 2
    PAUSING = 3
    PAUSED = 4


Version = tuple[int, int, int, int]  # major, minor, bugfix, build

VERSION: Version = (5, 11, 0, 108150)


def check_version(numbers: Sequence[float]) -> Version:
    """Checks that a version is four integers that the RTDE can send. Raises ValueError."""
    max_number = 2**32 - 1  # the RTDE sends each as a uint32
    if len(numbers) != 4 or not all(0 <= number <= max_number and number == int(number) for number in numbers):
        raise ValueError(f"a version is four whole numbers from 0 to {max_number}, got {list(numbers)}")
    major, minor, bugfix, build = map(int, numbers)
    return major, minor, bugfix, build


def version_text(version: Version) -> str:
    """Text such as 5.11.0.108150."""
    return ".".join(map(str, version))


def parse_version(text: str) -> Version:
    """Parses "5.11", "5.11.0" or "5.11.0.108150"; missing numbers are 0. Raises ValueError."""
    if re.fullmatch(r"\d{1,10}(\.\d{1,10}){1,3}", text, re.ASCII) is None:
        raise ValueError(f"a version of PolyScope is like 5.11 or 5.11.0.108150, got '{text[:40]}'")
    numbers = [int(number) for number in text.split(".")]
    return check_version([*numbers, *[0] * (4 - len(numbers))])


class Outputs:
    """Digital and analog outputs."""

    def __init__(self) -> None:
        self.digital = 0  # bits 0-7 standard, 8-15 configurable, 16-17 tool
        self.analog = [0.0, 0.0]  # fraction of the range
        self.analog_is_voltage = [False, False]

    @property
    def analog_types(self) -> int:
        """analog_io_types: bits 0 and 1 of the inputs, 2 and 3 of the outputs; 0 is a current, 1 a voltage."""
        return self.analog_is_voltage[0] << 2 | self.analog_is_voltage[1] << 3

    def analog_value(self, index: int) -> float:
        """Value of a standard analog output: 0-10 V [V], or 4-20 mA [A]."""
        part = self.analog[index]
        return 10.0 * part if self.analog_is_voltage[index] else 0.004 + 0.016 * part


class ScriptError(NamedTuple):
    """The error that prevented or ended a program, and its line and column, from 1 (0: unknown)."""

    text: str
    line: int = 0
    column: int = 0
    users: bool = True  # True for a program of a user, False for ur_rtde's control script


class RunningProgram(Protocol):
    """The interface of a program that the machine runs (`program.py`)."""

    name: str
    int_offset: int  # of the integer registers of the program

    def step(self) -> None:
        """Runs one control period. Raises ProgramError if the program ends with an error."""
        ...


class MachineState:
    """One robot at one time. `log` contains the last messages, each with its time [s]."""

    def __init__(
        self,
        model: Model = "ur5e",
        joints: Sequence[float] = HOME,
        version: Version = VERSION,
        tool: Mass = NO_MASS,  # on the flange
    ) -> None:
        unlock_delay = 0.0  # minimum time from a protective stop to its unlocking [s]; real robots need 5 s
        self.version = version
        self.arm, self.load, self.outputs = Arm(model, joints), Load(tool), Outputs()
        self.load.update(self.arm)
        self.ticks = 0
        self.mode, self.safety = Mode.RUNNING, Safety.NORMAL
        self.in_int, self.in_double = [0] * REGISTERS, [0.0] * REGISTERS
        self.out_int, self.out_double = [0] * REGISTERS, [0.0] * REGISTERS
        self.in_bits = 0  # input bit registers 0 to 127
        self.slider = 1.0
        self.program: RunningProgram | None = None
        self.paused = False
        self.freedrive: tuple[FloatArray, tuple[int, ...]] | None = None  # frame and free axes
        self.force_mode: ForceMode | None = None
        self.watchdog: tuple[int, float] | None = None  # input_int_register, maximum time between writes [s]
        self.watchdog_reset = 0  # tick at which its register was last written
        self.script_errors: deque[ScriptError] = deque(maxlen=20)  # not yet sent to clients
        self.control_offset = 0  # of the registers of the last control script
        self.stop_reason = ""  # why the last program ended
        self.stopped_at = -math.inf  # time of the last protective stop [s]
        self.unlock_delay = unlock_delay
        self.clock_offset = 0.0  # of the timestamp in packages [s]
        self.work_time = 0.0  # computation time of the last control period [s]
        self.log: deque[tuple[float, str]] = deque(maxlen=200)
        self._changing: tuple[int, Mode] | None = None  # tick of the next change of mode
        self._starting: tuple[int, RunningProgram] | None = None  # tick at which a program starts that replaces another

    @property
    def time(self) -> float:
        """Since power-on, in control periods [s]."""
        return self.ticks * PERIOD

    @property
    def steady(self) -> bool:
        """is_steady(): at rest, and not compliant."""
        return self.arm.rests and self.freedrive is None and self.force_mode is None

    def write_log(self, text: str) -> None:
        max_line = 500  # of a text of the log [characters]
        self.log.append((self.time, printable_line(text[:max_line])))

    def stop(self, reason: str) -> None:
        """Ends the program; the arm coasts to rest."""
        self.watchdog, self.freedrive, self.arm.waypoint, self._starting = None, None, None, None
        self.end_force_mode()
        if self.program is not None:
            self.program, self.stop_reason = None, reason
            self.write_log(f"program stopped: {reason}")

    def end_force_mode(self) -> None:
        if self.force_mode is not None:
            self.force_mode = None
            self.arm.settle()

    def protective_stop(self, reason: str) -> None:
        if self.safety in (Safety.NORMAL, Safety.REDUCED, Safety.SAFEGUARD_STOP):
            self.safety, self.stopped_at = Safety.PROTECTIVE_STOP, self.time
            self.write_log(f"protective stop: {reason}")
            self.stop(f"protective stop: {reason}")
