"""Comparisons of scores: two policies over the same episodes, normalised distances, and the table of all."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from robot.train.benchmark.score import EpisodeScore, Score
from robot.train.evaluate import Interval, bootstrap_interval
from tacsim.models.task import Unit

SAME = ("task", "split", "rig", "task_sha256", "split_sha256", "sensors_sha256")


class NotComparable(ValueError):
    """Two scores are not of the same episodes."""


@dataclass(frozen=True, slots=True)
class Comparison:
    """Two policies, `first` and `second`, in the episodes that both have played."""

    episodes: int
    both: int  # number of episodes in which both succeed
    first_alone: int
    second_alone: int
    neither: int
    p_value: float  # of McNemar's exact test: that chance alone makes the policies differ so much
    safe_first_alone: int
    safe_second_alone: int
    safe_p_value: float
    difference: Interval | None  # mean of distance of the first minus that of the second, same episode [SI]
    same_physics: bool


def compare_scores(first: Score, second: Score) -> Comparison:
    """Compares two scores episode by episode. Raises NotComparable for other tasks, splits, sensors, and without common
    episodes."""
    differing = [key for key in SAME if getattr(first, key) != getattr(second, key)]
    if differing:
        there = "; ".join(f"{key}: {getattr(first, key)[:24]} and {getattr(second, key)[:24]}" for key in differing)
        raise NotComparable(f"the scores are not of the same episodes: {there}")
    pairs = _pairs(first, second)
    if not pairs:
        raise NotComparable("the scores have no common episode; complete both runs")
    both, one, two, neither = _counts([(a.success, b.success) for a, b in pairs])
    _, safe_one, safe_two, _ = _counts([(a.safe, b.safe) for a, b in pairs])
    known = [a.distance - b.distance for a, b in pairs if a.distance is not None and b.distance is not None]
    return Comparison(
        episodes=len(pairs),
        both=both,
        first_alone=one,
        second_alone=two,
        neither=neither,
        p_value=mcnemar_exact(one, two),
        safe_first_alone=safe_one,
        safe_second_alone=safe_two,
        safe_p_value=mcnemar_exact(safe_one, safe_two),
        difference=bootstrap_interval(np.array(known)) if known else None,
        same_physics=first.physics.motion == second.physics.motion
        and first.machine.vector_width == second.machine.vector_width,
    )


def mcnemar_exact(first_alone: int, second_alone: int) -> float:
    """p-value of McNemar's exact test (two-sided): of the pairs with different results, as many or more on one side if
    both sides were equally likely. 1 without such pairs."""
    from scipy import stats

    total = first_alone + second_alone
    return float(stats.binomtest(first_alone, total, 0.5).pvalue) if total else 1.0


def _counts(results: Sequence[tuple[bool, bool]]) -> tuple[int, int, int, int]:
    """Both, the first alone, the second alone, neither."""
    both = sum(a and b for a, b in results)
    first, second = sum(a and not b for a, b in results), sum(b and not a for a, b in results)
    return both, first, second, len(results) - both - first - second


def _pairs(first: Score, second: Score) -> list[tuple[EpisodeScore, EpisodeScore]]:
    there = {each.episode: each for each in second.episodes}
    return [(each, there[each.episode]) for each in first.episodes if each.episode in there]


def normalised_distance(score: Score, random: Score, teacher: Score) -> float | None:
    """(mean distance of random - that of this policy) / (that of random - that of the teacher), over the episodes that
    all three have: 0 as good as random actions, 1 as good as the teacher. None without such episodes, or where the
    teacher is no better than random."""
    known = [{each.episode: each.distance for each in one.episodes} for one in (score, random, teacher)]
    common = [number for number in known[0] if all(distances.get(number) is not None for distances in known)]
    if not common:
        return None
    own, at_random, best = (float(np.mean([distances[number] or 0.0 for number in common])) for distances in known)
    return (at_random - own) / (at_random - best) if at_random > best else None


@dataclass(frozen=True, slots=True)
class Row:
    """One policy on one split in the table of results."""

    task: str
    split: str  # and the rig, if it is not the simulation
    policy: str
    episodes: int
    complete: bool
    success: Interval
    safe_success: Interval
    distance: Interval | None  # [SI]
    unit: Unit  # in which the distance is shown
    normalised: float | None
    peak_force: float  # mean over the episodes [N]
    steps: float  # mean number of steps until the goal was reached for good, of the successes; NaN without any
    outside: float | None  # share of episodes outside the training range; None: unknown
    wall_seconds: float  # of an episode
    failures: int  # episodes in which the policy raised, or that did not begin


def make_rows(scores: Sequence[Score]) -> list[Row]:
    """Rows of all scores, in the order of task, split and success. The baselines `random` and `teacher` of the same
    split normalise the distances."""
    rows = []
    for score in scores:
        if not score.episodes:
            continue
        references = _references(score, scores)
        normalised = None
        if references.keys() == {"random", "teacher"}:
            normalised = normalised_distance(score, references["random"], references["teacher"])
        rows.append(_make_row(score, normalised))
    return sorted(rows, key=lambda row: (row.task, _split_order(row.split), -row.success.value, row.policy))


def _split_order(split: str) -> tuple[bool, str]:
    return split != "test", split


def _references(score: Score, scores: Sequence[Score]) -> Mapping[str, Score]:
    same = [
        each
        for each in scores
        if each.policy in ("random", "teacher")
        and each.episodes
        and all(getattr(each, key) == getattr(score, key) for key in SAME)
    ]
    same.sort(key=lambda each: len(each.episodes))  # the one with more episodes replaces the other
    return {each.policy: each for each in same}


def _make_row(score: Score, normalised: float | None) -> Row:
    arrivals = [each.arrival for each in score.episodes if each.success and each.arrival is not None]
    known = [each.outside for each in score.episodes if each.outside is not None]
    return Row(
        task=score.task,
        split=score.where,
        policy=score.policy,
        episodes=len(score.episodes),
        complete=score.complete,
        success=score.success,
        safe_success=score.safe_success,
        distance=score.distance,
        unit=score.unit,
        normalised=normalised,
        peak_force=float(np.mean([each.peak_force for each in score.episodes])),
        steps=float(np.mean(arrivals)) if arrivals else float("nan"),
        outside=sum(known) / len(known) if known else None,
        wall_seconds=score.wall_seconds / len(score.episodes),
        failures=sum(each.end in ("error", "not begun") for each in score.episodes),
    )
