"""Every fault, seen from the wire."""

from __future__ import annotations

import math
import socket
import time
from collections.abc import Callable

import numpy as np
import pytest

from robot.mock import FaultClient, FaultError, MockUR
from robot.mock.ur.controller import PORTS
from tests.robot.mock.wire_client import TIMEOUT, ControlClient, RtdeClient, control_script, dashboard, wire_host
from tests.robot.waiting import until


def streaming(mock: MockUR, *names: str) -> RtdeClient:
    client = RtdeClient(mock.host)
    client.protocol()
    assert client.outputs("timestamp", *names)[0] == 1
    assert client.start()
    return client


def drain(client: RtdeClient) -> None:
    """Takes packages until there is an error."""
    while True:
        client.receive()


def moving(mock: MockUR, speed: float = 0.05) -> ControlClient:
    """A client whose arm goes down."""
    client = ControlClient(mock.host)
    client.call(10, [0, 0, -speed, 0, 0, 0, 0.5, 0])
    until(lambda: mock.faults.state().tcp_speed[2] < -0.99 * speed, "it moves")
    return client


def test_fault_client_state_equals_rtde_state(mock: MockUR, faults: FaultClient) -> None:
    with streaming(mock, "actual_q", "actual_TCP_pose") as client:
        state, package = faults.state(), client.receive()
        assert state.joints == pytest.approx(package["actual_q"], abs=1e-12)
        assert state.pose == pytest.approx(package["actual_TCP_pose"], abs=1e-12)
        assert state.clients == (30004,) and state.safety == "NORMAL" and state.mode == "RUNNING" and state.rests
    until(lambda: faults.state().tick_rate > 0, "500 ticks since the start of the process")


@pytest.mark.parametrize(
    ("press", "safety", "bits"),
    [
        (FaultClient.protective_stop, "PROTECTIVE_STOP", 1 << 2 | 1 << 10),
        (FaultClient.estop, "ROBOT_EMERGENCY_STOP", 0b10011 << 6),
    ],
)
def test_stop_ends_program_and_sets_safety_bits(
    mock: MockUR, faults: FaultClient, press: Callable[[FaultClient], None], safety: str, bits: int
) -> None:
    with moving(mock) as client, streaming(mock, "safety_status_bits", "runtime_state") as watch:
        press(faults)
        state = faults.state()
        assert state.safety == safety and not state.program
        until(lambda: faults.state().rests, "it rests")
        package = watch.newest()
        while package["safety_status_bits"] != (bits,):
            package = watch.receive()
        assert package["runtime_state"] == (1,)
        faults.recover()
        assert faults.state().safety == "NORMAL" and not faults.state().program
        client.upload(control_script())


def test_dashboard_unlocks_protective_stop(mock: MockUR, faults: FaultClient) -> None:
    faults.unlock_delay(3600)
    faults.protective_stop()
    assert "Cannot unlock" in dashboard(mock.host, "unlock protective stop")[0]
    faults.unlock_delay(0)
    assert dashboard(mock.host, "unlock protective stop") == ["Protective stop releasing"]
    assert faults.state().safety == "NORMAL"


def test_release_leaves_arm_without_power(mock: MockUR, faults: FaultClient) -> None:
    faults.estop()
    until(lambda: faults.state().mode == "POWER_OFF", "power off")
    faults.release()
    assert (faults.state().safety, faults.state().mode) == ("NORMAL", "POWER_OFF")


def test_safeguard_stop_pauses_and_continues(mock: MockUR, faults: FaultClient) -> None:
    with moving(mock) as client:
        faults.safeguard_stop(True)
        client.wait(lambda state: state["runtime_state"][0] == 4)
        faults.safeguard_stop(False)
        until(lambda: faults.state().tcp_speed[2] < -0.049, "it moves again")


def test_power_cycle_restarts_without_power(mock: MockUR, faults: FaultClient) -> None:
    with moving(mock) as client:
        faults.power_cycle(1.0)
        with pytest.raises(OSError):
            client.wait(lambda state: False)
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection((mock.host, 30004), TIMEOUT)
    until(lambda: dashboard_answers(mock), "the dashboard is back")
    state = faults.state()
    assert state.mode == "POWER_OFF" and not state.program
    dashboard(mock.host, "brake release")
    until(lambda: faults.state().mode == "RUNNING", "running")


def dashboard_answers(mock: MockUR) -> bool:
    try:
        return dashboard(mock.host, "running") == ["Program running: false"]
    except OSError:
        return False


