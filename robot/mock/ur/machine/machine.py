"""The robot behind the sockets: arm, load, power, safety, registers, inputs and outputs, and the running program.

No sockets and no clock here: `tick` is one control period. So the whole behaviour can be tested in simulated time.

Transitions that take a real robot seconds take POWER_UP and RELEASE periods. A protective stop ends the program (a real
controller may only pause it).
"""

from __future__ import annotations

import math
import re
import traceback
from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from robot.common.kinematics import JOINT_RANGE
from robot.mock.ur.machine.arm import BRAKE, COAST, HOME, PERIOD, TOP, Arm, ProgramError, TooFast
from robot.mock.ur.machine.force_mode import ForceMode
from robot.mock.ur.machine.load import NOTHING, Load, Mass, at_flange
from robot.mock.ur.machine.modes import SAFETY_BITS, Mode, Runtime, Safety
from robot.mock.ur.machine.motion import FREEDRIVE_DAMPING, FREEDRIVE_TURN_DAMPING, comply
from robot.mock.ur.machine.registry import COMMANDS
from robot.mock.ur.machine.script import CONTROL_SCRIPT, DONE, Program
from robot.mock.ur.machine.user_script import CompileError
from robot.mock.ur.machine.version import VERSION, Version
from tacsim.interface import FloatArray
from tacsim.models.text import printable

if TYPE_CHECKING:
    from tacsim.models.hardware import Model  # pydantic and SciPy: half a second of start-up

REGISTERS = 48  # of each kind and direction
POWER_UP = 50  # periods from power on to idle
RELEASE = 50  # periods from idle to running
SLIDER_RATE = 5.0  # how fast the speed scaling follows the slider [1/s]
LINE = 500  # longest text of the log
UNLOCK_DELAY = 0.0  # least time from a protective stop to its unlocking [s]; real robots want 5 s


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
        """Of a standard analog output: [V] of 0-10 V, or [A] of 4-20 mA."""
        part = self.analog[index]
        return 10.0 * part if self.analog_is_voltage[index] else 0.004 + 0.016 * part


class ScriptError(NamedTuple):
    """Why a program was not begun, or has ended by an error; where in it, from 1 (0: not known)."""

    text: str
    line: int = 0
    column: int = 0
    users: bool = True  # a program of a user, not ur_rtde's control script


