"""Play the frozen episodes of a split: in simulation, or on the mock rig over the real wire."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Self

from robot.train.benchmark.episodes import Split
from robot.train.benchmark.play import SplitPlayer
from robot.train.benchmark.score import EpisodeScore, RigName
from robot.train.benchmark.wire import WirePlayer

TOGETHER = 4  # simulated episodes that move together; results do not depend on it


@dataclass(frozen=True, slots=True)
class PlayedEpisode:
    """One episode of one policy."""

    number: int
    success: bool
    reason: str = ""  # of an end before the last step
    has_broken_contract: bool = False  # the policy raised, or gave an action that is none
    has_begun: bool = True  # False: the reset failed, which says nothing of the policy
    outside: bool | None = None  # a learned policy left the range of its training; None: unknown
    distance: float | None = None  # from the goal at the end [SI]

    @staticmethod
    def of(score: EpisodeScore) -> PlayedEpisode:
        """What an acceptance needs of the score of an episode."""
        return PlayedEpisode(
            score.episode,
            score.success,
            score.reason,
            has_broken_contract=score.end == "error",
            has_begun=score.end != "not begun",
            outside=score.outside,
            distance=score.distance,
        )


class EpisodePlayer:
    """Plays episodes of one split on a rig. A context manager."""

    def __init__(self, split: Split, numbers: Sequence[int], rig: RigName) -> None:
        self._player = SplitPlayer(split, numbers, TOGETHER) if rig == "sim" else WirePlayer(split, numbers)

    def __enter__(self) -> Self:
        self._player.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._player.__exit__(kind, error, trace)

    def examine(self, policy: str) -> list[str]:
        """Notes on the episodes and the training of a policy. Raises IncompatibleRig and PolicyNotFound for one that
        does not fit the rig."""
        notes: list[str] = []
        self._player.require_policy(policy, notes.append)
        return notes

    def play_episodes(self, policy: str, numbers: Sequence[int]) -> Iterator[PlayedEpisode]:
        """Plays these episodes, in order. Raises RigFailed."""
        for scores, _ in self._player.play(policy, numbers):
            yield from map(PlayedEpisode.of, scores)
