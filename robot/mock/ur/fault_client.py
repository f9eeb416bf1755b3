"""Client of a mock controller's fault server: injects faults and forces, and reads the state of the mock."""

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
    time: float  # of the robot, since its power-on [s]
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
    stop_reason: str  # why the last program ended; "" if none has ended
    payload: float  # as configured in the controller [kg]
    watchdog: bool  # a client has set the RTDE watchdog
    tick_rate: float  # [1/s]
    overruns: int  # control periods that were skipped because the machine was too slow
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
    """Packages in order of arrival. `last`: number for the next request. `lost`: number of packages that were dropped
    before this request."""

    entries: tuple[Input, ...]
    last: int
    lost: int


class FaultClient:
    """Injects faults into one mock and reads its state. Every call has a time-out and raises FaultError; threads may
    share a client."""

    def __init__(self, host: str, port: int = FAULT_PORT, timeout: float = TIMEOUT) -> None:
        self.host, self.port, self.timeout = host, port, timeout
        self.exit_report: Callable[[], str] = str  # how the mock has ended; set by the handle of its process
        self._lock = threading.Lock()
        self._socket: socket.socket | None = None
        self._received = b""

    def close(self) -> None:
        """Ends the connection; the next call connects again."""
        with self._lock:
            self._hang_up()

    # -- state -------------------------------------------------------------------------------------------------------

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
        """Releases the emergency stop. The arm has no power: power on, release brakes."""
        self._ask("release")

    def safeguard_stop(self, on: bool = True) -> None:
        """Opens or closes the safety gate: the program pauses or continues."""
        self._ask("safeguard_stop", on=on)

    def recover(self) -> None:
        """Does all that the operator does after a stop, at once. No program runs afterwards."""
        self._ask("recover")

    def power_cycle(self, seconds: float = 0.2) -> None:
        """Switches the controller off, and on again after this time; then the arm has no power, at its last joints."""
        self._ask("power_cycle", seconds=seconds)

    def unlock_delay(self, seconds: float) -> None:
        """Time after a protective stop in which it cannot be unlocked; real robots need 5 s, the mock 0."""
        self._ask("unlock_delay", seconds=seconds)

    # -- the line ----------------------------------------------------------------------------------------------------

    def silence(self, on: bool = True) -> None:
        """No data packages; everything else answers."""
        self._ask("silence", on=on)

    def cut(self, ports: Iterable[int] | None = None, reset: bool = False) -> int:
        """Closes connections to these ports (None: all except fault clients), with FIN or RST; returns their number."""
        return int(self._ask("cut", ports=None if ports is None else list(ports), reset=reset))

    def delay(self, seconds: float) -> None:
        """Delays everything that is sent."""
        self._ask("delay", seconds=seconds)

    def drop(self, probability: float, seed: int = 0) -> None:
        """Data packages are lost with this probability."""
        self._ask("drop", probability=probability, seed=seed)

    def refuse(self, on: bool = True) -> None:
        """Refuses new connections; existing ones stay."""
        self._ask("refuse", on=on)

    def black_hole(self, on: bool = True) -> None:
        """Accepts connections and answers nothing."""
        self._ask("black_hole", on=on)

    def partial_packages(self, on: bool = True) -> None:
        """Data packages arrive in two halves, a control period apart."""
        self._ask("partial_packages", on=on)

    def nan_state(self, on: bool = True) -> None:
        """All measured values (actual_...) are NaN."""
        self._ask("nan_state", on=on)

    def clock_jump(self, seconds: float) -> None:
        """Shifts the controller's timestamp once, forwards or backwards."""
        self._ask("clock_jump", seconds=seconds)

    def tick_overrun(self, seconds: float) -> None:
        """Stops the controller for this time, once."""
        self._ask("tick_overrun", limit=seconds + self.timeout, seconds=seconds)

    # -- the controller ----------------------------------------------------------------------------------------------

    def remote_control(self, on: bool) -> None:
        """False: the controller is in local control and refuses programs."""
        self._ask("remote_control", on=on)

    def dashboard_mute(self, on: bool = True) -> None:
        """The dashboard takes requests and does not answer."""
        self._ask("dashboard_mute", on=on)

    def claim(self, names: Iterable[str]) -> None:
        """Reserves these inputs for a field bus; an empty list releases all."""
        self._ask("claim", names=list(names))

    def version(self, major: int, minor: int, bugfix: int = 0, build: int = 0) -> None:
        """Sets the software version that the controller reports."""
        self._ask("version", version=[major, minor, bugfix, build])

    def slider(self, fraction: float) -> None:
        """Moves the speed slider of the pendant, 0 to 1."""
        self._ask("slider", fraction=fraction)

    def hold(self, on: bool = True) -> None:
        """Holds the arm: it does not move, whatever its program commands. After release it follows its servos again."""
        self._ask("hold", on=on)

    def joint_lag(self, joint: int, seconds: float) -> None:
        """Sets the time by which joint 0 to 5 lags behind a steady motion; 4 ms at power-on."""
        self._ask("joint_lag", joint=joint, seconds=seconds)

    # -- the load ----------------------------------------------------------------------------------------------------

    def wrench(self, wrench: Sequence[float]) -> None:
        """Sets an external wrench on the tool (6,) [N, N m], about the TCP, base axes; adds to wall and payload."""
        self._ask("wrench", wrench=[float(value) for value in wrench])

    def wall(self, z: float, stiffness: float) -> None:
        """Adds an elastic table at height z [m], base axes: it pushes the TCP up by stiffness [N/m] times its depth."""
        self._ask("wall", z=z, stiffness=stiffness)

    def no_wall(self) -> None:
        self._ask("no_wall")

    def force_limit(self, newtons: float) -> None:
        """Sets the |force| beyond which the controller makes a protective stop; 250 N at power-on."""
        self._ask("force_limit", newtons=newtons)

    def payload_mismatch(self, mass: float, centre: Sequence[float] = (0.0, 0.0, 0.0)) -> None:
        """Adds a mass [kg] on the flange, its centre in flange axes [m]. The measured force contains its weight until
        `set_payload` includes it."""
        self._ask("payload_mismatch", mass=mass, centre=[float(value) for value in centre])

    # ----------------------------------------------------------------------------------------------------------------

    def reset(self) -> None:
        """Restores the state at power-on: no clients, no faults, initial joints. Ticks and counts continue."""
        self._ask("reset")

    def _ask(self, action: str, *, limit: float | None = None, **arguments: Any) -> Any:
        with self._lock:
            try:
                answer = self._exchange({"do": action, **arguments}, self.timeout if limit is None else limit)
            except (OSError, ValueError) as error:
                self._hang_up()
                reason = "no answer in time" if isinstance(error, TimeoutError) else str(error)
                raise FaultError(f"mock {self.host}:{self.port}, {action}: {reason}{self.exit_report()}") from error
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