class Machine:
    """One robot. `log` keeps the last lines of what happened, each with its time [s]."""

    def __init__(
        self,
        model: Model = "ur5e",
        joints: Sequence[float] = HOME,
        version: Version = VERSION,
        tool: Mass = NOTHING,  # hangs on the flange
    ) -> None:
        self.version = version
        self.arm, self.load, self.outputs = Arm(model, joints), Load(tool), Outputs()
        self.load.update(self.arm)
        self.ticks = 0
        self.mode, self.safety = Mode.RUNNING, Safety.NORMAL
        self.in_int, self.in_double = [0] * REGISTERS, [0.0] * REGISTERS
        self.out_int, self.out_double = [0] * REGISTERS, [0.0] * REGISTERS
        self.in_bits = 0  # input bit registers 0 to 127
        self.slider = 1.0
        self.program: Program | None = None
        self.paused = False
        self.freedrive: tuple[FloatArray, tuple[int, ...]] | None = None  # frame and free axes
        self.force_mode: ForceMode | None = None
        self.watchdog: tuple[int, float] | None = None  # input_int_register, longest silence [s]
        self.watchdog_reset = 0  # tick at which its register was last written
        self.script_errors: deque[ScriptError] = deque(maxlen=20)  # not yet reported to those who listen
        self.control_offset = 0  # of the registers of the last control script
        self.stop_reason = ""  # why the last program ended
        self.stopped_at = -math.inf  # time of the last protective stop [s]
        self.unlock_delay = UNLOCK_DELAY
        self.clock_offset = 0.0  # of the timestamp that is sent [s]
        self.work_time = 0.0  # what the last control period took to compute [s]
        self.log: deque[tuple[float, str]] = deque(maxlen=200)
        self._changing: tuple[int, Mode] | None = None  # tick at which the mode changes
        self._starting: tuple[int, Program] | None = None  # tick at which a program begins that replaces another

    @property
    def time(self) -> float:
        """Since power-on, in control periods [s]."""
        return self.ticks * PERIOD

    @property
    def operational(self) -> bool:
        """True when a program may run."""
        return self.mode is Mode.RUNNING and self.safety in (Safety.NORMAL, Safety.REDUCED)

    @property
    def runtime(self) -> Runtime:
        if self.program is None:
            return Runtime.STOPPED
        if not self.paused:
            return Runtime.PLAYING
        return Runtime.PAUSED if self.arm.rests else Runtime.PAUSING

    @property
    def limiter(self) -> float:
        """speed_scaling: "of the trajectory limiter" (RTDE guide). Times target_speed_fraction, which is the slider, it
        is the speed scaling now (UR's ROS driver multiplies the two)."""
        return min(1.0, self.arm.scale / self.slider) if self.slider > 0.0 else 0.0

    @property
    def status_bits(self) -> int:
        """robot_status_bits: power on, program running, teach button, power button."""
        powered = self.mode in (Mode.IDLE, Mode.RUNNING)
        return powered << 0 | (self.program is not None) << 1 | (self.freedrive is not None) << 2

    @property
    def safety_status_bits(self) -> int:
        return SAFETY_BITS[self.safety]

    @property
    def raw_wrench(self) -> FloatArray:
        """Load on the flange in its axes, with the weight of the payload and no zero taken off (6,) [N, N m]."""
        return at_flange(self.load.measured, self.arm)

    @property
    def steady(self) -> bool:
        """is_steady(): at rest, and not compliant."""
        return self.arm.rests and self.freedrive is None and self.force_mode is None

    def write_log(self, text: str) -> None:
        self.log.append((self.time, printable(text[:LINE])))

    # -- program -----------------------------------------------------------------------------------------------------

    def start(self, text: str, delay: int = 0) -> bool:
        """Runs an uploaded program instead of the present one, which ends `delay` periods before; False where the robot
        is in no state to."""
        if not self.operational:
            self.write_log(f"program refused: robot {self.mode.name}, safety {self.safety.name}")
            return False
        if re.search(r"^[ \t]*def\s", text, re.M) is None:
            self.write_log(f"not run: {text[:60]!r}... is no program, or a secondary one")
            return False
        replaces = self.program is not None
        self.stop("replaced by another program")
        try:
            program = Program(self, text)
        except ProgramError as error:
            self.stop_reason = f"not run: {error}"
            self.write_log(self.stop_reason)
            place = (error.line, error.column) if isinstance(error, CompileError) else ()
            self.script_errors.append(ScriptError(str(error), *place))
            return False
        self._starting = self.ticks + delay * replaces, program
        self._begin()
        return True

    def _begin(self) -> None:
        if self._starting is not None and self.ticks >= self._starting[0]:
            self.program, self.paused, self._starting = self._starting[1], False, None
            if self.program.name == CONTROL_SCRIPT:
                self.control_offset = self.program.int_offset
            self.write_log(f"program '{self.program.name}' started")

    def stop(self, why: str) -> None:
        """Ends the program; the arm coasts to rest."""
        self.watchdog, self.freedrive, self.arm.waypoint, self._starting = None, None, None, None
        self.end_force_mode()
        if self.program is not None:
            self.program, self.stop_reason = None, why
            self.write_log(f"program stopped: {why}")

    def end_wait(self) -> None:
        """Writes what ur_rtde waits for while a program of its user runs, in the register where it looks."""
        self.out_int[self.control_offset] = DONE

    def end_force_mode(self) -> None:
        if self.force_mode is not None:
            self.force_mode = None
            self.arm.settle()

    # -- safety and power --------------------------------------------------------------------------------------------

    def protective_stop(self, why: str) -> None:
        if self.safety in (Safety.NORMAL, Safety.REDUCED, Safety.SAFEGUARD_STOP):
            self.safety, self.stopped_at = Safety.PROTECTIVE_STOP, self.time
            self.write_log(f"protective stop: {why}")
            self.stop(f"protective stop: {why}")

    def emergency_stop(self) -> None:
        self.safety = Safety.ROBOT_EMERGENCY_STOP
        self.write_log("emergency stop")
        self.stop("emergency stop")

    def safeguard_stop(self, on: bool) -> None:
        """Pauses a running program; it goes on when the gate is closed again."""
        if on and self.operational:
            self.safety, self.paused = Safety.SAFEGUARD_STOP, True
            self.write_log("safeguard stop")
        elif not on and self.safety is Safety.SAFEGUARD_STOP:
            self.safety, self.paused = Safety.NORMAL, False

    def fail(self, error: Exception) -> None:
        """The arm cannot be computed any more: a safety fault. It stands unloaded where it could last be computed."""
        traceback.print_exc()
        self.stop(f"error of the mock: {type(error).__name__}: {error}")
        self.safety, self.stop_reason = Safety.FAULT, f"fault, error of the mock: {type(error).__name__}: {error}"
        self.write_log(self.stop_reason)
        sound = (q for q in reversed(self.arm.history) if float(np.abs(q).max()) <= JOINT_RANGE)
        self.arm, self.load = Arm(self.arm.kinematics.model, next(sound, np.array(HOME)).tolist()), Load(self.load.tool)

    def unlock(self) -> bool:
        """Ends a protective stop; False where it is too early."""
        if self.safety is Safety.PROTECTIVE_STOP:
            if self.time - self.stopped_at < self.unlock_delay:
                return False
            self.safety = Safety.NORMAL
        return True

    def release_emergency_stop(self) -> None:
        """The button is pulled out again. The arm stays without power."""
        if self.safety is Safety.ROBOT_EMERGENCY_STOP:
            self.safety, self.mode, self._changing = Safety.NORMAL, Mode.POWER_OFF, None

    def power_off(self) -> None:
        self.stop("power off")
        self.mode, self._changing = Mode.POWER_OFF, None
        self.arm.halt()

    def power_on(self) -> None:
        if self.mode is Mode.POWER_OFF and self.safety is not Safety.ROBOT_EMERGENCY_STOP:
            self.mode, self._changing = Mode.POWER_ON, (self.ticks + POWER_UP, Mode.IDLE)

    def release_brakes(self) -> None:
        """From idle to running; powers on first where needed."""
        if self.safety is Safety.ROBOT_EMERGENCY_STOP or self.mode is Mode.RUNNING:
            return
        wait = RELEASE + (0 if self.mode is Mode.IDLE else POWER_UP)
        self.mode = Mode.IDLE if self.mode is Mode.IDLE else Mode.POWER_ON
        self._changing = (self.ticks + wait, Mode.RUNNING)

    def recover(self) -> None:
        """All that a person would do after a stop, at once: release, unlock, power, brakes."""
        self.safety, self.mode, self._changing, self.paused = Safety.NORMAL, Mode.RUNNING, None, False

    # -- one control period ------------------------------------------------------------------------------------------

    def tick(self) -> None:
        """Watchdog, program, motion, forces, safety: in this order. Raises nothing."""
        self.ticks += 1
        try:
            self._tick()
        except Exception as error:
            self.fail(error)

    def _tick(self) -> None:
        self._power()
        self._begin()
        if self.watchdog is not None and (self.ticks - self.watchdog_reset) * PERIOD > self.watchdog[1]:
            self.stop(
                f"RTDE watchdog: input_int_register_{self.watchdog[0]} was not written for {self.watchdog[1]:g} s"
            )
        self._scale()
        if self.program is not None and not (self.paused and self.arm.scale == 0.0):
            self._guarded(self.program.step)
        if self.freedrive is not None and not self.arm.commanded:
            self._guarded(self._follow_hand)
        if self.force_mode is not None:
            self._guarded(partial(self.force_mode.update, self.arm, self.load.felt))
        give_way = None if self.force_mode is None else partial(self.force_mode.mix, scale=self.arm.scale)
        if not self.arm.advance(COAST if self.safety in (Safety.NORMAL, Safety.REDUCED) else BRAKE, give_way):
            self.stop("force_mode: the arm cannot give way any further")
        self.load.update(self.arm)
        self.load.history.append(self.load.felt)
        self._check_limits()

    def _guarded(self, work: Callable[[], object]) -> None:
        try:
            work()
        except TooFast as error:
            self.protective_stop(str(error))
        except ProgramError as error:
            users = self.program is not None and self.program.name != CONTROL_SCRIPT
            self.stop(str(error))
            self.script_errors.append(ScriptError(f"runtime_error:{error}", users=users))
        except Exception as error:  # what the mock did not foresee is the end of this program, not of the other arms
            traceback.print_exc()
            self.stop(f"error of the mock: {type(error).__name__}: {error}")

    def _follow_hand(self) -> None:
        assert self.freedrive is not None
        damping = np.repeat([FREEDRIVE_DAMPING, FREEDRIVE_TURN_DAMPING], 3)
        frame, free = self.freedrive
        comply(self.arm, frame, free, self.load.unexplained / damping, np.array([0.25] * 3 + [1.0] * 3))

    def _power(self) -> None:
        if self._changing is not None and self.ticks >= self._changing[0]:
            self.mode, self._changing = self._changing[1], None
        if self.safety is Safety.ROBOT_EMERGENCY_STOP and self.mode is not Mode.POWER_OFF and self.arm.rests:
            self.power_off()

    def _scale(self) -> None:
        wanted, step = 0.0 if self.paused else self.slider, SLIDER_RATE * PERIOD
        self.arm.scale += max(-step, min(step, wanted - self.arm.scale))
        if abs(self.arm.scale - wanted) < 1e-12:
            self.arm.scale = wanted

    def _check_limits(self) -> None:
        """Makes a protective stop beyond the robot's own limits: force, joint speed, joint range."""
        if self.safety not in (Safety.NORMAL, Safety.REDUCED):
            return
        arm = self.arm
        force = math.sqrt(sum(value * value for value in self.load.unexplained[:3].tolist()))
        if force > self.load.force_limit:
            self.protective_stop(f"force of {force:.0f} N, limit {self.load.force_limit:g} N")
        fast = np.abs(arm.set_qd) > TOP * arm.kinematics.joint_speeds  # in force mode
        if fast.any():
            joint = int(np.argmax(fast))
            self.protective_stop(f"joint {joint + 1} at {abs(arm.set_qd[joint]):.2f} rad/s, too fast")
        beyond = (np.abs(arm.set_q) > JOINT_RANGE) & (arm.set_q * arm.set_qd > 0)  # the way back is free
        if beyond.any():
            self.protective_stop(f"joint {int(np.argmax(beyond)) + 1} at the end of its range")

    # -- what comes in -----------------------------------------------------------------------------------------------

    def on_int_register(self, register: int) -> None:
        """An input_int_register was written: the watchdog starts anew if it is its own."""
        if self.watchdog is not None and register == self.watchdog[0]:
            self.watchdog_reset = self.ticks

    def on_short_command(self, name: str, number: int, told: str) -> None:
        """A command arrived without all of its numbers: the program ends if that is the register it reads."""
        program = self.program
        if program is not None and name == f"input_int_register_{program.int_offset}" and number in COMMANDS:
            self.stop(f"command {number} of a wrong length, such as moveJ with three angles: {told}")

    def set_slider(self, fraction: float) -> None:
        if 0.0 <= fraction <= 1.0:
            self.slider = fraction
        else:
            self.write_log(f"speed slider {fraction} ignored: not within 0 and 1")
