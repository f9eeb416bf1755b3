"""Writes episodes as a LeRobot data set."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import util
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robot.common.whole_file import whole_folder
from robot.export.lerobot_files import DataSet, write_json
from robot.export.lerobot_mapping import (
    IMAGE,
    Column,
    Feature,
    ImageCounts,
    LeRobotMapping,
    Row,
    Statistics,
    frames_per_second,
    outcome,
    task_in_words,
)
from robot.export.lerobot_video import require_video
from robot.rig.recorded import ObservedEpisode, observe_episode
from tacsim.interface import IncompatibleRig
from tacsim.record.episode import EpisodeError
from tacsim.record.images import encode_png

OnStep = Callable[[int, int], None]


@dataclass(frozen=True, slots=True)
class Content:
    """What a data set holds, as the arguments of `export_lerobot`."""

    task: str | None
    maps: bool
    video: bool
    environment: bool
    pictures: bool


def export_lerobot(
    paths: Sequence[Path],
    folder: Path,
    *,
    task: str | None = None,
    maps: bool = True,
    cut: bool = False,
    video: bool = False,
    environment: bool = False,
    pictures: bool = True,
    on_step: OnStep = lambda done, total: None,
) -> None:
    """Writes the episodes, in this order, into a new folder, completely or not at all.

    An episode of n + 1 steps has n frames: the observation after step k with the action of step k + 1. Only one episode
    is in memory at a time.

    Args:
        task: description for policies that read language; None: made from the task and goal of each episode.
        maps: also write heights, gradients and flow.
        cut: accept incomplete recordings, up to their last step.
        pictures: also write the canonical pictures; without, a policy that reads numbers alone loads them faster.
        environment: also write `observation.environment_state`: touch and goal.
        video: write pictures as H.264 video, which is lossy, instead of PNG.
        on_step: is called with the numbers of finished steps and of all steps.

    Raises:
        ValueError: the episodes do not fit into one data set.
        EpisodeError, OSError, VideoFailed, and the errors of normalising.
    """
    if util.find_spec("pyarrow") is None:
        raise ValueError("writing data sets needs pyarrow, which is not installed: pip install 'tacsim[export]'")
    if video:
        require_video()
    episodes = [observe_episode(path) for path in paths]
    fps = _check_episodes(episodes, cut)
    with whole_folder(folder) as partial:
        chosen = Content(task, maps, video, environment, pictures)
        _write_episodes(episodes, partial, fps, chosen, on_step)


def _check_episodes(episodes: Sequence[ObservedEpisode], cut: bool) -> float:
    """Frames per second of all episodes. Checks them before anything is written. Raises ValueError."""
    if not episodes:
        raise ValueError("no episode to export")
    first = episodes[0]
    for each in episodes:
        episode, spec = each.episode, each.episode.meta.spec
        if not episode.complete and not cut:
            raise ValueError(
                f"{each.path} was cut off after {len(episode.steps)} steps: leave it out, or export these steps (--cut)"
            )
        if len(episode.steps) < 2:
            raise ValueError(f"{each.path} has no action: at least two steps are needed, it has {len(episode.steps)}")
        if episode.dropped or episode.steps[-1].index != len(episode.steps) - 1:
            raise ValueError(
                f"{each.path}: the recorder dropped steps, so its frames do not follow each other evenly; leave it out"
            )
        if abs(spec.period - first.episode.meta.spec.period) > 1e-3 * first.episode.meta.spec.period:
            raise ValueError(
                f"a data set has one rate, but {first.path} has a step every {first.episode.meta.spec.period:g} s and "
                f"{each.path} every {spec.period:g} s; make one data set of each"
            )
        if each.canonical != first.canonical:
            raise ValueError(f"{first.path} and {each.path} differ in their canonical grids; make one data set of each")
        try:
            LeRobotMapping(spec, each.canonical)
        except IncompatibleRig as unfit:
            raise ValueError(f"{each.path}: {unfit}") from None
    return frames_per_second(first.episode.meta.spec.period)


def _write_episodes(
    episodes: Sequence[ObservedEpisode],
    folder: Path,
    fps: float,
    chosen: Content,
    on_step: OnStep,
) -> None:
    total, done = sum(len(each.episode.steps) for each in episodes), 0
    data: DataSet | None = None
    features: dict[str, Feature] = {}

    def count() -> None:
        nonlocal done
        done += 1
        on_step(done, total)

    for each in episodes:
        meta = each.episode.meta
        mapping = LeRobotMapping(
            meta.spec, each.canonical, maps=chosen.maps, goal=meta.goal, environment=chosen.environment
        )
        found, columns, images = _convert_episode(each, mapping, chosen.pictures, count)
        if data is None:
            features, data = found, DataSet(folder, fps, meta.rig, found, video=chosen.video)
        elif found != features:
            raise ValueError(f"{episodes[0].path} and {each.path} do not fit together: {_difference(features, found)}")
        data.add(columns, images, task_in_words(meta.task, meta.goal) if chosen.task is None else chosen.task)
    assert data is not None
    data.close()
    provenance = _provenance(episodes, mapping)
    if chosen.video:
        provenance["video_error"] = {name: each.error.summarise() for name, each in data.videos.items()}
    write_json(folder / "meta" / "tacsim.json", provenance)


def _convert_episode(
    each: ObservedEpisode, mapping: LeRobotMapping, pictures: bool, count: Callable[[], None]
) -> tuple[dict[str, Feature], dict[str, Column], dict[str, Statistics]]:
    """Features, columns, and statistics of the pictures of one episode."""
    features: dict[str, Feature] = {}
    rows: list[Row] = []
    encoded: dict[str, list[bytes]] = {}
    counts: dict[str, ImageCounts] = {}
    before: Row | None = None
    last = each.episode.steps[-1].index
    for step, observation in each.steps():
        if before is not None:
            if not pictures:
                before = {key: value for key, value in before.items() if not key.startswith(IMAGE)}
            if step.action is None:
                raise EpisodeError(f"{each.path}: step {step.index} has no action")
            row = before | {"action": mapping.encode_action(step.action)} | outcome(step, step.index == last)
            found = mapping.features(row)
            features = features or found
            if found != features:
                raise ValueError(
                    f"{each.path}: step {step.index} differs from those before: {_difference(features, found)}"
                )
            for name in [key for key in row if key.startswith(IMAGE)]:
                picture: NDArray[np.uint8] = row.pop(name)
                encoded.setdefault(name, []).append(encode_png(picture))
                counts.setdefault(name, ImageCounts()).add(picture)
            rows.append(row)
        try:
            before = mapping.begin(observation) if before is None else mapping.encode_observation(observation)
        except IncompatibleRig as unfit:
            message = f"{each.path}: step {step.index} lacks data that the recording declares: {unfit}"
            raise EpisodeError(message) from None
        count()
    columns: dict[str, Column] = {key: np.stack([row[key] for row in rows]) for key in rows[0]}
    for key, column in columns.items():
        if not np.isfinite(column).all():
            raise ValueError(f"{each.path}: {key} holds numbers that are not finite")
    return features, columns | encoded, {key: found.statistics() for key, found in counts.items()}


def _difference(first: dict[str, Feature], second: dict[str, Feature]) -> str:
    """A description of the first difference."""
    for name in (*first, *second):
        if first.get(name) != second.get(name):
            a, b = (_describe_feature(each.get(name)) for each in (first, second))
            return f"{name} is {a} in the first and {b} in the second"
    return "nothing"


def _describe_feature(feature: Feature | None) -> str:
    return "missing" if feature is None else f"{feature.dtype} {feature.shape}"


def _provenance(episodes: Sequence[ObservedEpisode], mapping: LeRobotMapping) -> dict[str, Any]:
    """Data that LeRobot does not define: the scale of each number, and the source of each episode."""
    numbers = {"observation.state": mapping.state, "action": mapping.action}
    return {
        "scales": {key: dict(zip(each.names, each.scales, strict=True)) for key, each in numbers.items()},
        "units": "a number times its scale is in SI units; height and flow are in m",
        "canonical": episodes[0].canonical.model_dump(mode="json"),
        "episodes": [
            {
                "source": each.path.name,
                "rig": each.episode.meta.rig,
                "task": each.episode.meta.task,
                "goal": each.episode.meta.goal,
                "policy": each.episode.meta.policy,
                "seed": each.episode.meta.seed,
                "complete": each.episode.complete,
                "started": None if each.episode.meta.started is None else each.episode.meta.started.isoformat(),
                "versions": dict(each.episode.meta.versions),
            }
            for each in episodes
        ],
    }
