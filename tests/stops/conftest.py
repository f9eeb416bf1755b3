"""A mock controller for each module of tests, and the processes of a trial for each test."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from robot.mock import MockUR
from tests.robot.arm.mocked import HOST
from tests.stops.watched import LINK_TIMEOUT, Trial

TRIES = 5
BACK = (0.1, 1.0, 3.0, 0.0)  # a line is whole again after so long, in turn; 0: a cut one at once, a held one never [s]


@pytest.fixture(scope="module")
def controller(measuring: bool) -> Iterator[MockUR]:
    pytest.importorskip("rtde_control", reason="ur_rtde has no wheel for this Python")
    with MockUR(HOST, realtime=measuring) as mock:
        yield mock


@pytest.fixture
def trial(controller: MockUR, tmp_path: Path, measuring: bool) -> Iterator[Trial]:
    instead: str | None = None
    for _ in range(TRIES):
        controller.faults.reset()
        made = Trial(controller, tmp_path, measuring=measuring)
        try:
            instead = made.begin()
            if instead is None:
                yield made
                return
        finally:
            made.close()
    pytest.fail(f"{TRIES} times the arm came to no full speed before anything happened; the last time: {instead}")


@pytest.fixture
def watch(measuring: bool) -> float:
    """How long an arm is watched after its first standstill [s]."""
    return 5.0 if measuring else 2.0


@pytest.fixture
def back(request: pytest.FixtureRequest, measuring: bool) -> float:
    """After how long a broken line is whole again [s]."""
    return BACK[request.node.callspec.params["repetition"] % len(BACK)] if measuring else 1.5 * LINK_TIMEOUT
