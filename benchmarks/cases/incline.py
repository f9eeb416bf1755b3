"""Squeeze group: a block that only its weight holds on a tilted gel. Coulomb's law says when it slides."""

from __future__ import annotations

from functools import partial

import numpy as np

from benchmarks.harness.measure import Measurement, timed
from benchmarks.harness.runner import Case
from tacsim.interface import Pose
from tacsim.models.material import BodyMaterial
from tacsim.models.scene import Body, Box, Gel, Scene, Settling
from tacsim.physics.world import World, make_world

FRICTION = 0.5
# Ten times the earth's [m/s^2], so that a block just beyond the limit goes far enough to be seen to move; no more, for
# a heavy block's front edge sinks in, which turns it: at 2,000 m/s^2 (10 kPa) it slides from 0.98 of the friction on.
FIELD = 100.0
BLOCK = Body(geometry=Box(size=(6e-3, 6e-3, 3e-3)), material=BodyMaterial())  # elastic
LIFT = 0.5e-3  # of the other gel, out of the way [m]
HALF = 500  # substeps to land and come to rest, and again to watch
STILL = 1e-6  # a block that moves less while watched sticks [m]
BRACKET, STEPS = (0.97, 1.03), 4  # tan(tilt) / friction, and how often it is halved
STEEP = 1.1  # tan(tilt) / friction where the block slides for sure


def on_incline(slope: float) -> tuple[World, float]:
    """A block let go on the lower gel, gravity tilted towards x by tan(tilt) = `slope`; HALF substeps twice.

    Returns the world and how far the block went in the second half [m]. What brakes a body towards rest also brakes
    its slide, so speeds mean nothing here; whether it moves at all, and the ratio of forces, do.
    """
    tilt = float(np.arctan(slope))
    world = make_world(
        Scene(
            gel=Gel(size=(12e-3, 12e-3, 4e-3), housing=None),
            body=BLOCK,
            friction={"lower": FRICTION, "upper": FRICTION},
            gravity=(FIELD * np.sin(tilt), 0.0, -FIELD * np.cos(tilt)),
            settling=Settling(tolerance=1e-9, max_substeps=HALF),  # never settled: both halves at full length
        )
    )
    upper = world.pose("upper")
    world.move({"upper": Pose(upper.position + [0.0, 0.0, LIFT], upper.quaternion)})
    before = world.truth()
    world.move({})
    after = world.truth()
    assert before is not None and after is not None
    return world, float(np.linalg.norm(after.position - before.position))


def stick_limit() -> tuple[float, float]:
    """tan(tilt) / friction at which the block begins to slide, by bisection: the middle and half the last bracket.

    Raises RuntimeError when the limit lies outside the bracket.
    """
    low, high = BRACKET
    for end, sticks in ((low, True), (high, False)):
        moved = on_incline(end * FRICTION)[1]
        if (moved < STILL) != sticks:
            raise RuntimeError(f"at tan(tilt) = {end:g} of the friction the block moves {moved * 1e6:.3g} µm")
    for _ in range(STEPS):
        middle = (low + high) / 2
        low, high = (middle, high) if on_incline(middle * FRICTION)[1] < STILL else (low, middle)
    return (low + high) / 2, (high - low) / 2


def force_ratio(world: World) -> float:
    """Tangential over normal force on the lower gel."""
    wrench = world.wrench("lower")
    return float(np.hypot(wrench[0], wrench[1]) / -wrench[2])


def incline(repeat: int) -> list[Measurement]:
    """A block on a tilted gel: the slope at which it begins to slide, and its forces while it slides."""
    limit, width = stick_limit()
    timing, (world, moved) = timed(partial(on_incline, STEEP * FRICTION), repeat, warm=lambda: None)
    against = f"friction {FRICTION:g}, weight of {FIELD:g} m/s^2"
    return [
        Measurement(
            timing, abs(limit - 1) * 100, "%", against, "stick limit", 2 * HALF, {"resolution_percent": width * 100}
        ),
        Measurement(
            timing, abs(force_ratio(world) / FRICTION - 1) * 100, "%", against, "sliding force", 2 * HALF,
            {"moved_mm": moved * 1e3},
        ),
    ]  # fmt: skip


CASES = (Case("squeeze", "incline", "tacsim", "particles 0.5 mm, gel 1 mm", incline, long=True),)
