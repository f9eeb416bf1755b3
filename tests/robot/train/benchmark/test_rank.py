"""The order of policies in simulation against that on a twin: correlations by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from robot.train.benchmark.compare import NotComparable
from robot.train.benchmark.rank import kendall, max_rank_violation, rank_policies, spearman
from robot.train.benchmark.score import Score, write_score
from tests.robot.cli.invoked import tacsim
from tests.robot.train.benchmark.test_compare import episode, score

EPISODES = 10


def played(policy: str, split: str, successes: int, distance: float, **changed: object) -> Score:
    """The first `successes` of ten episodes succeed; all end at this distance [m]."""
    episodes = [episode(number, number < successes, distance) for number in range(EPISODES)]
    return score(policy, *episodes, split=split, policy_sha256=policy, **changed)


def scores(split: str, **successes: int) -> list[Score]:
    return [played(name, split, count, 1e-3 * (EPISODES - count)) for name, count in successes.items()]


def test_correlations_by_hand() -> None:
    """Ranks 1 2 3 4 against 1 3 2 4: Spearman 1 - 6 * 2 / (4 * 15) = 0.8, Kendall (5 - 1) / 6; the exchanged pair
    differs by 20 % on the twin, so its two policies have a violation of 0.2, the others of 0."""
    (found,) = rank_policies(scores("test", a=0, b=3, c=6, d=10), scores("shift-all", a=1, b=6, c=4, d=9))
    assert [pair.policy for pair in found.pairs] == ["d", "c", "b", "a"]
    assert found.pairs[1].success[0].value == 0.6 and found.pairs[1].success[1].value == 0.4
    for order, scale in ((found.by_success, 1.0), (found.by_distance, 10e-3)):
        assert order.spearman is not None and order.kendall is not None
        assert order.spearman.value == pytest.approx(0.8)
        assert order.kendall.value == pytest.approx(4 / 6)
        assert order.violation == pytest.approx((0.2 + 0.2) / 4 * scale)
    assert found.by_success.spearman is not None
    assert found.by_success.spearman.low < 0.8 <= found.by_success.spearman.high <= 1.0


def test_ties_count_by_mean_ranks() -> None:
    """Ranks 1.5 1.5 3 against 1 2 3: Pearson's correlation of these ranks, 1.5 / sqrt(1.5 * 2)."""
    (found,) = rank_policies(scores("test", a=2, b=2, c=9), scores("shift-all", a=1, b=5, c=9))
    assert found.by_success.spearman is not None
    assert found.by_success.spearman.value == pytest.approx(1.5 / np.sqrt(1.5 * 2.0))


def test_correlations_are_those_of_scipy() -> None:
    means = np.random.default_rng(0).integers(5, size=(20, 2, 7)) / 4.0
    for own, other in ((spearman, stats.spearmanr), (kendall, stats.kendalltau)):
        expected = [other(*each).statistic for each in means]
        np.testing.assert_allclose(own(means), expected, atol=1e-12)


def test_without_order_there_is_no_correlation() -> None:
    (found,) = rank_policies(scores("test", a=5, b=5, c=5), scores("shift-all", a=1, b=5, c=9))
    assert found.by_success.spearman is None and found.by_success.kendall is None


def test_only_common_episodes_count() -> None:
    """A policy that has played two episodes alone: of all others these two count."""
    first = scores("test", a=1, b=3, c=10)
    short = first[0].model_copy(update={"episodes": first[0].episodes[:2]})
    (found,) = rank_policies([short, *first[1:]], scores("shift-all", a=0, b=3, c=10))
    assert {pair.episodes for pair in found.pairs} == {2}
    assert found.pairs[-1].success[0].value == 0.5


@pytest.mark.filterwarnings("error")
def test_distances_of_episodes_that_did_not_begin_do_not_count() -> None:
    """They are failures: by success they count."""

    def some_not_begun(each: Score, number: int) -> Score:
        missing = [one.model_copy(update={"distance": None, "success": False}) for one in each.episodes[:number]]
        return each.model_copy(update={"episodes": (*missing, *each.episodes[number:3])})

    first, second = scores("test", a=1, b=2, c=3), scores("shift-all", a=1, b=2, c=3)
    (found,) = rank_policies(first, [some_not_begun(each, 2) for each in second])
    assert {pair.episodes for pair in found.pairs} == {3}
    assert [pair.success[1].value for pair in found.pairs] == pytest.approx([1 / 3, 0.0, 0.0])
    assert found.by_distance.spearman is not None and found.by_distance.spearman.low == pytest.approx(1.0)
    with pytest.raises(NotComparable, match="no common episode on 'small' began"):
        rank_policies(first, [some_not_begun(each, 3) for each in second])


def test_violation_is_the_largest_of_each_policy() -> None:
    simulated, real = np.array([0.1, 0.2, 0.3]), np.array([0.9, 0.4, 0.0])  # the order is turned round
    assert max_rank_violation(simulated, real) == pytest.approx((0.9 + 0.5 + 0.9) / 3)
    assert max_rank_violation(real, real) == 0.0


def test_too_few_policies_are_refused() -> None:
    with pytest.raises(NotComparable, match="3 or more policies"):
        rank_policies(scores("test", a=1, b=3, c=5), scores("shift-all", a=1, b=3))
    mixed = [*scores("test", a=1, b=3, c=5), *scores("shift-gel", a=1)]
    with pytest.raises(NotComparable, match="test and shift-gel: choose one"):
        rank_policies(mixed, scores("shift-all", a=1, b=3, c=5))


@pytest.mark.slow  # matplotlib
def test_command_prints_and_draws(tmp_path: Path) -> None:
    folder = tmp_path / "scores"
    for each in (*scores("test", a=0, b=3, c=6, d=10), *scores("shift-all", a=1, b=6, c=4, d=9)):
        write_score(folder / each.split / f"{each.policy}.json", each)
    picture = tmp_path / "ranking.png"
    result = tacsim("benchmark", "rank", folder, "--out", picture)
    assert result.exit_code == 0, result.stderr
    assert "0.80 (" in result.stdout and "60 (31 to 83)" in result.stdout
    assert picture.read_bytes()[:4] == b"\x89PNG"
    result = tacsim("benchmark", "rank", folder, "--other-split", "shift-gel")
    assert result.exit_code == 2 and "3 or more policies" in result.stderr
