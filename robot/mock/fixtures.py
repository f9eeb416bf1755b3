"""pytest fixtures of mock devices. Users take them, with that of a whole rig, from `robot.fixtures`.

Each test process has loopback addresses of its own (127.0.0.0/8; on macOS they must be made first: ifconfig lo0 alias),
so tests may run side by side.
"""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from robot.common.loopback import loopback_host
from robot.mock.camera.camera import MockCamera
from robot.mock.ur.handle import MockUR


def mock_host(number: int) -> str:
    """A loopback address of this process's own, number 1 to 254."""
    room = 31  # second number of the addresses
    return loopback_host(number, room)


def rig_addresses() -> list[str]:
    """Overrides that give the rig `mock` addresses of this process's own."""
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
    """One mock UR5e controller: connect to `mock_ur.host`, break it by `mock_ur.faults`."""
    with MockUR(mock_host(1)) as running:
        yield running


@pytest.fixture
def mock_camera() -> Iterator[MockCamera]:
    """One mock camera of 320 x 240 px with stamps: read `mock_camera.url`, feed it by `mock_camera.push`."""
    with MockCamera(mock_host(2)) as running:
        yield running