def test_silence_stops_only_data_stream(mock: MockUR, faults: FaultClient) -> None:
    with streaming(mock) as client:
        client.receive()
        faults.silence()
        sent = faults.state().packages_sent
        assert dashboard(mock.host, "running") == ["Program running: false"]
        with streaming(mock):
            pass  # set-up is answered
        assert faults.state().packages_sent == sent
        client.socket.settimeout(0.1)
        with pytest.raises(TimeoutError):
            drain(client)
        client.socket.settimeout(TIMEOUT)
        faults.silence(False)
        client.receive()


@pytest.mark.parametrize("reset", [False, True])
def test_cut_closes_connections(mock: MockUR, faults: FaultClient, reset: bool) -> None:
    with streaming(mock) as client, socket.create_connection((mock.host, 29999), TIMEOUT) as other:
        until(lambda: len(faults.state().clients) == 2, "two clients")
        assert faults.cut([30004], reset=reset) == 1
        with pytest.raises(ConnectionError):
            drain(client)
        assert other.recv(100).startswith(b"Connected")
        assert faults.cut() == 1


def test_refuse_rejects_new_connections(mock: MockUR, faults: FaultClient) -> None:
    with streaming(mock) as client:
        faults.refuse()
        for port in PORTS:
            with pytest.raises(ConnectionRefusedError):
                socket.create_connection((mock.host, port), TIMEOUT)
        client.receive()
        faults.refuse(False)
        with streaming(mock) as other:
            other.receive()


def test_black_hole_stops_answers(mock: MockUR, faults: FaultClient) -> None:
    with streaming(mock) as client:
        client.receive()
        faults.black_hole()
        sent = faults.state().packages_sent
        with socket.create_connection((mock.host, 29999), TIMEOUT) as other:
            other.settimeout(0.1)
            with pytest.raises(TimeoutError):
                other.recv(1)
            assert faults.state().packages_sent == sent
            faults.black_hole(False)
            other.settimeout(TIMEOUT)
            assert other.recv(100).startswith(b"Connected")
        client.receive()


def test_black_hole_mock_closes_without_error() -> None:
    with MockUR(wire_host(8)) as mock:
        mock.faults.black_hole(True)
    assert mock.exit_status == 0


def test_delay_is_at_least_requested(mock: MockUR, faults: FaultClient) -> None:
    faults.delay(0.1)
    begun = time.monotonic()
    assert dashboard(mock.host, "running") == ["Program running: false"]
    assert time.monotonic() - begun > 0.2  # the greeting, and the answer
    with streaming(mock) as client:
        steps = np.diff([client.receive()["timestamp"][0] for _ in range(50)])
        np.testing.assert_allclose(steps, 0.002, atol=1e-9)


def test_drop_is_seeded_and_has_its_probability(mock: MockUR, faults: FaultClient) -> None:
    with streaming(mock) as client:
        faults.drop(0.5, seed=3)
        begun = faults.state()
        times = np.array([client.receive()["timestamp"][0] for _ in range(300)])
        ended = faults.state()
    share = (ended.packages_dropped - begun.packages_dropped) / (
        ended.packages_sent + ended.packages_dropped - begun.packages_sent - begun.packages_dropped
    )
    assert 0.4 < share < 0.6
    assert np.diff(times).max() > 0.005
    with pytest.raises(FaultError, match="probability"):
        faults.drop(1.5)


def test_partial_packages_arrive_complete(mock: MockUR, faults: FaultClient) -> None:
    faults.partial_packages()
    with streaming(mock, "actual_q") as client:
        steps = np.diff([client.receive()["timestamp"][0] for _ in range(100)])
        assert client.ask(118)[:4] == b"\0\0\0\5"  # a reply does not come between the halves
        client.receive()
    np.testing.assert_allclose(steps, 0.002, atol=1e-9)


def test_nan_state_makes_measured_values_nan(mock: MockUR, faults: FaultClient) -> None:
    with streaming(mock, "actual_q", "target_q", "actual_tool_accelerometer") as client:
        faults.nan_state()
        state = client.receive()
        while not math.isnan(state["actual_q"][0]):
            state = client.receive()
        assert np.isnan(state["actual_tool_accelerometer"]).all() and np.isfinite(state["target_q"]).all()
        assert math.isfinite(state["timestamp"][0])


def test_clock_jump_shifts_timestamp(mock: MockUR, faults: FaultClient) -> None:
    with streaming(mock) as client:
        for jump in (3.0, -5.0):
            before = client.receive()["timestamp"][0]
            faults.clock_jump(jump)
            steps = [0.0]
            while abs(steps[-1]) < 1:
                after = client.receive()["timestamp"][0]
                steps.append(after - before)
                before = after
            assert steps[-1] == pytest.approx(jump + 0.002, abs=1e-9)


