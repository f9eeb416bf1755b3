"""Handles of mock controllers. Each handle starts a separate process (`robot/mock/__main__.py`)."""

from __future__ import annotations

import contextlib
import subprocess
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from robot.common import MOCK_SERIAL, require_loopback
from robot.common.process import END_TIMEOUT, Child
from robot.errors import DeviceError
from robot.mock.ur.fault_client import FAULT_PORT, FaultClient
from robot.mock.ur.machine.state import VERSION, Version, check_version, version_text

if TYPE_CHECKING:
    from tacsim.models.hardware import Model  # pydantic and SciPy: half a second of start-up


class MockError(DeviceError):
    """A mock controller did not start."""


class MockArms(Child):
    """Mock controllers in one separate process, one for each host; a context manager.

    model: one for all, or one for each arm.
    joints: initial joints [rad], (6,) or (arms, 6).
    payload: mass [kg] and centre of gravity in flange axes [m] of the load on the flange, (4,) or (arms, 4).
    version: of PolyScope that the controllers report, four numbers, or four for each arm.

    Raises MockError if they are not ready in time, for example because a port is in use; ValueError for hosts that are
    not loopback addresses and for invalid versions.
    """

    def __init__(
        self,
        hosts: Sequence[str],
        *,
        model: Model | Sequence[Model] = "ur5e",
        joints: Sequence[float] | Sequence[Sequence[float]] | None = None,
        payload: Sequence[float] | Sequence[Sequence[float]] | None = None,
        version: Version | Sequence[Version] = VERSION,
        fault_port: int = FAULT_PORT,
        serial: str = MOCK_SERIAL,
        ready_timeout: float = 60.0,
        allow_network: bool = False,
        realtime: bool = False,
    ) -> None:
        self.hosts = tuple(hosts)
        arguments = [*self.hosts, "--fault-port", str(fault_port), "--serial", serial]
        arguments += [f"--model={each}" for each in ([model] if isinstance(model, str) else model)]
        versions = [cast("Version", version)] if isinstance(version[0], int) else cast("Sequence[Version]", version)
        arguments += [f"--version={version_text(check_version(each))}" for each in versions]
        arguments.append("--with-parent")
        for option, rows in (("--joints", joints), ("--payload", payload)):
            for row in () if rows is None else np.atleast_2d(np.array(rows, dtype=np.float64)):
                arguments.append(f"{option}=" + ",".join(repr(float(number)) for number in row))
        if allow_network:
            arguments.append("--allow-network")
        if realtime:
            arguments.append("--realtime")
        check_hosts(self.hosts, allow_network)
        self.fault_clients = tuple(FaultClient(host, fault_port) for host in self.hosts)
        name = f"mock controller on {', '.join(hosts)}"
        super().__init__("robot.mock", arguments, name=name, error=MockError, ready_timeout=ready_timeout)
        for faults in self.fault_clients:
            faults.exit_report = self._exit_report

    def _exit_report(self) -> str:
        """Text for an error about how the process ended; empty while it runs."""
        exit_delay = 0.2  # a process ends this time after its connections at the latest [s]
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(exit_delay)
        try:
            self.check()
        except MockError as error:
            return f"; {error}"
        return ""

    def close(self, timeout: float = END_TIMEOUT) -> None:
        for faults in self.fault_clients:
            faults.close()
        super().close(timeout)


class MockUR(MockArms):
    """One mock controller in a separate process; `options` are those of MockArms."""

    def __init__(self, host: str = "127.0.0.2", **options: Any) -> None:
        super().__init__([host], **options)
        self.host = host
        self.faults = self.fault_clients[0]


def check_hosts(hosts: Sequence[str], allow_network: bool) -> None:
    """Raises ValueError unless the hosts are different loopback addresses, or the network is allowed."""
    if not hosts or len(set(hosts)) < len(hosts):
        raise ValueError(f"mock controllers need different hosts, at least one, got {list(hosts)}")
    for host in hosts:
        require_loopback(host, "mock controller", allow_network=allow_network)
