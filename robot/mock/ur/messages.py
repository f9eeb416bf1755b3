"""The dashboard server: one line of text per request and reply (Dashboard Server e-Series, Universal Robots); and the
messages of the primary and secondary interface (30001, 30002): only the exceptions of scripts (client interfaces)."""

from __future__ import annotations

import struct
from collections.abc import Callable

from robot.mock.ur.machine.machine import Machine
from robot.mock.ur.machine.state import Runtime, Safety, ScriptError

GREETING = "Connected: Universal Robots Dashboard Server"
_ROBOT = {"ur3e": "UR3", "ur5e": "UR5", "ur10e": "UR10"}  # `get robot model` omits the e


def answer(machine: Machine, line: str, serial: str, *, remote: bool) -> str:
    """The reply to one request line."""
    words = line.strip()
    request = words.lower()
    read_answer = _QUESTIONS.get(request)
    if read_answer is not None:
        return read_answer(machine, serial, remote)
    if request in _COMMANDS:
        act, reply = _COMMANDS[request]
        act(machine)
        return reply
    if request in _ATTEMPTS:
        return _ATTEMPTS[request](machine)
    if request.startswith("load "):
        # The mock cannot run it: it runs only programs that clients send.
        return f"File not found: {words[5:]}"
    if request.startswith(("popup ", "addtolog ", "setuserrole ", "set operational mode ")):
        machine.write_log(f"dashboard: {words}")
        return {"p": "showing popup", "a": "Added log message"}.get(request[0], "Setting user role: none")
    return f"could not understand: '{words}'"


def _yes(value: bool) -> str:
    return "true" if value else "false"


def _state(machine: Machine) -> str:
    state = {Runtime.STOPPED: "STOPPED", Runtime.PLAYING: "PLAYING"}.get(machine.runtime, "PAUSED")
    return f"{state} <unnamed>"


_QUESTIONS: dict[str, Callable[[Machine, str, bool], str]] = {
    "polyscopeversion": lambda m, serial, remote: f"URSoftware {'.'.join(map(str, m.version))} (Jan 01 2022)",
    "get serial number": lambda m, serial, remote: serial,
    "get robot model": lambda m, serial, remote: _ROBOT[m.arm.kinematics.model],
    "is in remote control": lambda m, serial, remote: _yes(remote),
    "robotmode": lambda m, serial, remote: f"Robotmode: {m.mode.name}",
    "safetystatus": lambda m, serial, remote: f"Safetystatus: {m.safety.name}",
    "safetymode": lambda m, serial, remote: f"Safetymode: {m.safety.name}",
    "programstate": lambda m, serial, remote: _state(m),
    "running": lambda m, serial, remote: f"Program running: {_yes(m.program is not None)}",
    "get loaded program": lambda m, serial, remote: "No program loaded",
    "isprogramsaved": lambda m, serial, remote: "true <unnamed>",
    "get operational mode": lambda m, serial, remote: "NONE",
}


def _pause(machine: Machine) -> str:
    if machine.program is None:
        return "Failed to execute: pause"
    machine.paused = True
    return "Pausing program"


def _play(machine: Machine) -> str:
    if machine.program is None or not machine.operational:
        return "Failed to execute: play"
    machine.paused = False
    return "Starting program"


def _unlock(machine: Machine) -> str:
    if machine.unlock():
        return "Protective stop releasing"
    return (
        f"Cannot unlock protective stop until {machine.unlock_delay:g}s after occurrence. "
        "Always inspect cause of protective stop before unlocking"
    )


def _restart_safety(machine: Machine) -> None:
    machine.power_off()
    if machine.safety is not Safety.ROBOT_EMERGENCY_STOP:
        machine.safety = Safety.NORMAL


_COMMANDS: dict[str, tuple[Callable[[Machine], object], str]] = {  # action and reply
    "power on": (Machine.power_on, "Powering on"),
    "power off": (Machine.power_off, "Powering off"),
    "brake release": (Machine.release_brakes, "Brake releasing"),
    "stop": (lambda machine: machine.stop("dashboard stop"), "Stopped"),
    "restart safety": (_restart_safety, "Restarting safety"),
    "close popup": (lambda machine: None, "closing popup"),
    "close safety popup": (lambda machine: None, "closing safety popup"),
}
_ATTEMPTS = {"pause": _pause, "play": _play, "unlock protective stop": _unlock}  # their replies depend on success


PRIMARY_PORTS = (30001, 30002)
ROBOT_MESSAGE, RUNTIME_EXCEPTION, CONTROLLER = 20, 10, 0xFE
_HEAD = struct.Struct(">iBQBBii")  # size, type, time [us], source, kind, line and column of the script


def runtime_exception(time: float, error: ScriptError) -> bytes:
    """A package with the error that ended or prevented a program; time: since power-on [s]."""
    words = error.text.encode()
    head = ROBOT_MESSAGE, round(1e6 * time), CONTROLLER, RUNTIME_EXCEPTION, error.line, error.column
    return _HEAD.pack(_HEAD.size + len(words), *head) + words
