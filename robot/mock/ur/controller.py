"""One mock controller on its address: the sockets of the RTDE, the script ports and the dashboard, and one tick."""

from __future__ import annotations

import re
import selectors
import socket
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from itertools import islice
from typing import TYPE_CHECKING

import numpy as np

from robot.common import MOCK_SERIAL
from robot.common.kinematics import JOINT_RANGE
from robot.mock.ur import messages
from robot.mock.ur.connection import Connection
from robot.mock.ur.fields import apply_inputs
from robot.mock.ur.machine.arm import HOME, PERIOD
from robot.mock.ur.machine.forces import NO_MASS, Mass
from robot.mock.ur.machine.machine import Machine
from robot.mock.ur.machine.state import VERSION, Version
from robot.mock.ur.rtde import BadPackage, InputRecipe, Inputs, Session, take_packages

if TYPE_CHECKING:
    from tacsim.models.hardware import Model  # pydantic and SciPy: half a second of start-up

RTDE, DASHBOARD, REALTIME = 30004, 29999, 30003
SCRIPTS = (*messages.PRIMARY_PORTS, REALTIME)
PORTS = (RTDE, DASHBOARD, *SCRIPTS)
MAX_CLIENTS = 256  # of one controller; further ones are closed at once
BURST = 16  # packages or lines of one client served at once; others wait, and no more data are read
# From the end of a program to the start of the program that replaces it [control periods]. A controller stops one,
# compiles the other, and is STOPPED in between; the duration on a real one is not published.
START_DELAY = 5
_PROGRAM_END = re.compile(rb"^end[ \t\r]*$", re.M)


@dataclass(frozen=True)
class ControllerConfig:
    """Configuration of a controller at power-on."""

    host: str
    model: Model = "ur5e"
    joints: tuple[float, ...] = HOME
    version: Version = VERSION
    serial: str = MOCK_SERIAL
    tool: Mass = NO_MASS  # on the flange


@dataclass
class Faults:
    """The present faults; by default none."""

    silence: bool = False  # no data packages; all other requests are answered
    black_hole: bool = False  # no reading and no answers; connections stay open
    dashboard_mute: bool = False
    partial: bool = False  # data packages arrive in two halves, a period apart
    nan: bool = False  # measured values are NaN
    remote_control: bool = True
    delay: float = 0.0  # of all data that are sent [s]
    drop: float = 0.0  # probability for each data package
    random: np.random.Generator = field(default_factory=lambda: np.random.default_rng(0))
    claimed: set[str] = field(default_factory=set)  # input names that a field bus uses


