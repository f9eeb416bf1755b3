"""The wire, byte by byte, by a client without ur_rtde: framing, recipes, claims, programs, dashboard; and abuse."""

from __future__ import annotations

import math
import socket
import struct
import time

import numpy as np
import pytest

from robot.common.kinematics import Kinematics, matrix
from robot.mock import MOCK_SERIAL, FaultClient, MockUR
from robot.mock.ur.controller import MAX_CLIENTS, PORTS
from robot.mock.ur.fields import INPUTS, OUTPUTS
from robot.mock.ur.machine.arm import HOME
from robot.mock.ur.rtde import BadPackage, make_package, take_packages
from tests.robot.mock.wire_client import TIMEOUT, ControlClient, RtdeClient, control_script, dashboard
from tests.robot.waiting import until


def streaming(client: RtdeClient, *names: str, frequency: float = 500.0) -> RtdeClient:
    assert client.protocol()
    recipe, types = client.outputs(*names, frequency=frequency)
    assert recipe == 1, types
    assert client.start()
    return client


def answers(mock: MockUR) -> bool:
    """True when a new client is still served."""
    with RtdeClient(mock.host) as client:
        return len(streaming(client, "timestamp").receive()["timestamp"]) == 1


# -- framing ---------------------------------------------------------------------------------------------------------


def test_take_packages_from_any_pieces_is_complete() -> None:
    stream = make_package(86, b"\0\2") + make_package(118, b"") + make_package(85, bytes(range(200)))
    for cut in range(len(stream)):
        buffer = bytearray(stream[:cut])
        found = list(take_packages(buffer))
        buffer += stream[cut:]
        found += list(take_packages(buffer))
        assert [kind for kind, _ in found] == [86, 118, 85] and not buffer
    with pytest.raises(BadPackage, match="less than its header"):
        list(take_packages(bytearray(b"\0\1\0")))


def test_rtde_protocol_and_version_are_answered(mock: MockUR) -> None:
    with RtdeClient(mock.host) as client:
        assert client.ask(86, struct.pack(">H", 2)) == b"\1"
        assert client.ask(86, struct.pack(">H", 1)) == b"\0"
        assert struct.unpack(">4I", client.ask(118)) == (5, 11, 0, 108150)


def test_output_recipe_returns_types_and_not_found(mock: MockUR) -> None:
    with RtdeClient(mock.host) as client:
        assert client.outputs("timestamp", "actual_q", "runtime_state") == (1, ["DOUBLE", "VECTOR6D", "UINT32"])
        assert client.outputs("timestamp", "nonsense") == (0, ["DOUBLE", "NOT_FOUND"])
        assert client.outputs("actual_current_as_torque")[1] == ["NOT_FOUND"]  # of 5.23 and later
        assert client.outputs("timestamp", frequency=0.0)[0] == 0
        assert client.ask(79, b"\0\0") == b"\0"
    with RtdeClient(mock.host) as client:
        assert client.inputs("input_int_register_0", "nonsense") == (0, ["INT32", "NOT_FOUND"])


def test_each_output_field_is_packed_and_finite(mock: MockUR) -> None:
    mock.faults.version(5, 25)
    state: dict[str, tuple[float, ...]] = {}
    for first in range(0, len(OUTPUTS), 60):  # so many names fit into a recipe
        with RtdeClient(mock.host) as client:
            state |= streaming(client, *list(OUTPUTS)[first : first + 60]).receive()
    assert set(state) == set(OUTPUTS)
    assert all(math.isfinite(value) for values in state.values() for value in values)
    assert state["robot_mode"] == (7,) and state["safety_mode"] == (1,) and state["joint_mode"] == (253,) * 6
    assert state["actual_q"] == pytest.approx(HOME) and state["runtime_state"] == (1,)
    np.testing.assert_allclose(matrix(state["actual_TCP_pose"]), Kinematics("ur5e").forward(HOME), atol=1e-9)


def test_stream_runs_only_between_start_and_pause(mock: MockUR) -> None:
    with RtdeClient(mock.host) as client:
        client.outputs("timestamp")
        sent = mock.faults.state().packages_sent
        time.sleep(0.05)
        assert mock.faults.state().packages_sent == sent
        assert client.start()
        client.receive()
        assert client.pause()
        sent = mock.faults.state().packages_sent
        time.sleep(0.05)
        assert mock.faults.state().packages_sent == sent


