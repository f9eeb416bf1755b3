"""A client without errors, next to clients with errors."""

from __future__ import annotations

import contextlib
import socket
import threading

import numpy as np

from robot.mock import FaultClient
from tests.robot.mock.wire_client import TIMEOUT, RtdeClient
from tests.robot.waiting import until


class Innocent:
    """A client at 500 Hz, in a thread. Every package must reach it."""

    def __init__(self, host: str) -> None:
        self.times: list[float] = []
        self._client = RtdeClient(host)
        assert self._client.protocol() and self._client.outputs("timestamp")[0] == 1 and self._client.start()
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                self.times.append(self._client.receive()["timestamp"][0])

    def check(self, faults: FaultClient) -> None:
        """It still receives, and nothing was left out."""
        end = faults.state().time
        until(lambda: bool(self.times) and self.times[-1] >= end, "packages still arrive")
        np.testing.assert_allclose(np.diff(self.times), 0.002, atol=1e-9)

    def close(self) -> None:
        with contextlib.suppress(OSError):  # the mock has closed it
            self._client.socket.shutdown(socket.SHUT_RDWR)
        self._thread.join(TIMEOUT)
        self._client.socket.close()
