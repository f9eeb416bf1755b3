"""The noise of a force sensor: how large, from which seeds, and who feels it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tacsim.models.limits import ArmLimits, Workspace
from tacsim.models.rig import WrenchNoise
from tacsim.sim.arm import SimArm, WrenchNoiseSource, wrench_noise_source
from tacsim.sim.clock import SimClock

MODEL = WrenchNoise(force=0.02, torque=0.5e-3)


@pytest.mark.slow
def test_readings_scatter_as_the_model_says() -> None:
    drawn = np.array([WrenchNoiseSource(MODEL, "lower")(k, 0.1, 7) for k in range(1500)])
    assert drawn.mean(axis=0) == pytest.approx(np.zeros(6), abs=3e-3)
    assert drawn.std(axis=0) == pytest.approx([0.02] * 3 + [0.5e-3] * 3, rel=0.08)
    assert np.abs(np.corrcoef(drawn.T) - np.eye(6)).max() < 0.1
    assert abs(np.corrcoef(drawn[1:, 2], drawn[:-1, 2])[0, 1]) < 0.1


@pytest.mark.slow
@pytest.mark.parametrize("period", [0.1, 0.5])
def test_the_zero_wanders_from_where_it_was_at_reset(period: float) -> None:
    """After a minute by `drift` deviations, after a quarter of it by half as much, whatever the period."""
    source = WrenchNoiseSource(MODEL.model_copy(update={"drift": 10.0}), "lower")
    still = WrenchNoiseSource(MODEL, "lower")
    for seconds, deviations in ((0, 0.0), (15, 5.0), (60, 10.0)):
        index = round(seconds / period)
        zeros = [(source(index, period, e) - still(index, period, e))[:3] / 0.02 for e in range(300)]
        assert np.std(zeros) == pytest.approx(deviations, rel=0.1)


def test_it_follows_from_seed_arm_episode_and_period_alone() -> None:
    first = WrenchNoiseSource(MODEL, "lower")(3, 0.1, 5)
    assert (WrenchNoiseSource(MODEL, "lower")(3, 0.1, 5) == first).all()
    others = [
        WrenchNoiseSource(MODEL, "upper")(3, 0.1, 5),
        WrenchNoiseSource(MODEL.model_copy(update={"seed": 1}), "lower")(3, 0.1, 5),
        WrenchNoiseSource(MODEL, "lower")(4, 0.1, 5),
        WrenchNoiseSource(MODEL, "lower")(3, 0.1, 6),
    ]
    assert all((first != other).all() for other in others)
    assert wrench_noise_source(WrenchNoise(), "lower") is None


def test_an_arm_tells_it_and_its_guard_does_not_feel_it(spring_world: Any) -> None:
    clock = SimClock(spring_world, 0.1)
    limits = ArmLimits(workspace=Workspace(lower=(-0.1, -0.1, -0.1), upper=(0.1, 0.1, 0.1)), force=5.0)
    noise = WrenchNoiseSource(WrenchNoise(force=100.0), "upper")
    arm = SimArm(spring_world, clock, "upper", 1.0, 1.0, limits, noise=noise)
    exact = SimArm(spring_world, clock, "upper", 1.0, 1.0)
    told = []
    for episode in (5, 5, 6):
        clock.restart(episode=episode)
        arm.command(None)  # guarded: nothing presses
        clock.tick()
        told.append(arm.state().wrench - exact.state().wrench)
        assert arm.state() is arm.state()  # looked at twice, it is one reading
    assert told[0] == pytest.approx(noise(1, 0.1, 5))
    assert (told[0] == told[1]).all() and (told[0][:3] != told[2][:3]).all()


def test_a_rig_has_it_from_its_file_and_the_seed_of_its_reset(open_springs: Any) -> None:
    quiet = open_springs("squeeze")
    rig = open_springs("squeeze", "arms.lower.noise.force=20 mN", "arms.lower.noise.drift=1")
    of_quiet = quiet.reset(3).arms["lower"].wrench
    first, again, other = (rig.reset(seed).arms["lower"].wrench - of_quiet for seed in (3, 3, 4))
    assert (first == again).all() and (first[:3] != other[:3]).all()
    assert 0 < np.abs(first[:3]).max() < 5 * 0.02 and (first[3:] == 0).all()
    assert (rig.reset(3).arms["upper"].wrench == quiet.reset(3).arms["upper"].wrench).all()
