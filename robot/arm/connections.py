"""Connections that read a UR controller: its dashboard (port 29999; lines of text, each answered within a time-out) and
its state by RTDE, version 2 (port 30004). Sockets only.

Answers are those of the "Dashboard Server e-Series" manual, packages those of the "Real-Time Data Exchange guide" of
Universal Robots. The RTDE connection requests outputs only. It claims no input and sends no program, so a program that
controls the arm is not disturbed.
"""

from __future__ import annotations

import re
import socket
import struct
import time
from dataclasses import dataclass

import numpy as np

from robot.common import Closing
from robot.errors import DeviceError, DeviceNotConnectedError, EmergencyStop, ProtectiveStop
from tacsim.interface import FloatArray

DASHBOARD_PORT = 29999
RTDE_PORT = 30004
AVERAGING_TIME = 0.3  # forces are means over this time [s]
FORMATS = {"DOUBLE": "d", "VECTOR6D": "6d", "VECTOR3D": "3d", "INT32": "i", "UINT32": "I"}
REQUIRED = ("actual_q", "actual_TCP_pose", "actual_TCP_force", "runtime_state")
OPTIONAL = ("payload", "payload_cog", "tcp_offset", "target_speed_fraction")  # missing on some older controllers


class Dashboard(Closing):
    """One session; a context manager. Each failed request raises a DeviceNotConnectedError that names the host."""

    def __init__(self, host: str, timeout: float = 2.0) -> None:
        self.host, self._buffer = host, b""
        try:
            self._socket = socket.create_connection((host, DASHBOARD_PORT), timeout)
        except OSError as failure:
            raise DeviceNotConnectedError(
                f"no dashboard at {host}:{DASHBOARD_PORT} ({failure}); is the controller on, and the address right?"
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
        return DeviceNotConnectedError(
            f"dashboard at {self.host}:{DASHBOARD_PORT} does not answer '{request}' ({reason})"
        )

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


HEADER = struct.Struct(">HB")  # size with header, kind
VERSION, SETUP, START, DATA = b"VOSU"


@dataclass(frozen=True, slots=True, eq=False)
class ControllerReading:
    """Values of a controller; None: not reported."""

    joints: FloatArray  # (6,) [rad]
    tcp_pose: FloatArray  # (6,) base axes, position and rotation vector [m, rad]: what the pendant shows
    tcp_force: FloatArray  # (6,) mean force on the TCP, base axes [N, N m]
    program_state: int  # runtime_state; 2 is PLAYING
    payload: float | None  # [kg]
    payload_centre: FloatArray | None  # (3,) flange axes [m]
    tcp: FloatArray | None  # (6,) flange_from_tcp as position and rotation vector [m, rad]
    speed_slider: float | None  # 0 to 1


def read_controller(host: str, timeout: float = 2.0) -> ControllerReading:
    """Reads the newest values. Raises DeviceNotConnectedError if they do not arrive within `timeout` [s]."""
    try:
        with socket.create_connection((host, RTDE_PORT), timeout) as link:
            return _read_outputs(_Session(link, time.monotonic() + timeout + AVERAGING_TIME))
    except (OSError, struct.error, ValueError) as failure:
        raise DeviceNotConnectedError(f"no RTDE data from {host}:{RTDE_PORT} ({failure})") from failure


class _Session:
    """One connection; every wait ends at `deadline`."""

    def __init__(self, link: socket.socket, deadline: float) -> None:
        self._link, self._deadline = link, deadline

    def ask(self, kind: int, payload: bytes = b"") -> bytes:
        """The payload of the answer to a request. Raises OSError."""
        self._link.sendall(HEADER.pack(HEADER.size + len(payload), kind) + payload)
        return self.next(kind)

    def next(self, kind: int) -> bytes:
        """The payload of the next package of this kind; others, such as messages, are skipped."""
        while True:
            size, found = HEADER.unpack(self._receive_exactly(HEADER.size))
            payload = self._receive_exactly(max(0, size - HEADER.size))
            if found == kind:
                return payload

    def _receive_exactly(self, number: int) -> bytes:
        data = b""
        while len(data) < number:
            left = self._deadline - time.monotonic()
            if left <= 0.0:
                raise TimeoutError("timed out")
            self._link.settimeout(left)
            more = self._link.recv(number - len(data))
            if not more:
                raise ConnectionError("closed by the controller")
            data += more
        return data


def _read_outputs(session: _Session) -> ControllerReading:
    if session.ask(VERSION, struct.pack(">H", 2)) != b"\x01":
        raise ValueError("version 2 refused; it needs PolyScope 3.5 or later")
    names = [*REQUIRED, *OPTIONAL]
    types = _request_outputs(session, names)
    if "NOT_FOUND" in types:
        names = [name for name, kind in zip(names, types, strict=True) if kind != "NOT_FOUND"]
        types = _request_outputs(session, names)
    layout = struct.Struct(">B" + "".join(FORMATS[kind] for kind in types))  # the recipe's number, then the values
    if session.ask(START) != b"\x01":
        raise ValueError("the controller refuses to send")
    packages: list[dict[str, FloatArray]] = []
    until = time.monotonic() + AVERAGING_TIME
    while not packages or time.monotonic() < until:
        values, package = list(layout.unpack(session.next(DATA))[1:]), {}
        for name, kind in zip(names, types, strict=True):
            length = int(FORMATS[kind][:-1] or 1)
            package[name], values = np.array(values[:length], dtype=np.float64), values[length:]
        if all(np.isfinite(value).all() for value in package.values()):
            packages.append(package)
    last = packages[-1]
    payload, slider = last.get("payload"), last.get("target_speed_fraction")
    return ControllerReading(
        joints=last["actual_q"],
        tcp_pose=last["actual_TCP_pose"],
        tcp_force=np.mean([package["actual_TCP_force"] for package in packages], axis=0),
        program_state=int(last["runtime_state"][0]),
        payload=None if payload is None else float(payload[0]),
        payload_centre=last.get("payload_cog"),
        tcp=last.get("tcp_offset"),
        speed_slider=None if slider is None else float(slider[0]),
    )


def _request_outputs(session: _Session, names: list[str]) -> list[str]:
    """Requests these outputs and returns their types. Raises ValueError if a required one is missing."""
    package_rate = 125.0  # requested rate [Hz]; every generation of controllers supports it
    answer = session.ask(SETUP, struct.pack(">d", package_rate) + ",".join(names).encode())
    types = answer[1:].decode(errors="replace").split(",")
    if len(types) != len(names):
        raise ValueError(f"{len(names)} values were requested, {len(types)} are offered")
    for name, kind in zip(names, types, strict=True):
        if kind not in FORMATS and (kind != "NOT_FOUND" or name in REQUIRED):
            raise ValueError(f"{name} is {kind}")
    return types
