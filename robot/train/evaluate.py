"""Evaluates policies: each in the same held-out episodes, with confidence intervals.

Needs no torch. A policy file is evaluated as it runs on a rig: with its own encoder, from observations.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from robot.deploy.policy import (
    describe_outside,
    has_training_range,
    load_policy,
    require_fit,
    require_policy_name,
    reset_policy,
    training_notes,
)
from robot.open import load_with_task, make_vector_env
from tacsim.gym.env import TacsimEnv
from tacsim.gym.vector import TacsimVectorEnv
from tacsim.interface import Policy
from tacsim.models.policy import Features, Training
from tacsim.models.scene import Scene
from tacsim.models.sensor import CanonicalGrid
from tacsim.models.task import LENGTH, Unit

TEACHER, RANDOM = "teacher", "random"  # in addition to the policies of load_policy
HELD_OUT_SEED_OFFSET = 1_000_000  # added to the training seeds: other bodies, other episodes
ReportProgress = Callable[[str, int, int], None]
Act = Callable[[TacsimEnv], NDArray[np.float32]]


@dataclass(frozen=True, slots=True)
class Interval:
    """An estimate with its 95 % confidence interval."""

    value: float
    low: float
    high: float


class EpisodeResult(NamedTuple):
    """Result of one episode."""

    distance: float  # of the body from the goal [m]
    success: bool
    peak_force: float  # maximum normal force [N]
    improvement: float  # fraction of the distance at the start
    outside: bool | None = None  # a learned policy left its training range; None: unknown


@dataclass(frozen=True, slots=True)
class EvaluationResult:
    """Results of the episodes of one policy."""

    policy: str
    episodes: tuple[EpisodeResult, ...]
    unit: Unit = LENGTH  # in which distances are shown

    @property
    def success(self) -> Interval:
        """Success rate, with Wilson's interval."""
        return wilson_interval(sum(each.success for each in self.episodes), len(self.episodes))

    @property
    def distance(self) -> Interval:
        """Mean distance [SI], with a bootstrap interval."""
        return bootstrap_interval(np.array([each.distance for each in self.episodes]))

    @property
    def improvement(self) -> Interval:
        """Mean improvement, with a bootstrap interval."""
        return bootstrap_interval(np.array([each.improvement for each in self.episodes]))

    @property
    def outside(self) -> float | None:
        """Fraction of episodes in which a learned policy left its training range; None: unknown."""
        known = [each.outside for each in self.episodes if each.outside is not None]
        return sum(known) / len(known) if known else None

    @property
    def peak_force(self) -> tuple[float, float]:
        """Mean and 95th percentile of the peak force [N]."""
        forces = [each.peak_force for each in self.episodes]
        return float(np.mean(forces)), float(np.quantile(forces, 0.95))


ReportResult = Callable[[EvaluationResult], None]
Warn = Callable[[str], None]


def evaluate(
    training: Training,
    policies: Sequence[str],
    episodes: int = 200,
    seed: int = 0,
    report_progress: ReportProgress = lambda words, done, of: None,
    report_result: ReportResult = lambda so_far: None,
    warn: Warn = lambda words: None,
) -> list[EvaluationResult]:
    """Evaluates each policy in the same episodes, with bodies and goals drawn as in training but by other seeds.

    policies: "teacher" (acts by the truth), "random", and names of `load_policy`: "scripted", "FILE.onnx" ...
    report_result: called with the results so far, each time that all environments have played an episode.
    warn: called once for each learned policy with scenes outside its training, or with an unknown range.
    Raises PolicyNotFound, IncompatibleRig, and the errors of `make_vector_env`.
    """
    for name in policies:
        require_policy_name(name, (TEACHER, RANDOM))  # before the worlds are made, which takes a minute
    config = load_with_task(training.rig, training.task, training.overrides).config
    drawn = training.randomise
    if drawn is not None:
        drawn = drawn.model_copy(update={"draws": episodes, "seed": HELD_OUT_SEED_OFFSET + seed})
    number = min(training.environments, episodes)
    features = Features(sensors=(), maps=(), touch=("moved",), arms=tuple(config.arms)[:1], goal=False)  # not used
    envs = make_vector_env(
        number, training.task, training.rig, training.overrides, randomise=drawn, features=features, learning=False
    )
    try:
        for name in policies:
            policy = _load_fitting_policy(name, envs.members[0], config.canonical)
            for words in training_notes(policy, name, _scenes(envs.members[0])):
                warn(words)
        return [
            _evaluate_policy(envs, name, episodes, seed, config.canonical, report_progress, report_result)
            for name in policies
        ]
    finally:
        envs.close()


