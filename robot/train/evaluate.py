"""How good policies are: the same unseen episodes for each, and intervals for what that tells of all others.

Needs no torch. A policy file is judged as it would run on a rig: by its own encoder, from observations.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from robot.deploy.policy import (
    has_training_range,
    load_policy,
    outside_in_words,
    require_fit,
    training_notes,
)
from robot.open import load_with_task, make_vector_env
from tacsim.gym.env import TacsimEnv
from tacsim.gym.vector import TacsimVectorEnv
from tacsim.interface import Policy
from tacsim.models.policy import Features
from tacsim.models.scene import Scene
from tacsim.models.sensor import CanonicalGrid
from tacsim.models.training import Training

TEACHER, RANDOM = "teacher", "random"  # beside what load_policy knows
UNSEEN = 1_000_000  # added to the seeds of training: other bodies, other episodes
Tell = Callable[[str, int, int], None]
Act = Callable[[TacsimEnv], NDArray[np.float32]]


@dataclass(frozen=True, slots=True)
class Interval:
    """An estimate, and where the truth lies in 95 of 100 cases."""

    value: float
    low: float
    high: float


class Ended(NamedTuple):
    """One episode."""

    distance: float  # of the body from the goal [m]
    success: bool
    peak_force: float  # the greatest normal force [N]
    improvement: float  # share of the distance at the start
    outside: bool | None = None  # a learned policy observed what it did not observe in training; None: unknown


@dataclass(frozen=True, slots=True)
class Judged:
    """How the episodes of one policy ended."""

    policy: str
    episodes: tuple[Ended, ...]

    @property
    def success(self) -> Interval:
        """Share, by Wilson's interval."""
        return wilson(sum(each.success for each in self.episodes), len(self.episodes))

    @property
    def distance(self) -> Interval:
        """Mean [m], by bootstrap."""
        return bootstrap(np.array([each.distance for each in self.episodes]))

    @property
    def improvement(self) -> Interval:
        """Mean, by bootstrap."""
        return bootstrap(np.array([each.improvement for each in self.episodes]))

    @property
    def outside(self) -> float | None:
        """Share of the episodes in which a learned policy left the range of its training; None where it is unknown."""
        known = [each.outside for each in self.episodes if each.outside is not None]
        return sum(known) / len(known) if known else None

    @property
    def peak_force(self) -> tuple[float, float]:
        """Mean, and what one episode in twenty exceeds [N]."""
        forces = [each.peak_force for each in self.episodes]
        return float(np.mean(forces)), float(np.quantile(forces, 0.95))


Say = Callable[[Judged], None]
Warn = Callable[[str], None]


def evaluate(
    training: Training,
    policies: Sequence[str],
    episodes: int = 200,
    seed: int = 0,
    tell: Tell = lambda words, done, of: None,
    say: Say = lambda so_far: None,
    warn: Warn = lambda words: None,
) -> list[Judged]:
    """Each policy in the same episodes, of bodies and goals drawn as in training but with other seeds.

    policies: "teacher" (acts by the truth), "random", and what `load_policy` knows: "scripted", "FILE.onnx" ...
    say: is told how the episodes so far ended, each time that all environments have played one.
    warn: is told, once for each learned policy, which scenes are outside its training, or that its range is unknown.
    Raises PolicyNotFound, IncompatibleRig, and as `make_vector_env`.
    """
    config = load_with_task(training.rig, training.task, training.overrides).config
    drawn = training.randomise
    if drawn is not None:
        drawn = drawn.model_copy(update={"draws": episodes, "seed": UNSEEN + seed})
    number = min(training.environments, episodes)
    sight = Features(maps=(), touch=("moved",), arms=tuple(config.arms)[:1], goal=False)  # nobody looks at it
    envs = make_vector_env(
        number, training.task, training.rig, training.overrides, randomise=drawn, features=sight, learning=False
    )
    try:
        for name in policies:
            policy = _fitting(name, envs.members[0], config.canonical)
            for words in training_notes(policy, name, _scenes(envs.members[0])):
                warn(words)
        return [_judge(envs, name, episodes, seed, config.canonical, tell, say) for name in policies]
    finally:
        envs.close()


def _judge(
    envs: TacsimVectorEnv, name: str, episodes: int, seed: int, canonical: CanonicalGrid, tell: Tell, say: Say
) -> Judged:
    rows: list[Ended] = []
    members = envs.members
    count = len(members)
    for first in range(0, episodes, count):
        seeds = [UNSEEN + seed + first + i for i in range(count)]
        for at, env in enumerate(members):  # each draw once: episodes that are alike tell nothing of others
            env.next_variant = (first + at) % len(env.variants) if env.variants else None
        _, info = envs.reset(seed=list(seeds))
        start = info["distance"]
        fitting = [_fitting(name, env, canonical) for env in members]
        actors = [_actor(name, env, policy, each) for env, policy, each in zip(members, fitting, seeds, strict=True)]
        ends: dict[int, Ended] = {}
        while len(ends) < count:
            tell(name, len(rows) + len(ends), episodes)
            idle = np.zeros(len(members[0].task.axes), np.float32)
            actions = [
                idle if i in ends else act(env) for i, (act, env) in enumerate(zip(actors, members, strict=True))
            ]
            _, _, terminated, truncated, info = envs.step(np.stack(actions))
            for i in np.flatnonzero(terminated | truncated).tolist():
                if i not in ends:
                    ends[i] = Ended(
                        float(info["distance"][i]),
                        bool(info["is_success"][i]),
                        float(info["peak_force"][i]),
                        max(0.0, 1.0 - float(info["distance"][i]) / float(start[i])),
                        bool(outside_in_words(fitting[i])) if has_training_range(fitting[i]) else None,
                    )
        rows += [ends[i] for i in range(count)]
        say(Judged(name, tuple(rows[:episodes])))
    return Judged(name, tuple(rows[:episodes]))


def _scenes(env: TacsimEnv) -> list[Scene]:
    """All that its episodes may play."""
    return [variant.scene for variant in env.variants] or ([] if env.scene is None else [env.scene])


def _actor(name: str, env: TacsimEnv, policy: Policy | None, seed: int) -> Act:
    """The policy at the start of an episode."""
    if name == TEACHER:
        return lambda env: env.expert()
    if name == RANDOM:
        random = np.random.default_rng([UNSEEN, seed])
        return lambda env: random.uniform(-1.0, 1.0, len(env.task.axes)).astype(np.float32)
    assert policy is not None
    policy.reset()
    return lambda env: env.policy_action(policy)


def _fitting(name: str, env: TacsimEnv, canonical: CanonicalGrid) -> Policy | None:
    if name in (TEACHER, RANDOM):
        return None
    policy = load_policy(name, env.task, env.rig.spec, canonical)
    require_fit(env.rig.name, env.rig.spec, policy, name, env.task)
    return policy


def wilson(count: int, total: int) -> Interval:
    """A share, by Wilson's interval."""
    from scipy import stats

    low, high = stats.binomtest(count, total).proportion_ci(method="wilson")
    return Interval(count / total, float(low), float(high))


def bootstrap(values: NDArray[np.float64]) -> Interval:
    """The mean of (n,) values."""
    draws = 10_000
    chosen = np.random.default_rng(0).integers(len(values), size=(draws, len(values)))
    low, high = np.quantile(values[chosen].mean(axis=1), [0.025, 0.975])
    return Interval(float(values.mean()), float(low), float(high))
