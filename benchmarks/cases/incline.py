"""Squeeze group: a block on a tilted gel under its weight alone. Coulomb's law gives the angle at which it slides."""

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
# Ten times that of the earth [m/s^2], so that a block just beyond the limit moves a measurable distance; not more,
# because the front edge of a heavy block sinks in and tilts it: at 2,000 m/s^2 (10 kPa) it slides from 0.98 of the
# friction on.
FIELD = 100.0
BLOCK = Body(geometry=Box(size=(6e-3, 6e-3, 3e-3)), material=BodyMaterial())  # elastic
LIFT = 0.5e-3  # of the other gel, to remove its contact [m]
HALF = 500  # substeps to settle, and the same number to measure
STILL = 1e-6  # a block that moves less in the second half sticks [m]
BRACKET, STEPS = (0.97, 1.03), 4  # tan(tilt) / friction, and number of bisections
STEEP = 1.1  # tan(tilt) / friction at which the block slides with certainty


def on_incline(slope: float) -> tuple[World, float]:
    """A block released on the lower gel, with gravity tilted towards x by tan(tilt) = `slope`, for HALF substeps twice.

    Returns the world and the displacement of the block in the second half [m]. The damping of the solver also damps the
    slide, so its speed has no meaning here; only the fact that the block moves, and the ratio of forces, do.
    """
    tilt = float(np.arctan(slope))
    world = make_world(
        Scene(
            gel=Gel(size=(12e-3, 12e-3, 4e-3), housing=None),
            body=BLOCK,
            friction={"lower": FRICTION, "upper": FRICTION},
            gravity=(FIELD * np.sin(tilt), 0.0, -FIELD * np.cos(tilt)),
            settling=Settling(tolerance=1e-9, max_substeps=HALF),  # never reached: both halves have full length
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
    """tan(tilt) / friction at which the block begins to slide, by bisection: the centre and half the last bracket.

    Raises RuntimeError if the limit is outside the bracket.
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
    """A block on a tilted gel: the slope at which it begins to slide, and its ratio of forces while it slides."""
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
