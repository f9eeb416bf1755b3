"""Random abuse of every port of one arm, seeded: other clients of it, and the other arm, see all their packages."""

from __future__ import annotations

import contextlib
import json
import os
import random
import socket
import struct
from collections.abc import Callable, Iterator

import pytest

from robot.mock import MockArms
from robot.mock.ur.controller import DASHBOARD, RTDE, SCRIPTS
from robot.mock.ur.fault_server import ACTIONS
from robot.mock.ur.fields import FORMATS, INPUTS, OUTPUTS
from robot.mock.ur.rtde import (
    DATA,
    INPUT_RECIPE,
    MESSAGE,
    OUTPUT_RECIPE,
    PAUSE,
    PROTOCOL,
    START,
    VERSION,
    make_package,
)
from tests.robot.mock.innocent import Innocent
from tests.robot.mock.wire_client import TIMEOUT, ControlClient, control_script, wire_host
from tests.robot.waiting import until

KINDS = (PROTOCOL, VERSION, MESSAGE, DATA, OUTPUT_RECIPE, INPUT_RECIPE, START, PAUSE)
NUMBERS = (0.0, 1.0, -1.0, 0.5, 1e-300, 1e6, -1e160, 1e300, float("nan"), float("inf"), 3.2, 255.0)
REQUESTS = "power on|brake release|stop|play|pause|unlock protective stop|running|restart safety|power off|popup|quit"
MOVES = "movej([0,0,0,0,0,0],a=1,v=1,r=0)|movel(p[0,0,0],a=1,v=1,r=0)|signal_async_progress(1)|end|x()"
WHOLE_PROCESS = {"tick_overrun"}  # makes all arms stand still, as it is meant to


def some(chance: random.Random, depth: int = 0) -> object:
    """A value of JSON."""
    plain = [*NUMBERS, None, True, "", "x", "input_int_register_0", 2**70, -1, 30004, [0.1] * 6, [5, 11, 0, 0]]
    if depth < 3 and chance.random() < 0.3:
        inner = [some(chance, depth + 1) for _ in range(chance.randrange(7))]
        return inner if chance.random() < 0.5 else dict(zip("abcdefg", inner, strict=False))
    return chance.choice(plain)


def rtde(chance: random.Random) -> bytes:
    """Packages of all types, mostly of a handshake, with commands for the control script among them."""
    sent, recipes = b"", []
    for _ in range(chance.randrange(1, 30)):
        kind = chance.choice(KINDS) if chance.random() < 0.95 else chance.randrange(256)
        payload = chance.randbytes(chance.choice((0, 1, 2, 8, 100)))
        if kind == PROTOCOL and chance.random() < 0.9:
            payload = b"\0\2"
        elif kind in (OUTPUT_RECIPE, INPUT_RECIPE) and chance.random() < 0.9:
            known = list(OUTPUTS if kind == OUTPUT_RECIPE else INPUTS)
            names = [chance.choice(known) for _ in range(chance.choice((1, 3, 30, 300)))]
            if kind == INPUT_RECIPE:
                names = ["input_int_register_0", *(f"input_double_register_{i}" for i in range(18))][: len(names)]
                recipes.append(names)
            payload = ",".join(names).encode()
            if kind == OUTPUT_RECIPE:
                payload = struct.pack(">d", chance.choice((500.0, 125.0, *NUMBERS))) + payload
        elif kind == DATA and recipes and chance.random() < 0.9:
            number = chance.randrange(len(recipes))
            payload = bytes([number + 1])
            for name in recipes[number]:
                value = chance.choice((chance.randrange(72), 255)) if "int" in name else chance.choice(NUMBERS)
                payload += struct.pack(">" + FORMATS[INPUTS[name]], value)
            payload = payload[: chance.choice((len(payload), len(payload), chance.randrange(len(payload))))]
        sent += make_package(kind, payload)
    return sent if chance.random() < 0.9 else sent[: chance.randrange(len(sent))]


def requests(chance: random.Random) -> bytes:
    """Lines for the dashboard."""
    lines = [chance.choice(REQUESTS.split("|")).encode() for _ in range(chance.randrange(1, 50))]
    lines.append(chance.randbytes(chance.choice((0, 5, 70_000))))
    return b"\n".join(lines) + b"\n" * chance.randrange(2)


def script(chance: random.Random) -> bytes:
    """ur_rtde's control script, more or less."""
    path = [chance.choice(MOVES.split("|")) for _ in range(chance.choice((0, 3, 300)))]
    text = control_script(chance.choice((0, 0, 24, 47, 9999)), path).encode()
    for _ in range(chance.choice((0, 0, 1, 5))):
        place = chance.randrange(len(text))
        text = text[:place] + chance.choice((b"\n" * 50_000, b"end\n", b"$5.9 ", b"\xff", b"")) + text[place + 3 :]
    return text


