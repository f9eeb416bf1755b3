"""A plain client of the wire, without ur_rtde: for tests of the mock, also on Pythons that ur_rtde has no wheel for."""

from __future__ import annotations

import socket
import struct
import time
from collections.abc import Callable, Sequence
from typing import Self

from robot.common import loopback_host
from robot.mock.ur.controller import DASHBOARD, RTDE, SCRIPTS
from robot.mock.ur.fields import FORMATS, INPUTS
from robot.mock.ur.machine.program import COMMANDS
from robot.mock.ur.rtde import DATA, INPUT_RECIPE, OUTPUT_RECIPE, PAUSE, PROTOCOL, START, make_package

TIMEOUT = 60.0  # of whatever a test waits for [s]


def wire_host(number: int) -> str:
    """A loopback address of this process's own."""
    return loopback_host(number, 21)


def control_script(offset: int = 0, path: Sequence[str] = ()) -> str:
    """What the mock looks for in ur_rtde's control script, and no more."""
    calls = "\n".join(f"    {call}" for call in {each.needs for each in COMMANDS.values()})
    moves = "\n".join(f"        {line}" for line in path)
    return (
        "def rtde_control():\n"
        f"    global reg_offset_float = # float register offset\n{offset}"
        f"    global reg_offset_int = # int register offset\n{offset}\n"
        f"    def exec_move_path():\n        # inject move path\n{moves}\n    end\n{calls}\nend\n"
    )


def dashboard(host: str, *requests: str) -> list[str]:
    """The dashboard's answers, after its greeting."""
    with socket.create_connection((host, DASHBOARD), TIMEOUT) as line, line.makefile("rw") as file:
        file.readline()
        answers = []
        for request in requests:
            file.write(request + "\n")
            file.flush()
            answers.append(file.readline().strip())
        return answers


class RtdeClient:
    """One RTDE connection. Everything has a time-out and raises TimeoutError; a closed line raises ConnectionError."""

    def __init__(self, host: str, timeout: float = TIMEOUT) -> None:
        self.host = host
        self.socket = socket.create_connection((host, RTDE), timeout)
        self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._buffer = b""
        self._types: list[str] = []
        self._names: list[str] = []
        self._inputs: dict[int, list[str]] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.socket.close()

    def package(self) -> tuple[int, bytes]:
        """The next package: type and payload."""
        while len(self._buffer) < 3 or len(self._buffer) < struct.unpack_from(">H", self._buffer)[0]:
            data = self.socket.recv(1 << 16)
            if not data:
                raise ConnectionError("the controller has closed the connection")
            self._buffer += data
        size, kind = struct.unpack_from(">HB", self._buffer)
        payload, self._buffer = self._buffer[3:size], self._buffer[size:]
        return kind, payload

    def ask(self, kind: int, payload: bytes = b"") -> bytes:
        """Sends a package and returns the payload of the next one of its type."""
        self.socket.sendall(make_package(kind, payload))
        while True:
            found, answer = self.package()
            if found == kind:
                return answer

    def protocol(self) -> bool:
        return self.ask(PROTOCOL, b"\0\2") == b"\1"

    def outputs(self, *names: str, frequency: float = 500.0) -> tuple[int, list[str]]:
        """Sets the stream up; its recipe and the types, or what is wrong with each name."""
        answer = self.ask(OUTPUT_RECIPE, struct.pack(">d", frequency) + ",".join(names).encode())
        self._names, self._types = list(names), answer[1:].decode().split(",")
        return answer[0], self._types

    def inputs(self, *names: str) -> tuple[int, list[str]]:
        """Sets an input recipe up; its number (0: refused) and types."""
        answer = self.ask(INPUT_RECIPE, ",".join(names).encode())
        self._inputs[answer[0]] = list(names)
        return answer[0], answer[1:].decode().split(",")

    def start(self) -> bool:
        return self.ask(START) == b"\1"

    def pause(self) -> bool:
        return self.ask(PAUSE) == b"\1"

    def send(self, recipe: int, *values: float) -> None:
        """One input package."""
        layout = ">B" + "".join(FORMATS[INPUTS[name]] for name in self._inputs[recipe])
        self.socket.sendall(make_package(DATA, struct.pack(layout, recipe, *values)))

    def receive(self) -> dict[str, tuple[float, ...]]:
        """The next data package of the stream: values by name, each a tuple."""
        while True:
            kind, payload = self.package()
            if kind != DATA:
                continue
            values = list(struct.unpack(">B" + "".join(FORMATS[kind] for kind in self._types), payload))[1:]
            found = {}
            for name, kind_name in zip(self._names, self._types, strict=True):
                count = int(FORMATS[kind_name][:-1] or 1)
                found[name], values = tuple(values[:count]), values[count:]
            return found

    def newest(self) -> dict[str, tuple[float, ...]]:
        """The last package that has arrived, or the next one."""
        state = self.receive()
        while len(self._buffer) >= 3:
            state = self.receive()
        return state


class ControlClient(RtdeClient):
    """Speaks the register protocol as ur_rtde's control interface does, with one recipe for all commands."""

    INTEGERS = tuple(f"input_int_register_{i}" for i in range(8))
    DOUBLES = tuple(f"input_double_register_{i}" for i in range(18))
    ANSWERS = tuple(f"output_double_register_{i}" for i in range(48))
    STATE = ("timestamp", "runtime_state", "actual_q", "actual_TCP_pose", "actual_TCP_force")

    def __init__(self, host: str, script: str | None = None) -> None:
        super().__init__(host)
        try:
            self.protocol()
            self.outputs(*self.STATE, *(f"output_int_register_{i}" for i in range(3)), *self.ANSWERS)
            self._recipe, types = self.inputs(*self.INTEGERS, *self.DOUBLES)
            if self._recipe == 0:
                raise ConnectionError(f"inputs refused: {types}")
            self.start()
            self.upload(control_script() if script is None else script)
        except BaseException:
            self.socket.close()
            raise

    def upload(self, script: str) -> None:
        """Sends a program and waits until it plays and is ready."""
        self.write(0)
        with socket.create_connection((self.host, SCRIPTS[2]), TIMEOUT) as line:
            line.sendall(script.encode())
        self.wait(lambda state: state["runtime_state"][0] == 2 and state["output_int_register_0"][0] == 1)

    def write(self, command: int, doubles: Sequence[float] = (), integers: Sequence[int] = ()) -> None:
        """Writes the input registers; what is not given is 0."""
        ints = [command, *integers, *[0] * (7 - len(integers))]
        self.send(self._recipe, *ints, *doubles, *[0.0] * (18 - len(doubles)))

    def wait(
        self, until: Callable[[dict[str, tuple[float, ...]]], bool], limit: float = TIMEOUT
    ) -> dict[str, tuple[float, ...]]:
        """The first package for which `until` holds. Raises TimeoutError."""
        deadline = time.monotonic() + limit
        while time.monotonic() < deadline:
            state = self.receive()
            if until(state):
                return state
        raise TimeoutError(f"nothing of the kind within {limit:g} s")

    def call(
        self, command: int, doubles: Sequence[float] = (), integers: Sequence[int] = ()
    ) -> dict[str, tuple[float, ...]] | None:
        """One command; the package with its answers, or None when the program has ended over it."""
        self.wait(lambda state: state["output_int_register_0"][0] == 1)
        self.write(command, doubles, integers)
        if COMMANDS[command].every_cycle:
            return None
        state = self.wait(lambda state: state["output_int_register_0"][0] == 2 or state["runtime_state"][0] != 2)
        ended = state["runtime_state"][0] != 2
        self.write(0)
        return None if ended else state
