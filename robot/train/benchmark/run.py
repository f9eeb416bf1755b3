"""Runs policies on splits, and writes their scores round by round: a run that was stopped continues where it was."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from robot.common.file_lock import hold_lock
from robot.train.benchmark.episodes import Split, load_split, subset_size
from robot.train.benchmark.fingerprint import machine, physics
from robot.train.benchmark.play import SplitPlayer, Warn
from robot.train.benchmark.policies import hash_policy
from robot.train.benchmark.score import RigName, Score, read_score, score_path, write_score
from robot.train.benchmark.wire import WirePlayer, require_mock

Subset = Literal["quick", "full"]
ReportProgress = Callable[[str, int, int], None]
ReportScore = Callable[[Path, Score], None]


class OtherRun(ValueError):
    """A score that was begun with other settings, or that another process writes, cannot be continued."""


@dataclass(frozen=True, slots=True)
class Run:
    """What is to be run, and where the scores go."""

    task: str  # name or path of a task file
    policies: tuple[str, ...]
    splits: tuple[str, ...]
    subset: Subset
    folder: Path
    environments: int = 8  # simulated episodes that move together; results do not depend on it
    rig: RigName = "sim"
    first: int | None = None  # only so many episodes of the subset, for now; None: all


def new_score(split: Split, policy: str, subset: Subset, rig: RigName = "sim") -> Score:
    """The score of a policy without episodes. Raises PolicyNotFound."""
    config = split.load_config()
    assert config.task is not None
    return Score(
        task=split.task_name,
        kind=config.task.kind,
        split=split.name,
        subset=subset,
        rig=rig,
        policy=policy,
        policy_sha256=hash_policy(policy, split.file, config.task.kind),
        task_sha256=split.task_sha256,
        split_sha256=split.sha256,
        sensors_sha256=split.sensors_sha256,
        physics=physics(),
        machine=machine(config.clock),
        number=subset_size(subset, len(split.episodes)),
    )


def run_benchmark(
    run: Run,
    report_progress: ReportProgress = lambda words, done, of: None,
    report_score: ReportScore = lambda path, score: None,
    warn: Warn = lambda words: None,
) -> list[tuple[Path, Score]]:
    """Plays all episodes that the score files in the folder do not have. Returns all scores.

    An episode in which the policy raises is a failed episode, with the reason in its score; the run continues.
    report_score: called with each score when it is complete.
    Raises ValueError for more episodes than the subset has; PolicyNotFound, IncompatibleRig, SplitChanged, OtherRun,
    ScoreEdited, and the errors of `SplitPlayer` and `WirePlayer`.
    """
    found: list[tuple[Path, Score]] = []
    for name in run.splits:
        split = load_split(run.task, name)
        _require_episodes(run, split)
        if run.rig == "mock":
            require_mock(split)
        scores = [open_score(run.folder, new_score(split, policy, run.subset, run.rig)) for policy in run.policies]
        numbers = sorted({number for _, score in scores for number in _missing(score, run.first)})
        if numbers:
            scores = _play_split(run, split, scores, numbers, report_progress, warn)
        for path, score in scores:
            report_score(path, score)
        found += scores
    return found


def _require_episodes(run: Run, split: Split) -> None:
    """Raises ValueError if more episodes are asked for than the subset has."""
    number, whole = subset_size(run.subset, len(split.episodes)), len(split.episodes)
    if run.first is not None and run.first > number:
        more = f"; with --full {whole}" if number < whole else ""
        raise ValueError(f"--episodes {run.first}: the subset '{run.subset}' has {number} episodes{more}")


def _play_split(
    run: Run,
    split: Split,
    scores: list[tuple[Path, Score]],
    numbers: Sequence[int],
    report_progress: ReportProgress,
    warn: Warn,
) -> list[tuple[Path, Score]]:
    """Plays those of the episodes that the scores do not have. Returns the scores with them."""
    with _make_player(split, numbers, run) as player, ExitStack() as held:
        for _, score in scores:
            player.require_policy(score.policy, warn)
        for path in {path for path, _ in scores}:
            _lock_score(path, held)
        scores = [open_score(run.folder, score) for _, score in scores]  # as another process may have left them
        for chosen in [[number] for number in numbers] if run.rig == "mock" else [numbers]:
            scores = [_play(player, path, score, chosen, report_progress) for path, score in scores]
    return scores


def _lock_score(path: Path, held: ExitStack) -> None:
    try:
        held.enter_context(hold_lock(path))
    except BlockingIOError:
        raise OtherRun(f"{path}: another process writes this score; wait for it, or end it") from None


def _make_player(split: Split, numbers: Sequence[int], run: Run) -> SplitPlayer | WirePlayer:
    return WirePlayer(split, numbers) if run.rig == "mock" else SplitPlayer(split, numbers, run.environments)


def _missing(score: Score, first: int | None) -> list[int]:
    """Numbers of the episodes to play, of the first so many."""
    return [number for number in score.missing if first is None or number < first]


def open_score(folder: Path, new: Score) -> tuple[Path, Score]:
    """The score file of this subject, or `new` if there is none yet. Raises OtherRun if the file there has another
    subject: another physics, task, split, sensors or vector width."""
    path = score_path(folder, new)
    if not path.exists():
        return path, new
    there = read_score(path)
    if there.subject != new.subject:
        differing = [key for key, value in new.subject.items() if there.subject[key] != value]
        raise OtherRun(
            f"{path}: has a score with another {', '.join(differing)}; nothing is overwritten, give another --out"
        )
    return path, there


def _play(
    player: SplitPlayer | WirePlayer, path: Path, score: Score, numbers: Sequence[int], report: ReportProgress
) -> tuple[Path, Score]:
    """Plays those of the episodes that the score does not have."""
    missing = [number for number in score.missing if number in numbers]
    started = time.perf_counter()
    words = f"{score.policy}, {score.where}"
    rounds = player.play(
        score.policy,
        missing,
        lambda step, steps: report(f"{words}: step {step} of {steps}", len(score.episodes), score.number),
    )
    for episodes, seconds in rounds:
        now = time.perf_counter()
        score = write_score(path, score.with_episodes(episodes, now - started, seconds))
        started = now
        report(words, len(score.episodes), score.number)
    return path, score
