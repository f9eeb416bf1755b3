"""Pieces of a set made on a Ray cluster. The nodes make them; only this process writes them."""

from __future__ import annotations

import os
import socket
import tempfile
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from importlib import util
from pathlib import Path
from typing import Any

from robot.collect.job import Job, Piece, SetError, Worker
from robot.collect.workers import PIECES_PER_WORKER, CollectFailed, Stop, Stopped, piece_of_result, piece_or_error
from robot.common.whole_file import write_whole
from robot.deploy.control_loop import versions


def make_on_cluster(
    address: str, job: Job, files: Mapping[str, bytes], numbers: Sequence[int], stop: Stop
) -> Iterator[Piece]:
    """Makes the pieces as tasks of one CPU each, and yields them as they finish.

    If a node fails, Ray repeats its tasks on another node, also those whose results were lost with it.

    Args:
        address: of a cluster ("HOST:6379", "ray://..."), "auto" for the cluster that this machine belongs to, "local"
            for one on this machine alone. Call `require_cluster` first.
        files: that the workers need, by path in the set's folder.

    Raises:
        SetError, CollectFailed, Stopped.
    """
    poll_interval = 0.5  # between two checks for finished pieces and for a request to stop [s]
    import ray

    try:
        ray.init(address=address, log_to_driver=False, configure_logging=False)
    except (ConnectionError, ValueError, RuntimeError) as failure:
        raise SetError(f"--ray {address}: no Ray cluster answers at this address: {failure}") from None
    try:
        kit = [
            ray.put((job, dict(files), versions().get("tacsim", "")))
        ]  # in a list: Ray fetches it only where it is needed
        make: Any = ray.remote(num_cpus=1, max_retries=-1)(_make_piece)
        waiting, running = deque(numbers), list[Any]()
        while waiting or running:
            if stop():
                raise Stopped
            max_running = PIECES_PER_WORKER * max(1, int(ray.cluster_resources().get("CPU", 1)))
            while waiting and len(running) < max_running:
                running.append(make.remote(kit, waiting.popleft()))
            done, running = ray.wait(running, timeout=poll_interval)
            for each in done:
                yield piece_of_result(ray.get(each))
    except ray.exceptions.RayError as failure:
        words = f"{type(failure).__name__}: {failure}".splitlines()
        raise CollectFailed(
            f"Ray: {words[0]} {words[-1] if len(words) > 1 else ''}\nIs tacsim installed on all nodes, in one version?"
        ) from failure
    finally:
        ray.shutdown()


def require_cluster(address: str) -> None:
    """Raises SetError if Ray is not installed, or no server listens at HOST:PORT; Ray itself would try for a minute."""
    timeout = 5.0  # for a cluster to answer [s]
    if util.find_spec("ray") is None:
        raise SetError("--ray needs ray, which is not installed: pip install 'tacsim[cluster]'")
    host, colon, port = address.removeprefix("ray://").rpartition(":")
    if colon and port.isdecimal():
        try:
            socket.create_connection((host, int(port)), timeout).close()
        except (OSError, OverflowError) as failure:
            raise SetError(f"--ray {address}: no Ray cluster answers at this address: {failure}") from None


_workers: dict[str, tuple[Any, Worker]] = {}  # of this process of a node, each with its folder of files


def _make_piece(kit: Sequence[Any], number: int) -> Piece | str:
    """Makes a piece in a process of a node."""
    os.environ.setdefault("TACSIM_THREADS", "1")
    import ray

    return piece_or_error(
        lambda: _find_worker(kit[0]), number, f"{ray.get_runtime_context().get_node_id()}:{os.getpid()}"
    )


def _find_worker(kit: Any) -> Worker:
    if (name := kit.hex()) not in _workers:
        import ray

        job, files, version = ray.get(kit)
        if (here := versions().get("tacsim", "")) != version:
            raise SetError(f"a node has tacsim {here or 'unknown'}, the command runs with {version or 'unknown'}")
        folder = tempfile.TemporaryDirectory(prefix="tacsim-collect-")
        for place, data in files.items():
            write_whole(Path(folder.name) / place, data)
        _workers[name] = folder, job.worker(Path(folder.name))
    return _workers[name][1]
