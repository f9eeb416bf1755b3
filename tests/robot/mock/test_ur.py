"""The process of the mock: it starts, it says why it cannot, and it never outlives who started it."""

from __future__ import annotations

import json
import os
import signal
import struct
import subprocess
import sys
import time

import pytest

from robot.mock import FaultError, MockArms, MockError, MockUR
from robot.mock.cell.cell import MockCell
from tacsim.config import ConfigError, load_rig
from tests.robot.mock.wire_client import TIMEOUT, ControlClient, dashboard, wire_host
from tests.robot.waiting import until


def exists(pid: int) -> bool:
    """True for a zombie, too."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def test_mock_ur_close_twice_leaves_no_process() -> None:
    mock = MockUR(wire_host(10))
    assert mock.running and mock.faults.state().tick >= 0
    mock.close()
    mock.close()
    assert not exists(mock.pid) and not mock.running
    with pytest.raises(FaultError):
        mock.faults.state()
    with MockUR(wire_host(10)):
        pass  # the ports are free again at once


def test_mock_ur_options_are_applied() -> None:
    joints = [0.1, -1.2, 1.3, -1.4, -1.5, 0.6]
    with MockUR(wire_host(11), model="ur3e", joints=joints, fault_port=30555) as mock:
        assert mock.faults.port == 30555
        assert mock.faults.state().joints == pytest.approx(joints)


def test_mock_arms_in_one_process_are_independent() -> None:
    hosts = [wire_host(12), wire_host(13)]
    versions = [(5, 11, 0, 0), (5, 23, 1, 0)]
    with MockArms(hosts, version=versions) as arms, ControlClient(hosts[0]) as client:
        assert [struct.unpack(">4I", client.ask(118))] == versions[:1]
        assert dashboard(hosts[1], "PolyscopeVersion")[0].startswith("URSoftware 5.23.1.0 ")
        client.call(9, [0, 0, 0, 0, 0, 0.5, 2.0, 0])
        until(lambda: arms.fault_clients[0].state().joint_speeds[5] > 0.4, "the first moves")
        arms.fault_clients[1].protective_stop()
        assert arms.fault_clients[0].state().safety == "NORMAL" and arms.fault_clients[0].state().program
        assert arms.fault_clients[1].state().rests and arms.fault_clients[1].state().safety == "PROTECTIVE_STOP"


def test_rig_file_sets_mock_version() -> None:
    place = [f"arms.{name}.host={wire_host(21 + number)}" for number, name in enumerate(("lower", "upper"))]
    place += [
        "arms.lower.start.position=[0, 0, 0]",
        "arms.upper.start={position: [0, 0, 30 mm], rotation: [180 deg, 0, 0]}",
    ]
    config = load_rig("mock", overrides=[*place, "arms.upper.mock.version='5.23'"]).config
    with MockCell(config.model_copy(update={"sensors": {}})) as cell:
        versions = [dashboard(faults.host, "PolyscopeVersion")[0] for faults in cell.faults.values()]
    assert [version.split()[1] for version in versions] == ["5.11.0.108150", "5.23.0.0"]
    for wrong, words in (("5.10", "a text"), ("banana", "such as '5.11'"), ("'5'", "such as '5.11'")):
        with pytest.raises(ConfigError, match=rf"arms.lower.mock.version: .*{words}"):
            load_rig("mock", overrides=[f"arms.lower.mock.version={wrong}"])


def test_mock_ur_port_in_use_is_named() -> None:
    host = wire_host(14)
    with MockUR(host) as first:
        with pytest.raises(MockError, match=rf"cannot listen on {host}:\d+: .*in use"):
            MockUR(host)
        assert first.faults.state().safety == "NORMAL"


@pytest.mark.parametrize(
    ("hosts", "words"),
    [
        (["10.0.0.1"], "not a loopback address"),
        (["0.0.0.0"], "not a loopback address"),
        (["robot.example"], "not a loopback address"),
        ([], "at least one"),
        (["127.0.0.9", "127.0.0.9"], "different hosts"),
    ],
)
def test_mock_ur_invalid_addresses_are_refused(hosts: list[str], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        MockArms(hosts)


def test_mock_ur_invalid_joints_are_refused() -> None:
    with pytest.raises(MockError, match=r"within \+-2 pi"):
        MockUR(wire_host(15), joints=[7, 0, 0, 0, 0, 0])
    with pytest.raises(MockError, match="6 finite"):
        MockUR(wire_host(15), joints=[0, 0])
    for version in ((5, 11), (5, 11, 0, -1), (5, 11, 0, 2**32), (5, 11, 0, 0.5), (5, 11, 0, float("nan"))):
        with pytest.raises(ValueError, match="four whole numbers"):
            MockUR(wire_host(15), version=version)


@pytest.mark.slow
@pytest.mark.parametrize("end", [signal.SIGKILL, pytest.param(signal.SIGTERM, marks=pytest.mark.deep)])
def test_mock_ur_ends_with_its_parent(end: signal.Signals) -> None:
    code = (
        "import sys, time; from robot.mock import MockUR\n"
        f"mock = MockUR({wire_host(16)!r}); print(mock.pid, flush=True); time.sleep(600)"
    )
    parent = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    with parent, parent.stdout:
        pid = int(parent.stdout.readline())
        assert exists(pid)
        parent.send_signal(end)
        parent.wait(TIMEOUT)
        until(lambda: not exists(pid), "the mock is gone")


@pytest.mark.slow
def test_stopped_mock_ur_process_is_killed() -> None:
    with MockUR(wire_host(17)) as mock:
        mock.faults.timeout = 0.2
        os.kill(mock.pid, signal.SIGSTOP)
        with pytest.raises(FaultError, match="no answer in time"):
            mock.faults.state()
    assert not exists(mock.pid)


def test_mock_ur_continues_after_pause_of_process() -> None:
    with MockUR(wire_host(18)) as mock:
        before = mock.faults.state()
        os.kill(mock.pid, signal.SIGSTOP)
        time.sleep(0.3)
        os.kill(mock.pid, signal.SIGCONT)
        until(lambda: mock.faults.state().overruns > before.overruns + 50, "it counts what it missed")
        after = mock.faults.state()
        until(lambda: mock.faults.state().tick > after.tick + 100, "it ticks")


def test_mock_process_without_parent_runs_until_signal() -> None:
    command = [sys.executable, "-m", "robot.mock", wire_host(19)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stdin=subprocess.DEVNULL, text=True)
    assert process.stdout is not None
    with process, process.stdout:
        assert json.loads(process.stdout.readline()) == {"ready": [wire_host(19)]}
        process.send_signal(signal.SIGINT)
        assert process.wait(TIMEOUT) == 0


@pytest.mark.slow
def test_client_killed_in_motion_stops_only_with_watchdog() -> None:
    """Without the watchdog the arm goes on for ever, as a real one does; with it, the program ends."""
    with MockUR(wire_host(20)) as mock:
        for watchdog in (False, True):
            code = (
                "import sys, time; from tests.robot.mock.wire_client import ControlClient\n"
                f"client = ControlClient({mock.host!r})\n"
                f"if {watchdog}: client.call(35, [1.0])\n"
                "client.write(10, [0, 0, -0.01, 0, 0, 0, 0.5, 0]); print('moves', flush=True); \n"
                "while True: client.write(10, [0, 0, -0.01, 0, 0, 0, 0.5, 0]); time.sleep(0.01)"
            )
            client = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
            assert client.stdout is not None
            with client, client.stdout:
                assert client.stdout.readline() == "moves\n"
                until(lambda: mock.faults.state().tcp_speed[2] < -0.0099, "it moves")
                client.kill()
            if watchdog:
                until(lambda: mock.faults.state().rests, "it rests")
                assert "watchdog" in mock.faults.state().stop_reason
            else:
                end = mock.faults.state().tick + 250
                until(lambda end=end: mock.faults.state().tick > end, "half a second has passed")
                assert mock.faults.state().tcp_speed[2] < -0.0099
                mock.faults.reset()
