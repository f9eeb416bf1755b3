"""Whether scores in simulation put policies in the order that they have on a twin: rank correlations, and a figure."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from robot.train.benchmark.compare import NotComparable
from robot.train.benchmark.score import Score
from robot.train.evaluate import Interval, wilson_interval
from tacsim.interface import FloatArray
from tacsim.models.task import Unit

MIN_POLICIES = 3  # fewer have hardly an order
DRAWS = 2000  # of the bootstrap


@dataclass(frozen=True, slots=True)
class Pair:
    """One policy in the same episodes of both splits."""

    policy: str
    episodes: int
    success: tuple[Interval, Interval]  # rate in simulation, and on the twin


@dataclass(frozen=True, slots=True)
class Correlation:
    """Of two orders of the same policies. None: all policies are equal on one side."""

    spearman: Interval | None  # rank correlation; interval of a bootstrap over episodes
    kendall: Interval | None  # tau-b
    # largest loss of the twin's measure by an exchange of two policies (MMRV): mean over the policies of the largest
    # difference on the twin to a policy that the simulation puts on the other side
    violation: float


@dataclass(frozen=True, slots=True)
class Ranking:
    """One task."""

    task: str
    unit: Unit  # in which distances are shown
    pairs: tuple[Pair, ...]
    by_success: Correlation
    by_distance: Correlation  # of the mean distance at the end of the episodes that began; it has no ties


def rank_policies(first: Sequence[Score], second: Sequence[Score]) -> list[Ranking]:
    """Compares the order of the policies of each task in two sets of scores, such as those of `test` and of
    `shift-all`, over the episodes that all have played.

    Raises NotComparable without a task that has three policies on both sides, and for two scores of one policy.
    """
    found = []
    for task in dict.fromkeys(score.task for score in first):
        here, there = _by_policy(first, task), _by_policy(second, task)
        policies = [key for key in here if key in there]
        if len(policies) >= MIN_POLICIES:
            found.append(_rank_task(task, [(here[key], there[key]) for key in policies]))
    if not found:
        raise NotComparable(
            f"no task has scores of {MIN_POLICIES} or more policies on both sides; play more: tacsim benchmark run "
            "TASK --split test --split shift-all --policy ..."
        )
    return found


def _by_policy(scores: Sequence[Score], task: str) -> dict[str, Score]:
    """By the hash of the policy; of two subsets the larger one counts."""
    found: dict[str, Score] = {}
    for score in sorted((each for each in scores if each.task == task), key=lambda each: len(each.episodes)):
        other = found.get(score.policy_sha256)
        if other is not None and other.where != score.where:
            raise NotComparable(f"'{score.policy}' has scores of {other.where} and {score.where}: choose one")
        found[score.policy_sha256] = score
    return found


def _rank_task(task: str, scores: Sequence[tuple[Score, Score]]) -> Ranking:
    sides = [[{each.episode: each for each in one.episodes} for one in pair] for pair in scores]
    common = sorted(set.intersection(*(set(side) for pair in sides for side in pair)))
    if len(common) < 2:
        raise NotComparable(f"the policies on '{task}' have {len(common)} common episodes; complete the runs")
    # (sides, policies, episodes)
    success = np.array([[[pair[side][n].success for n in common] for pair in sides] for side in (0, 1)], float)
    distance = np.array([[[_number(pair[side][n].distance) for n in common] for pair in sides] for side in (0, 1)])
    begun = ~np.isnan(distance).any(axis=(0, 1))
    if not begun.any():
        raise NotComparable(f"no common episode on '{task}' began; the scores say why")
    pairs = [
        Pair(one.policy, len(common), (_rate(success[0, index]), _rate(success[1, index])))
        for index, (one, _) in enumerate(scores)
    ]
    return Ranking(
        task=task,
        unit=scores[0][0].unit,
        pairs=tuple(sorted(pairs, key=lambda pair: -pair.success[0].value)),
        by_success=_correlate(success),
        by_distance=_correlate(-distance[:, :, begun]),
    )


def _number(distance: float | None) -> float:
    return np.nan if distance is None else distance


def _rate(reached: FloatArray) -> Interval:
    return wilson_interval(int(reached.sum()), len(reached))


def _correlate(values: FloatArray) -> Correlation:
    """values: (2, policies, episodes), larger is better."""
    episodes = values.shape[2]
    chosen = np.random.default_rng(0).integers(episodes, size=(DRAWS, episodes))
    drawn = np.mean(values[:, :, chosen], axis=3).transpose(2, 0, 1)  # (draws, 2, policies)
    means = np.mean(values, axis=2)
    return Correlation(
        spearman=_interval(spearman, means, drawn),
        kendall=_interval(kendall, means, drawn),
        violation=max_rank_violation(*means),
    )


def _interval(correlate: Callable[[FloatArray], FloatArray], means: FloatArray, drawn: FloatArray) -> Interval | None:
    """With the middle 95 % of the draws in which both sides have an order; None without an order."""
    if not _has_order(means):
        return None
    low, high = np.quantile(correlate(drawn[_has_order(drawn)]), [0.025, 0.975])
    return Interval(float(correlate(means)), float(low), float(high))


def _has_order(means: FloatArray) -> NDArray[np.bool_]:
    """(...,) whether on both sides (..., 2, policies) not all policies are equal."""
    unequal: NDArray[np.bool_] = (np.ptp(means, axis=-1) > 0.0).all(axis=-1)
    return unequal


def spearman(means: FloatArray) -> FloatArray:
    """(...,) rank correlation of two sides (..., 2, policies); equal ones have the mean of their ranks."""
    ranks = _signs(means).sum(axis=-1) / 2  # less the mean rank
    return _cosine(ranks)


def kendall(means: FloatArray) -> FloatArray:
    """(...,) Kendall's tau-b of two sides (..., 2, policies)."""
    signs = _signs(means)
    return _cosine(signs.reshape(*signs.shape[:-2], -1))