def door(chance: random.Random) -> bytes:
    """Lines for the fault server."""
    lines = []
    for _ in range(chance.randrange(1, 20)):
        action = chance.choice(sorted(set(ACTIONS) - WHOLE_PROCESS))
        code = getattr(ACTIONS[action], "__code__", None)
        names = code.co_varnames[1 : code.co_argcount] if code is not None else ()
        lines.append(json.dumps({"do": action, **{name: some(chance) for name in names}}))
    lines.append(chance.choice(("[" * 30_000, "nonsense", '{"do": []}', "9" * 5000, '"')))
    return "\n".join(lines).encode() + b"\n" * chance.randrange(2)


WIRE: dict[int, Callable[[random.Random], bytes]] = {RTDE: rtde, DASHBOARD: requests, **dict.fromkeys(SCRIPTS, script)}


def command(arms: MockArms, chance: random.Random) -> None:
    """The control script, and commands with numbers that do not go with them."""
    faults = arms.fault_clients[0]
    until(lambda: faults.state().clients == (RTDE,), "the others have gone, and all they sent is served")
    faults.recover()
    faults.force_limit(1e6)  # it may have been told of any payload
    path = [chance.choice(MOVES.split("|")) for _ in range(chance.choice((0, 3, 300)))]
    with ControlClient(arms.hosts[0], control_script(path=path)) as client:
        for _ in range(chance.randrange(1, 30)):
            doubles = [chance.choice((*NUMBERS, 0.1, 0.01)) for _ in range(18)]
            integers = [chance.choice((0, 1, 2, -1, 1 << 30)) for _ in range(7)]
            client.write(chance.choice((0, chance.randrange(80))), doubles, integers)
            if client.receive()["runtime_state"] != (2,):
                return


def abuse(arms: MockArms, seed: int, steps: int, ports: dict[int, Callable[[random.Random], bytes]]) -> None:
    """Connects to the first arm again and again, sends, sometimes reads, leaves or stays."""
    chance, lines = random.Random(seed), []
    try:
        for _ in range(steps):
            if ports is WIRE and chance.random() < 0.15:
                while lines:
                    lines.pop().close()  # who hold input registers
                command(arms, chance)
            port = chance.choice(list(ports))
            with contextlib.suppress(OSError):  # cut, or refused
                line = socket.create_connection((arms.hosts[0], port), TIMEOUT)
                lines.append(line)
                line.settimeout(0.2)
                line.sendall(ports[port](chance))
                if ports[port] is door:  # what it asked for is done when it ends
                    line.settimeout(TIMEOUT)
                    line.shutdown(socket.SHUT_WR)
                    while line.recv(1 << 16):
                        pass
                if chance.random() < 0.2:
                    line.recv(chance.choice((1, 1000)))
            while len(lines) > 20 or (lines and chance.random() < 0.4):
                lines.pop(chance.randrange(len(lines))).close()
    finally:
        for line in lines:
            line.close()


@pytest.fixture(scope="module")
def arms() -> Iterator[MockArms]:
    with MockArms([wire_host(93), wire_host(94)]) as running:
        yield running


def survives(arms: MockArms, seed: int, steps: int, ports: dict[int, Callable[[random.Random], bytes]]) -> None:
    spared = slice(1 if ports is not WIRE else 0, None)  # faults that are asked for at the door reach all clients
    arms.fault_clients[0].reset()
    with contextlib.ExitStack() as stack:
        innocents = [stack.enter_context(contextlib.closing(Innocent(host))) for host in arms.hosts[spared]]
        abuse(arms, seed, steps, ports)
        arms.check()
        for innocent, faults in zip(innocents, arms.fault_clients[spared], strict=True):
            innocent.check(faults)
    abused = arms.fault_clients[0]
    abused.reset()
    until(lambda: not abused.state().clients, "those that still waited have gone")
    abused.reset()
    with ControlClient(arms.hosts[0]) as client:
        assert client.call(40) is not None
    errors = os.pread(arms._errors.fileno(), 1 << 20, 0).decode()
    assert "Traceback" not in errors, errors[-5000:]


def test_random_messages_leave_mock_working(arms: MockArms) -> None:
    survives(arms, 0, 40, WIRE)
    survives(arms, 0, 20, {arms.fault_clients[0].port: door})


@pytest.mark.deep
@pytest.mark.parametrize("seed", [10, 11])
def test_many_random_messages_leave_mock_working(arms: MockArms, seed: int) -> None:
    survives(arms, seed, 200, WIRE)
    survives(arms, seed, 100, {arms.fault_clients[0].port: door, **WIRE})
