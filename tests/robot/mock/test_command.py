"""`tacsim mock` as a person starts it."""

from __future__ import annotations

import signal
import subprocess

import pytest

from robot.camera.camera import Camera
from robot.mock import FaultClient
from tacsim.models.hardware import CameraSensorConfig
from tests.robot.cli.invoked import START, tacsim
from tests.robot.mock.wire_client import TIMEOUT, dashboard, wire_host


def test_mock_command_serves_until_ctrl_c() -> None:
    hosts = [wire_host(40), wire_host(41)]
    options = [word for host in hosts for word in ("--host", host)]
    options += ["--model", "ur3e", "--version", "5.23.1", "--payload", "0.5,0,0,0.03"]
    process = subprocess.Popen([*START, "mock", *options], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    with process, process.stdout:
        said = [process.stdout.readline() for _ in range(3)]
        assert all(host in line for host, line in zip(hosts, said, strict=False))
        for host in hosts:
            faults = FaultClient(host)
            assert faults.state().mode == "RUNNING" and faults.state().wrench[2] == pytest.approx(-4.91)
            faults.close()
            assert dashboard(host, "PolyscopeVersion")[0].startswith("URSoftware 5.23.1.0 ")
        dashboard(hosts[1], "addToLog \x1b[2J hello")
        assert process.stdout.readline().startswith(f"{hosts[1]} ")
        process.send_signal(signal.SIGINT)
        assert process.wait(TIMEOUT) == 128 + signal.SIGINT


@pytest.mark.slow
def test_mock_command_cameras_use_arm_addresses() -> None:
    host = wire_host(42)
    options = ["--host", host, "--cameras", "1", "--camera-port", "8090"]
    process = subprocess.Popen([*START, "mock", *options], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    with process, process.stdout:
        said = [process.stdout.readline() for _ in range(3)]
        url = f"http://{host}:8090/?action=stream"
        assert said[1].strip() == f"camera at {url}"
        config = CameraSensorConfig(driver="camera", source=url, width=320, height=240, stamped=True, max_age=10.0)
        with Camera(config, "finger", TIMEOUT) as camera:
            assert camera.read(TIMEOUT).image.shape == (240, 320, 3)
        process.send_signal(signal.SIGINT)
        assert process.wait(TIMEOUT) == 128 + signal.SIGINT


@pytest.mark.parametrize(
    ("options", "words", "code"),
    [
        (["--model", "ur7"], "--model", 2),
        (["--host", "192.168.0.9"], "not a loopback", 2),
        (["--arms", "0"], "nothing to run", 2),
        (["--version", "5"], "like 5.11", 2),
        (["--version", "5.x"], "like 5.11", 2),
        (["--version", "5.9999999999"], "4294967295", 2),
        (["--payload", "0.5,0"], "mass [kg]", 2),
        (["--payload", "nan"], "mass [kg]", 2),
        (["--payload", "heavy"], "--payload", 2),
        (["--arms", "0", "--cameras", "1", "--camera-port", "70000"], "--camera-port", 2),
    ],
)
def test_mock_command_invalid_options_are_refused(options: list[str], words: str, code: int) -> None:
    done = tacsim("mock", *options)
    assert done.exit_code == code and words in done.stderr and "Traceback" not in done.stderr