def test_stream_is_ordered_complete_and_at_frequency(mock: MockUR) -> None:
    for frequency, step, count in ((500.0, 0.002, 12), (125.0, 0.008, 12), (10.0, 0.1, 4)):
        with RtdeClient(mock.host) as client:
            streaming(client, "timestamp", frequency=frequency)
            times = [client.receive()["timestamp"][0] for _ in range(count)]
        np.testing.assert_allclose(np.diff(times), step, atol=1e-9)


def test_start_without_recipe_is_refused(mock: MockUR) -> None:
    with RtdeClient(mock.host) as client:
        assert not client.start()


# -- input registers -------------------------------------------------------------------------------------------------


def test_inputs_have_one_owner_until_disconnect(mock: MockUR) -> None:
    with RtdeClient(mock.host) as first, RtdeClient(mock.host) as second:
        assert first.inputs("input_int_register_0", "input_double_register_3") == (1, ["INT32", "DOUBLE"])
        assert first.inputs("input_int_register_0") == (2, ["INT32"])  # one's own, again
        assert second.inputs("input_int_register_1", "input_int_register_0") == (0, ["INT32", "IN_USE"])
        assert second.inputs("input_int_register_1") == (1, ["INT32"])
        first.socket.close()
        until(lambda: mock.faults.state().clients.count(30004) == 1, "the first client is gone")
        assert second.inputs("input_int_register_0")[0] == 2


def test_fault_server_returns_stored_inputs(mock: MockUR) -> None:
    since = mock.faults.received().last
    with RtdeClient(mock.host) as client:
        client.inputs("input_int_register_5", "input_double_register_7")
        for value in range(1200):  # more than a page of the fault server
            client.send(1, value, value / 8)
        until(lambda: mock.faults.state().packages_received == since + 1200, "1200 packages")
        found = mock.faults.received(since)
    assert found.lost == 0 and found.last == since + 1200
    assert [entry.values["input_int_register_5"] for entry in found.entries] == list(range(1200))
    assert found.entries[8].values["input_double_register_7"] == 1.0
    assert all(a.tick <= b.tick for a, b in zip(found.entries, found.entries[1:], strict=False))
    assert mock.faults.received(found.last).entries == ()


def test_input_package_of_wrong_size_or_recipe_is_ignored(mock: MockUR) -> None:
    with RtdeClient(mock.host) as client:
        client.inputs("input_int_register_5")
        since = mock.faults.received().last
        for payload in (b"\1\0\0", b"\7" + bytes(4), b"", b"\1\0\0\0\2too long"):
            client.socket.sendall(make_package(85, payload))
        client.send(1, 3)
        until(lambda: mock.faults.state().packages_received == since + 2, "the good ones")
        entries = mock.faults.received(since).entries
    assert [entry.values for entry in entries] == [{"input_int_register_5": 2}, {"input_int_register_5": 3}]
    texts = [text for _, text in mock.faults.log()]
    assert len([text for text in texts if "ignored" in text]) == 3 and any("cut: 12 bytes" in text for text in texts)


def test_controller_outputs_are_set_by_mask(mock: MockUR) -> None:
    with RtdeClient(mock.host) as client:
        streaming(client, "actual_digital_output_bits", "standard_analog_output0", "standard_analog_output1")
        for kind in ("standard", "configurable", "tool"):
            number, _ = client.inputs(f"{kind}_digital_output_mask", f"{kind}_digital_output")
            client.send(number, 0b11, 0b10)
        names = ("mask", "type", "0", "1")
        number, _ = client.inputs(*(f"standard_analog_output_{name}" for name in names))
        client.send(number, 3, 0b10, 0.5, 0.25)
        state = client.receive()
        while state["standard_analog_output1"] != (2.5,):
            state = client.receive()
    assert state["actual_digital_output_bits"] == (0b10 | 0b10 << 8 | 0b10 << 16,)
    assert state["standard_analog_output0"] == pytest.approx((0.012,))  # half of 4-20 mA


