"""Handles of mock controllers, for those who start them: each is a process of its own (`robot/mock/__main__.py`)."""

from __future__ import annotations

import ipaddress
import json
import os
import selectors
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Self

import numpy as np

from robot.common import MOCK_SERIAL
from robot.errors import DeviceError
from robot.mock.ur.fault_client import FAULT_PORT, FaultClient
from robot.mock.ur.machine.machine import Version

if TYPE_CHECKING:
    from tacsim.models.hardware import Model  # pydantic and SciPy: half a second of start-up

VERSION: Version = (5, 11, 0, 108150)


class MockError(DeviceError):
    """A mock controller did not start."""


class MockArms:
    """Mock controllers in one process of their own, one for each host; a context manager.

    model: one for all, or one each; joints: where they begin [rad], (6,) or (arms, 6). Raises MockError when they are
    not ready in time, for example because a port is in use, ValueError for hosts that are not loopback addresses.
    """

    def __init__(
        self,
        hosts: Sequence[str],
        *,
        model: Model | Sequence[Model] = "ur5e",
        joints: Sequence[float] | Sequence[Sequence[float]] | None = None,
        version: Version = VERSION,
        fault_port: int = FAULT_PORT,
        serial: str = MOCK_SERIAL,
        ready_timeout: float = 10.0,
        allow_network: bool = False,
        realtime: bool = False,
    ) -> None:
        self.hosts = tuple(hosts)
        arguments = [*self.hosts, "--fault-port", str(fault_port), "--serial", serial]
        arguments += [f"--model={each}" for each in ([model] if isinstance(model, str) else model)]
        arguments += ["--version", ".".join(map(str, version)), "--with-parent"]
        for posture in () if joints is None else np.atleast_2d(np.array(joints, dtype=np.float64)):
            arguments.append("--joints=" + ",".join(repr(float(angle)) for angle in posture))
        if allow_network:
            arguments.append("--allow-network")
        if realtime:
            arguments.append("--realtime")
        check_hosts(self.hosts, allow_network)
        root = str(Path(__file__).resolve().parents[3])
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", "robot.mock", *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,  # Ctrl-C is for the parent; the mock ends with it
            env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, [root, os.environ.get("PYTHONPATH")]))},
        )
        self.pid = self._process.pid
        self.fault_clients = tuple(FaultClient(host, fault_port) for host in self.hosts)
        try:
            self._wait(ready_timeout)
        except BaseException:
            self.close()
            raise

    @property
    def running(self) -> bool:
        """False once the process has ended."""
        return self._process.poll() is None

    def close(self) -> None:
        """Ends the process; again does nothing."""
        for faults in self.fault_clients:
            faults.close()
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                pipe.close()
        if self._process.poll() is not None:
            return
        # A stopped process hears neither the end of its input nor SIGTERM.
        for patience, end in ((2.0, self._process.terminate), (1.0, self._process.kill)):
            try:
                self._process.wait(patience)
                return
            except subprocess.TimeoutExpired:
                end()
        self._process.wait()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def _wait(self, limit: float) -> None:
        pipe = self._process.stdout
        assert pipe is not None
        deadline, said = time.monotonic() + limit, b""
        with selectors.DefaultSelector() as selector:
            selector.register(pipe, selectors.EVENT_READ)
            while not said.endswith(b"\n"):
                if not selector.select(max(0.0, deadline - time.monotonic())):
                    raise MockError(f"mock controller on {', '.join(self.hosts)}: not ready after {limit:g} s")
                data = os.read(pipe.fileno(), 4096)
                if not data:
                    code = self._process.wait()
                    raise MockError(f"mock controller on {', '.join(self.hosts)} ended at once, exit code {code}")
                said += data
        message = json.loads(said)
        if "error" in message:
            raise MockError(message["error"])


class MockUR(MockArms):
    """One mock controller in a process of its own. See MockArms."""

    def __init__(
        self,
        host: str = "127.0.0.2",
        *,
        model: Model = "ur5e",
        joints: Sequence[float] | None = None,
        version: Version = VERSION,
        fault_port: int = FAULT_PORT,
        serial: str = MOCK_SERIAL,
        ready_timeout: float = 10.0,
        allow_network: bool = False,
        realtime: bool = False,
    ) -> None:
        super().__init__(
            [host],
            model=model,
            joints=joints,
            version=version,
            fault_port=fault_port,
            serial=serial,
            ready_timeout=ready_timeout,
            allow_network=allow_network,
            realtime=realtime,
        )
        self.host = host
        self.faults = self.fault_clients[0]

    @property
    def door(self) -> FaultClient:
        """The same as `faults`, by its old name."""
        return self.faults


def check_hosts(hosts: Sequence[str], allow_network: bool) -> None:
    """Raises ValueError unless every host is a numeric loopback address, or the network is allowed."""
    if not hosts or len(set(hosts)) < len(hosts):
        raise ValueError(f"mock controllers need different hosts, at least one, got {list(hosts)}")
    for host in hosts:
        try:
            loopback = ipaddress.ip_address(host).is_loopback
        except ValueError:
            raise ValueError(f"'{host}' is no address; a mock controller listens on one like 127.0.0.2") from None
        if not (loopback or allow_network):
            raise ValueError(
                f"{host} is not a loopback address: a mock controller there could be taken for a robot by the whole "
                "network. Use 127.x.y.z, or ask for it with --allow-network"
            )
