"""Addresses of this machine alone: mocks live on them, and nothing else does."""

from __future__ import annotations

import ipaddress
import os


def is_loopback(host: str) -> bool:
    """True for 127.x.y.z, ::1 and localhost; any other name may lead anywhere."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host.lower().rstrip(".") == "localhost"


def require_loopback(host: str, what: str, *, allow_network: bool) -> None:
    """Raises ValueError for an address that other machines reach, unless the network is allowed."""
    if not (allow_network or is_loopback(host)):
        raise ValueError(
            f"{what}: {host} is not a loopback address, so the whole network could take the mock for a real device; "
            "use 127.x.y.z, or ask for it with --allow-network (allow_network=True)"
        )


def loopback_host(number: int, room: int) -> str:
    """An address of this process's own, `number` and `room` 1 to 254: processes side by side do not meet."""
    return f"127.{room}.{os.getpid() % 250 + 1}.{number}"
