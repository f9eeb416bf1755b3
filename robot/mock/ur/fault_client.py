"""Client of a mock controller's fault server: breaks the mock, pushes on its tool, and tells its state."""

from __future__ import annotations

import json
import socket
import threading
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

FAULT_PORT = 30020
TIMEOUT = 5.0  # of every call [s]


class FaultError(RuntimeError):
    """The mock did not answer in time, or refused."""


@dataclass(frozen=True)
class MockState:
    """A mock controller between two control periods. SI units; UR poses (position, rotation vector), base axes."""

    tick: int  # control periods since the process began
    time: float  # of the robot, from its power-on [s]
    joints: tuple[float, ...]  # (6,) actual
    joint_speeds: tuple[float, ...]
    target_joints: tuple[float, ...]
    pose: tuple[float, ...]  # (6,) of the TCP
    tcp_speed: tuple[float, ...]  # (6,) [m/s, rad/s]
    wrench: tuple[float, ...]  # (6,) as actual_TCP_force has it [N, N m]
    rests: bool  # neither target nor actual joints move
    program: bool  # a program runs, or is paused
    safety: str  # NORMAL, PROTECTIVE_STOP, ...
    mode: str  # RUNNING, POWER_OFF, ...
    stop_reason: str  # why the last program ended; "" if none has
    payload: float  # as the controller was told [kg]
    watchdog: bool  # a client has set the RTDE watchdog
    tick_rate: float  # [1/s]
    overruns: int  # control periods that were left out because the machine was too slow
    packages_sent: int  # to all clients
    packages_dropped: int
    packages_received: int  # input packages
    clients: tuple[int, ...]  # ports that clients are connected to


@dataclass(frozen=True)
class Input:
    """One package that arrived on the input registers."""

    number: int  # counts from 1
    tick: int  # control period in which it arrived
    values: dict[str, float | int | tuple[float, ...]]


@dataclass(frozen=True)
class Inputs:
    """Packages in their order. `last` goes into the next question; `lost` were forgotten before it was asked."""

    entries: tuple[Input, ...]
    last: int
    lost: int


