"""An observer of a UR controller, in a process of its own: `python observer.py HOST FILE`.

A plain RTDE v2 client that shares no code with the driver, nor with the mock. It says "ready" on standard output, and
when its standard input ends, it writes all packages it has received to FILE (numpy structured array, see PACKAGE).
Protocol: Universal Robots, Real-Time Data Exchange (RTDE) Guide.
"""

from __future__ import annotations

import select
import socket
import struct
import sys
import time

import numpy as np

PACKAGE = np.dtype(
    [
        ("received", "f8"),  # monotonic clock of this machine [s]
        ("timestamp", "f8"),  # of the controller [s]
        ("position", "f8", 3),  # of the TCP, base axes [m]
        ("velocity", "f8", 3),  # of the TCP [m/s]
        ("runtime_state", "u4"),
    ]
)
NAMES = "timestamp,actual_TCP_pose,actual_TCP_speed,runtime_state"
TYPES = b"DOUBLE,VECTOR6D,VECTOR6D,UINT32"
LAYOUT = struct.Struct(">d6d6dI")
HEADER = struct.Struct(">HB")
VERSION, SETUP, START, DATA = b"V", b"O", b"S", b"U"


def ask(link: socket.socket, kind: bytes, payload: bytes) -> bytes:
    """Sends a request; returns the payload of its answer."""
    link.sendall(HEADER.pack(HEADER.size + len(payload), kind[0]) + payload)
    while True:
        size, answered = HEADER.unpack(exactly(link, HEADER.size))
        answer = exactly(link, size - HEADER.size)
        if answered == kind[0]:
            return answer


def exactly(link: socket.socket, number: int) -> bytes:
    data = b""
    while len(data) < number:
        more = link.recv(number - len(data))
        if not more:
            raise ConnectionError("the controller has closed the connection")
        data += more
    return data


def connect(host: str) -> socket.socket:
    link = socket.create_connection((host, 30004), timeout=10.0)
    link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    assert ask(link, VERSION, struct.pack(">H", 2)) == b"\x01"
    recipe = ask(link, SETUP, struct.pack(">d", 500.0) + NAMES.encode())
    assert recipe[1:] == TYPES, recipe
    assert ask(link, START, b"") == b"\x01"
    return link


def main(host: str, file: str) -> None:
    link, data = connect(host), b""
    print("ready", flush=True)
    seen: list[tuple[object, ...]] = []
    while True:
        readable, _, _ = select.select([link, sys.stdin], [], [])
        if sys.stdin in readable:
            break
        try:
            more = link.recv(1 << 16)
        except ConnectionError:
            more = b""
        now = time.monotonic()
        if not more:  # the controller cuts all its connections: this one, too
            link, data = connect(host), b""
            continue
        data += more
        while len(data) >= HEADER.size and len(data) >= (size := HEADER.unpack_from(data)[0]):
            if data[2] == DATA[0]:
                stamp, *numbers, state = LAYOUT.unpack(data[HEADER.size + 1 : size])  # behind the recipe's number
                seen.append((now, stamp, numbers[:3], numbers[6:9], state))
            data = data[size:]
    np.save(file, np.array(seen, PACKAGE))


if __name__ == "__main__":
    main(*sys.argv[1:])
