"""The sequential tests keep their error rates and need as many episodes as Wald's formula says: Bernoulli draws."""

from __future__ import annotations

import math

import numpy as np
import pytest

from robot.train.acceptance.sequential import Errors, PairedTest, RateTest

REPEATS = 2000
GOOD, BAD = 0.9, 0.7


def play_rate(rate: float, random: np.random.Generator, errors: Errors) -> RateTest:
    test = RateTest(GOOD, BAD, errors)
    while test.decision == "continue":
        test.add(bool(random.random() < rate))
    return test


@pytest.mark.parametrize("errors", [Errors(0.05, 0.05), Errors(0.1, 0.02)])
@pytest.mark.parametrize("rate", [GOOD, BAD])
def test_error_rates_and_mean_length_are_walds(rate: float, errors: Errors) -> None:
    """Each error rate is at most alpha / (1 - beta), or beta / (1 - alpha) (Wald 1945, section 3.3). The mean length is
    Wald's, plus at most one greatest step of the evidence over a bound."""
    random = np.random.default_rng(1)
    ended = [play_rate(rate, random, errors) for _ in range(REPEATS)]
    accepted = float(np.mean([test.decision == "accept" for test in ended]))
    wrong, allowed = (
        (1 - accepted, errors.beta / (1 - errors.alpha))
        if rate == GOOD
        else (accepted, errors.alpha / (1 - errors.beta))
    )
    deviation = math.sqrt(allowed * (1 - allowed) / REPEATS)
    assert wrong <= allowed + 3 * deviation
    assert wrong > 0.2 * allowed  # no end is far beyond its bound: episodes are not wasted
    mean = float(np.mean([test.count for test in ended]))
    expected = ended[0].expected_count(rate, accepted)
    overshoot = abs(math.log((1 - GOOD) / (1 - BAD)) / ended[0].mean_increment(rate))
    assert 0.97 * expected <= mean <= expected + overshoot
    # Wald's identity: the mean evidence at the end is the mean length times the mean of a step.
    evidence = float(np.mean([test.evidence for test in ended]))
    assert evidence == pytest.approx(mean * ended[0].mean_increment(rate), rel=0.05)


def test_clear_cases_end_after_few_episodes() -> None:
    always, never = RateTest(GOOD, BAD, Errors()), RateTest(GOOD, BAD, Errors())
    while always.decision == "continue":
        always.add(True)
    while never.decision == "continue":
        never.add(False)
    assert (always.decision, always.count) == ("accept", 12) and (never.decision, never.count) == ("reject", 3)


@pytest.mark.parametrize("discordant", [0.2, 0.3, 0.5])
@pytest.mark.parametrize("worse", [True, False])
def test_paired_test_keeps_its_error_rates(discordant: float, worse: bool) -> None:
    """Whatever the share of episodes in which the policies differ, which is unknown beforehand."""
    margin, errors = 0.2, Errors()
    difference = -margin if worse else 0.0
    won, lost = (discordant + difference) / 2, (discordant - difference) / 2
    random = np.random.default_rng(2)
    wrong = 0
    for _ in range(400):
        test = PairedTest(margin, errors)
        while test.decision == "continue" and test.count < 300:
            drawn = random.random()
            test.add(bool(drawn < won or drawn >= won + lost), bool(drawn >= won))
        wrong += test.decision == ("accept" if worse else "reject")
    assert wrong / 400 <= 0.05 + 3 * math.sqrt(0.05 * 0.95 / 400)


def test_ties_bound_the_difference() -> None:
    """Two policies that never differ: an accepted one after log(0.95 / 0.05) / -log(1 - margin) episodes."""
    test = PairedTest(0.2, Errors())
    while test.decision == "continue":
        test.add(True, True)
    assert test.decision == "accept" and test.count == math.ceil(math.log(19) / -math.log(0.8)) == 14


def test_likelihoods_are_the_greatest_under_their_hypotheses() -> None:
    """Against a search over all shares."""
    test = PairedTest(0.15, Errors())
    for own, other in [(True, False)] * 3 + [(False, True)] * 7 + [(True, True)] * 11:
        test.add(own, other)
    found = {}
    for difference in (0.0, 0.15):
        x = np.linspace(1e-6, (1 - difference) / 2 - 1e-6, 200_001)
        values = 3 * np.log(x) + 7 * np.log(x + difference) + 11 * np.log(1 - 2 * x - difference)
        found[difference] = float(values.max())
    assert test.evidence == pytest.approx(found[0.0] - found[0.15], abs=1e-6)


@pytest.mark.parametrize("alpha", [0.0, 0.5, -1.0, math.nan, math.inf])
def test_no_probability_is_refused(alpha: float) -> None:
    with pytest.raises(ValueError, match="alpha is a probability between"):
        Errors(alpha, 0.05)


@pytest.mark.parametrize(("good", "bad"), [(1.0, 0.8), (0.9, 0.9), (0.9, 0.0), (0.7, 0.9), (math.nan, 0.5)])
def test_rates_that_cannot_be_told_apart_are_refused(good: float, bad: float) -> None:
    with pytest.raises(ValueError, match="0 < bad < good < 1"):
        RateTest(good, bad, Errors())
