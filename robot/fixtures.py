"""pytest fixtures of mock hardware for users: ``pytest_plugins = ["robot.fixtures"]`` in a conftest.py.

Each test process has its own loopback addresses (127.0.0.0/8; on macOS they must be made first: ifconfig lo0 alias), so
tests may run in parallel.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack

import pytest

from robot.common import loopback_host
from robot.mock.camera.camera import MockCamera
from robot.mock.ur.handle import MockUR
from robot.open import open_rig
from tacsim.rig import Rig


def mock_host(number: int) -> str:
    """A loopback address for this process only, number 1 to 254."""
    room = 31  # second number of the addresses
    return loopback_host(number, room)


def rig_addresses() -> list[str]:
    """Overrides that give the rig `mock` addresses for this process only."""
    return [
        override
        for number, name in enumerate(("lower", "upper"), start=11)
        for override in (
            f"arms.{name}.host={mock_host(number)}",
            f"sensors.{name}.source=http://{mock_host(number)}:8081/?action=stream",
        )
    ]


@pytest.fixture
def mock_ur() -> Iterator[MockUR]:
    """One mock UR5e controller: connect to `mock_ur.host`, inject faults by `mock_ur.faults`."""
    with MockUR(mock_host(1)) as running:
        yield running


@pytest.fixture
def mock_camera() -> Iterator[MockCamera]:
    """One mock camera of 320 x 240 px with stamps: read `mock_camera.url`, set its image by `mock_camera.push`."""
    with MockCamera(mock_host(2)) as running:
        yield running


@pytest.fixture
def mock_rig() -> Iterator[Callable[..., Rig]]:
    """Opens the complete mock cell: `mock_rig("task=reposition", ...)` takes overrides of configs/rigs/mock.yaml."""
    with ExitStack() as stack:

        def opened(*overrides: str, rig: str = "mock", task: str | None = None) -> Rig:
            return stack.enter_context(open_rig(rig, task=task, overrides=[*rig_addresses(), *overrides]))

        yield opened
