"""Real-Time Data Exchange, protocol version 2 (port 30004): packages, recipes, the stream, the newest input packages.

A package is uint16 size (with the three bytes of the header), uint8 type, payload; all big endian.
"""

from __future__ import annotations

import math
import struct
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import islice

from robot.mock.ur.fault_client import Input
from robot.mock.ur.fields import FORMATS, INPUTS, OUTPUTS, Output, Value
from robot.mock.ur.machine.arm import PERIOD
from robot.mock.ur.machine.machine import Machine

HEADER = struct.Struct(">HB")
PROTOCOL, VERSION, MESSAGE, DATA = ord("V"), ord("v"), ord("M"), ord("U")
OUTPUT_RECIPE, INPUT_RECIPE, START, PAUSE = ord("O"), ord("I"), ord("S"), ord("P")
MAX_NAMES = 2048  # of one recipe (manual of PolyScope X 10.10, chapter RTDE, which does not give the reaction) [bytes]
MAX_STORED_BYTES = 1 << 24  # of one controller; 1.5 minutes of a driver at 500 Hz [bytes]
PACKAGE_OVERHEAD = 256  # of a stored package, in addition to its payload [bytes]


class BadPackage(ValueError):
    """Bytes that are not a package: the rest of the connection cannot be parsed."""


def make_package(kind: int, payload: bytes) -> bytes:
    """A package on the wire."""
    return HEADER.pack(len(payload) + HEADER.size, kind) + payload


def take_packages(buffer: bytearray) -> Iterator[tuple[int, bytes]]:
    """Removes complete packages from the front of the buffer and yields (type, payload). Raises BadPackage."""
    while len(buffer) >= HEADER.size:
        size, kind = HEADER.unpack_from(buffer)
        if size < HEADER.size:
            raise BadPackage(f"a package of {size} bytes, less than its header")
        if len(buffer) < size:
            return
        payload = bytes(buffer[HEADER.size : size])
        del buffer[:size]
        yield kind, payload


@dataclass(frozen=True)
class InputRecipe:
    """Names and layout of one kind of input package."""

    names: tuple[str, ...]
    layout: struct.Struct
    counts: tuple[int, ...]  # values of each name

    def unpack(self, payload: bytes) -> dict[str, Value | tuple[Value, ...]]:
        values: tuple[Value, ...] = self.layout.unpack(payload)
        found: dict[str, Value | tuple[Value, ...]] = {}
        at = 0
        for name, count in zip(self.names, self.counts, strict=True):
            found[name] = values[at] if count == 1 else values[at : at + count]
            at += count
        return found


@dataclass
class OutputRecipe:
    """Names and layout of the stream."""

    names: tuple[str, ...]
    fields: tuple[Output, ...]
    layout: struct.Struct
    every: int  # control periods between two packages

    def pack(self, machine: Machine, *, nan: bool) -> bytes:
        """One data package. `nan`: measured values are NaN."""
        flat: list[Value] = []
        for name, output in zip(self.names, self.fields, strict=True):
            value = output.read(machine)
            if nan and name.startswith("actual_") and FORMATS[output.type].endswith("d"):
                value = [math.nan] * len(value) if isinstance(value, (list, tuple)) else math.nan
            if isinstance(value, (list, tuple)):
                flat.extend(value)
            else:
                flat.append(value)
        return self.layout.pack(self.layout.size, DATA, 1, *flat)


