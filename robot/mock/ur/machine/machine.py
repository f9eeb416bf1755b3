"""The robot without its sockets: arm, load, power, safety, registers, inputs and outputs, and the running program.

`tick` is one control period. This module uses no sockets and no clock, so tests run it in simulated time.

Changes of power and brakes take 50 control periods each; a real robot needs seconds. A protective stop ends the program
(a real controller may only pause it).

The text of ur_rtde's control script is not interpreted. It only gives the registers, the calls that its `$version`
lines leave in it, and the path in it. Its loop is here, its threads and answers are in `program`, `motion_commands` and
`state_commands`, with the command numbers of ur_rtde 1.6.5.
"""

from __future__ import annotations

import math
import re
import traceback
from collections.abc import Callable
from functools import partial

import numpy as np

from robot.common.kinematics import JOINT_RANGE
from robot.mock.ur.machine import motion_commands, state_commands, user_script  # noqa: F401  # they register COMMANDS
from robot.mock.ur.machine.arm import (
    BRAKE_DECELERATION,
    COAST_DECELERATION,
    HOME,
    MAX_SPEED_RATIO,
    PERIOD,
    Arm,
    MotionSteps,
    ProgramError,
    TooFast,
)
from robot.mock.ur.machine.forces import Load, at_flange
from robot.mock.ur.machine.motion import FREEDRIVE_DAMPING, FREEDRIVE_TURN_DAMPING, move_with_compliance
from robot.mock.ur.machine.program import COMMANDS, CONTROL_SCRIPT, DONE, READY, Program
from robot.mock.ur.machine.state import SAFETY_BITS, MachineState, Mode, Runtime, Safety, ScriptError
from robot.mock.ur.machine.user_script import CompileError
from tacsim.interface import FloatArray

POWER_UP = 50  # periods from power on to idle
SLIDER_RATE = 5.0  # maximum rate of change of the speed scaling [1/s]


def make_program(machine: MachineState, text: str) -> Program:
    """Makes the program of a text. Raises ProgramError if it cannot be compiled."""
    program = Program(machine, text)
    program.main = _control_loop(program) if program.name == CONTROL_SCRIPT else user_script.run(program)
    return program


def _control_loop(program: Program) -> MotionSteps:
    """The loop of the control script: runs the commands of the client one after the other."""
    stop_script = 255  # the command that ends the script
    program.signal(-1)
    program.answer_integer(READY, 0)
    executing = False
    while True:
        command = program.integer(0)
        if command == 0:
            command, program.internal = program.internal, 0
        work = _run_command(program, command)
        if command in COMMANDS and COMMANDS[command].every_cycle:
            yield from work
            program.answer_integer(READY, 0)
        elif command == 0:
            executing = False
            program.answer_integer(READY, 0)
        elif not executing:
            if command == stop_script:
                return
            yield from work
            program.answer_integer(DONE, 0)
            executing = True
        yield


def _run_command(program: Program, command: int) -> MotionSteps:
    """Runs a command; does nothing if this controller does not have it."""
    known = COMMANDS.get(command)
    if known is not None and known.needs in program.text:
        yield from known.work(program) or ()


