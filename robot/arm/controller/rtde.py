"""Reads the state of a UR controller by RTDE, version 2 (Universal Robots, "Real-Time Data Exchange guide").

It requests outputs only. It claims no input and sends no program, so a program that controls the arm is not disturbed.
It uses sockets only.
"""

from __future__ import annotations

import socket
import struct
import time
from dataclasses import dataclass

import numpy as np

from robot.errors import DeviceNotConnectedError
from tacsim.interface import FloatArray

PORT = 30004
AVERAGING_TIME = 0.3  # forces are means over this time [s]
HEADER = struct.Struct(">HB")  # size with header, kind
VERSION, SETUP, START, DATA = b"VOSU"
FORMATS = {"DOUBLE": "d", "VECTOR6D": "6d", "VECTOR3D": "3d", "INT32": "i", "UINT32": "I"}
REQUIRED = ("actual_q", "actual_TCP_pose", "actual_TCP_force", "runtime_state")
OPTIONAL = ("payload", "payload_cog", "tcp_offset", "target_speed_fraction")  # missing on some older controllers


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
        with socket.create_connection((host, PORT), timeout) as link:
            return _read_outputs(_Session(link, time.monotonic() + timeout + AVERAGING_TIME))
    except (OSError, struct.error, ValueError) as failure:
        raise DeviceNotConnectedError(f"no RTDE data from {host}:{PORT} ({failure})") from failure


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
