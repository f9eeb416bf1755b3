"""Starts or continues a set: workers make its pieces; only this process writes them."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from robot.collect.card import press_card, press_statistics
from robot.collect.cluster import make_on_cluster, require_cluster
from robot.collect.episodes import EpisodeJob
from robot.collect.folder import CARD, SetFolder, open_set
from robot.collect.job import Job, Piece
from robot.collect.presses import PressJob, render_reference
from robot.collect.workers import Stop, make_in_processes, make_in_this_process
from robot.common.whole_file import write_whole
from robot.deploy.control_loop import versions

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
        SetError, CollectFailed, Stopped, OSError: written pieces stay valid; the same call continues the set.
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