def test_tick_overrun_is_counted_and_skipped(mock: MockUR, faults: FaultClient) -> None:
    begun = time.monotonic()
    before = faults.state()
    faults.tick_overrun(0.3)
    after = faults.state()
    periods = (time.monotonic() - begun) / 0.002
    left_out = after.overruns - before.overruns
    assert left_out > 100
    assert after.tick - before.tick < periods - left_out + 20  # a few are made up for


def test_local_control_refuses_programs(mock: MockUR, faults: FaultClient) -> None:
    faults.remote_control(False)
    assert dashboard(mock.host, "is in remote control") == ["false"]
    with socket.create_connection((mock.host, 30002), TIMEOUT) as line:
        line.sendall(control_script().encode())
        until(lambda: any("not in remote control" in text for _, text in faults.log()), "it says so")
    assert not faults.state().program


def test_muted_dashboard_does_not_answer(mock: MockUR, faults: FaultClient) -> None:
    faults.dashboard_mute()
    with socket.create_connection((mock.host, 29999), 0.1) as line:
        line.sendall(b"running\n")
        with pytest.raises(TimeoutError):
            line.recv(1)
        faults.dashboard_mute(False)
        line.settimeout(TIMEOUT)
        line.sendall(b"running\n")
        assert line.recv(100) == b"Program running: false\n"


def test_claimed_inputs_are_in_use(mock: MockUR, faults: FaultClient) -> None:
    faults.claim(["input_int_register_0"])
    with RtdeClient(mock.host) as client:
        assert client.inputs("input_int_register_0") == (0, ["IN_USE"])
        faults.claim([])
        assert client.inputs("input_int_register_0") == (1, ["INT32"])
    with pytest.raises(FaultError, match="no such inputs: nonsense"):
        faults.claim(["nonsense"])


def test_version_option_prints_version(mock: MockUR, faults: FaultClient) -> None:
    faults.version(3, 9, 1)
    assert dashboard(mock.host, "PolyscopeVersion")[0].startswith("URSoftware 3.9.1.0")
    with RtdeClient(mock.host) as client:
        assert client.outputs("timestamp", "payload") == (0, ["DOUBLE", "NOT_FOUND"])


def test_wrench_wall_and_force_limit_change_force(mock: MockUR, faults: FaultClient) -> None:
    faults.wrench([1, 2, 3, 0.1, 0.2, 0.3])
    with streaming(mock, "actual_TCP_force", "ft_raw_wrench") as client:
        state = client.receive()
        while state["actual_TCP_force"] != (1, 2, 3, 0.1, 0.2, 0.3):
            state = client.receive()
        assert np.linalg.norm(state["ft_raw_wrench"][:3]) == pytest.approx(math.sqrt(14))
    faults.wrench([0] * 6)
    top = faults.state().pose[2] - 0.01
    faults.wall(top, 1000.0)
    faults.force_limit(20.0)
    with moving(mock):
        until(lambda: faults.state().safety == "PROTECTIVE_STOP", "the wall stops it")
        until(lambda: faults.state().rests, "it rests")
        state = faults.state()
        assert state.wrench[2] == pytest.approx(1000 * (top - state.pose[2]), abs=1e-6)
        assert 20 < state.wrench[2] < 25 and "limit 20 N" in state.stop_reason
    faults.no_wall()
    until(lambda: faults.state().wrench == (0,) * 6, "no force")
    with pytest.raises(FaultError, match="6 finite"):
        faults.wrench([1, 2])


def test_payload_mismatch_changes_force(mock: MockUR, faults: FaultClient) -> None:
    faults.payload_mismatch(1.0, (0, 0, 0.1))
    until(lambda: faults.state().wrench[2] < 0, "it weighs")
    assert faults.state().wrench[2] == pytest.approx(-9.82)


def test_fault_reset_restores_power_on_state(mock: MockUR, faults: FaultClient) -> None:
    begun = faults.state()
    with moving(mock) as client:
        faults.silence()
        faults.wall(1.0, 10.0)
        faults.refuse()
        faults.reset()
        with pytest.raises(OSError):
            client.wait(lambda state: False)
    state = faults.state()
    assert state.joints == begun.joints and state.wrench == (0,) * 6 and not state.program and state.clients == ()
    assert state.tick > begun.tick
    with streaming(mock) as other:
        other.receive()


def test_fault_client_without_mock_raises() -> None:
    with pytest.raises(FaultError, match=r"127\.21\..*:30020, state: .*refused"):
        FaultClient(wire_host(200)).state()
