"""Starts or continues a set: workers on this machine or on a Ray cluster make its pieces; only this process writes
them."""

from __future__ import annotations

import os
import tempfile
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from robot.collect.card import press_card, press_statistics
from robot.collect.episodes import EpisodeJob
from robot.collect.folder import CARD, SetFolder, open_set
from robot.collect.presses import PressJob, render_reference
from robot.collect.workers import (
    PIECES_PER_WORKER,
    CollectFailed,
    Job,
    Piece,
    SetError,
    Stop,
    Stopped,
    Worker,
    make_in_processes,
    make_in_this_process,
    piece_of_result,
    piece_or_error,
)
from robot.common.cluster import connected_to_cluster, describe_ray_error, require_cluster, tacsim_version
from robot.common.whole_file import write_whole
from robot.deploy.control_loop import versions


def make_on_cluster(
    address: str, job: Job, files: Mapping[str, bytes], numbers: Sequence[int], stop: Stop
) -> Iterator[Piece]:
    """Makes the pieces as tasks of one CPU each, and yields them as they finish.

    If a node fails, Ray repeats its tasks on another node, also those whose results were lost with it.

    Args:
        address: of a cluster ("HOST:6379", "ray://..."), "auto" for the cluster that this machine belongs to, "local"
            for one on this machine alone.
        files: that the workers need, by path in the set's folder.

    Raises:
        ClusterError, CollectFailed, Stopped.
    """
    poll_interval = 0.5  # between two checks for finished pieces and for a request to stop [s]
    with connected_to_cluster(address) as ray:
        try:
            kit = [ray.put((job, dict(files), tacsim_version()))]  # in a list: Ray fetches it only where it is needed
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
            raise CollectFailed(
                f"Ray: {describe_ray_error(failure)}\nIs tacsim installed on all nodes, in one version?"
            ) from failure


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
        if (here := tacsim_version()) != version:
            raise SetError(f"a node has tacsim {here or 'unknown'}, the command runs with {version or 'unknown'}")
        folder = tempfile.TemporaryDirectory(prefix="tacsim-collect-")
        for place, data in files.items():
            write_whole(Path(folder.name) / place, data)
        _workers[name] = folder, job.worker(Path(folder.name))
    return _workers[name][1]


ReportProgress = Callable[[int, int], None]


@dataclass(slots=True)
class Collected:
    """Result of one call of `collect`."""

    made: int = 0
    failures: Mapping[int, str] = field(default_factory=dict)  # of the whole set
    bytes: int = 0  # written
    seconds: Counter[str] = field(default_factory=Counter)  # of all workers, by part
    workers: set[str] = field(default_factory=set)
    writing_seconds: float = 0.0  # of the process that writes [s]


def collect(
    job: PressJob | EpisodeJob,
    folder: Path,
    files: Mapping[str, bytes],
    command: str,
    *,
    workers: int = 1,
    cluster: str | None = None,
    report_progress: ReportProgress = lambda done, total: None,
    stop: Stop = lambda: False,
) -> Collected:
    """Makes a set, or its missing pieces.

    Args:
        files: that the job needs, by path in the set's folder.
        workers: number of processes; 1: this process alone.
        cluster: address of a Ray cluster that makes the pieces; None: this machine makes them.
        report_progress: is called with the numbers of finished and of all presses or episodes.
        stop: is polled; True ends the call.

    Raises:
        SetError, ClusterError, CollectFailed, Stopped, OSError: written pieces stay valid; the same call continues the
            set.
    """
    settings = job.settings.model_dump(mode="json")
    found = Collected()
    if cluster is not None:
        require_cluster(cluster)
    with open_set(folder, job, settings, files, command) as place:
        if isinstance(job, PressJob) and not (place.path / CARD).exists():
            write_whole(place.path / "reference.png", render_reference(job.settings, place.path))
            write_whole(place.path / CARD, press_card(job.settings, command, versions()).encode())
        report_progress(place.done, job.count)
        for piece in _pieces(job, place, files, workers, cluster, stop):
            began = time.perf_counter()
            place.write_piece(piece)
            found.writing_seconds += time.perf_counter() - began
            found.workers.add(piece.worker)
            found.made += piece.made
            found.bytes += len(piece.data or b"")
            found.seconds.update(piece.seconds)
            report_progress(place.done, job.count)
        if isinstance(job, PressJob):
            whole = press_card(job.settings, command, versions(), press_statistics(place, job.settings))
            write_whole(place.path / CARD, whole.encode())
        found.failures = dict(place.failures)
    return found


def _pieces(
    job: Job, place: SetFolder, files: Mapping[str, bytes], workers: int, cluster: str | None, stop: Stop
) -> Iterator[Piece]:
    missing = place.missing
    if cluster is not None:
        return make_on_cluster(cluster, job, files, missing, stop)
    if workers == 1:
        return make_in_this_process(job, place.path, missing, stop)
    return make_in_processes(job, place.path, missing, stop, workers)
