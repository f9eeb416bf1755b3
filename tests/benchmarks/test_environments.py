"""Environments at a small size: two of them, one step, two rounds of resets."""

from __future__ import annotations

import pytest

from benchmarks.cases import environments


@pytest.mark.slow
def test_random_actions_are_those_of_one_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in {"NUMBER": 2, "STEPS": 1, "ROUNDS": 2, "BODIES": environments.BODIES[:2]}.items():
        monkeypatch.setattr(environments, name, value)
    blind, in_processes, step, reset = environments.random_actions("learn", "flowing", 1)
    assert blind.error == in_processes.error == step.error == 0.0  # to the bit
    assert step.figures["env_steps_per_s"] == pytest.approx(2 / step.timing.median)
    assert reset.figures["kept_ms"] < reset.figures["first_ms"]


@pytest.mark.deep
def test_a_policy_found_at_learn_is_right_at_learn() -> None:
    counted, felt = environments.transfer("learn", 1)
    assert counted.error < 0.02 and felt.error < 0.05  # mm
    assert counted.figures["reward"] == pytest.approx(-counted.error)
