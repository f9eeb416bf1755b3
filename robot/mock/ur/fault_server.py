"""The fault server of a mock controller: one JSON object per line for request and reply (client:
`robot.mock.ur.fault_client`).

A request is {"do": name, ...arguments}; the reply {"ok": true, "result": ...} or {"ok": false, "error": text}. It is
not part of a real protocol, and its port stays open when the others are closed.
"""

from __future__ import annotations

import json
import selectors
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from robot.mock.ur.connection import Connection
from robot.mock.ur.controller import PORTS, Controller, accept_client, open_port, take_lines
from robot.mock.ur.fields import INPUTS
from robot.mock.ur.machine.forces import Mass, Wall
from robot.mock.ur.machine.program import MAX_NUMBER
from robot.mock.ur.machine.state import check_version
from tacsim.interface import FloatArray

PAGE = 500  # input packages in one reply


class FaultServer:
    """Listens on one port and acts on one controller."""

    def __init__(self, controller: Controller, selector: selectors.BaseSelector, port: int) -> None:
        self._controller, self._selector = controller, selector
        self._clients: set[Connection] = set()
        self._behind: set[Connection] = set()  # clients that sent more than one request
        self._listener = open_port(controller.config.host, port)
        self.port = port
        selector.register(self._listener, selectors.EVENT_READ, self._accept)

    def close(self) -> None:
        for client in list(self._clients):
            self._drop(client)
        self._selector.unregister(self._listener)
        self._listener.close()

    def flush(self) -> None:
        """Sends data that did not fit into the socket before."""
        for client in list(self._clients):
            if not client.flush(0.0):
                self._drop(client)
            elif client in self._behind:
                self._serve(client)

    def _accept(self) -> None:
        max_clients = 64  # more are closed at once
        client = accept_client(self._listener, self.port)
        if client is None:
            return
        if len(self._clients) >= max_clients:
            client.close()
            return
        self._clients.add(client)
        self._selector.register(client.socket, selectors.EVENT_READ, partial(self._serve, client))

    def _drop(self, client: Connection) -> None:
        self._clients.discard(client)
        self._behind.discard(client)
        self._selector.unregister(client.socket)
        client.close()

    def _serve(self, client: Connection) -> None:
        """Answers one request. No more data are read from a client whose requests still wait."""
        max_request = 1 << 16  # bytes
        alive = client in self._behind or client.read()
        line = next(take_lines(client.received), None)
        if line is not None:
            client.send(json.dumps(self.answer(line)).encode() + b"\n")
        if not alive or (line is None and len(client.received) > max_request):
            self._drop(client)
        else:
            (self._behind.add if b"\n" in client.received else self._behind.discard)(client)

    def answer(self, line: bytes) -> dict[str, Any]:
        """Runs a request; returns its result, or the reason of its failure."""
        try:
            request = json.loads(line)
            action = ACTIONS.get(request.pop("do"))
            if action is None:
                return {"ok": False, "error": f"no such action; allowed: {', '.join(sorted(ACTIONS))}"}
            return {"ok": True, "result": action(self._controller, **request)}
        except Exception as error:  # an invalid request must not stop the arms
            return {"ok": False, "error": f"{type(error).__name__}: {error}"}


def _six_numbers(values: list[float]) -> FloatArray:
    array = np.array(values, dtype=np.float64)
    if array.shape != (6,) or not float(np.abs(array).max()) <= MAX_NUMBER:
        raise ValueError(f"need 6 finite numbers of at most {MAX_NUMBER:g}, got {values}")
    return array


def _require_number(value: float, name: str, low: float = -MAX_NUMBER, high: float = MAX_NUMBER) -> float:
    if not low <= value <= high:  # also refuses NaN
        raise ValueError(f"{name} must be within {low:g} and {high:g}, got {value}")
    return float(value)


def _state(controller: Controller) -> dict[str, Any]:
    machine, arm = controller.machine, controller.machine.arm
    return {
        "tick": controller.ticks,
        "time": machine.time,
        "joints": arm.q.tolist(),
        "joint_speeds": arm.qd.tolist(),
        "target_joints": arm.target_q.tolist(),
        "pose": arm.pose.tolist(),
        "tcp_speed": arm.twist.tolist(),
        "wrench": machine.load.zeroed_wrench.tolist(),
        "rests": arm.rests,
        "program": machine.program is not None,
        "safety": machine.safety.name,
        "mode": machine.mode.name,
        "stop_reason": machine.stop_reason,
        "payload": machine.load.configured_payload.mass,
        "watchdog": machine.watchdog is not None,
        "tick_rate": controller.tick_rate,
        "overruns": controller.overruns,
        "packages_sent": controller.sent,
        "packages_dropped": controller.dropped,
        "packages_received": controller.inputs.arrived,
        "clients": sorted(client.port for client in controller.clients),
    }


