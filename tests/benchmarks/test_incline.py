"""A block on a tilted gel."""

from __future__ import annotations

import pytest

from benchmarks.cases.incline import FRICTION, STILL, force_ratio, on_incline


def test_a_block_sticks_below_the_limit_and_slides_above() -> None:
    assert FRICTION == 0.5
    world, moved = on_incline(0.495)
    assert moved < STILL
    assert force_ratio(world) == pytest.approx(0.495, rel=5e-3)  # its weight's own: at rest
    world, moved = on_incline(0.505)
    assert moved > STILL
    assert force_ratio(world) == pytest.approx(0.5, rel=1e-2)