@dataclass
class Session:
    """The settings of one client of the port.

    `names_in_use` returns the input names that other clients use; `write` handles the payload of an input package.
    """

    machine: Callable[[], Machine]
    names_in_use: Callable[[Session], set[str]]
    write: Callable[[InputRecipe, bytes], None]
    recipes: dict[int, InputRecipe] = field(default_factory=dict)
    output: OutputRecipe | None = None
    streaming: bool = False

    @property
    def claims(self) -> set[str]:
        """Input names that this client uses."""
        return {name for recipe in self.recipes.values() for name in recipe.names}

    def handle(self, kind: int, payload: bytes) -> bytes | None:
        """The reply to a package; None if it has none."""
        handler = _HANDLERS.get(kind)
        if handler is None:
            self.machine().write_log(f"RTDE: package of unknown type {kind} ignored")
            return None
        reply = handler(self, payload)
        return None if reply is None else make_package(kind, reply)

    def _protocol(self, payload: bytes) -> bytes:
        return bytes([payload == b"\0\2"])

    def _version(self, payload: bytes) -> bytes:
        return struct.pack(">4I", *self.machine().version)

    def _start(self, payload: bytes) -> bytes:
        self.streaming = self.output is not None
        return bytes([self.streaming or bool(self.recipes)])

    def _pause(self, payload: bytes) -> bytes:
        self.streaming = False
        return b"\1"

    def _ask_outputs(self, payload: bytes) -> bytes:
        if len(payload) < 8:
            self.machine().write_log("RTDE: output recipe without a frequency refused")
            return b"\0"
        (frequency,) = struct.unpack_from(">d", payload)
        names = self._names(payload[8:])
        version = self.machine().version
        fields = [output for name in names if (output := OUTPUTS.get(name)) and output.known(version)]
        types = [OUTPUTS[name].type if OUTPUTS.get(name) in fields else "NOT_FOUND" for name in names]
        if not names or len(fields) < len(names) or not 1.0 <= frequency <= 1.0 / PERIOD:
            self.machine().write_log(f"RTDE: output recipe at {frequency:g} Hz refused: {','.join(types)}")
            return b"\0" + ",".join(types).encode()
        layout = struct.Struct(">HBB" + "".join(FORMATS[kind] for kind in types))
        self.output = OutputRecipe(tuple(names), tuple(fields), layout, max(1, round(1.0 / (PERIOD * frequency))))
        return b"\1" + ",".join(types).encode()

    def _ask_inputs(self, payload: bytes) -> bytes:
        max_recipes = 255
        names, names_in_use = self._names(payload), self.names_in_use(self)
        types = ["IN_USE" if name in names_in_use else INPUTS.get(name, "NOT_FOUND") for name in names]
        number = len(self.recipes) + 1
        if not names or not all(kind in FORMATS for kind in types) or number > max_recipes:
            self.machine().write_log(f"RTDE: input recipe refused: {','.join(types)[:200]}")
            return b"\0" + ",".join(types).encode()
        layout = struct.Struct(">" + "".join(FORMATS[kind] for kind in types))
        counts = tuple(int(FORMATS[kind][:-1] or 1) for kind in types)
        self.recipes[number] = InputRecipe(tuple(names), layout, counts)
        return bytes([number]) + ",".join(types).encode()

    def _names(self, payload: bytes) -> list[str]:
        """Names of a comma-separated list, which may end in a comma; none of a list that is too long."""
        if len(payload) > MAX_NAMES:
            self.machine().write_log(f"RTDE: recipe of {len(payload)} bytes of names, at most {MAX_NAMES}")
            return []
        return [name for name in payload.decode("ascii", errors="replace").split(",") if name]

    def _data(self, payload: bytes) -> None:
        recipe = self.recipes.get(payload[0]) if payload else None
        if recipe is None:
            self.machine().write_log(f"RTDE: data for an unknown recipe ignored: {payload[:1].hex() or 'none'}")
        else:
            # The reaction of a controller to a wrong size is unknown. Surplus bytes are ignored (ur_rtde 1.6.5 sends
            # command 44 with them), short packages too (command 55). A short package with a command that the program
            # knows (moveJ with three numbers) ends the program, so that its client does not wait without success.
            given, size = len(payload) - 1, recipe.layout.size
            if given != size:
                done = "ignored" if given < size else "cut"
                description = f"data package {done}: {given} bytes, recipe {payload[0]} has {size}"
                self.machine().write_log(f"RTDE: {description}")
                if 4 <= given < size:
                    self.machine().on_short_command(
                        recipe.names[0], struct.unpack_from(">i", payload, 1)[0], description
                    )
            if given >= size:
                self.write(recipe, payload[1 : 1 + size])

    def _message(self, payload: bytes) -> None:
        self.machine().write_log(f"RTDE: message of a client: {payload[:200]!r}")


_HANDLERS: dict[int, Callable[[Session, bytes], bytes | None]] = {
    PROTOCOL: Session._protocol,
    VERSION: Session._version,
    OUTPUT_RECIPE: Session._ask_outputs,
    INPUT_RECIPE: Session._ask_inputs,
    START: Session._start,
    PAUSE: Session._pause,
    DATA: Session._data,
    MESSAGE: Session._message,
}


class Inputs:
    """A ring buffer: new packages replace the oldest ones. Numbers count from 1 and continue after `clear`."""

    def __init__(self) -> None:
        self.arrived = 0  # number of packages so far
        self._packages: deque[tuple[int, InputRecipe, bytes]] = deque()  # control period, recipe and payload of each
        self._size = 0  # of the stored packages [bytes]

    def add(self, tick: int, recipe: InputRecipe, payload: bytes) -> None:
        self.arrived += 1
        self._packages.append((tick, recipe, payload))
        self._size += PACKAGE_OVERHEAD + len(payload)
        while self._size > MAX_STORED_BYTES:
            self._size -= PACKAGE_OVERHEAD + len(self._packages.popleft()[2])

    def after(self, number: int, count: int) -> tuple[list[Input], int]:
        """At most `count` packages after the one with this number; and how many after it are no longer stored."""
        oldest = self.arrived - len(self._packages)  # number of the last package that was removed
        begin = max(number, oldest)
        page = islice(self._packages, begin - oldest, begin - oldest + count)
        entries = [
            Input(begin + place, tick, recipe.unpack(payload)) for place, (tick, recipe, payload) in enumerate(page, 1)
        ]
        return entries, max(0, oldest - number)

    def clear(self) -> None:
        self._packages.clear()
        self._size = 0
