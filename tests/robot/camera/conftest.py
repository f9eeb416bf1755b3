"""Fixtures of the tests of the camera driver."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from robot.camera import mjpeg
from tests.robot.camera.mocked import WAIT
from tests.robot.camera.servers import Server
from tests.robot.waiting import until


@pytest.fixture
def server() -> Iterator[Server]:
    server = Server()
    yield server
    server.close()


def sockets() -> set[str]:
    targets = [str(link.readlink()) for link in Path("/proc/self/fd").iterdir() if link.is_symlink()]
    return {target for target in targets if target.startswith("socket:")}


@pytest.fixture
def nothing_is_left() -> Iterator[None]:
    threads, open_sockets = set(threading.enumerate()), sockets()
    yield
    assert [t.name for t in set(threading.enumerate()) - threads if t.name.startswith("camera")] == []
    # what the mock's own thread has yet to close goes a moment later
    until(lambda: sockets() <= open_sockets, "every socket of the test closed")


@pytest.fixture
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """A camera that a busy machine keeps from sending is not taken for a stalled one."""
    monkeypatch.setattr(mjpeg, "READ_TIMEOUT", 2 * WAIT)
