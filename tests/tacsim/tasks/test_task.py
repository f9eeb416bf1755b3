"""How a state is judged."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tacsim.interface import Truth
from tacsim.models.task import RepositionConfig, SqueezeConfig
from tacsim.tasks import evaluate_outcome, make_task, tolerance_reward


def truth(height: float = 10e-3, x: float = 0.0, y: float = 0.0) -> Truth:
    return Truth(height, np.array([x, y, 5e-3]), np.zeros((1, 3), np.float32), {})


def test_squeeze_counts_the_height_only() -> None:
    task = make_task(SqueezeConfig(kind="squeeze", goal=7e-3, reward_scale=2e-3, success=0.1e-3))
    outcome = evaluate_outcome(task, truth(height=6.5e-3, x=1e-3), truth())
    assert outcome.distance == pytest.approx(0.5e-3)
    assert outcome.reward == pytest.approx(-0.25)
    assert not outcome.success
    assert evaluate_outcome(task, truth(height=7.05e-3), truth()).success


def test_reposition_counts_the_way_in_the_plane_since_reset() -> None:
    task = make_task(RepositionConfig(kind="reposition", goal=(2e-3, 1e-3)))
    outcome = evaluate_outcome(task, truth(height=3e-3, x=6e-3, y=2e-3), truth(x=1e-3, y=-2e-3))
    assert outcome.distance == pytest.approx(math.hypot(5e-3 - 2e-3, 4e-3 - 1e-3))
    assert evaluate_outcome(task, truth(x=3e-3, y=-1e-3), truth(x=1e-3, y=-2e-3)).distance == pytest.approx(
        0.0, abs=1e-12
    )


def test_score_is_one_within_success_and_a_tenth_one_scale_further() -> None:
    task = make_task(SqueezeConfig(kind="squeeze", goal=7e-3, reward_scale=1e-3, success=0.1e-3))
    assert evaluate_outcome(task, truth(height=7.1e-3 - 1e-12), truth()).score == 1.0
    assert evaluate_outcome(task, truth(height=8.1e-3), truth()).score == pytest.approx(0.1)


def test_tolerance_against_its_definition() -> None:
    assert tolerance_reward(0.5, (0.0, 1.0), margin=2.0) == tolerance_reward(1.0, (0.0, 1.0), margin=2.0) == 1.0
    assert tolerance_reward(3.0, (0.0, 1.0), margin=2.0) == pytest.approx(0.1)
    assert tolerance_reward(-2.0, (0.0, 1.0), margin=2.0) == pytest.approx(0.1)
    assert tolerance_reward(2.0, (0.0, 1.0), margin=2.0) == pytest.approx(
        0.1 ** (1 / 4)
    )  # Gaussian: quarter exponent half-way
    assert (
        tolerance_reward(2.0, (-math.inf, 1.0), margin=2.0) < tolerance_reward(1.5, (-math.inf, 1.0), margin=2.0) < 1.0
    )
