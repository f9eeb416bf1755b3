"""The fault server of a mock controller: one JSON object a line in, one out (client: `robot.mock.ur.fault_client`).

A request is {"do": name, ...arguments}; the reply {"ok": true, "result": ...} or {"ok": false, "error": text}. It is
no part of any real protocol, and its port stays open whatever happens to the others.
"""

from __future__ import annotations

import json
import selectors
import time
from collections.abc import Callable
from functools import partial
from itertools import islice
from typing import Any

import numpy as np

from robot.mock.ur.machine.load import Mass, Wall
from robot.mock.ur.wire.connection import Connection
from robot.mock.ur.wire.controller import PORTS, Controller, open_port
from robot.mock.ur.wire.fields import INPUTS
from tacsim.interface import FloatArray

PAGE = 500  # input packages in one reply
MAX_REQUEST = 1 << 16  # bytes


class FaultServer:
    """Listens on one port and acts on one controller."""

    def __init__(self, controller: Controller, selector: selectors.BaseSelector, port: int) -> None:
        self._controller, self._selector = controller, selector
        self._clients: set[Connection] = set()
        self._listener = open_port(controller.config.host, port)
        self.port = port
        selector.register(self._listener, selectors.EVENT_READ, self._accept)

    def close(self) -> None:
        for client in list(self._clients):
            self._drop(client)
        self._selector.unregister(self._listener)
        self._listener.close()

    def flush(self) -> None:
        """Sends what did not fit before."""
        for client in list(self._clients):
            if not client.flush(0.0):
                self._drop(client)

    def _accept(self) -> None:
        try:
            sock, _ = self._listener.accept()
        except OSError:
            return
        client = Connection(sock, self.port)
        self._clients.add(client)
        self._selector.register(sock, selectors.EVENT_READ, partial(self._read, client))

    def _drop(self, client: Connection) -> None:
        self._clients.discard(client)
        self._selector.unregister(client.socket)
        client.close()

    def _read(self, client: Connection) -> None:
        alive = client.read()
        while (end := client.received.find(b"\n")) >= 0:
            line = bytes(client.received[:end])
            del client.received[: end + 1]
            client.send(json.dumps(self.answer(line)).encode() + b"\n")
        if not alive or len(client.received) > MAX_REQUEST:
            self._drop(client)

    def answer(self, line: bytes) -> dict[str, Any]:
        """What a request brings about, or why not."""
        try:
            request = json.loads(line)
            action = ACTIONS.get(request.pop("do"))
            if action is None:
                return {"ok": False, "error": f"no such action; allowed: {', '.join(sorted(ACTIONS))}"}
            return {"ok": True, "result": action(self._controller, **request)}
        except (ValueError, TypeError, KeyError, AttributeError, OSError) as error:
            return {"ok": False, "error": f"{type(error).__name__}: {error}"}


def _six(values: list[float]) -> FloatArray:
    array = np.array(values, dtype=np.float64)
    if array.shape != (6,) or not np.isfinite(array).all():
        raise ValueError(f"need 6 finite numbers, got {values}")
    return array


def _not_negative(value: float, name: str) -> float:
    if not 0 <= value < float("inf"):
        raise ValueError(f"{name} must be at least 0 and finite, got {value}")
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
        "wrench": machine.load.felt.tolist(),
        "rests": arm.rests,
        "program": machine.program is not None,
        "safety": machine.safety.name,
        "mode": machine.mode.name,
        "stop_reason": machine.stop_reason,
        "payload": machine.load.told.mass,
        "watchdog": machine.watchdog is not None,
        "tick_rate": controller.tick_rate,
        "overruns": controller.overruns,
        "packages_sent": controller.sent,
        "packages_dropped": controller.dropped,
        "packages_received": controller.arrived,
        "clients": sorted(client.port for client in controller.clients),
    }


def _received(controller: Controller, since: int) -> dict[str, Any]:
    kept = controller.received
    oldest = controller.arrived - len(kept)  # number of the last one that is gone
    begin = max(0, since - oldest)
    page = islice(kept, begin, begin + PAGE)
    entries = [(entry.number, entry.tick, entry.values) for entry in page]
    return {"entries": entries, "lost": max(0, oldest - since), "last": controller.arrived}


def _wrench(controller: Controller, wrench: list[float]) -> None:
    controller.machine.load.wrench = _six(wrench)


def _wall(controller: Controller, z: float, stiffness: float) -> None:
    controller.machine.load.wall = Wall(float(z), _not_negative(stiffness, "stiffness"))


def _no_wall(controller: Controller) -> None:
    controller.machine.load.wall = None


def _payload_mismatch(controller: Controller, mass: float, centre: list[float]) -> None:
    controller.machine.load.hidden = Mass.of([mass, *centre])


def _force_limit(controller: Controller, newtons: float) -> None:
    controller.machine.load.force_limit = _not_negative(newtons, "force limit")


def _drop(controller: Controller, probability: float, seed: int) -> None:
    if not 0 <= probability <= 1:
        raise ValueError(f"probability must lie within 0 and 1, got {probability}")
    controller.faults.drop, controller.faults.chance = float(probability), np.random.default_rng(seed)


def _delay(controller: Controller, seconds: float) -> None:
    controller.faults.delay = _not_negative(seconds, "delay")


def _claim(controller: Controller, names: list[str]) -> None:
    unknown = [name for name in names if name not in INPUTS]
    if unknown:
        raise ValueError(f"no such inputs: {', '.join(unknown)}")
    controller.faults.claimed = set(names)


def _version(controller: Controller, version: list[int]) -> None:
    major, minor, bugfix, build = (int(number) for number in version)
    controller.machine.version = (major, minor, bugfix, build)


def _clock_jump(controller: Controller, seconds: float) -> None:
    controller.machine.clock_offset += float(seconds)


def _tick_overrun(controller: Controller, seconds: float) -> None:
    time.sleep(min(_not_negative(seconds, "seconds"), 30.0))  # the whole controller stands still, as asked


def _unlock_delay(controller: Controller, seconds: float) -> None:
    controller.machine.unlock_delay = _not_negative(seconds, "unlock delay")


def _switch(name: str) -> Callable[[Controller, bool], None]:
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
    "safeguard_stop": lambda controller, on: controller.machine.safeguard_stop(on),
    "recover": lambda controller: controller.machine.recover(),
    "power_cycle": lambda controller, seconds: controller.power_cycle(_not_negative(seconds, "seconds")),
    "silence": _switch("silence"),
    "partial_packages": _switch("partial"),
    "nan_state": _switch("nan"),
    "remote_control": _switch("remote_control"),
    "dashboard_mute": _switch("dashboard_mute"),
    "black_hole": Controller.black_hole,
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
    "version": _version,
    "clock_jump": _clock_jump,
    "tick_overrun": _tick_overrun,
    "unlock_delay": _unlock_delay,
}
