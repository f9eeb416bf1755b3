"""Plays episodes of a split, several at once, and scores them."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from types import TracebackType
from typing import Any, Self

import numpy as np

from robot.deploy.policy import training_notes
from robot.open import make_vector_env
from robot.train.benchmark.blind import load_blind, start_numbers
from robot.train.benchmark.episodes import Split
from robot.train.benchmark.integrity import is_broken
from robot.train.benchmark.policies import (
    ANALYTIC,
    BLIND,
    RANDOM,
    TEACHER,
    Actor,
    PolicyError,
    load_fitting_policy,
)
from robot.train.benchmark.score import EpisodeScore
from tacsim.geometry.shapes import enclosed_volume
from tacsim.gym.env import TacsimEnv
from tacsim.interface import Float32, FloatArray
from tacsim.models.policy import Features
from tacsim.models.rig import RigConfig

Warn = Callable[[str], None]
ReportSteps = Callable[[int, int], None]  # control steps of this round that are done, and all
STATES = ("distance", "peak_force", "body_height", "work")  # numbers of a step whose bits are hashed


class RunningEpisode:
    """One episode while it is played: what its score is made of.

    Args:
        info: of its environment, at the reset.
        actor: None: nothing acts, and `failure` says why.
    """

    def __init__(
        self,
        number: int,
        env: TacsimEnv,
        info: Mapping[str, Any],
        actor: Actor | None,
        max_force: float,
        failure: str = "",
    ) -> None:
        self._number, self._env, self._actor, self._max_force = number, env, actor, max_force
        self._actions, self._states = hashlib.sha256(), hashlib.sha256()
        self._info, self._start = info, float(info["distance"])
        self.steps, self._arrival = 0, None if float(info["distance"]) > env.task.config.success else 0
        self.seconds = 0.0  # inside the policy
        self.score: EpisodeScore | None = None  # once it is over
        if actor is None:
            self._finish("error", failure)

    def act(self) -> Float32:
        """The action of this step; zeros once the episode is over. An error of the policy ends the episode."""
        idle = np.zeros(len(self._env.task.axes), np.float32)
        if self.score is not None or self._actor is None:
            return idle
        started = time.perf_counter()
        try:
            action = self._actor(self._env)
        except PolicyError as failure:
            self._finish("error", f"policy: {failure}")
            return idle
        finally:
            self.seconds += time.perf_counter() - started
        self._actions.update(np.ascontiguousarray(action, "<f4").tobytes())
        return action

    def add_step(self, info: Mapping[str, Any]) -> None:
        """Takes the state after a step."""
        if self.score is not None:
            return
        self.steps, self._info = self.steps + 1, info
        self._states.update(np.array([info[key] for key in STATES], "<f8").tobytes())
        reached = float(info["distance"]) <= self._env.task.config.success
        self._arrival = None if not reached else self.steps if self._arrival is None else self._arrival
        if self._env.phase == "over":
            limit, diverged = info.get("limit"), info.get("diverged")
            self._finish("limit" if limit else "diverged" if diverged else "steps", str(limit or diverged or ""))

    def _finish(self, end: str, reason: str) -> None:
        truth, scene = self._env.rig.truth(), self._env.scene
        broken = False
        if truth is not None and scene is not None and scene.body is not None:
            self._states.update(np.ascontiguousarray(truth.points, "<f4").tobytes())
            broken = is_broken(truth.points, enclosed_volume(scene.body.geometry))
        for pose in () if truth is None else truth.objects.values():
            self._states.update(np.concatenate([pose.position, pose.quaternion]).astype("<f8").tobytes())
        success = end == "steps" and bool(self._info["is_success"])
        peak = float(self._info["peak_force"])
        self.score = EpisodeScore.model_validate(
            {
                "episode": self._number,
                "success": success,
                "safe": success and not broken and peak <= self._max_force,
                "distance": float(self._info["distance"]),
                "start": self._start,
                "peak_force": peak,
                "broken": broken,
                "steps": self.steps,
                "arrival": self._arrival if end == "steps" else None,
                "end": end,
                "reason": reason[:500],
                "outside": None if self._actor is None else self._actor.outside,
                "actions": self._actions.hexdigest()[:32],
                "states": self._states.hexdigest()[:32],
            }
        )


class SplitPlayer:
    """The environments of a split, in which policies play one after the other.

    numbers: of the episodes that may be played.
    environments: episodes that move together; results do not depend on it.
    Raises ConfigError, CannotOpen, ValueError.
    """

    def __init__(self, split: Split, numbers: Sequence[int], environments: int) -> None:
        self._split, self._numbers = split, list(dict.fromkeys(numbers))
        self.config: RigConfig = split.load_config()
        arms = tuple(self.config.arms)[:1]
        features = Features(sensors=(), maps=(), touch=("moved",), arms=arms, goal=False)  # not used
        self._envs = make_vector_env(
            max(1, min(environments, len(self._numbers))),
            split.task.task,
            split.task.rig,
            split.overrides,
            variants=[split.episode_overrides(number) for number in self._numbers],
            features=features,
            learning=False,
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._envs.close()

    def require_policy(self, name: str, warn: Warn) -> None:
        """Raises PolicyNotFound, IncompatibleRig, BlindMissing, ValueError for a policy that cannot play here. `warn`
        gets notes on scenes outside the training of a learned policy."""
        env = self._envs.members[0]
        if name == BLIND:
            load_blind(self._split.file, env.task)
        elif name == ANALYTIC:
            env.task.analytic()
        elif name not in (RANDOM, TEACHER):
            policy = load_fitting_policy(name, env, self.config.canonical)
            for words in training_notes(policy, name, [variant.scene for variant in env.variants]):
                warn(words)

    def play(
        self, policy: str, numbers: Sequence[int], report: ReportSteps = lambda step, steps: None
    ) -> Iterator[tuple[list[EpisodeScore], float]]:
        """Plays these episodes. Yields the scores of each round of the environments when it ends, and the seconds
        inside the policy."""
        members, steps = self._envs.members, self._envs.members[0].task.config.steps
        for first in range(0, len(numbers), len(members)):
            chosen = list(numbers[first : first + len(members)])
            begun = self._begin(policy, [*chosen, *[chosen[-1]] * (len(members) - len(chosen))])
            while any(isinstance(each, RunningEpisode) and each.score is None for each in begun):
                self._step(begun)
                report(max(each.steps for each in begun if isinstance(each, RunningEpisode)), steps)
            own = begun[: len(chosen)]
            scores = [each.score if isinstance(each, RunningEpisode) else each for each in own]
            seconds = sum(each.seconds for each in own if isinstance(each, RunningEpisode))
            yield [each for each in scores if each is not None], seconds

    def starts_and_actions(self, report: Callable[[int], None] = lambda done: None) -> tuple[FloatArray, FloatArray]:
        """What a blind policy may know at the start of each episode (episodes, numbers), and the actions (episodes,
        steps, axes) of the teacher in it; to fit `blind`."""
        starts: list[FloatArray] = []
        actions: list[FloatArray] = []
        members = self._envs.members
        for first in range(0, len(self._numbers) - len(members) + 1, len(members)):
            for env, index in zip(members, range(first, first + len(members)), strict=True):
                env.next_variant = index
            self._envs.reset(seed=[self._split.episode_seed(self._numbers[first + at]) for at in range(len(members))])
            starts += [start_numbers(env.task.goal, env.observation) for env in members]
            taken = []
            for _ in range(members[0].task.config.steps):
                taken.append(np.stack([env.expert() for env in members]))
                self._envs.step(taken[-1])
            actions += list(np.stack(taken, axis=1).astype(np.float64))
            report(len(actions))
        return np.array(starts), np.array(actions)

    def _begin(self, policy: str, numbers: Sequence[int]) -> list[RunningEpisode | EpisodeScore]:
        """Resets each environment to one of the episodes; the score of one that cannot begin is known at once."""
        indices = [self._numbers.index(number) for number in numbers]
        for env, index in zip(self._envs.members, indices, strict=True):
            env.next_variant = index
        seeds: list[int | None] = [self._split.episode_seed(number) for number in numbers]
        _, batched = self._envs.reset(seed=seeds)
        begun: list[RunningEpisode | EpisodeScore] = []
        for at, (env, number, index) in enumerate(zip(self._envs.members, numbers, indices, strict=True)):
            info = _info_of(batched, at)
            if int(info["variant"]) != index:  # another draw has replaced it
                begun.append(score_not_begun(number, env.refused[-1] if env.refused else "the reset failed"))
                continue
            actor, failure = None, ""
            try:
                actor = Actor(policy, self._split.file, number, env, self.config.canonical)
            except PolicyError as error:
                failure = f"policy: {error}"
            begun.append(RunningEpisode(number, env, info, actor, self._split.task.max_force, failure))
        return begun

    def _step(self, begun: Sequence[RunningEpisode | EpisodeScore]) -> None:
        idle = np.zeros(len(self._envs.members[0].task.axes), np.float32)
        actions = [each.act() if isinstance(each, RunningEpisode) else idle for each in begun]
        batched = self._envs.step(np.stack(actions))[4]
        for at, each in enumerate(begun):
            if isinstance(each, RunningEpisode):
                each.add_step(_info_of(batched, at))


def _info_of(batched: Mapping[str, Any], at: int) -> dict[str, Any]:
    """The info of environment `at`, of what gymnasium has put together."""
    return {
        key: values[at]
        for key, values in batched.items()
        if not key.startswith("_") and bool(batched.get(f"_{key}", np.ones(at + 1, bool))[at])
    }


def score_not_begun(number: int, reason: str) -> EpisodeScore:
    """Of an episode whose reset failed."""
    return EpisodeScore(
        episode=number, success=False, safe=False, distance=None, start=None, peak_force=0.0, broken=False, steps=0,
        arrival=None, end="not begun", reason=reason[:500], actions="", states="",
    )  # fmt: skip
