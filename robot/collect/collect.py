"""A set is begun or gone on with, made by workers, and written by this process alone."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from robot.collect.card import press_card, press_statistics
from robot.collect.cluster import on_cluster, require_cluster
from robot.collect.episodes import EpisodeJob
from robot.collect.folder import CARD, SetFolder, open_set
from robot.collect.job import Job, Piece
from robot.collect.presses import PressJob, reference
from robot.collect.workers import Stop, in_processes, in_this_process
from robot.common.whole_file import write_whole
from robot.deploy.control_loop import versions

Tell = Callable[[int, int], None]


@dataclass(slots=True)
class Collected:
    """What was done by one call."""

    made: int = 0
    failures: Mapping[int, str] = field(default_factory=dict)  # of the whole set
    bytes: int = 0  # written
    seconds: Counter[str] = field(default_factory=Counter)  # of all workers, by part
    workers: set[str] = field(default_factory=set)
    writing: float = 0.0  # by the one who writes [s]


def collect(
    job: PressJob | EpisodeJob,
    folder: Path,
    files: Mapping[str, bytes],
    command: str,
    *,
    workers: int = 1,
    cluster: str | None = None,
    tell: Tell = lambda done, total: None,
    stop: Stop = lambda: False,
) -> Collected:
    """Makes a set, or what is missing of it.

    Args:
        files: that the job needs, by their place in the set's folder.
        workers: processes; 1: this one alone.
        cluster: address of a Ray cluster, which makes it instead.
        tell: told (presses or episodes done, all).
        stop: asked again and again.

    Raises SetError, CollectFailed, Stopped, OSError. What is written stays, and the same call goes on.
    """
    settings = job.settings.model_dump(mode="json")
    found = Collected()
    if cluster is not None:
        require_cluster(cluster)
    with open_set(folder, job, settings, files, command) as place:
        if isinstance(job, PressJob) and not (place.path / CARD).exists():
            write_whole(place.path / "reference.png", reference(job.settings, place.path))
            write_whole(place.path / CARD, press_card(job.settings, command, versions()).encode())
        tell(place.done, job.count)
        for piece in _pieces(job, place, files, workers, cluster, stop):
            began = time.perf_counter()
            place.put(piece)
            found.writing += time.perf_counter() - began
            found.workers.add(piece.worker)
            found.made += piece.made
            found.bytes += len(piece.data or b"")
            found.seconds.update(piece.seconds)
            tell(place.done, job.count)
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
        return on_cluster(cluster, job, files, missing, stop)
    if workers == 1:
        return in_this_process(job, place.path, missing, stop)
    return in_processes(job, place.path, missing, stop, workers)
