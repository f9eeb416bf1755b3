"""Plays episodes of a split on the mock rig, over the real wire, and scores them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from types import TracebackType
from typing import Self

from robot.common import loopback_host
from robot.deploy.control_loop import EpisodeFailed, EpisodeSetup, run_episode
from robot.deploy.policy import describe_outside, has_training_range, load_policy, require_fit, training_notes
from robot.open import load_with_task, open_rig, rig_spec
from robot.train.benchmark.baselines import load_baseline, require_baseline
from robot.train.benchmark.episodes import Split
from robot.train.benchmark.integrity import is_broken
from robot.train.benchmark.play import ReportSteps, Warn, score_not_begun
from robot.train.benchmark.policies import BASELINES, SCRIPTED
from robot.train.benchmark.score import End, EpisodeScore
from tacsim.config import LoadedRig
from tacsim.control import NoTouch
from tacsim.geometry.shapes import enclosed_volume
from tacsim.limits import LimitExceeded
from tacsim.models.sensor import CanonicalGrid
from tacsim.record.episode import Step
from tacsim.rig import Rig
from tacsim.tasks import GoalOutOfReach, Task, make_task

MOCK_RIG = "mock"
ARMS = ("lower", "upper")  # of the mock rig


class RigFailed(RuntimeError):
    """The rig ended an episode, by no fault of the policy."""


def require_mock(split: Split) -> None:
    """Raises ValueError for a task that has no mock."""
    if split.task.rig != "sim":
        raise ValueError(
            f"task '{split.task_name}' is of rig '{split.task.rig}', which has no mock; use --rig sim, the default"
        )


class WirePlayer:
    """Mock arms and cameras over loopback, one episode after the other. Each has its own rig, since each has another
    body; policies that play the same episode one after the other use the same. The values of an episode that are errors
    or mounts of the arms, or delays of the sensors, are those of the mocks. Times are those of the wire, so two runs do
    not have the same bits.

    numbers: of the episodes that may be played.
    Raises ValueError for a task that is not of the rig `sim`.
    """

    def __init__(self, split: Split, numbers: Sequence[int]) -> None:
        require_mock(split)
        self._split, self._numbers = split, numbers
        self._opened = ExitStack()  # the rig of the last episode
        self._rig: Rig | None = None
        self._at = -1  # the number of that episode

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._close_rig()

    def require_policy(self, name: str, warn: Warn) -> None:
        """As `SplitPlayer.require_policy`; opens no device."""
        loaded = [self._load(number) for number in self._numbers]
        config = loaded[0].config
        assert config.task is not None
        task, spec = make_task(config.task), rig_spec(config)
        if _is_baseline(name):
            require_baseline(name, self._split.file, task)
            return
        policy = load_policy(name, task, spec, config.canonical, BASELINES)
        require_fit(config.name, spec, policy, name, task)
        for words in training_notes(policy, name, [each.config.scene for each in loaded if each.config.scene]):
            warn(words)

    def play(
        self, policy: str, numbers: Sequence[int], report: ReportSteps = lambda step, steps: None
    ) -> Iterator[tuple[list[EpisodeScore], float]]:
        """Plays these episodes. Yields the score of each when it ends; the seconds inside the policy are not measured.
        Raises RigFailed."""
        for number in numbers:
            loaded = self._load(number)
            assert loaded.config.task is not None
            task = make_task(loaded.config.task)
            rig = self._open_rig(loaded, number)
            try:
                score = self._play_episode(rig, loaded.config.canonical, task, policy, number, report)
            except BaseException:
                self._close_rig()
                raise
            if score.end != "steps":  # stopped arms
                self._close_rig()
            yield [score], 0.0

    def _open_rig(self, loaded: LoadedRig, number: int) -> Rig:
        if self._rig is None or self._at != number:
            self._close_rig()
            self._rig, self._at = self._opened.enter_context(open_rig(loaded)), number
        return self._rig

    def _close_rig(self) -> None:
        self._rig = None
        self._opened.close()

    def _load(self, number: int) -> LoadedRig:
        words = [_mock_override(word) for word in [*self._split.overrides, *self._split.episode_overrides(number)]]
        return load_with_task(MOCK_RIG, self._split.task.task, [*filter(None, words), *_addresses(), *_pictures(words)])

    def _play_episode(
        self, rig: Rig, canonical: CanonicalGrid, task: Task, name: str, number: int, report: ReportSteps
    ) -> EpisodeScore:
        if _is_baseline(name):
            policy = load_baseline(name, self._split.file, number, rig, task)
        else:
            policy = load_policy(name, task, rig.spec, canonical, BASELINES)
        setup = EpisodeSetup(name, self._split.episode_seed(number), canonical=canonical)
        steps: list[Step] = []

        def add(step: Step) -> None:
            steps.append(step)
            report(len(steps) - 1, task.config.steps)

        end: End = "steps"
        reason = ""
        try:
            run_episode(rig, policy, task, task.config.steps, setup=setup, on_step=add)
        except (GoalOutOfReach, NoTouch) as failure:
            return score_not_begun(number, str(failure))
        except EpisodeFailed as failure:
            exceeded = isinstance(failure.__cause__, LimitExceeded)
            if not failure.by_policy and not exceeded:
                raise RigFailed(f"episode {number} on rig '{rig.name}': {failure}") from failure
            end, reason = "limit" if exceeded else "error", str(failure)
        if end == "steps" and len(steps) <= task.config.steps:
            raise KeyboardInterrupt  # with which a run ends as if complete
        outside = bool(describe_outside(policy)) if has_training_range(policy) else None
        return self._score(rig, task, number, steps, end, reason, outside)

    def _score(
        self, rig: Rig, task: Task, number: int, steps: Sequence[Step], end: End, reason: str, outside: bool | None
    ) -> EpisodeScore:
        """Of the steps from the state after the reset on; their bits are not hashed."""
        distances = [step.distance for step in steps if step.distance is not None]
        peak = max((abs(float(arm.wrench[2])) for step in steps for arm in step.arms.values()), default=0.0)
        limit = task.config.force_limit
        if end == "steps" and limit is not None and peak > limit:
            end, reason = "limit", f"a normal force of {peak:.2f} N, beyond the limit of {limit:g} N"
        truth, body = rig.truth(), task.config.scene.body
        broken = truth is not None and body is not None and is_broken(truth.points, enclosed_volume(body.geometry))
        success = end == "steps" and bool(distances) and distances[-1] <= task.config.success
        missed = [index for index, distance in enumerate(distances) if distance > task.config.success]
        arrival = missed[-1] + 1 if missed else 0
        return EpisodeScore(
            episode=number,
            success=success,
            safe=success and not broken and peak <= self._split.task.max_force,
            distance=distances[-1] if distances else None,
            start=distances[0] if distances else None,
            peak_force=peak,
            broken=broken,
            steps=max(len(steps) - 1, 0),
            arrival=arrival if end == "steps" and arrival < len(distances) else None,
            end=end,
            reason=reason[:500],
            outside=outside,
            actions="",
            states="",
        )


def _is_baseline(name: str) -> bool:
    return name in BASELINES and name != SCRIPTED


def _mock_override(word: str) -> str:
    """An override of the simulated rig as one of the mock rig; "" for one that hardware does not have."""
    key, _, value = word.partition("=")
    parts = key.split(".")
    if parts[0] == "motion":
        return ""
    if (parts[0], *parts[2:3]) in (("arms", "error"), ("arms", "mount"), ("sensors", "delay")):
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
    """Loopback addresses of this process, so that several may run at once."""
    room = 45  # second number of the addresses
    return [
        word
        for number, name in enumerate(ARMS, start=1)
        for host in [loopback_host(number, room)]
        for word in (f"arms.{name}.host={host}", f"sensors.{name}.source=http://{host}:8081/?action=stream")
    ]