class FaultClient:
    """Breaks one mock and tells its state. Every call has a time-out and raises FaultError; threads may share one."""

    def __init__(self, host: str, port: int = FAULT_PORT, timeout: float = TIMEOUT) -> None:
        self.host, self.port, self.timeout = host, port, timeout
        self.last_words: Callable[[], str] = str  # why the mock has ended; set by the handle of its process
        self._lock = threading.Lock()
        self._socket: socket.socket | None = None
        self._received = b""

    def close(self) -> None:
        """Ends the connection; the next call makes a new one."""
        with self._lock:
            self._hang_up()

    # -- looking -----------------------------------------------------------------------------------------------------

    def state(self) -> MockState:
        found: dict[str, Any] = self._ask("state")
        plain: dict[str, Any] = {
            name: tuple(value) if isinstance(value, list) else value for name, value in found.items()
        }
        return MockState(**plain)

    def received(self, since: int = 0) -> Inputs:
        """Input packages after number `since`."""
        entries: list[Input] = []
        lost, last = 0, since
        while True:
            page = self._ask("received", since=last)
            for number, tick, values in page["entries"]:
                plain = {name: tuple(value) if isinstance(value, list) else value for name, value in values.items()}
                entries.append(Input(number, tick, plain))
            lost += page["lost"]
            last = entries[-1].number if entries else max(last, page["last"])
            if not page["entries"] or last >= page["last"]:
                return Inputs(tuple(entries), last, lost)

    def log(self) -> list[tuple[float, str]]:
        """The last lines of the controller's log: robot time [s] and text."""
        return [(time, text) for time, text in self._ask("log")]

    # -- stops -------------------------------------------------------------------------------------------------------

    def protective_stop(self) -> None:
        self._ask("protective_stop")

    def estop(self) -> None:
        """Presses the emergency stop; the arm brakes, then loses power."""
        self._ask("estop")

    def release(self) -> None:
        """Pulls the emergency stop out again. The arm is without power: power on, release brakes."""
        self._ask("release")

    def safeguard_stop(self, on: bool = True) -> None:
        """Opens or closes the safety gate: the program pauses, and goes on."""
        self._ask("safeguard_stop", on=on)

    def recover(self) -> None:
        """All that a person would do after any stop, at once. No program runs afterwards."""
        self._ask("recover")

    def power_cycle(self, seconds: float = 0.2) -> None:
        """Off, and on again after so long; then the robot waits without power, where it stood."""
        self._ask("power_cycle", seconds=seconds)

    def unlock_delay(self, seconds: float) -> None:
        """How long after a protective stop it cannot be unlocked; real robots want 5 s, the mock 0."""
        self._ask("unlock_delay", seconds=seconds)

    # -- the line ----------------------------------------------------------------------------------------------------

    def silence(self, on: bool = True) -> None:
        """No data packages; everything else answers."""
        self._ask("silence", on=on)

    def cut(self, ports: Iterable[int] | None = None, reset: bool = False) -> int:
        """Closes connections to these ports (None: all but fault clients'), with FIN or RST; returns how many."""
        return int(self._ask("cut", ports=None if ports is None else list(ports), reset=reset))

    def delay(self, seconds: float) -> None:
        """Everything is sent so much later."""
        self._ask("delay", seconds=seconds)

    def drop(self, probability: float, seed: int = 0) -> None:
        """Data packages are lost with this probability."""
        self._ask("drop", probability=probability, seed=seed)

    def refuse(self, on: bool = True) -> None:
        """Connections are refused; those that stand remain."""
        self._ask("refuse", on=on)

    def black_hole(self, on: bool = True) -> None:
        """Connections are taken, and nothing is ever answered."""
        self._ask("black_hole", on=on)

    def partial_packages(self, on: bool = True) -> None:
        """Data packages arrive in two halves, a control period apart."""
        self._ask("partial_packages", on=on)

    def nan_state(self, on: bool = True) -> None:
        """All that is measured (actual_...) is not a number."""
        self._ask("nan_state", on=on)

    def clock_jump(self, seconds: float) -> None:
        """The controller's timestamp jumps, once; also backwards."""
        self._ask("clock_jump", seconds=seconds)

    def tick_overrun(self, seconds: float) -> None:
        """The controller stands still for so long, once."""
        self._ask("tick_overrun", limit=seconds + self.timeout, seconds=seconds)

    # -- the controller ----------------------------------------------------------------------------------------------

    def remote_control(self, on: bool) -> None:
        """Local control refuses programs."""
        self._ask("remote_control", on=on)

    def dashboard_mute(self, on: bool = True) -> None:
        """The dashboard takes requests and does not answer."""
        self._ask("dashboard_mute", on=on)

    def claim(self, names: Iterable[str]) -> None:
        """These inputs are in use by a field bus; an empty list frees all."""
        self._ask("claim", names=list(names))

    def version(self, major: int, minor: int, bugfix: int = 0, build: int = 0) -> None:
        """The software that the controller claims to run."""
        self._ask("version", version=[major, minor, bugfix, build])

    def slider(self, fraction: float) -> None:
        """Moves the speed slider of the pendant, 0 to 1."""
        self._ask("slider", fraction=fraction)

    def hold(self, on: bool = True) -> None:
        """Somebody holds the arm: it stands, whatever its program asks; let go, it follows its servos again."""
        self._ask("hold", on=on)

    def joint_lag(self, joint: int, seconds: float) -> None:
        """Joint 0 to 5 trails a steady motion by so much; 4 ms at power-on."""
        self._ask("joint_lag", joint=joint, seconds=seconds)

    # -- the load ----------------------------------------------------------------------------------------------------

    def wrench(self, wrench: Sequence[float]) -> None:
        """What pushes on the tool (6,) [N, N m]: about the TCP, base axes; adds to wall and payload."""
        self._ask("wrench", wrench=[float(value) for value in wrench])

    def wall(self, z: float, stiffness: float) -> None:
        """A spring table at height z [m], base axes: pushes the TCP up by stiffness [N/m] times its depth."""
        self._ask("wall", z=z, stiffness=stiffness)

    def no_wall(self) -> None:
        self._ask("no_wall")

    def force_limit(self, newtons: float) -> None:
        """|force| beyond which the controller makes a protective stop; 250 N at power-on."""
        self._ask("force_limit", newtons=newtons)

    def payload_mismatch(self, mass: float, centre: Sequence[float] = (0.0, 0.0, 0.0)) -> None:
        """Hangs a mass [kg] on the flange, its centre in flange axes [m]: felt until the controller is told of it."""
        self._ask("payload_mismatch", mass=mass, centre=[float(value) for value in centre])

    # ----------------------------------------------------------------------------------------------------------------

    def reset(self) -> None:
        """As at power-on: clients are cut, faults gone, the arm where it began. Ticks and counts go on."""
        self._ask("reset")

    def _ask(self, action: str, *, limit: float | None = None, **arguments: Any) -> Any:
        with self._lock:
            try:
                answer = self._exchange({"do": action, **arguments}, self.timeout if limit is None else limit)
            except (OSError, ValueError) as error:
                self._hang_up()
                reason = "no answer in time" if isinstance(error, TimeoutError) else str(error)
                raise FaultError(f"mock {self.host}:{self.port}, {action}: {reason}{self.last_words()}") from error
        if not answer["ok"]:
            raise FaultError(f"mock {self.host}:{self.port}, {action}: {answer['error']}")
        return answer["result"]

    def _exchange(self, request: dict[str, Any], limit: float) -> Any:
        if self._socket is None:
            self._socket = socket.create_connection((self.host, self.port), timeout=limit)
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket.settimeout(limit)
        self._socket.sendall(json.dumps(request).encode() + b"\n")
        while b"\n" not in self._received:
            data = self._socket.recv(1 << 16)
            if not data:
                raise OSError("the mock has closed the connection")
            self._received += data
        line, _, self._received = self._received.partition(b"\n")
        return json.loads(line)

    def _hang_up(self) -> None:
        if self._socket is not None:
            self._socket.close()
        self._socket, self._received = None, b""
