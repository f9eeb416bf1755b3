"""Connection to a Ray cluster, with errors in words. Only functions import ray, which is an extra."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import metadata, util
from typing import Any


class ClusterError(ValueError):
    """No Ray cluster can be used at the given address."""


def require_cluster(address: str) -> None:
    """Raises ClusterError if Ray is not installed, or no server listens at HOST:PORT; Ray itself would try for a
    minute."""
    timeout = 5.0  # for a cluster to answer [s]
    if util.find_spec("ray") is None:
        raise ClusterError("--ray needs ray, which is not installed: pip install 'tacsim[cluster]'")
    host, colon, port = address.removeprefix("ray://").rpartition(":")
    if colon and port.isdecimal():
        try:
            socket.create_connection((host, int(port)), timeout).close()
        except (OSError, OverflowError) as failure:
            raise ClusterError(f"--ray {address}: no Ray cluster answers at this address: {failure}") from None


@contextmanager
def connected_to_cluster(address: str) -> Iterator[Any]:
    """Connects this program to a cluster for the block, and gives the module ray. A program that is connected already
    keeps its connection.

    address: of a cluster ("HOST:6379", "ray://..."), "auto" for the cluster that this machine belongs to, "local" for
    one on this machine alone. Raises ClusterError.
    """
    require_cluster(address)
    import ray

    if ray.is_initialized():
        yield ray
        return
    try:
        ray.init(address=address, log_to_driver=False, configure_logging=False)
    except (ConnectionError, ValueError, RuntimeError) as failure:
        raise ClusterError(f"--ray {address}: no Ray cluster answers at this address: {failure}") from None
    try:
        yield ray
    finally:
        ray.shutdown()


def describe_ray_error(failure: Exception) -> str:
    """An error of Ray in one line: its type, its first line and the beginning of its last."""
    max_length = 200  # of the last line; Ray adds a list of possible causes
    lines = [line.strip() for line in f"{type(failure).__name__}: {failure}".splitlines() if line.strip()]
    last = lines[-1] if len(lines[-1]) <= max_length else lines[-1][:max_length] + " ..."
    return " ".join(dict.fromkeys([lines[0], last]))


def tacsim_version() -> str:
    """Version of the installed package, "" if it runs from its sources. All nodes need the same."""
    try:
        return metadata.version("tacsim")
    except metadata.PackageNotFoundError:
        return ""
