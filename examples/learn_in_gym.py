"""Learn in a Gymnasium environment: find where to stop a squeeze, by the cross-entropy method.

    python examples/learn_in_gym.py

The policy has two parameters: the distance between the sensors at which it stops, and the speed before that. It
observes one number. `tacsim train squeeze` learns a network for unseen bodies and goals.
"""

from __future__ import annotations

import sys

import gymnasium
import numpy as np

import tacsim.gym  # noqa: F401 - registers the environments

CLOSE = np.array([1.0, -1.0], np.float32)  # the lower sensor up, the upper one down
ROUNDS, CANDIDATES, BEST, STEPS = 4, 8, 3, 12


def play(envs: gymnasium.vector.VectorEnv, parameters: np.ndarray) -> np.ndarray:
    """Final distance from the goal [mm] of each row of parameters: stop distance [10 mm], speed."""
    observations, infos = envs.reset(seed=0)
    for _ in range(STEPS):
        between = observations["touch"][:, -1]  # from the lower sensor to the upper one along z; 1 is 10 mm
        speed = np.clip((between - parameters[:, 0]) / 0.04, 0.0, 1.0) * np.clip(parameters[:, 1], 0.0, 1.0)
        observations, _, _, _, infos = envs.step(speed[:, None].astype(np.float32) * CLOSE)
    return np.asarray(infos["distance"]) * 1e3


def main() -> None:
    envs = gymnasium.make_vec("tacsim/Squeeze-v0", CANDIDATES, overrides=["task.goal=8 mm", "task.steps=40"])
    random = np.random.default_rng(0)
    mean, spread = np.array([0.95, 0.5]), np.array([0.1, 0.3])
    history = []
    for number in range(ROUNDS):
        candidates = mean + spread * random.normal(size=(CANDIDATES, 2))
        distances = play(envs, candidates)
        best = candidates[np.argsort(distances)[:BEST]]
        mean, spread = best.mean(axis=0), best.std(axis=0) + 0.01
        history.append(float(np.median(distances)))
        print(f"round {number}: median {history[-1]:.2f} mm from the goal, best {distances.min():.2f} mm")
    envs.close()

    if not history[-1] < 0.5 * history[0]:
        sys.exit(f"nothing was learned: the median distance went from {history[0]:.2f} to {history[-1]:.2f} mm")


if __name__ == "__main__":
    main()
