"""Reads what a UR controller tells of itself by RTDE, version 2 (Universal Robots, "Real-Time Data Exchange guide").

Only outputs are asked for. No input is claimed and no program is sent, so whoever controls the arm goes on undisturbed.
Sockets only.
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
SECONDS = 0.3  # how long is read: forces are the mean of it
HEADER = struct.Struct(">HB")  # size with header, kind
VERSION, SETUP, START, DATA = b"VOSU"
FORMATS = {"DOUBLE": "d", "VECTOR6D": "6d", "VECTOR3D": "3d", "INT32": "i", "UINT32": "I"}
NEEDED = ("actual_q", "actual_TCP_pose", "actual_TCP_force", "runtime_state")
MAYBE = ("payload", "payload_cog", "tcp_offset", "target_speed_fraction")  # older controllers lack some


@dataclass(frozen=True, slots=True, eq=False)
class Reading:
    """What a controller told; None is what it does not tell."""

    joints: FloatArray  # (6,) [rad]
    tcp_pose: FloatArray  # (6,) base axes, position and rotation vector [m, rad]: what the pendant shows
    tcp_force: FloatArray  # (6,) mean of what the TCP feels, base axes [N, N m]
    program_state: int  # runtime_state; 2 is PLAYING
    payload: float | None  # [kg]
    payload_centre: FloatArray | None  # (3,) flange axes [m]
    tcp: FloatArray | None  # (6,) flange_from_tcp as position and rotation vector [m, rad]
    speed_slider: float | None  # 0 to 1


def read_controller(host: str, timeout: float = 2.0) -> Reading:
    """The newest values. Raises DeviceNotConnectedError when they are not there within `timeout` [s]."""
    try:
        with socket.create_connection((host, PORT), timeout) as link:
            return _read(_Session(link, time.monotonic() + timeout + SECONDS))
    except (OSError, struct.error, ValueError) as failure:
        raise DeviceNotConnectedError(f"no RTDE data from {host}:{PORT} ({failure})") from failure


class _Session:
    """One connection; nothing takes longer than until `deadline`."""

    def __init__(self, link: socket.socket, deadline: float) -> None:
        self._link, self._deadline = link, deadline

    def ask(self, kind: int, payload: bytes = b"") -> bytes:
        """The payload of the answer to a request. Raises OSError."""
        self._link.sendall(HEADER.pack(HEADER.size + len(payload), kind) + payload)
        return self.next(kind)

    def next(self, kind: int) -> bytes:
        """The payload of the next package of this kind; others, such as messages, are passed over."""
        while True:
            size, found = HEADER.unpack(self._exactly(HEADER.size))
            payload = self._exactly(max(0, size - HEADER.size))
            if found == kind:
                return payload

    def _exactly(self, number: int) -> bytes:
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


def _read(session: _Session) -> Reading:
    if session.ask(VERSION, struct.pack(">H", 2)) != b"\x01":
        raise ValueError("version 2 refused; it needs PolyScope 3.5 or later")
    names = [*NEEDED, *MAYBE]
    types = _recipe(session, names)
    if "NOT_FOUND" in types:
        names = [name for name, kind in zip(names, types, strict=True) if kind != "NOT_FOUND"]
        types = _recipe(session, names)
    layout = struct.Struct(">B" + "".join(FORMATS[kind] for kind in types))  # the recipe's number, then the values
    if session.ask(START) != b"\x01":
        raise ValueError("it does not send")
    packages: list[dict[str, FloatArray]] = []
    until = time.monotonic() + SECONDS
    while not packages or time.monotonic() < until:
        values, package = list(layout.unpack(session.next(DATA))[1:]), {}
        for name, kind in zip(names, types, strict=True):
            length = int(FORMATS[kind][:-1] or 1)
            package[name], values = np.array(values[:length], dtype=np.float64), values[length:]
        if all(np.isfinite(value).all() for value in package.values()):
            packages.append(package)
    last = packages[-1]
    payload, slider = last.get("payload"), last.get("target_speed_fraction")
    return Reading(
        joints=last["actual_q"],
        tcp_pose=last["actual_TCP_pose"],
        tcp_force=np.mean([package["actual_TCP_force"] for package in packages], axis=0),
        program_state=int(last["runtime_state"][0]),
        payload=None if payload is None else float(payload[0]),
        payload_centre=last.get("payload_cog"),
        tcp=last.get("tcp_offset"),
        speed_slider=None if slider is None else float(slider[0]),
    )


def _recipe(session: _Session, names: list[str]) -> list[str]:
    """Asks for these outputs; their types. Raises ValueError for one that must be there and is not."""
    rate = 125.0  # of the packages that are asked for [Hz]; every generation of controllers has it
    answer = session.ask(SETUP, struct.pack(">d", rate) + ",".join(names).encode())
    types = answer[1:].decode(errors="replace").split(",")
    if len(types) != len(names):
        raise ValueError(f"{len(names)} values were asked for, {len(types)} are offered")
    for name, kind in zip(names, types, strict=True):
        if kind not in FORMATS and (kind != "NOT_FOUND" or name in NEEDED):
            raise ValueError(f"{name} is {kind}")
    return types
