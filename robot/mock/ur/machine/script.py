"""The register protocol: what ur_rtde's control script does when it runs on a controller.

The text of that script is recognised, not interpreted: which registers it uses, which calls its `$version` lines left
in it, and the path that was written into it. Its loop, its threads and its answers are done here, in `program`, and in
`motion_commands` and `state_commands`, by the numbers of ur_rtde 1.6.5.
"""

from __future__ import annotations

from robot.mock.ur.machine import motion_commands, state_commands, user_script  # noqa: F401  # they enter COMMANDS
from robot.mock.ur.machine.arm import MotionSteps
from robot.mock.ur.machine.program import CONTROL_SCRIPT, DONE, READY, Program
from robot.mock.ur.machine.registry import COMMANDS
from robot.mock.ur.machine.state import MachineState


def make_program(machine: MachineState, text: str) -> Program:
    """The program of a text, ready for its first step. Raises ProgramError where it cannot be compiled."""
    program = Program(machine, text)
    program.main = _control_loop(program) if program.name == CONTROL_SCRIPT else user_script.run(program)
    return program


def _control_loop(program: Program) -> MotionSteps:
    """The loop of the control script: one command of the client after the other."""
    stop_script = 255  # the command that ends the script
    program.signal(-1)
    program.answer_integer(READY, 0)
    executing = False
    while True:
        command = program.integer(0)
        if command == 0:
            command, program.internal = program.internal, 0
        work = _work(program, command)
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


def _work(program: Program, command: int) -> MotionSteps:
    """What the command does; nothing for one that this controller has not."""
    known = COMMANDS.get(command)
    if known is not None and known.needs in program.text:
        yield from known.work(program) or ()