def _evaluate_policy(
    envs: TacsimVectorEnv,
    name: str,
    episodes: int,
    seed: int,
    canonical: CanonicalGrid,
    report_progress: ReportProgress,
    report_result: ReportResult,
) -> EvaluationResult:
    rows: list[EpisodeResult] = []
    members = envs.members
    count = len(members)
    for first in range(0, episodes, count):
        seeds = [HELD_OUT_SEED_OFFSET + seed + first + i for i in range(count)]
        for at, env in enumerate(members):  # each draw once: equal episodes add no information
            env.next_variant = (first + at) % len(env.variants) if env.variants else None
        _, info = envs.reset(seed=list(seeds))
        start = info["distance"]
        loaded_policies = [_load_fitting_policy(name, env, canonical) for env in members]
        actors = [
            _make_actor(name, env, policy, each)
            for env, policy, each in zip(members, loaded_policies, seeds, strict=True)
        ]
        ends: dict[int, EpisodeResult] = {}
        while len(ends) < count:
            report_progress(name, len(rows) + len(ends), episodes)
            idle = np.zeros(len(members[0].task.axes), np.float32)
            actions = [
                idle if i in ends else act(env) for i, (act, env) in enumerate(zip(actors, members, strict=True))
            ]
            _, _, terminated, truncated, info = envs.step(np.stack(actions))
            for i in np.flatnonzero(terminated | truncated).tolist():
                if i not in ends:
                    ends[i] = EpisodeResult(
                        float(info["distance"][i]),
                        bool(info["is_success"][i]),
                        float(info["peak_force"][i]),
                        max(0.0, 1.0 - float(info["distance"][i]) / float(start[i])),
                        bool(describe_outside(loaded_policies[i])) if has_training_range(loaded_policies[i]) else None,
                    )
        rows += [ends[i] for i in range(count)]
        result = EvaluationResult(name, tuple(rows[:episodes]), members[0].task.config.unit)
        report_result(result)
    return result


def _scenes(env: TacsimEnv) -> list[Scene]:
    """All scenes of its episodes."""
    return [variant.scene for variant in env.variants] or ([] if env.scene is None else [env.scene])


def _make_actor(name: str, env: TacsimEnv, policy: Policy | None, seed: int) -> Act:
    """The policy as a function of the environment, reset for an episode."""
    if name == TEACHER:
        return lambda env: env.expert()
    if name == RANDOM:
        random = np.random.default_rng([HELD_OUT_SEED_OFFSET, seed])
        return lambda env: random.uniform(-1.0, 1.0, len(env.task.axes)).astype(np.float32)
    assert policy is not None
    reset_policy(policy, env.task)
    return lambda env: env.policy_action(policy)


def _load_fitting_policy(name: str, env: TacsimEnv, canonical: CanonicalGrid) -> Policy | None:
    if name in (TEACHER, RANDOM):
        return None
    policy = load_policy(name, env.task, env.rig.spec, canonical, (TEACHER, RANDOM))
    require_fit(env.rig.name, env.rig.spec, policy, name, env.task)
    return policy


def wilson_interval(count: int, total: int) -> Interval:
    """Rate `count` / `total` with Wilson's 95 % interval."""
    from scipy import stats

    low, high = stats.binomtest(count, total).proportion_ci(method="wilson")
    return Interval(count / total, float(low), float(high))


def bootstrap_interval(values: NDArray[np.float64]) -> Interval:
    """Mean of values (n,) with a 95 % bootstrap interval."""
    draws = 10_000
    chosen = np.random.default_rng(0).integers(len(values), size=(draws, len(values)))
    low, high = np.quantile(values[chosen].mean(axis=1), [0.025, 0.975])
    return Interval(float(values.mean()), float(low), float(high))