def _signs(means: FloatArray) -> FloatArray:
    """(..., 2, n, n) of the difference of each two policies."""
    return np.sign(means[..., :, None] - means[..., None, :])


def _cosine(vectors: FloatArray) -> FloatArray:
    """(...,) of the angle between two vectors (..., 2, n)."""
    one, two = vectors[..., 0, :], vectors[..., 1, :]
    cosine: FloatArray = (one * two).sum(axis=-1) / np.sqrt((one**2).sum(axis=-1) * (two**2).sum(axis=-1))
    return cosine


def max_rank_violation(simulated: FloatArray, real: FloatArray) -> float:
    """Mean maximum rank violation of Li et al. 2024 (SIMPLER, equation 2): for each policy the largest difference on
    the real side to a policy with which it changes places, and the mean over the policies. 0: the same order."""
    apart = np.abs(real[:, None] - real[None, :])
    exchanged = (simulated[:, None] < simulated[None, :]) != (real[:, None] < real[None, :])
    return float((apart * exchanged).max(axis=1).mean())


def draw_ranking(rankings: Sequence[Ranking], path: Path, names: tuple[str, str]) -> None:
    """Success in simulation against success on the twin: a panel for each task, a colour for each name of a policy.

    names: of both sides, for the axes.
    """
    from matplotlib import colormaps
    from matplotlib.figure import Figure

    columns = min(3, len(rankings))
    rows = -(-len(rankings) // columns)
    figure = Figure(figsize=(2.9 * columns + 1.8, 2.9 * rows + 0.4), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
    policies = list(dict.fromkeys(_short_name(pair.policy) for ranking in rankings for pair in ranking.pairs))
    colours = {policy: colormaps["tab20"](number % 20) for number, policy in enumerate(policies)}
    for panel in panels.flat[len(rankings) :]:
        panel.set_visible(False)
    for ranking, panel in zip(rankings, panels.flat, strict=False):
        panel.plot([0, 100], [0, 100], color="#bbbbbb", linewidth=1, zorder=0)
        rho = ranking.by_success.spearman
        panel.set_title(f"{ranking.task}: {'no order' if rho is None else f'ρ = {rho.value:.2f}'}", fontsize=10)
        places = [tuple(side.value for side in pair.success) for pair in ranking.pairs]
        for number, pair in enumerate(ranking.pairs):
            one, two = pair.success
            panel.errorbar(
                100 * one.value,
                100 * two.value,
                xerr=_error_lengths(one),
                yerr=_error_lengths(two),
                fmt="o",
                color=colours[_short_name(pair.policy)],
                markersize=7 + 4 * places[number + 1 :].count(places[number]),  # policies at the same place are rings
                elinewidth=0.6,
                alpha=0.9,
            )
        panel.set(xlim=(-5, 105), ylim=(-5, 105), box_aspect=1)
        panel.tick_params(labelbottom=True)
    figure.supxlabel(f"success, {names[0]} [%]", fontsize=10)
    figure.supylabel(f"success, {names[1]} [%]", fontsize=10)
    for policy, colour in colours.items():
        panels[0, 0].plot([], [], "o", color=colour, label=policy)
    figure.legend(loc="outside right upper", fontsize=8, frameon=False)
    figure.savefig(path, dpi=110)


def _short_name(policy: str) -> str:
    """As the table calls it: without folder and ending of a file."""
    return policy if ":" in policy else Path(policy).name.removesuffix(".onnx")


def _error_lengths(interval: Interval) -> list[list[float]]:
    return [[100 * (interval.value - interval.low)], [100 * (interval.high - interval.value)]]
