"""The dashboard of a UR controller (port 29999): lines of text, each answered within a time-out. Sockets only.

Answers are those of the "Dashboard Server e-Series" manual of Universal Robots.
"""

from __future__ import annotations

import re
import socket
import time

from robot.common import Closing
from robot.errors import DeviceError, DeviceNotConnectedError, EmergencyStop, ProtectiveStop

PORT = 29999
LONGEST_LINE = 4096


class Dashboard(Closing):
    """One session; a context manager. Every failure is a DeviceNotConnectedError that names the host."""

    def __init__(self, host: str, timeout: float = 2.0) -> None:
        self.host, self._buffer = host, b""
        try:
            self._socket = socket.create_connection((host, PORT), timeout)
        except OSError as failure:
            raise DeviceNotConnectedError(
                f"no dashboard at {host}:{PORT} ({failure}); is the controller on, and the address right?"
            ) from failure
        try:
            self._line("greeting")
        except BaseException:
            self._socket.close()
            raise

    def ask(self, request: str) -> str:
        """The answer to one request, without the line end."""
        try:
            self._socket.sendall(request.encode() + b"\n")
        except OSError as failure:
            raise self._lost(request, failure) from failure
        return self._line(request)

    def _line(self, request: str) -> str:
        while b"\n" not in self._buffer:
            try:
                part = self._socket.recv(LONGEST_LINE)
            except OSError as failure:
                raise self._lost(request, failure) from failure
            if not part or len(self._buffer) > LONGEST_LINE:
                raise self._lost(request, "closed" if not part else "an endless line")
            self._buffer += part
        line, self._buffer = self._buffer.split(b"\n", 1)
        return line.decode(errors="replace").strip()

    def _lost(self, request: str, why: object) -> DeviceNotConnectedError:
        return DeviceNotConnectedError(f"dashboard at {self.host}:{PORT} does not answer '{request}' ({why})")

    def safety(self) -> str:
        """Such as NORMAL, REDUCED, PROTECTIVE_STOP, ROBOT_EMERGENCY_STOP."""
        return _value(self.ask("safetystatus"))

    def mode(self) -> str:
        """Such as RUNNING, IDLE, POWER_OFF."""
        return _value(self.ask("robotmode"))

    def program(self) -> str:
        """Such as STOPPED, PLAYING or PAUSED."""
        return self.ask("programState").partition(" ")[0]

    def require_ready(self, who: str) -> None:
        """Raises EmergencyStop, ProtectiveStop or DeviceError unless the arm is powered, free and in remote control."""
        safety = self.safety()
        if safety == "PROTECTIVE_STOP":
            raise ProtectiveStop(f"{who}: protective stop; look why, then unlock it on the pendant")
        if safety not in ("NORMAL", "REDUCED"):
            raise EmergencyStop(f"{who}: {safety.lower().replace('_', ' ')}; a person must release it on the robot")
        mode = self.mode()
        if mode != "RUNNING":
            raise DeviceError(f"{who}: robot mode is {mode}; power it on and release the brakes on the pendant")
        if self.ask("is in remote control").lower() == "false":
            raise DeviceError(f"{who}: the pendant has local control; switch it to remote control (top right corner)")

    def require_identity(self, name: str, model: str, serial: str | None, refused_serial: str | None) -> None:
        """Raises DeviceNotConnectedError unless the robot is the one that the file of the arm `name` describes: by its
        model, by its `serial` number where one is given, and not that of a mock where one is refused."""
        found = self.serial()
        if found == refused_serial:
            raise DeviceNotConnectedError(f"{self.host} is a mock controller, but arm '{name}' has no `mock:` block")
        if serial not in (None, found):
            raise DeviceNotConnectedError(
                f"the robot at {self.host} has the serial number {found}, but the file of arm '{name}' says "
                f"serial: {serial}; is it the right robot?"
            )
        reported = self.model()
        if reported is not None and not model.startswith(reported):
            raise DeviceNotConnectedError(f"arm '{name}' is a {reported.upper()}, but its file says model: {model}")

    def unlock(self, who: str) -> None:
        """Releases a protective stop. Raises EmergencyStop for any other stop, ProtectiveStop if it cannot be done."""
        patience = 8.0  # a controller refuses to unlock in the first 5 s after a protective stop [s]
        deadline = time.monotonic() + patience
        answer = ""
        while (safety := self.safety()) == "PROTECTIVE_STOP":
            if time.monotonic() > deadline:
                raise ProtectiveStop(f"{who}: cannot be unlocked: '{answer}'; unlock it on the pendant")
            self.ask("close safety popup")
            answer = self.ask("unlock protective stop")
            time.sleep(0.05)
        if safety not in ("NORMAL", "REDUCED"):
            raise EmergencyStop(f"{who}: {safety.lower().replace('_', ' ')}; a person must release it on the robot")

    def serial(self) -> str:
        return self.ask("get serial number")

    def model(self) -> str | None:
        """Such as 'ur5', as far as it is told: e-Series controllers leave the e away."""
        found = re.match(r"ur\d+", self.ask("get robot model").lower())
        return found[0] if found else None

    def close(self) -> None:
        self._socket.close()


def _value(answer: str) -> str:
    """'Safetystatus: NORMAL' -> 'NORMAL'."""
    return answer.rpartition(":")[2].strip()
