"""The worker process alone: its imports, and its exit without a driver."""

from __future__ import annotations

import dataclasses
import json
import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from robot.arm import channel, worker
from robot.arm.channel import Channel, WorkerConfig
from robot.arm.channel import make_worker_config as config_of
from robot.arm.status import ArmStatus
from robot.arm.trajectory import PERIOD
from robot.mock import MOCK_SERIAL, MockUR
from tacsim.models.hardware import MockArmConfig, Placement, UrArmConfig
from tacsim.models.limits import ArmLimits, Workspace
from tests.robot.arm.mocked import HOST
from tests.robot.waiting import PATIENCE, until

ROOT = Path(worker.__file__).parents[2]
CHANGES = (29, 17, 35)  # numbers of the commands setTcp, setPayload, setWatchdog
NOBODY = f"127.223.{os.getpid() >> 8 & 255}.{os.getpid() & 255}"


def worker_config(segment: int, **changes: object) -> WorkerConfig:
    box = Workspace(lower=(-1.0, -1.0, -1.0), upper=(1.0, 1.0, 1.0))
    config = UrArmConfig(
        driver="ur",
        host=NOBODY,
        world_from_base=Placement(),
        limits=ArmLimits(workspace=box),
        mock=MockArmConfig(),
    )
    return dataclasses.replace(config_of(config, "left", segment, []), **changes)  # type: ignore[arg-type]


def start(config: WorkerConfig, *words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, *(words or ("-m", "robot.arm.worker"))],
        pass_fds=[config.segment],
        input=json.dumps(dataclasses.asdict(config)) + "\n",
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=60,
    )


def test_worker_import_loads_no_heavy_package() -> None:
    """A new worker has half a second; SciPy or pydantic alone take that long."""
    heavy = {"scipy", "pydantic", "taichi", "cv2", "rtde_control", "rtde_receive"}
    code = (
        f"import sys, robot.arm.worker; print(*sorted({{name.partition('.')[0] for name in sys.modules}} & {heavy!r}))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=60, check=True
    )
    assert done.stdout.split() == []


def test_variables_are_known_to_library() -> None:
    """A name that the library does not know shifts all fields after it, without a word."""
    receive = pytest.importorskip("rtde_receive", reason="ur_rtde has no wheel for this Python")
    library = Path(receive.__file__).read_bytes()
    # The compiled library carries its table's names as text.
    assert [name for name in worker.VARIABLES if name.encode() not in library] == []


def test_worker_failure_prints_one_json_line() -> None:
    segment = channel.create_segment(Channel.SIZE)
    done = start(worker_config(segment.descriptor))
    assert done.returncode == worker.FAILED_EXIT_STATUS
    told = json.loads(done.stdout)
    assert told["kind"] == "DeviceNotConnectedError"
    assert f"no controller at {NOBODY}: port 30004 (RTDE)" in told["error"]
    latest = Channel(segment).states.latest()
    assert latest is not None and latest["status"] == ArmStatus.CONNECTING


def test_worker_without_memory_reports_error() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "robot.arm.worker"],
        input=json.dumps(dataclasses.asdict(worker_config(99))) + "\n",
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == worker.FAILED_EXIT_STATUS
    assert "Bad file descriptor" in json.loads(done.stdout)["error"]


def test_worker_driver_died_during_connect_exits(mock: MockUR) -> None:
    """The first message of the worker is not read: it still ends its program."""
    segment = channel.create_segment(Channel.SIZE)
    config = worker_config(segment.descriptor, host=HOST, parent=1, link_timeout=2.0)  # not this process
    reader, writer = os.pipe()
    os.close(reader)
    with subprocess.Popen(
        [sys.executable, "-m", "robot.arm.worker"],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        pass_fds=[segment.descriptor],
        stdin=subprocess.PIPE,
        stdout=writer,
        stderr=subprocess.PIPE,
    ) as process:
        os.close(writer)
        _, errors = process.communicate(json.dumps(dataclasses.asdict(config)).encode() + b"\n", timeout=PATIENCE)
    assert (process.returncode, errors.decode()) == (0, "")
    until(lambda: not mock.faults.state().program, "end of the program")


UNSEEN = "from robot.arm import worker; worker.Dashboard.require_identity = lambda *_: None; worker.main()"


def test_worker_wrong_model_keeps_controller_settings(mock: MockUR) -> None:
    """Also if the dashboard does not report the model."""
    segment, before = channel.create_segment(Channel.SIZE), mock.faults.state().payload
    given = worker_config(segment.descriptor, host=HOST, model="ur10e", mass=2.0, tcp=[0.0, 0.0, 0.1, 0.0, 0.0, 0.0])
    done = start(given, "-c", UNSEEN)
    assert done.returncode == worker.FAILED_EXIT_STATUS
    assert re.search(r"its tool is \d+ mm and .* from the pose of a ur10e at these joints; check model", done.stdout)
    asked = {entry.values.get("input_int_register_0") for entry in mock.faults.received().entries}
    assert asked & {*CHANGES} == set()
    assert mock.faults.state().payload == before
    assert not mock.faults.state().program  # its own was ended


class Packages:
    """The library's receiver of a controller whose packages come 0.1 s late."""

    LATE = 50  # packages

    def __init__(self) -> None:
        self.now, self.told = 0, 0  # packages so far, and before the payload was set

    def getTimestamp(self) -> float:
        return max(0, self.now - self.LATE) * PERIOD

    def getActualTCPForce(self) -> list[float]:
        return [0.0, 0.0, -9.82 if self.now - self.LATE < self.told else 0.0, 0.0, 0.0, 0.0]

    def getSpeedScaling(self) -> float:
        return 1.0

    getTargetSpeedFraction = getSpeedScaling

    def sleep(self, seconds: float) -> None:
        self.now += 1

    def __getattr__(self, name: str) -> Callable[[], object]:
        return lambda: 0 if name in ("getRuntimeState", "getSafetyStatusBits") else [0.0] * 6


def test_worker_first_wrench_uses_payload(monkeypatch: pytest.MonkeyPatch) -> None:
    """Packages that were measured before arrive after the controller's word that it has taken it."""
    segment, packages = channel.create_segment(Channel.SIZE), Packages()
    made = worker.Worker(worker_config(os.dup(segment.descriptor)))  # which closes its own
    monkeypatch.setattr(worker.time, "sleep", packages.sleep)
    made.receive = packages
    packages.now = packages.told = 500
    made._read_package()
    assert made.record["tcp_force"][2] < -9.0
    made._wait_for_settings()
    assert made.record["tcp_force"][2] == 0.0


def test_worker_wrong_serial_number_is_refused(mock: MockUR) -> None:
    segment = channel.create_segment(Channel.SIZE)
    done = start(worker_config(segment.descriptor, host=HOST, serial="20225500001"))
    assert f"has the serial number {MOCK_SERIAL}, but the file of arm 'left' says serial: 20225500001" in done.stdout
    assert not mock.faults.received().entries
