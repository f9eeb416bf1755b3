"""One mock controller for a module, which each test finds as at power-on; and the machine of one without sockets."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from robot.mock import FaultClient, MockUR
from tests.robot.mock.machine_bench import Bench
from tests.robot.mock.wire_client import wire_host


@pytest.fixture(scope="module")
def running() -> Iterator[MockUR]:
    with MockUR(wire_host(2)) as mock:
        yield mock


@pytest.fixture
def mock(running: MockUR) -> Iterator[MockUR]:
    running.faults.reset()
    yield running
    assert running.running, "the process of the mock has ended"


@pytest.fixture
def faults(mock: MockUR) -> FaultClient:
    return mock.faults


@pytest.fixture
def bench() -> Bench:
    return Bench()