def test_input_names_equal_protocol() -> None:
    assert {"speed_slider_mask", "speed_slider_fraction", "external_force_torque"} <= set(INPUTS)
    assert sum(name.startswith("input_double_register_") for name in INPUTS) == 48


# -- programs and dashboard ------------------------------------------------------------------------------------------


def test_uploaded_program_moves_arm(mock: MockUR) -> None:
    with ControlClient(mock.host) as client:
        goal = list(client.receive()["actual_TCP_pose"])
        goal[2] -= 0.05
        assert client.call(3, [*goal, 0.25, 1.2]) is not None
        state = client.wait(lambda state: math.dist(state["actual_TCP_pose"][:3], goal[:3]) < 1e-8)
        assert state["runtime_state"] == (2,)
        found = client.call(40)
        assert found is not None and [found[f"output_double_register_{i}"] for i in range(6)] == [(0.0,)] * 6


def test_upper_registers_control_program(mock: MockUR) -> None:
    with ControlClient(mock.host) as first, RtdeClient(mock.host) as second:
        streaming(second, "runtime_state", *(f"output_int_register_{i}" for i in (24, 25)))
        second.inputs("input_int_register_24", *(f"input_double_register_{24 + i}" for i in range(6)))
        with socket.create_connection((mock.host, 30001), TIMEOUT) as line:
            line.sendall(control_script(24).encode())
        while second.receive()["output_int_register_24"] != (1,):
            pass
        second.send(1, 37, *[7.0] * 6)
        while second.receive()["output_int_register_24"] != (2,):
            pass
        assert second.receive()["output_int_register_25"] == (0,)
        first.wait(lambda state: state["runtime_state"] == (2,))  # older packages wait in its socket


def test_programs_in_pieces_or_together_are_run(mock: MockUR) -> None:
    text = control_script().encode()
    with socket.create_connection((mock.host, 30002), TIMEOUT) as line:
        for start in range(0, len(text), 100):
            line.sendall(text[start : start + 100])
            time.sleep(0.001)
        until(lambda: mock.faults.state().program, "the program runs")
        line.sendall(text + b"def second():\n  sync()\nend\n")  # at once: the second replaces the one before it starts
        until(lambda: any("'second' started" in t for _, t in mock.faults.log()), "the second of two starts")


def test_dashboard_answers_requests(mock: MockUR) -> None:
    found = dashboard(
        mock.host,
        *("PolyscopeVersion", "get serial number", "is in remote control", "robotmode", "safetystatus", "running"),
        *("programState", "play", "stop", "nonsense", "get robot model", "load x.urp"),
    )
    assert found == [
        "URSoftware 5.11.0.108150 (Jan 01 2022)",
        MOCK_SERIAL,
        *("true", "Robotmode: RUNNING", "Safetystatus: NORMAL", "Program running: false"),
        *("STOPPED <unnamed>", "Failed to execute: play", "Stopped", "could not understand: 'nonsense'", "UR5"),
        "File not found: x.urp",
    ]
    assert MOCK_SERIAL.isdigit()


def test_dashboard_switches_power(mock: MockUR) -> None:
    assert dashboard(mock.host, "power off", "robotmode") == ["Powering off", "Robotmode: POWER_OFF"]
    dashboard(mock.host, "power on")
    until(lambda: mock.faults.state().mode == "IDLE", "idle")
    dashboard(mock.host, "brake release")
    until(lambda: mock.faults.state().mode == "RUNNING", "running")


def test_dashboard_pauses_and_continues_program(mock: MockUR) -> None:
    with ControlClient(mock.host) as client:
        goal = list(client.receive()["actual_TCP_pose"])
        goal[2] -= 0.05
        client.write(3, [*goal, 0.1, 1.0])
        client.wait(lambda state: state["actual_TCP_pose"][2] < goal[2] + 0.045)
        assert dashboard(mock.host, "pause", "programState") == ["Pausing program", "PAUSED <unnamed>"]
        client.wait(lambda state: state["runtime_state"] == (4,))
        assert dashboard(mock.host, "play") == ["Starting program"]
        client.wait(lambda state: math.dist(state["actual_TCP_pose"][:3], goal[:3]) < 1e-8)


