"""What a client sends in error or malice ends its program or its connection; the other arms and clients go on."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import struct
import time
from collections.abc import Callable, Iterator
from types import SimpleNamespace

import pytest

from robot.mock import FaultClient, FaultError, MockArms
from robot.mock.ur import rtde
from robot.mock.ur.connection import Connection
from robot.mock.ur.controller import Controller
from robot.mock.ur.rtde import MAX_NAMES, InputRecipe, Inputs, make_package
from tests.robot.mock.innocent import Innocent
from tests.robot.mock.wire_client import TIMEOUT, ControlClient, RtdeClient, wire_host
from tests.robot.waiting import until

SET_TCP, MOVE_J, MOVE_L, SOLVE, MOVE_PATH = 29, 1, 3, 46, 45


@pytest.fixture(scope="module")
def running() -> Iterator[MockArms]:
    with MockArms([wire_host(90), wire_host(91)]) as arms:
        yield arms


@pytest.fixture
def arms(running: MockArms) -> Iterator[MockArms]:
    """Two arms. At the end both are as they were for their innocent clients."""
    for faults in running.fault_clients:
        faults.reset()
    with contextlib.ExitStack() as stack:
        innocents = [stack.enter_context(contextlib.closing(Innocent(host))) for host in running.hosts]
        yield running
        running.check()
        for innocent, faults in zip(innocents, running.fault_clients, strict=True):
            innocent.check(faults)


def stopped(faults: FaultClient) -> str:
    """Why the program ended."""
    until(lambda: not faults.state().program, "the program ends")
    return faults.state().stop_reason


def test_short_command_ends_program(arms: MockArms) -> None:
    """As moveJ([0, 0, 0]) does: its client would wait for minutes."""
    with ControlClient(arms.hosts[0]) as client:
        client.socket.sendall(make_package(85, struct.pack(">Bi", 1, MOVE_J) + bytes(24)))
        client.wait(lambda state: state["runtime_state"] == (1,))
    assert "command 1 of a wrong length" in stopped(arms.fault_clients[0])


@pytest.mark.parametrize("names", [["actual_q"] * 1366, ["a"] * 30_000])
def test_too_long_recipe_is_refused(arms: MockArms, names: list[str]) -> None:
    with RtdeClient(arms.hosts[0]) as client:
        assert client.outputs(*names)[0] == 0
        assert client.inputs(*names)[0] == 0
        assert not client.start()
        most = (MAX_NAMES + 1) // 9
        assert client.outputs(*["actual_q"] * most)[0] == 1
        assert client.start() and len(client.receive()) == 1
    assert any(f"at most {MAX_NAMES}" in text for _, text in arms.fault_clients[0].log())


@pytest.mark.parametrize(
    "request_",
    [
        "[" * 20_000,
        '{"do": "version", "version": [Infinity, 1, 1, 1]}',
        '{"do": "version", "version": [100000000000, 1, 1, 1]}',
        '{"do": "version", "version": [NaN, 1, 1, 1]}',
        '{"do": "clock_jump", "seconds": 1' + "0" * 400 + "}",
        '{"do": "clock_jump", "seconds": NaN}',
        '{"do": "wrench", "wrench": [1e300, 0, 0, 0, 0, 0]}',
        '{"do": "wall", "z": NaN, "stiffness": 1}',
        '{"do": "delay", "seconds": 1e9}',
        '{"do": "received", "since": []}',
        '{"do": "claim", "names": [[]]}',
    ],
)
def test_fault_server_refuses_invalid_values(arms: MockArms, request_: str) -> None:
    with socket.create_connection((arms.hosts[0], 30020), TIMEOUT) as line, line.makefile("rw") as file:
        file.write(request_ + "\n")
        file.flush()
        answer = json.loads(file.readline())
    assert answer["ok"] is False and len(answer["error"]) < 1000
    with RtdeClient(arms.hosts[0]) as client:
        assert struct.unpack(">4I", client.ask(118))[0] == 5


def test_flood_of_packages_does_not_delay_others(arms: MockArms) -> None:
    """Its client is served a burst at a time; all of it in the end."""
    with RtdeClient(arms.hosts[0]) as client:
        client.inputs("input_int_register_30")
        since = arms.fault_clients[0].received().last
        flood = make_package(85, struct.pack(">Bi", 1, 7)) * 1000
        for _ in range(5):
            client.socket.sendall(flood)
        begun = arms.fault_clients[0].state().tick
        until(lambda: arms.fault_clients[0].state().packages_received == since + 5000, "all of it")
        assert arms.fault_clients[0].state().tick > begun


def test_program_end_is_searched_once() -> None:
    """A megabyte that waits for its end makes a byte more no dearer than the first."""
    client = SimpleNamespace(received=bytearray(), searched=0)
    serve: Callable[[object, object], bool] = Controller._serve_script
    costs = []
    for filled in (0, 1_000_000):
        client.received += b"\n" * filled
        serve(None, client)
        spent = []
        for _ in range(30):
            client.received += b"\n"
            begun = time.perf_counter()
            serve(None, client)
            spent.append(time.perf_counter() - begun)
        costs.append(min(spent))
    assert costs[1] < 20 * costs[0] + 1e-4  # it was fifty milliseconds


def test_stored_inputs_are_limited_and_losses_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rtde, "MAX_STORED_BYTES", 1000 * (rtde.PACKAGE_OVERHEAD + 4))
    kept, recipe = Inputs(), InputRecipe(("input_int_register_5",), struct.Struct(">i"), (1,))
    for value in range(1, 5001):
        kept.add(value, recipe, struct.pack(">i", value))
    entries, lost = kept.after(0, 10_000)
    assert (len(entries), lost) == (1000, 4000) and entries[0].number == 4001
    assert all(entry.values == {"input_int_register_5": entry.number} for entry in entries)
    entries, lost = kept.after(4990, 5)
    assert [entry.number for entry in entries] == [4991, 4992, 4993, 4994, 4995] and lost == 0
    kept.clear()
    assert kept.after(0, 10) == ([], 5000)
    kept.add(1, recipe, struct.pack(">i", 7))
    assert kept.after(5000, 10)[0][0].number == 5001


def test_many_requests_in_one_package_are_answered(arms: MockArms) -> None:
    with socket.create_connection((arms.hosts[0], 30020), TIMEOUT) as line, line.makefile("rw") as file:
        file.write('{"do": "state"}\n' * 50)
        file.flush()
        assert all(json.loads(file.readline())["ok"] for _ in range(50))
    with socket.create_connection((arms.hosts[0], 29999), TIMEOUT) as line, line.makefile("rw") as file:
        file.write("running\n" * 50)
        file.flush()
        file.readline()
        assert [file.readline().strip() for _ in range(50)] == ["Program running: false"] * 50


def test_slow_connection_buffer_is_limited() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener, socket.create_connection(listener.getsockname()):
        client = Connection(listener.accept()[0], 30004)
        for _ in range(70):
            client.send(bytes(1 << 20), due=1.0)
        assert not client.flush(0.0)
        client.close()


def test_fault_client_reports_how_mock_ended() -> None:
    with MockArms([wire_host(92)]) as mock:
        mock.fault_clients[0].state()
        os.kill(mock.pid, signal.SIGKILL)
        with pytest.raises(FaultError, match="has ended, killed by SIGKILL"):
            mock.fault_clients[0].state()
