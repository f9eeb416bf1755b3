"""Play the frozen episodes of a split: in simulation, or on the mock rig over the real wire."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Protocol, Self

from robot.common import loopback_host
from robot.deploy.control_loop import EpisodeFailed, EpisodeSetup, run_episode
from robot.deploy.policy import describe_outside, has_training_range, load_policy, require_fit, training_notes
from robot.open import load_with_task, open_rig, rig_spec
from robot.train.benchmark.episodes import Split
from robot.train.benchmark.play import SplitPlayer
from tacsim.config import LoadedRig
from tacsim.control import NoTouch
from tacsim.interface import Policy
from tacsim.limits import LimitExceeded
from tacsim.tasks import GoalOutOfReach, make_task

TOGETHER = 4  # simulated episodes that move together; results do not depend on it
MOCK_RIG = "mock"


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


class RigFailed(RuntimeError):
    """The rig ended an episode, by no fault of the policy."""


class Player(Protocol):
    """Plays episodes of one split. A context manager."""

    def __enter__(self) -> Self: ...
    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...

    def examine(self, policy: str) -> list[str]:
        """Notes on the episodes and the training of a policy. Raises IncompatibleRig and PolicyNotFound for one that
        does not fit the rig."""
        ...

    def play_episodes(self, policy: str, numbers: Sequence[int]) -> Iterator[PlayedEpisode]:
        """Plays these episodes, in order. Raises RigFailed."""
        ...


class SimulatedPlayer(SplitPlayer):
    """In simulation, as `tacsim benchmark run`."""

    def __init__(self, split: Split, numbers: Sequence[int]) -> None:
        super().__init__(split, numbers, TOGETHER)

    def examine(self, policy: str) -> list[str]:
        notes: list[str] = []
        self.require_policy(policy, notes.append)
        return notes

    def play_episodes(self, policy: str, numbers: Sequence[int]) -> Iterator[PlayedEpisode]:
        for scores, _ in self.play(policy, numbers):
            for each in scores:
                yield PlayedEpisode(
                    each.episode,
                    each.success,
                    each.reason,
                    has_broken_contract=each.end == "error",
                    has_begun=each.end != "not begun",
                    outside=each.outside,
                    distance=each.distance,
                )


class MockPlayer:
    """On mock arms and cameras over loopback, one episode after the other; each has its own rig, since each has another
    body. The values of an episode that are errors of the arms or delays of the sensors are those of the mocks.

    split: of a task on the rig `sim`.
    """

    def __init__(self, split: Split, numbers: Sequence[int]) -> None:
        self._split, self._numbers = split, numbers

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        return

    def examine(self, policy: str) -> list[str]:
        loaded = [self._load(number) for number in self._numbers]
        config = loaded[0].config
        assert config.task is not None
        task, spec = make_task(config.task), rig_spec(config)
        found = load_policy(policy, task, spec, config.canonical)
        require_fit(config.name, spec, found, policy, task)
        scenes = [each.config.scene for each in loaded if each.config.scene is not None]
        return training_notes(found, policy, scenes)

    def play_episodes(self, policy: str, numbers: Sequence[int]) -> Iterator[PlayedEpisode]:
        for number in numbers:
            yield self._play_episode(policy, number)

    def _load(self, number: int) -> LoadedRig:
        words = [_word_of_mock(word) for word in [*self._split.overrides, *self._split.episode_overrides(number)]]
        return load_with_task(MOCK_RIG, self._split.task.task, [*filter(None, words), *_addresses(), *_pictures(words)])

    def _play_episode(self, name: str, number: int) -> PlayedEpisode:
        loaded = self._load(number)
        config = loaded.config
        assert config.task is not None
        task = make_task(config.task)
        with open_rig(loaded) as rig:
            policy = load_policy(name, task, rig.spec, config.canonical)
            try:
                _set_policy_goal(policy, task.goal)
                setup = EpisodeSetup(name, self._split.episode_seed(number), canonical=config.canonical)
                episode = run_episode(rig, policy, task, task.config.steps, setup=setup)
            except _PolicyFailed as failure:
                return PlayedEpisode(number, success=False, reason=str(failure), has_broken_contract=True)
            except (GoalOutOfReach, NoTouch) as failure:
                return PlayedEpisode(number, success=False, reason=str(failure), has_begun=False)
            except EpisodeFailed as failure:
                if not failure.by_policy and not isinstance(failure.__cause__, LimitExceeded):
                    raise RigFailed(f"episode {number} on rig '{rig.name}': {failure}") from failure
                return PlayedEpisode(
                    number,
                    success=False,
                    reason=str(failure),
                    has_broken_contract=failure.by_policy,
                    outside=_is_outside(policy),
                )
        if len(episode.steps) <= task.config.steps:
            raise KeyboardInterrupt  # with which a run ends as if complete
        distance = episode.steps[-1].distance
        peak = max(abs(float(arm.wrench[2])) for step in episode.steps for arm in step.arms.values())
        limit = math.inf if task.config.force_limit is None else task.config.force_limit
        reason = f"a normal force of {peak:.2f} N, beyond the limit of {limit:g} N" if peak > limit else ""
        success = distance is not None and distance <= task.config.success and not reason
        return PlayedEpisode(number, success, reason, outside=_is_outside(policy), distance=distance)


class _PolicyFailed(RuntimeError):
    """A policy raised before the episode."""


def _set_policy_goal(policy: Policy, goal: float | tuple[float, ...]) -> None:
    """As the benchmark does, before the reset of the policy."""
    if not hasattr(policy, "set_goal"):
        return
    try:
        policy.set_goal(goal)
    except (Exception, SystemExit) as failure:  # a policy may end Python
        raise _PolicyFailed(f"policy: {type(failure).__name__} in set_goal: {failure}") from failure


def _is_outside(policy: Policy) -> bool | None:
    return bool(describe_outside(policy)) if has_training_range(policy) else None


def _word_of_mock(word: str) -> str:
    """An override of the simulated rig as one of the mock rig; "" for one that hardware does not have."""
    key, _, value = word.partition("=")
    parts = key.split(".")
    if parts[0] == "motion":
        return ""
    if (parts[0], *parts[2:3]) in (("arms", "error"), ("sensors", "delay")):
        parts.insert(2, "mock")
    return f"{'.'.join(parts)}={value}"


def _pictures(words: Sequence[str]) -> list[str]:
    """A camera's pictures are as large as those of the sensor's model."""
    found = []
    for word in words:
        key, _, value = word.partition("=")
        parts = key.split(".")
        if parts[0] == "sensors" and parts[2:4] == ["model", "geometry"] and parts[-1] in ("width", "height"):
            found.append(f"sensors.{parts[1]}.{parts[-1]}={value}")
    return found


def _addresses() -> list[str]:
    """Loopback addresses of this process, so that several sessions may run at once."""
    room = 45  # second number of the addresses
    return [
        word
        for number, name in enumerate(("lower", "upper"), start=1)
        for host in [loopback_host(number, room)]
        for word in (f"arms.{name}.host={host}", f"sensors.{name}.source=http://{host}:8081/?action=stream")
    ]
