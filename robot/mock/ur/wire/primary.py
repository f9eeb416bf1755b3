"""Messages of the primary and secondary interface (30001, 30002): only the exceptions of scripts (Universal Robots,
client interfaces)."""

from __future__ import annotations

import struct

from robot.mock.ur.machine.state import ScriptError

PORTS = (30001, 30002)
ROBOT_MESSAGE, RUNTIME_EXCEPTION, CONTROLLER = 20, 10, 0xFE
_HEAD = struct.Struct(">iBQBBii")  # size, type, time [us], source, kind, line and column of the script


def runtime_exception(time: float, error: ScriptError) -> bytes:
    """A package with the error that ended or prevented a program; time: since power-on [s]."""
    words = error.text.encode()
    head = ROBOT_MESSAGE, round(1e6 * time), CONTROLLER, RUNTIME_EXCEPTION, error.line, error.column
    return _HEAD.pack(_HEAD.size + len(words), *head) + words
