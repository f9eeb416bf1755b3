"""A mock controller for each module of tests, as at power-on for each test; and the driver on it."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from robot.arm.ur import URArm
from robot.mock import MockUR
from tests.robot.arm.mocked import CARRIED, HOST, config


@pytest.fixture(scope="module")
def controller(measuring: bool) -> Iterator[MockUR]:
    pytest.importorskip("rtde_control", reason="ur_rtde has no wheel for this Python")
    with MockUR(HOST, realtime=measuring, payload=CARRIED) as mock:
        yield mock


@pytest.fixture
def mock(controller: MockUR) -> MockUR:
    """One as at power-on."""
    controller.faults.reset()
    return controller


@pytest.fixture
def arm(mock: MockUR, measuring: bool) -> Iterator[URArm]:
    with URArm(config(realtime=measuring), "left") as opened:
        yield opened
