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


class Dashboard(Closing):
    """One session; a context manager. Each failed request raises a DeviceNotConnectedError that names the host."""

    def __init__(self, host: str, timeout: float = 2.0) -> None:
        self.host, self._buffer = host, b""
        try:
            self._socket = socket.create_connection((host, PORT), timeout)
        except OSError as failure:
            raise DeviceNotConnectedError(
                f"no dashboard at {host}:{PORT} ({failure}); is the controller on, and the address right?"
            ) from failure
        try:
            self._read_line("greeting")
        except BaseException:
            self._socket.close()
            raise

    def request(self, request: str) -> str:
        """The answer to one request, without the line end."""
        try:
            self._socket.sendall(request.encode() + b"\n")
        except OSError as failure:
            raise self._no_answer_error(request, failure) from failure
        return self._read_line(request)

    def _read_line(self, request: str) -> str:
        max_line = 4096
        while b"\n" not in self._buffer:
            try:
                part = self._socket.recv(max_line)
            except OSError as failure:
                raise self._no_answer_error(request, failure) from failure
            if not part or len(self._buffer) > max_line:
                raise self._no_answer_error(request, "closed" if not part else "an endless line")
            self._buffer += part
        line, self._buffer = self._buffer.split(b"\n", 1)
        return line.decode(errors="replace").strip()

    def _no_answer_error(self, request: str, reason: object) -> DeviceNotConnectedError:
        return DeviceNotConnectedError(f"dashboard at {self.host}:{PORT} does not answer '{request}' ({reason})")

    def safety(self) -> str:
        """Safety status, such as NORMAL, REDUCED, PROTECTIVE_STOP, ROBOT_EMERGENCY_STOP."""
        return _value(self.request("safetystatus"))

    def mode(self) -> str:
        """Robot mode, such as RUNNING, IDLE, POWER_OFF."""
        return _value(self.request("robotmode"))

    def program(self) -> str:
        """Program state: STOPPED, PLAYING or PAUSED."""
        return self.request("programState").partition(" ")[0]

    def require_ready(self, requester: str) -> None:
        """Raises EmergencyStop, ProtectiveStop or DeviceError unless the arm is powered, free and in remote control."""
        safety = self.safety()
        if safety == "PROTECTIVE_STOP":
            raise ProtectiveStop(f"{requester}: protective stop; find the cause, then unlock it on the pendant")
        if safety not in ("NORMAL", "REDUCED"):
            raise EmergencyStop(
                f"{requester}: {safety.lower().replace('_', ' ')}; a person must release it on the robot"
            )
        mode = self.mode()
        if mode != "RUNNING":
            raise DeviceError(f"{requester}: robot mode is {mode}; power it on and release the brakes on the pendant")
        if self.request("is in remote control").lower() == "false":
            raise DeviceError(
                f"{requester}: the pendant has local control; switch it to remote control (top right corner)"
            )

    def require_identity(self, name: str, model: str, serial: str | None, refused_serial: str | None) -> None:
        """Raises DeviceNotConnectedError unless the robot has the `model` and the `serial` number (None: any) that the
        file of arm `name` gives, and not the refused serial number of a mock."""
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

    def unlock(self, requester: str) -> None:
        """Releases a protective stop. Raises EmergencyStop for any other stop, ProtectiveStop if the release fails."""
        unlock_timeout = 8.0  # a controller refuses to unlock in the first 5 s after a protective stop [s]
        deadline = time.monotonic() + unlock_timeout
        answer = ""
        while (safety := self.safety()) == "PROTECTIVE_STOP":
            if time.monotonic() > deadline:
                raise ProtectiveStop(f"{requester}: cannot be unlocked: '{answer}'; unlock it on the pendant")
            self.request("close safety popup")
            answer = self.request("unlock protective stop")
            time.sleep(0.05)
        if safety not in ("NORMAL", "REDUCED"):
            raise EmergencyStop(
                f"{requester}: {safety.lower().replace('_', ' ')}; a person must release it on the robot"
            )

    def serial(self) -> str:
        return self.request("get serial number")

    def model(self) -> str | None:
        """Robot model such as 'ur5'; e-Series controllers omit the e. None if the answer is not a model."""
        found = re.match(r"ur\d+", self.request("get robot model").lower())
        return found[0] if found else None

    def close(self) -> None:
        self._socket.close()


def _value(answer: str) -> str:
    """'Safetystatus: NORMAL' -> 'NORMAL'."""
    return answer.rpartition(":")[2].strip()