def _received(controller: Controller, since: int) -> dict[str, Any]:
    entries, lost = controller.inputs.after(since, PAGE)
    rows = [(entry.number, entry.tick, entry.values) for entry in entries]
    return {"entries": rows, "lost": lost, "last": controller.inputs.arrived}


def _wrench(controller: Controller, wrench: list[float]) -> None:
    controller.machine.load.wrench = _six_numbers(wrench)


def _wall(controller: Controller, z: float, stiffness: float) -> None:
    controller.machine.load.wall = Wall(_require_number(z, "z"), _require_number(stiffness, "stiffness", 0.0, 1e9))


def _no_wall(controller: Controller) -> None:
    controller.machine.load.wall = None


def _payload_mismatch(controller: Controller, mass: float, centre: list[float]) -> None:
    controller.machine.load.hidden = Mass.of([mass, *centre])


def _force_limit(controller: Controller, newtons: float) -> None:
    controller.machine.load.force_limit = _require_number(newtons, "force limit", 0.0)


def _drop(controller: Controller, probability: float, seed: int) -> None:
    if not 0 <= probability <= 1:
        raise ValueError(f"probability must be within 0 and 1, got {probability}")
    controller.faults.drop, controller.faults.random = float(probability), np.random.default_rng(seed)


def _delay(controller: Controller, seconds: float) -> None:
    max_delay = 60.0  # of a slow connection [s]
    controller.faults.delay = _require_number(seconds, "delay", 0.0, max_delay)


def _claim(controller: Controller, names: list[str]) -> None:
    unknown = [name for name in names if name not in INPUTS]
    if unknown:
        raise ValueError(f"no such inputs: {', '.join(unknown)}")
    controller.faults.claimed = set(names)


def _version(controller: Controller, version: list[int]) -> None:
    controller.machine.version = check_version(version)


def _clock_jump(controller: Controller, seconds: float) -> None:
    controller.machine.clock_offset += _require_number(seconds, "seconds")


def _tick_overrun(controller: Controller, seconds: float) -> None:
    time.sleep(_require_number(seconds, "seconds", 0.0, 30.0))  # stops the whole controller, as requested


def _unlock_delay(controller: Controller, seconds: float) -> None:
    controller.machine.unlock_delay = _require_number(seconds, "unlock delay", 0.0)


def _slider(controller: Controller, fraction: float) -> None:
    controller.machine.set_slider(_require_number(fraction, "speed slider", 0.0, 1.0))


def _hold(controller: Controller, on: bool) -> None:
    controller.machine.arm.held = bool(on)


def _joint_lag(controller: Controller, joint: int, seconds: float) -> None:
    if joint not in range(6):
        raise ValueError(f"joint must be one of 0 to 5, got {joint}")
    controller.machine.arm.servo_rates[joint] = 2.0 / _require_number(seconds, "lag", 1e-3, 60.0)


def _fault_switch(name: str) -> Callable[[Controller, bool], None]:
    def switch(controller: Controller, on: bool) -> None:
        setattr(controller.faults, name, bool(on))

    return switch


ACTIONS: dict[str, Callable[..., Any]] = {
    "state": _state,
    "received": _received,
    "log": lambda controller: list(controller.machine.log),
    "reset": Controller.reset,
    "protective_stop": lambda controller: controller.machine.protective_stop("injected"),
    "estop": lambda controller: controller.machine.emergency_stop(),
    "release": lambda controller: controller.machine.release_emergency_stop(),
    "safeguard_stop": lambda controller, on: controller.machine.safeguard_stop(bool(on)),
    "recover": lambda controller: controller.machine.recover(),
    "power_cycle": lambda controller, seconds: controller.power_cycle(_require_number(seconds, "seconds", 0.0)),
    "silence": _fault_switch("silence"),
    "partial_packages": _fault_switch("partial"),
    "nan_state": _fault_switch("nan"),
    "remote_control": _fault_switch("remote_control"),
    "dashboard_mute": _fault_switch("dashboard_mute"),
    "black_hole": lambda controller, on: controller.black_hole(bool(on)),
    "cut": lambda controller, ports, reset: controller.cut(PORTS if ports is None else ports, reset=reset),
    "refuse": lambda controller, on: controller.refuse() if on else controller.listen(),
    "delay": _delay,
    "drop": _drop,
    "wrench": _wrench,
    "wall": _wall,
    "no_wall": _no_wall,
    "force_limit": _force_limit,
    "payload_mismatch": _payload_mismatch,
    "claim": _claim,
    "slider": _slider,
    "hold": _hold,
    "joint_lag": _joint_lag,
    "version": _version,
    "clock_jump": _clock_jump,
    "tick_overrun": _tick_overrun,
    "unlock_delay": _unlock_delay,
}