class Machine(MachineState):
    """A robot whose state changes with each control period."""

    @property
    def operational(self) -> bool:
        """True if a program may run."""
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
        """speed_scaling: "of the trajectory limiter" (RTDE guide). Multiplied by target_speed_fraction, the slider, it
        is the present speed scaling (UR's ROS driver multiplies the two)."""
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
        """Wrench (6,) on the flange in its axes, with the weight of the payload and without zeroing [N, N m]."""
        return at_flange(self.load.measured, self.arm)

    # -- program -----------------------------------------------------------------------------------------------------

    def start(self, text: str, delay: int = 0) -> bool:
        """Replaces the present program by an uploaded one, which starts `delay` control periods later. Returns False if
        the robot cannot run programs in its present state."""
        if not self.operational:
            self.write_log(f"program refused: robot {self.mode.name}, safety {self.safety.name}")
            return False
        if re.search(r"^[ \t]*def\s", text, re.M) is None:
            self.write_log(f"not run: {text[:60]!r}... is not a program, or a secondary one")
            return False
        replaces = self.program is not None
        self.stop("replaced by another program")
        try:
            program = make_program(self, text)
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

    def end_wait(self) -> None:
        """Writes DONE into the register that ur_rtde polls while a user's program runs."""
        self.out_int[self.control_offset] = DONE

    # -- safety and power --------------------------------------------------------------------------------------------

    def emergency_stop(self) -> None:
        self.safety = Safety.ROBOT_EMERGENCY_STOP
        self.write_log("emergency stop")
        self.stop("emergency stop")

    def safeguard_stop(self, on: bool) -> None:
        """Pauses a running program; it continues when the gate is closed again."""
        if on and self.operational:
            self.safety, self.paused = Safety.SAFEGUARD_STOP, True
            self.write_log("safeguard stop")
        elif not on and self.safety is Safety.SAFEGUARD_STOP:
            self.safety, self.paused = Safety.NORMAL, False

    def fail(self, error: Exception) -> None:
        """Sets a safety fault after an error of the mock. The arm rests without load at its last valid joints."""
        traceback.print_exc()
        self.stop(f"error of the mock: {type(error).__name__}: {error}")
        self.safety, self.stop_reason = Safety.FAULT, f"fault, error of the mock: {type(error).__name__}: {error}"
        self.write_log(self.stop_reason)
        valid = (q for q in reversed(self.arm.history) if float(np.abs(q).max()) <= JOINT_RANGE)
        self.arm, self.load = Arm(self.arm.kinematics.model, next(valid, np.array(HOME)).tolist()), Load(self.load.tool)

    def unlock(self) -> bool:
        """Ends a protective stop; returns False if it is too early."""
        if self.safety is Safety.PROTECTIVE_STOP:
            if self.time - self.stopped_at < self.unlock_delay:
                return False
            self.safety = Safety.NORMAL
        return True

    def release_emergency_stop(self) -> None:
        """Releases the emergency stop. The arm stays without power."""
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
        """Changes from idle to running; switches the power on first if it is off."""
        release_periods = 50  # periods from idle to running
        if self.safety is Safety.ROBOT_EMERGENCY_STOP or self.mode is Mode.RUNNING:
            return
        wait = release_periods + (0 if self.mode is Mode.IDLE else POWER_UP)
        self.mode = Mode.IDLE if self.mode is Mode.IDLE else Mode.POWER_ON
        self._changing = (self.ticks + wait, Mode.RUNNING)

    def recover(self) -> None:
        """Does all that the operator does after a stop, at once: release, unlock, power, brakes."""
        self.safety, self.mode, self._changing, self.paused = Safety.NORMAL, Mode.RUNNING, None, False

    # -- one control period ------------------------------------------------------------------------------------------

    def tick(self) -> None:
        """Runs watchdog, program, motion, forces and safety, in this order. Raises nothing."""
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
            self._guarded(self._apply_freedrive)
        if self.force_mode is not None:
            self._guarded(partial(self.force_mode.update, self.arm, self.load.zeroed_wrench))
        compliance = None if self.force_mode is None else partial(self.force_mode.mix, scale=self.arm.scale)
        if not self.arm.advance(
            COAST_DECELERATION if self.safety in (Safety.NORMAL, Safety.REDUCED) else BRAKE_DECELERATION, compliance
        ):
            self.stop("force_mode: the compliant motion is out of reach")
        self.load.update(self.arm)
        self.load.history.append(self.load.zeroed_wrench)
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
        except Exception as error:  # an unexpected error ends this program, not the other arms
            traceback.print_exc()
            self.stop(f"error of the mock: {type(error).__name__}: {error}")

    def _apply_freedrive(self) -> None:
        assert self.freedrive is not None
        damping = np.repeat([FREEDRIVE_DAMPING, FREEDRIVE_TURN_DAMPING], 3)
        frame, free = self.freedrive
        move_with_compliance(self.arm, frame, free, self.load.unexplained / damping, np.array([0.25] * 3 + [1.0] * 3))

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
        """Makes a protective stop if a limit of the robot is exceeded: force, joint speed, joint range."""
        if self.safety not in (Safety.NORMAL, Safety.REDUCED):
            return
        arm = self.arm
        force = math.sqrt(sum(value * value for value in self.load.unexplained[:3].tolist()))
        if force > self.load.force_limit:
            self.protective_stop(f"force of {force:.0f} N, limit {self.load.force_limit:g} N")
        fast = np.abs(arm.set_qd) > MAX_SPEED_RATIO * arm.kinematics.joint_speeds  # in force mode
        if fast.any():
            joint = int(np.argmax(fast))
            self.protective_stop(f"joint {joint + 1} at {abs(arm.set_qd[joint]):.2f} rad/s, too fast")
        beyond = (np.abs(arm.set_q) > JOINT_RANGE) & (
            arm.set_q * arm.set_qd > 0
        )  # motion back into the range is allowed
        if beyond.any():
            self.protective_stop(f"joint {int(np.argmax(beyond)) + 1} at the end of its range")

    # -- input -------------------------------------------------------------------------------------------------------

    def on_int_register(self, register: int) -> None:
        """Handles a write to an input_int_register: restarts the watchdog if it is the watchdog's register."""
        if self.watchdog is not None and register == self.watchdog[0]:
            self.watchdog_reset = self.ticks

    def on_short_command(self, name: str, number: int, description: str) -> None:
        """Handles a command that arrived without all its numbers: ends the program if it reads that register."""
        program = self.program
        if program is not None and name == f"input_int_register_{program.int_offset}" and number in COMMANDS:
            self.stop(f"command {number} of a wrong length, such as moveJ with three angles: {description}")

    def set_slider(self, fraction: float) -> None:
        if 0.0 <= fraction <= 1.0:
            self.slider = fraction
        else:
            self.write_log(f"speed slider {fraction} ignored: not within 0 and 1")
