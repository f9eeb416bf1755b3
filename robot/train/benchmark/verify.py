"""Verifies a score: plays a sample of its episodes again and compares the bits."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from robot.train.benchmark.episodes import load_split
from robot.train.benchmark.fingerprint import describe_differences
from robot.train.benchmark.play import SplitPlayer
from robot.train.benchmark.run import new_score
from robot.train.benchmark.score import EpisodeScore, NotAScore, Score, read_score

# agrees: the bits of all episodes that were played again are equal. differs: they are not, with the same program on a
# machine with the same vector width. unverifiable: they are not, and something named in `differences` explains it.
Verdict = Literal["agrees", "differs", "unverifiable"]
DIGITS = 1e-9  # an edited number of an episode differs by more [m, N]


@dataclass(frozen=True, slots=True)
class EpisodeCheck:
    """One episode that was played again."""

    episode: int
    same_actions: bool  # bits of the actions
    same_states: bool  # bits of what followed
    same_numbers: bool  # success, distance, force ... as the score says
    recorded: EpisodeScore
    found: EpisodeScore

    @property
    def is_equal(self) -> bool:
        return self.same_actions and self.same_states and self.same_numbers


@dataclass(frozen=True, slots=True)
class Verification:
    """Result of a verification."""

    score: Score
    verdict: Verdict
    differences: tuple[str, ...]  # between where the score was computed and here
    checks: tuple[EpisodeCheck, ...]


class WrongSubject(ValueError):
    """A score belongs to another policy file, task, split or sensors than those that are here."""


def verify_score(
    path: Path,
    sample: int | None,
    policy: str | None = None,
    task: str | None = None,
    report_progress: Callable[[str, int, int], None] = lambda words, done, of: None,
) -> Verification:
    """Plays `sample` episodes of a score again (None: all).

    policy: where the policy is here, if not at the place in the score. task: the path of the task file, if the task is
    not a shipped one.
    Raises NotAScore, ScoreEdited, WrongSubject, and the errors of a run.
    """
    score = read_score(path)
    if not score.episodes:
        raise NotAScore(f"{path}: has no episodes yet; run the benchmark again, and it continues")
    if score.rig != "sim":
        raise NotAScore(
            f"{path}: of the rig '{score.rig}', where no two runs have the same bits; play it again into another "
            f"folder: tacsim benchmark run {score.task} --rig {score.rig}"
        )
    split = load_split(task or score.task, score.split)
    here = new_score(split, policy or score.policy, score.subset)
    _require_subject(path, score, here)
    differences = describe_differences((score.physics, score.machine), (here.physics, here.machine))
    recorded = {each.episode: each for each in score.episodes}
    numbers = choose_sample(score, sample)
    checks = []
    with SplitPlayer(split, numbers, min(len(numbers), 8)) as player:
        player.require_policy(here.policy, lambda words: None)
        for episodes, _ in player.play(here.policy, numbers):
            checks += [_check(recorded[each.episode], each) for each in episodes]
            report_progress("playing again", len(checks), len(numbers))
    same_bits = all(each.same_actions and each.same_states for each in checks)
    edited = any(each.same_states and not each.same_numbers for each in checks)
    is_equal = all(each.is_equal for each in checks)
    verdict: Verdict = "agrees" if is_equal else "differs" if edited or same_bits or not differences else "unverifiable"
    return Verification(score, verdict, tuple(differences), tuple(checks))


def choose_sample(score: Score, sample: int | None) -> list[int]:
    """Numbers of the episodes to play again; they follow from the seal of the score."""
    played = [each.episode for each in score.episodes if each.end != "not begun"] or [0]
    if sample is None or sample >= len(played):
        return played
    return sorted(random.Random(score.seal).sample(played, sample))


def _require_subject(path: Path, score: Score, here: Score) -> None:
    """Raises WrongSubject, with what differs and what to do."""
    advice = {
        "policy_sha256": f"policy '{here.policy}' is another file; name that of the score: --policy FILE",
        "task_sha256": f"task '{here.task}' is simulated or judged otherwise here; take the version in the score",
        "split_sha256": f"the episodes of '{here.task}', {here.split}, are others here; restore the episode file",
        "sensors_sha256": f"the sensors of '{here.task}' are others here; take the version in the score",
    }
    found = [
        f"{words} ({getattr(score, key)[:12]} in the score, {getattr(here, key)[:12]} here)"
        for key, words in advice.items()
        if getattr(score, key) != getattr(here, key)
    ]
    if found:
        raise WrongSubject(f"{path}: {'; '.join(found)}")


def _check(recorded: EpisodeScore, found: EpisodeScore) -> EpisodeCheck:
    numbers = ("distance", "start", "peak_force")
    words = ("success", "safe", "broken", "steps", "arrival", "end")
    close = all(_is_close(getattr(recorded, key), getattr(found, key)) for key in numbers)
    return EpisodeCheck(
        episode=found.episode,
        same_actions=recorded.actions == found.actions,
        same_states=recorded.states == found.states,
        same_numbers=close and all(getattr(recorded, key) == getattr(found, key) for key in words),
        recorded=recorded,
        found=found,
    )


def _is_close(one: float | None, other: float | None) -> bool:
    if one is None or other is None:
        return one is other
    return abs(one - other) <= DIGITS
