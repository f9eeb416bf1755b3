"""Sequential tests: after each episode they say whether to accept, to reject, or to play another one.

Both compare the logarithm of a likelihood ratio with the bounds of Wald 1945 ("Sequential tests of statistical
hypotheses", equation 3.21): log((1 - beta) / alpha) accepts, log(beta / (1 - alpha)) rejects.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Literal

Decision = Literal["accept", "reject", "continue"]


@dataclass(frozen=True, slots=True)
class Errors:
    """Probabilities of a wrong end: `alpha` of accepting a policy that is too bad, `beta` of rejecting a good one."""

    alpha: float = 0.05
    beta: float = 0.05

    def __post_init__(self) -> None:
        for name, value in (("alpha", self.alpha), ("beta", self.beta)):
            if not 0.0 < value < 0.5:
                raise ValueError(f"{name} is a probability between 0 and 0.5, got {value:g}")

    @property
    def upper(self) -> float:
        """Bound that accepts."""
        return math.log((1.0 - self.beta) / self.alpha)

    @property
    def lower(self) -> float:
        """Bound that rejects."""
        return math.log(self.beta / (1.0 - self.alpha))


class SequentialTest(ABC):
    """A test in progress."""

    def __init__(self, errors: Errors) -> None:
        self.errors, self.count = errors, 0

    @property
    @abstractmethod
    def evidence(self) -> float:
        """Logarithm of the likelihood ratio, good over bad, of all episodes so far."""

    @property
    def decision(self) -> Decision:
        return (
            "accept"
            if self.evidence >= self.errors.upper
            else "reject"
            if self.evidence <= self.errors.lower
            else "continue"
        )


class RateTest(SequentialTest):
    """Wald's test of a rate of success: `good` or more against `bad` or less; between them either answer is right."""

    def __init__(self, good: float, bad: float, errors: Errors) -> None:
        super().__init__(errors)
        if not 0.0 < bad < good < 1.0:
            raise ValueError(f"rates must be 0 < bad < good < 1, got bad {bad:g} and good {good:g}")
        self._success = math.log(good / bad)
        self._miss = math.log((1.0 - good) / (1.0 - bad))
        self.successes = 0

    def add(self, success: bool) -> None:
        """The result of the next episode."""
        self.count, self.successes = self.count + 1, self.successes + success

    @property
    def evidence(self) -> float:
        return self.successes * self._success + (self.count - self.successes) * self._miss

    def mean_increment(self, rate: float) -> float:
        """Mean change of the evidence by one episode of a policy with this rate of success."""
        return rate * self._success + (1.0 - rate) * self._miss

    def expected_count(self, rate: float, accepted: float) -> float:
        """Mean number of episodes at a rate of success, if a share `accepted` of the tests accepts (Wald 1945, equation
        4.8): without the overshoot over the bounds, so a little too small. Infinite where episodes tell nothing."""
        mean = self.mean_increment(rate)
        ends = accepted * self.errors.upper + (1.0 - accepted) * self.errors.lower
        return ends / mean if mean != 0.0 else math.inf


class PairedTest(SequentialTest):
    """Whether a policy is as good as an earlier one in the same episodes, or its rate of success is lower by `margin`.

    Pairs in which one policy alone succeeds are those of McNemar's test; ties count too, since they bound the
    difference. A generalised sequential probability ratio test (Li, Liu & Ying 2014): in place of the unknown share of
    ties each hypothesis has its most likely one, which Tango 1998 gives for a fixed difference of matched pairs.
    """

    def __init__(self, margin: float, errors: Errors) -> None:
        super().__init__(errors)
        if not 0.0 < margin < 1.0:
            raise ValueError(f"the margin is a difference of rates between 0 and 1, got {margin:g}")
        self._margin = margin
        self.won = self.lost = 0  # episodes in which the new policy, or the earlier one, alone succeeds

    def add(self, success: bool, earlier: bool) -> None:
        """The results of both policies in the next episode."""
        self.count += 1
        self.won += success and not earlier
        self.lost += earlier and not success

    @property
    def evidence(self) -> float:
        return self._log_likelihood(0.0) - self._log_likelihood(self._margin)

    def _log_likelihood(self, lower_by: float) -> float:
        """Greatest logarithm of the likelihood if the rate of the new policy is lower by `lower_by`."""
        if self.count == 0:
            return 0.0
        won, lost, tied = self.won, self.lost, self.count - self.won - self.lost
        # The share x of episodes won maximises won log x + lost log(x + d) + tied log(1 - 2x - d): its derivative is
        # a quadratic over positive denominators, with one root in the range.
        d = lower_by
        a, b, c = -2.0 * self.count, won * (1 - 3 * d) - 2 * tied * d + lost * (1 - d), won * (1 - d) * d
        root = (-b - math.sqrt(max(b * b - 4 * a * c, 0.0))) / (2 * a)
        x = min(max(root, 0.0), (1.0 - d) / 2)
        shares = ((won, x), (lost, x + d), (tied, 1.0 - 2 * x - d))
        return sum(number * math.log(share) if share > 0 else -math.inf for number, share in shares if number)
