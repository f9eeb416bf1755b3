"""What drivers and mocks share, so that neither imports the other: names, loopback addresses (only this machine reaches
them: mocks listen on them), and real-time priority for time-critical processes (workers of real arms, and mocks where
timing is measured)."""

from __future__ import annotations

import ipaddress
import os
from abc import ABC, abstractmethod
from typing import Self

MOCK_SERIAL = "00000000001"  # of mock controllers; no real arm has this number, so a driver recognises a mock
# A mock controller, which stands in for hardware, comes before its worker
WORKER_PRIORITY, CONTROLLER_PRIORITY = 10, 11


class Closing(ABC):
    """A context manager that closes itself at the end of its block."""

    @abstractmethod
    def close(self) -> None: ...

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()


def is_loopback(host: str) -> bool:
    """True for 127.x.y.z, ::1 and localhost; False for any other name, which may resolve to any machine."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host.lower().rstrip(".") == "localhost"


def require_loopback(host: str, what: str, *, allow_network: bool) -> None:
    """Raises ValueError for an address that other machines reach, unless the network is allowed."""
    if not (allow_network or is_loopback(host)):
        raise ValueError(
            f"{what}: {host} is not a loopback address, so the whole network could take the mock for a real device; "
            "use 127.x.y.z, or allow it with --allow-network (allow_network=True)"
        )


def loopback_host(number: int, room: int) -> str:
    """A loopback address for this process only, `number` and `room` 1 to 254: parallel processes do not collide."""
    return f"127.{room}.{os.getpid() % 250 + 1}.{number}"


def request_realtime(priority: int) -> bool:
    """Gives this process, and threads that it starts later, real-time priority (SCHED_RR): no ordinary process delays
    it. Returns False, without any change, where the system has no such priority or does not allow it.

    Linux allows it for root, with CAP_SYS_NICE, or by `rtprio` in /etc/security/limits.conf.
    """
    if not hasattr(os, "sched_setscheduler"):
        return False
    try:
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(priority))
    except (OSError, ValueError):
        return False
    return True


def is_realtime_allowed() -> bool:
    """True if a process may have real-time priority here; the priority of this process does not change."""
    if not hasattr(os, "sched_setscheduler"):
        return False
    policy, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
    granted = request_realtime(WORKER_PRIORITY)
    if granted:
        os.sched_setscheduler(0, policy, parameters)
    return granted
