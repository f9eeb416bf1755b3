"""The register protocol: the behaviour of ur_rtde's control script on a controller.

The text of that script is not interpreted. It only gives the registers, the calls that its `$version` lines leave in
it, and the path in it. This module, `program`, `motion_commands` and `state_commands` implement its loop, its threads
and its answers, with the command numbers of ur_rtde 1.6.5.
"""

from __future__ import annotations

from robot.mock.ur.machine import motion_commands, state_commands, user_script  # noqa: F401  # they register COMMANDS
from robot.mock.ur.machine.arm import MotionSteps
from robot.mock.ur.machine.program import CONTROL_SCRIPT, DONE, READY, Program
from robot.mock.ur.machine.registry import COMMANDS
from robot.mock.ur.machine.state import MachineState


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
