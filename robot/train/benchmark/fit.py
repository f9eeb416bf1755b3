"""Fits the baseline `blind` of a task to its teacher."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from robot.train.benchmark.blind import blind_file, fit_blind, write_blind
from robot.train.benchmark.episodes import training_split
from robot.train.benchmark.play import SplitPlayer


def fit_task(
    task: str,
    episodes: int,
    environments: int,
    report_progress: Callable[[str, int, int], None] = lambda words, done, of: None,
) -> Path:
    """Plays the teacher in episodes that are drawn like those of the test split, by another seed, and fits the blind
    motion to it. Returns the file. Raises FileExistsError if there is one, and the errors of `SplitPlayer`."""
    path = blind_file(task)
    if path.exists():
        raise FileExistsError(17, "File exists", str(path))
    split = training_split(task, episodes)
    with SplitPlayer(split, range(episodes), environments) as player:
        starts, actions = player.starts_and_actions(lambda done: report_progress("teacher", done, episodes))
    return write_blind(task, fit_blind(split.task_name, starts, actions))