# -- abuse -----------------------------------------------------------------------------------------------------------


def test_truncated_or_oversized_package_keeps_mock_working(mock: MockUR) -> None:
    with RtdeClient(mock.host) as half, RtdeClient(mock.host) as big:
        half.socket.sendall(struct.pack(">HB", 500, 85) + b"\1\2\3")
        big.socket.sendall(struct.pack(">HB", 65535, 90) + bytes(65532))
        assert struct.unpack(">4I", big.ask(118))[0] == 5
        assert answers(mock)
        assert mock.faults.state().clients.count(30004) == 2


def test_package_shorter_than_header_closes_connection(mock: MockUR) -> None:
    with RtdeClient(mock.host) as client:
        client.socket.sendall(b"\0\1\0")
        with pytest.raises(ConnectionError):
            client.package()


@pytest.mark.parametrize(("port", "filling"), [(29999, b"x"), (30002, b"def long():\n")])
def test_endless_line_or_program_closes_connection(mock: MockUR, port: int, filling: bytes) -> None:
    def send(line: socket.socket) -> None:
        for _ in range(100):
            line.sendall(filling * (100_000 // len(filling)))
            time.sleep(0.002)

    with socket.create_connection((mock.host, port), TIMEOUT) as line, pytest.raises(OSError):
        send(line)
    assert answers(mock)


def test_slow_reader_loses_only_complete_packages(mock: MockUR) -> None:
    before = mock.faults.state().packages_dropped
    with RtdeClient(mock.host) as slow, RtdeClient(mock.host) as quick:
        slow.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 65536)
        streaming(slow, "timestamp", *["actual_q"] * 200)
        streaming(quick, "timestamp")
        until(lambda: mock.faults.state().packages_dropped > before + 60, "packages are dropped")
        times = [slow.receive()["timestamp"][0] for _ in range(2)]
        while times[-1] - times[-2] < 0.1:  # what waited is whole and in order; then some are missing
            times.append(slow.receive()["timestamp"][0])
        times += [slow.receive()["timestamp"][0] for _ in range(20)]
        steps = np.diff(times)
        assert steps.min() > 0.0019
        np.testing.assert_allclose(steps / 0.002, np.round(steps / 0.002), atol=1e-6)
        quick.receive()


def test_many_connections_are_served_and_excess_closed(mock: MockUR) -> None:
    lines = [socket.create_connection((mock.host, PORTS[i % len(PORTS)]), TIMEOUT) for i in range(100)]
    try:
        until(lambda: len(mock.faults.state().clients) == 100, "100 clients")
        assert answers(mock)
        lines += [socket.create_connection((mock.host, PORTS[0]), TIMEOUT) for _ in range(MAX_CLIENTS - 90)]
        until(lambda: any("are connected already" in text for _, text in mock.faults.log()), "some are turned away")
        assert len(mock.faults.state().clients) <= MAX_CLIENTS
    finally:
        for line in lines:
            line.close()
    until(lambda: not mock.faults.state().clients, "all gone")
    assert answers(mock)


def test_half_closed_connection_is_dropped(mock: MockUR) -> None:
    """A client that ends its half of the line is gone; one that resets it, too."""
    with RtdeClient(mock.host) as client:
        streaming(client, "timestamp").receive()
        client.socket.shutdown(socket.SHUT_WR)
        until(lambda: not mock.faults.state().clients, "gone")
    with RtdeClient(mock.host) as client:
        streaming(client, "timestamp").receive()
        client.socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    until(lambda: not mock.faults.state().clients, "gone")


def test_fault_server_refuses_invalid_requests(faults: FaultClient, mock: MockUR) -> None:
    with socket.create_connection((mock.host, 30020), TIMEOUT) as line, line.makefile("rw") as file:
        for request in ("nonsense", "[]", "{}", '{"do": "fly"}', '{"do": "drop"}', '{"do": "wall", "z": 0, "k": 1}'):
            file.write(request + "\n")
            file.flush()
            assert '"ok": false' in file.readline()
    assert faults.state().safety == "NORMAL"
