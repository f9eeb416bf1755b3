"""Environments at a small size: two of them, one step, two rounds of resets; a policy carried nowhere."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks import policy_transfer
from benchmarks.cases import environments


def test_random_actions_are_those_of_one_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in {"NUMBER": 2, "STEPS": 1, "ROUNDS": 2, "BODIES": environments.BODIES[:2]}.items():
        monkeypatch.setattr(environments, name, value)
    blind, step, reset = environments.random_actions("learn", "flowing", 1)
    assert blind.error == step.error == 0.0  # to the bit
    assert step.figures["env_steps_per_s"] == pytest.approx(2 / step.timing.median)
    assert reset.figures["kept_ms"] < reset.figures["first_ms"]


@pytest.mark.deep
def test_a_policy_found_at_learn_is_right_at_learn() -> None:
    counted, felt = environments.transfer("learn", 1)
    assert counted.error < 0.02 and felt.error < 0.05  # mm
    assert counted.figures["reward"] == pytest.approx(-counted.error)


@pytest.mark.deep
def test_a_linear_policy_is_trained_and_judged_on_the_same_bodies(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in {"TRAIN": 2, "JUDGE": 2, "STEPS": 2, "LAST": 1, "ROUNDS": 1, "EPISODES": 1, "BEST": 1}.items():
        monkeypatch.setattr(policy_transfer, name, value)
    weights, reward = policy_transfer.train("learn", (0, 2, 3), seed=0)
    assert weights[1] == 0 and np.isfinite(weights).all() and reward < 0
    still, again = policy_transfer.judge("learn", [np.zeros(4), np.zeros(4)])
    assert (still.distances == again.distances).all() and still.distances.min() > 1  # mm: nothing was closed


def test_what_was_judged_is_said_with_its_uncertainty() -> None:
    judged = policy_transfer.Judged(np.array([0.0, 0.05, 0.1, 0.25]))
    assert str(judged) == "reached 3 of 4 (95 %: 0.30 to 0.95), 0.100 ± 0.172 mm from the goal"
