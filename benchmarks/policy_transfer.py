"""What a policy that was trained in coarse physics loses in fine physics: `python -m benchmarks.policy_transfer`.

A linear policy of the squeeze is trained by the cross-entropy method in a batch at one preset, then judged on bodies
that it has not met, the same ones at each preset. Two policies: one sees depths in the gels, travel and force; the
other travel and force alone. Minutes at learn and draft, many at standard; docs/learn.md has the figures.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
import typer
from scipy import stats

from tacsim.gym.vector import TacsimVectorEnv
from tacsim.interface import FloatArray

TRAIN, JUDGE = 12, 12  # environments of a batch: candidates; bodies
STEPS, LAST = 13, 3  # of an episode; whose reward counts
ROUNDS, EPISODES, BEST = 12, 2, 3  # of training; for each candidate in a round; candidates kept in it
SEEDS = 10_000  # of judging; training has others, and other bodies
SIGHTS = {"depths, travel, force": (0, 1, 2, 3), "travel, force": (0, 2, 3)}  # indices of features
SMALLEST = ("width=16", "height=16", "pixel_pitch=1 mm")  # nobody looks at pictures


@dataclass(frozen=True, slots=True)
class Judged:
    """How episodes ended."""

    distances: FloatArray  # (n,) of the body's height from the goal [mm]

    def __str__(self) -> str:
        reached, count = int((self.distances <= 0.1).sum()), len(self.distances)
        low, high = stats.binomtest(reached, count).proportion_ci(method="wilson")
        half = stats.t.ppf(0.975, count - 1) * self.distances.std(ddof=1) / np.sqrt(count)
        return (
            f"reached {reached} of {count} (95 %: {low:.2f} to {high:.2f}), "
            f"{self.distances.mean():.3f} ± {half:.3f} mm from the goal"
        )


def bodies(count: int, seed: int) -> list[list[str]]:
    """Overrides: clay of other strengths and widths, all of 10 mm height."""
    rng = np.random.default_rng(seed)
    return [
        [
            f"scene.body.material.yield_stress={rng.uniform(20, 35):.2f} kPa",
            f"scene.body.geometry.size=[{rng.uniform(8.5, 10.5):.2f} mm, {rng.uniform(8.5, 10.5):.2f} mm, 10 mm]",
        ]
        for _ in range(count)
    ]


def open_batch(preset: str, count: int, variants: list[list[str]]) -> TacsimVectorEnv:
    """`count` squeezes to 7 mm, of these bodies."""
    import gymnasium

    import tacsim.gym.env  # noqa: F401  registers

    pictures = [f"sensors.{name}.model.geometry.{what}" for name in ("lower", "upper") for what in SMALLEST]
    overrides = [f"scene.preset={preset}", f"task.steps={STEPS}", "motion=flowing", *pictures]
    options: dict[str, Any] = {"autoreset_mode": "Disabled", "overrides": overrides, "variants": variants}
    envs = gymnasium.make_vec("tacsim/Squeeze-v0", count, **options)
    assert isinstance(envs, TacsimVectorEnv)
    return envs


def features(observed: dict[str, FloatArray]) -> FloatArray:
    """(n, 4): one; greatest depth in both gels [mm], travel of both sensors beyond 3 mm [mm], and mean
    force [10 N]."""
    both = [
        np.stack(
            [observed[f"height_{n}"].max(axis=(1, 2)), observed[f"pose_{n}"][:, 2], -observed[f"wrench_{n}"][:, 2]]
        )
        for n in ("lower", "upper")
    ]
    depth, travel, force = np.sum(both, axis=0)
    return np.stack([np.ones(len(force)), depth * 1e3, travel * 1e3 - 3.0, force / 20], axis=1)


def episodes(envs: TacsimVectorEnv, weights: FloatArray, seeds: list[int | None]) -> tuple[FloatArray, FloatArray]:
    """Mean reward of each environment's last steps, and how far its body ends from the goal [mm]; of a row of weights
    each."""
    observed, _ = envs.reset(seed=seeds)
    total = np.zeros(len(weights))
    for step in range(STEPS):
        closing = np.clip((features(observed) * weights).sum(axis=1), -1, 1)
        actions = np.stack([closing, -closing], axis=1).astype(np.float32)  # up and down: world z
        observed, rewards, _, _, infos = envs.step(actions)
        total += rewards if step >= STEPS - LAST else 0.0
    return total / LAST, infos["distance"] * 1e3


def train(preset: str, sight: tuple[int, ...], seed: int) -> tuple[FloatArray, float]:
    """Weights of the policy that was found (4,), and its mean reward in training's last round."""
    rng = np.random.default_rng(seed)
    mean, spread = np.zeros(len(sight)), np.ones(len(sight))
    envs = open_batch(preset, TRAIN, bodies(8, seed=1))
    best = -np.inf
    for number in range(ROUNDS):
        tried = np.zeros((TRAIN, 4))
        tried[:, sight] = rng.normal(mean, spread, (TRAIN, len(sight)))
        scores = np.zeros(TRAIN)
        for episode in range(EPISODES):
            scores += episodes(envs, tried, [number * EPISODES + episode] * TRAIN)[0] / EPISODES  # one body for all
        kept = np.argsort(scores)[-BEST:]
        mean, spread, best = (
            tried[kept][:, sight].mean(axis=0),
            tried[kept][:, sight].std(axis=0) + 0.02,
            scores[kept].mean(),
        )
    envs.close()
    weights = np.zeros(4)
    weights[list(sight)] = mean
    return weights, float(best)


def judge(preset: str, policies: list[FloatArray]) -> list[Judged]:
    """Each policy with the same unseen bodies."""
    envs = open_batch(preset, JUDGE, bodies(64, seed=2))
    seeds: list[int | None] = list(range(SEEDS, SEEDS + JUDGE))
    found = [Judged(episodes(envs, np.tile(weights, (JUDGE, 1)), seeds)[1]) for weights in policies]
    envs.close()
    return found


def main(trained_at: list[str] = ["learn", "draft"], judged_at: list[str] = ["learn", "draft", "standard"]) -> None:  # noqa: B006
    """Trains, judges, prints."""
    policies = []
    for preset in trained_at:
        for words, sight in SIGHTS.items():
            began = time.perf_counter()
            weights, reward = train(preset, sight, seed=0)
            policies.append((f"trained at {preset}, sees {words}", weights))
            typer.echo(
                f"{policies[-1][0]}: {weights.round(2)}, reward {reward:.3f}, {time.perf_counter() - began:.0f} s"
            )
    for preset in judged_at:
        for (words, _), judged in zip(policies, judge(preset, [weights for _, weights in policies]), strict=True):
            typer.echo(f"{words}, judged at {preset}: {judged}")


if __name__ == "__main__":
    typer.run(main)