class Controller:
    """Serves one host. The process calls `tick` once a control period; sockets call back in between."""

    def __init__(self, config: ControllerConfig, selector: selectors.BaseSelector) -> None:
        self.config, self._selector = config, selector
        self.faults = Faults()
        self.machine = Machine(config.model, config.joints, config.version, config.tool)
        self.ticks = self.overruns = 0
        self.sent = self.dropped = 0  # data packages
        self.inputs = Inputs()
        self.clients: dict[Connection, Session | None] = {}
        self._behind: set[Connection] = set()  # clients whose requests still wait
        self._author: Connection | None = None  # client that sent the last program
        self._listeners: list[socket.socket] = []
        self._boot_at: int | None = None  # tick at which a power cycle ends
        self._rate = (
            time.monotonic(),
            0,
            0.0,
        )  # start of the interval, ticks at its start, rate of the previous interval
        self.listen()

    # -- life --------------------------------------------------------------------------------------------------------

    def listen(self) -> None:
        """Opens the ports, all or none. Raises OSError that names host and port."""
        if self._listeners:
            return
        try:
            for port in PORTS:
                self._listeners.append(open_port(self.config.host, port))
        except OSError:
            self.refuse()
            raise
        for listener, port in zip(self._listeners, PORTS, strict=True):
            self._watch(listener, partial(self._accept, listener, port))

    def refuse(self) -> None:
        """Closes the ports; connected clients stay."""
        for listener in self._listeners:
            self._ignore(listener)
            listener.close()
        self._listeners.clear()

    def close(self) -> None:
        self.cut(PORTS, reset=False)
        self.refuse()

    def reset(self) -> None:
        """Restores the state at power-on: no clients, no faults, initial joints. Ticks and counts continue."""
        self.cut(PORTS, reset=True)
        self.black_hole(False)
        self._boot_at = None
        self.faults = Faults()
        self.machine = Machine(self.config.model, self.config.joints, self.config.version, self.config.tool)
        self.inputs.clear()
        self.listen()

    def power_cycle(self, seconds: float) -> None:
        """Switches off and on again: disconnects clients, closes ports for this time, then the arm has no power."""
        self.cut(PORTS, reset=True)
        self.refuse()
        joints = np.clip(self.machine.arm.q, -JOINT_RANGE, JOINT_RANGE).tolist()
        self.machine = Machine(self.config.model, joints, self.machine.version, self.config.tool)
        self.machine.power_off()
        self._boot_at = self.ticks + max(1, round(seconds / PERIOD))

    def cut(self, ports: Sequence[int], *, reset: bool) -> int:
        """Closes the connections to these ports; returns their number."""
        chosen = [client for client in self.clients if client.port in ports]
        for client in chosen:
            self._drop(client, reset=reset)
        return len(chosen)

    def black_hole(self, on: bool) -> None:
        """Stops reading all sockets, which stay open, or starts again."""
        self.faults.black_hole = on
        for client in self.clients:
            self._watch(client.socket, partial(self._serve, client))
        for listener in self._listeners:
            self._watch(listener, partial(self._accept, listener, listener.getsockname()[1]))

    # -- one control period ------------------------------------------------------------------------------------------

    def tick(self) -> None:
        restart_periods = 500  # control periods until a restarted controller tries again to open its ports
        begun = time.perf_counter()
        self.ticks += 1
        if self._boot_at is not None:
            if self.ticks < self._boot_at:
                return
            self._boot_at = None
            try:
                self.listen()
            except OSError as error:  # another process has taken a port
                self.machine.write_log(f"{error.strerror}; tried again in {restart_periods * PERIOD:g} s")
                self._boot_at = self.ticks + restart_periods
                return
        self.machine.tick()
        if not self.faults.black_hole:
            self._report_script_errors()
            for client in list(self._behind):
                self._serve(client)
            self._publish()
        if self.ticks % 500 == 0:
            now, (then, count, _) = time.monotonic(), self._rate
            self._rate = now, self.ticks, (self.ticks - count) / max(now - then, 1e-9)
        self.machine.work_time = time.perf_counter() - begun

    @property
    def tick_rate(self) -> float:
        """Control periods per second, over the last 500 of them [1/s]; 0 before that."""
        return self._rate[2]

    def _publish(self) -> None:
        now = time.monotonic()
        made: dict[tuple[str, ...], bytes] = {}  # clients with the same recipe get the same bytes
        for client, session in list(self.clients.items()):
            if not client.flush(now):
                self._drop(client)
            elif session is not None and session.streaming and session.output is not None:
                recipe = session.output
                if self.ticks % recipe.every or self.faults.silence:
                    continue
                if self.faults.drop > 0 and self.faults.random.random() < self.faults.drop:
                    self.dropped += 1
                    continue
                try:
                    data = made.get(recipe.names)
                    if data is None:
                        data = made[recipe.names] = recipe.pack(self.machine, nan=self.faults.nan)
                except Exception as error:
                    self._cut(client, error)
                else:
                    self._stream(client, data)

    def _report_script_errors(self) -> None:
        """Reports errors on the same ports as a controller. ur_rtde does not read them: it waits 600 s for its
        register, then sends its control script again. Its connection is closed, so that its call raises now."""
        while self.machine.script_errors:
            error = self.machine.script_errors.popleft()
            data = messages.runtime_exception(self.machine.time, error)
            for client in self.clients:
                if client.port in messages.PRIMARY_PORTS:
                    client.send(data, due=self._due())
            if error.users and self._author is not None and self._author.port == REALTIME:
                self._drop(self._author, reset=True)
                self.machine.end_wait()

    def _stream(self, client: Connection, data: bytes) -> None:
        sent, dropped = client.sent, client.dropped
        client.send(data, droppable=True, due=self._due(), halved=self.faults.partial)
        self.sent += client.sent - sent
        self.dropped += client.dropped - dropped

    def _due(self) -> float:
        return time.monotonic() + self.faults.delay if self.faults.delay > 0 else 0.0

    # -- sockets -----------------------------------------------------------------------------------------------------

    def _watch(self, sock: socket.socket, work: Callable[[], None]) -> None:
        """Registers `work` for data that arrive at the socket, unless the fault black_hole is set."""
        self._ignore(sock)
        if not self.faults.black_hole:
            self._selector.register(sock, selectors.EVENT_READ, work)

    def _ignore(self, sock: socket.socket) -> None:
        with suppress(KeyError):  # it is not registered
            self._selector.unregister(sock)

    def _accept(self, listener: socket.socket, port: int) -> None:
        client = accept_client(listener, port)
        if client is None:
            return
        if len(self.clients) >= MAX_CLIENTS:
            self.machine.write_log(f"client of port {port} closed: {MAX_CLIENTS} are connected already")
            client.close()
            return
        session = None
        if port == RTDE:
            session = Session(lambda: self.machine, self._names_in_use, self._write)
        self.clients[client] = session
        self._watch(client.socket, partial(self._serve, client))
        if port == DASHBOARD and not self.faults.dashboard_mute:
            client.send(messages.GREETING.encode() + b"\n", due=self._due())

    def _drop(self, client: Connection, *, reset: bool = False) -> None:
        if client in self.clients:
            del self.clients[client]
            self._behind.discard(client)
            self._ignore(client.socket)
            client.close(reset=reset)

    def _cut(self, client: Connection, error: Exception) -> None:
        """Ends the connection of a client that cannot be served; the others continue."""
        if not isinstance(error, BadPackage):
            traceback.print_exc()
        self.machine.write_log(f"port {client.port}: client cut: {type(error).__name__}: {error}")
        self._drop(client)

    def _serve(self, client: Connection) -> None:
        """Reads data and serves a burst of requests. No more data are read from a client whose requests still wait."""
        if client not in self.clients:
            return
        alive = client in self._behind or client.read()
        try:
            if client.port == RTDE:
                behind = self._serve_rtde(client)
            elif client.port == DASHBOARD:
                behind = self._serve_dashboard(client)
            else:
                behind = self._serve_script(client)
        except Exception as error:
            self._cut(client, error)
            return
        if not alive:
            self._drop(client)
        elif client in self.clients:
            (self._behind.add if behind else self._behind.discard)(client)

    def _serve_rtde(self, client: Connection) -> bool:
        session = self.clients[client]
        assert session is not None
        served = 0
        for kind, payload in islice(take_packages(client.received), BURST):
            reply = session.handle(kind, payload)
            if reply is not None:
                client.send(reply, due=self._due())
            served += 1
        return served == BURST

    def _serve_dashboard(self, client: Connection) -> bool:
        max_line = 1 << 16  # of a dashboard line; then the client is disconnected [bytes]
        for line in islice(take_lines(client.received), BURST):
            request = line.decode("utf-8", errors="replace").strip()
            if self.faults.dashboard_mute:
                continue
            if request.lower() in ("quit", "shutdown"):
                client.send(b"Disconnected\n" if request.lower() == "quit" else b"Shutting down\n")
                self._drop(client)
                return False
            reply = messages.answer(self.machine, request, self.config.serial, remote=self.faults.remote_control)
            client.send(reply.encode() + b"\n", due=self._due())
        behind = b"\n" in client.received
        if not behind and len(client.received) > max_line:
            raise BadPackage(f"a dashboard line of more than {max_line} bytes")
        return behind

    def _serve_script(self, client: Connection) -> bool:
        """Runs one program: it begins with `def` or `sec` and ends with an `end` that is not indented."""
        max_program = 1 << 20  # of a program; then the client is disconnected [bytes]
        found = _PROGRAM_END.search(client.received, client.searched)
        if found is None:
            client.searched = max(0, client.received.rfind(b"\n"))
            if len(client.received) > max_program:
                raise BadPackage(f"a program of more than {max_program} bytes")
            return False
        program = client.received[: found.end()].decode("utf-8", errors="replace")
        del client.received[: found.end()]
        client.searched = 0
        self._author = client
        if self.faults.remote_control:
            self.machine.start(program, START_DELAY)
        else:
            self.machine.write_log("program refused: the robot is not in remote control")
        return True

    # -- input registers ---------------------------------------------------------------------------------------------

    def _names_in_use(self, requester: Session) -> set[str]:
        others = (
            session.claims for session in self.clients.values() if session is not None and session is not requester
        )
        return self.faults.claimed.union(*others)

    def _write(self, recipe: InputRecipe, payload: bytes) -> None:
        self.inputs.add(self.ticks, recipe, payload)
        apply_inputs(self.machine, recipe.unpack(payload))


def take_lines(buffer: bytearray) -> Iterator[bytes]:
    """Removes complete lines from the front of the buffer and yields them without line ends."""
    while (end := buffer.find(b"\n")) >= 0:
        line = bytes(buffer[:end])
        del buffer[: end + 1]
        yield line


def accept_client(listener: socket.socket, port: int) -> Connection | None:
    """The connection of a client that waits at the port; None if it is gone."""
    try:
        sock, _ = listener.accept()
    except OSError:
        return None
    try:
        return Connection(sock, port)
    except OSError:
        sock.close()
        return None


def open_port(host: str, port: int) -> socket.socket:
    """A listening socket. Raises OSError that names host and port."""
    listener = socket.socket()
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((host, port))
        listener.listen(128)
    except OSError as error:
        listener.close()
        reason = (error.strerror or str(error)).lower()
        raise OSError(
            error.errno, f"cannot listen on {host}:{port}: {reason}; is another mock running there?"
        ) from None
    listener.setblocking(False)
    return listener
