"""Accepts or rejects a policy, and says what a failure is of: the contract, the physics, or the policy."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Literal

from robot.deploy.policy import require_policy_name
from robot.deploy.python_policy import PolicyNotFound
from robot.train.acceptance.players import TOGETHER, EpisodePlayer, PlayedEpisode
from robot.train.acceptance.sequential import Errors, PairedTest, RateTest
from robot.train.benchmark.episodes import Split, load_split
from robot.train.benchmark.policies import BASELINES
from robot.train.benchmark.score import RigName
from robot.train.benchmark.wire import require_mock
from tacsim.interface import IncompatibleRig
from tacsim.models.benchmark import TEST_SPLIT

Verdict = Literal["accepted", "rejected", "undecided"]
# What a failure is of. contract: the policy does not fit the rig, raises, or gives no action. physics: most missed
# episodes left the range of its training. policy: it misses within that range.
Cause = Literal["", "contract", "physics", "policy"]
ReportEpisode = Callable[[PlayedEpisode, float], None]  # and the evidence after it


class BadRequest(ValueError):
    """The acceptance cannot begin: an option, a name, a file. Nothing is said of the policy."""


@dataclass(frozen=True, slots=True)
class Acceptance:
    """Requirements on a policy, and the episodes of its test."""

    policy: str
    task: str  # of the benchmark: a name or the path of a task file
    against: str | None = None  # the earlier policy; None: a rate of success is asked
    rig: RigName = "sim"
    split: str = TEST_SPLIT
    success: float = 0.9  # rate that a good policy has
    indifference: float = 0.2  # a policy that is worse by this is too bad
    errors: Errors = field(default_factory=Errors)
    max_episodes: int = 100

    def make_test(self) -> RateTest | PairedTest:
        """The test, before its first episode. Raises BadRequest."""
        try:
            if self.against is not None:
                return PairedTest(self.indifference, self.errors)
            return RateTest(self.success, self.success - self.indifference, self.errors)
        except ValueError as failure:
            raise BadRequest(f"--success and --indifference: {failure}") from None


@dataclass(frozen=True, slots=True)
class Report:
    """The result."""

    request: Acceptance
    verdict: Verdict
    cause: Cause
    test: RateTest | PairedTest
    played: tuple[PlayedEpisode, ...] = ()  # of the policy
    earlier: tuple[PlayedEpisode, ...] = ()  # of the earlier policy, the same episodes
    notes: tuple[str, ...] = ()  # on the scenes and the training
    contract_error: str = ""  # of the contract

    @property
    def counted(self) -> list[PlayedEpisode]:
        """Episodes of the policy that began."""
        return [each for each in self.played if each.has_begun and not each.has_broken_contract]

    @property
    def misses(self) -> list[PlayedEpisode]:
        """Of these, the ones that count against it: missed, and where there is an earlier policy, reached by that."""
        reached = {each.number for each in self.earlier if each.success}
        missed = [each for each in self.counted if not each.success]
        return missed if self.request.against is None else [each for each in missed if each.number in reached]


def accept_policy(request: Acceptance, report_episode: ReportEpisode = lambda episode, evidence: None) -> Report:
    """Plays the frozen episodes of a split in their order, until they decide or `max_episodes` are played.

    Raises BadRequest; RigFailed if the mock rig fails; ConfigError, SplitChanged.
    """
    test = request.make_test()
    split = load_checked_split(request)
    numbers = range(request.max_episodes)
    played: list[PlayedEpisode] = []
    earlier: list[PlayedEpisode] = []

    def result(verdict: Verdict, cause: Cause, contract_error: str = "") -> Report:
        return Report(request, verdict, cause, test, tuple(played), tuple(earlier), tuple(notes), contract_error)

    notes: list[str] = []
    with EpisodePlayer(split, numbers, request.rig) as player:
        try:
            notes += player.examine(request.policy)
        except (IncompatibleRig, PolicyNotFound) as unfit:
            return result("rejected", "contract", str(unfit))
        if request.against is not None:
            _require_earlier(player, request.against)
        for own, other in _play_pairs(player, request, numbers):
            played.append(own)
            if own.has_broken_contract:
                return result("rejected", "contract", f"episode {own.number}: {own.reason}")
            if other is not None:
                earlier.append(other)
                if other.has_broken_contract:
                    raise BadRequest(f"--against: episode {other.number}: {other.reason}; name a policy that works")
            if own.has_begun:
                if isinstance(test, RateTest):
                    test.add(own.success)
                else:
                    test.add(own.success, other is not None and other.success)
            report_episode(own, test.evidence)
            if test.decision == "accept":
                return result("accepted", "")
            if test.decision == "reject":
                return result("rejected", find_cause(result("rejected", "policy").misses))
    return result("undecided", find_cause(result("undecided", "policy").misses))


def find_cause(misses: list[PlayedEpisode]) -> Cause:
    """Of the missed episodes: physics if most of them left the range of the training, else policy."""
    outside = sum(bool(each.outside) for each in misses)
    return "physics" if 2 * outside > len(misses) else "policy"


def _play_pairs(
    player: EpisodePlayer, request: Acceptance, numbers: range
) -> Iterator[tuple[PlayedEpisode, PlayedEpisode | None]]:
    """Each episode of the policy, with the same one of the earlier policy."""
    together = TOGETHER if request.rig == "sim" else 1
    for first in range(0, len(numbers), together):
        chosen = numbers[first : first + together]
        own = list(player.play_episodes(request.policy, chosen))
        if request.against is None:
            yield from ((each, None) for each in own)
        else:
            yield from zip(own, player.play_episodes(request.against, chosen), strict=True)


def load_checked_split(request: Acceptance) -> Split:
    """The split, after the names of policies, task and split and the numbers are checked. Raises BadRequest."""
    request.make_test()
    for option, name in (("--policy", request.policy), ("--against", request.against)):
        if name is not None:
            try:
                require_policy_name(name, BASELINES)
            except PolicyNotFound as failure:
                raise BadRequest(f"{option}: {failure}") from None
    try:
        split = load_split(request.task, request.split)
        if request.rig == "mock":
            require_mock(split)
    except (ValueError, OSError) as failure:
        raise BadRequest(f"--task, --split: {failure}") from None
    if not 1 <= request.max_episodes <= len(split.episodes):
        raise BadRequest(
            f"--max-episodes: the split '{split.name}' of '{split.task_name}' has {len(split.episodes)} episodes; give "
            "1 to that number"
        )
    return split


def _require_earlier(player: EpisodePlayer, name: str) -> None:
    try:
        player.examine(name)
    except (IncompatibleRig, PolicyNotFound) as unfit:
        raise BadRequest(f"--against: {unfit}; name a policy that fits this task") from None
