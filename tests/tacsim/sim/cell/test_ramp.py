"""Paths of a control period."""

from __future__ import annotations

import numpy as np
import pytest

from tacsim.sim.cell.ramp import Ramp

PERIOD = 0.05


def plans(ways: list[float]) -> list[Ramp]:
    speed, found = np.zeros(2), list[Ramp]()
    for way in ways:
        found.append(Ramp.plan(np.array([way, -2 * way]), speed, PERIOD))
        speed = found[-1].speed(PERIOD)
    return found


@pytest.mark.parametrize("ways", [[1e-3], [1e-3, 1e-3, 0.0, -2e-3], [0.0, 5e-3]])
def test_a_period_ends_at_its_target(ways: list[float]) -> None:
    for plan, way in zip(plans(ways), ways, strict=True):
        assert plan.displacement(PERIOD) == pytest.approx([way, -2 * way], abs=1e-15)


def test_positions_and_speeds_have_no_jumps() -> None:
    plan, step = plans([1e-3, 2e-3])[1], 1e-5
    times = np.arange(0.0, PERIOD, step)
    places = np.array([plan.displacement(time) for time in times])
    speeds = np.array([plan.speed(time) for time in times])
    assert np.diff(places, axis=0) / step == pytest.approx((speeds[1:] + speeds[:-1]) / 2, abs=1e-6)
    assert np.abs(np.diff(speeds, axis=0)).max() < 0.1 * step / RISE_OF_SPEED


RISE_OF_SPEED = 0.01  # [s]


def test_the_same_way_again_and_again_becomes_an_even_motion_and_a_stop_rests() -> None:
    last = plans([1e-3] * 8 + [0.0] * 8)
    assert last[7].speed(0.01) == pytest.approx([0.02, -0.04], rel=1e-3)
    assert np.abs(last[7].change).max() < 1e-4
    assert np.abs(last[-1].speed(PERIOD)).max() < 1e-6
    overshoot = max(last[8].displacement(time)[0] for time in np.arange(0.0, PERIOD, 1e-3))
    assert 0 < overshoot < 0.15e-3
