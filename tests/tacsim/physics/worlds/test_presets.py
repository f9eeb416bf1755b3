"""What each preset is worth, against a solver that shares nothing with ours.

Numbers: an axisymmetric elastoplastic cylinder (multiplicative Hencky strain, radial return; biquadratic elements of
0.5 mm) between two neo-Hookean gels, friction by penalty, gels as discs of the square's area. From elements of
0.5 to 0.25 mm its force changes by 0.3 %.
"""

from __future__ import annotations

import pytest

from tacsim.config import load_scene
from tacsim.interface import Pose
from tacsim.physics.world import make_world

CLOSED = (1e-3, 2e-3, 3e-3)  # both sensors together, from first touch [m]
FORCES, HEIGHTS = (2.054, 2.799, 3.137), (9.548e-3, 8.729e-3, 7.789e-3)  # [N], [m]


@pytest.mark.parametrize(("preset", "most"), [("learn", 0.20), ("draft", 0.06)])
def test_squeezed_cylinder_is_within_error_of_preset(preset: str, most: float) -> None:
    shape = "body.geometry={shape: cylinder, radius: 5 mm, height: 10 mm}"
    world = make_world(load_scene("squeeze", [f"preset={preset}", shape]))
    for by, force, height in zip(CLOSED, FORCES, HEIGHTS, strict=True):
        upper, lower = world.pose("upper"), world.pose("lower")
        gap = upper.position[2] - lower.position[2]
        step = [0.0, 0.0, (gap - (10e-3 - by)) / 2]
        stats = world.move(
            {
                "lower": Pose(lower.position + step, lower.quaternion),
                "upper": Pose(upper.position - step, upper.quaternion),
            }
        )
        truth = world.truth()
        assert stats.settled
        assert -world.wrench("lower")[2] == pytest.approx(force, rel=most)
        assert truth is not None
        assert truth.height == pytest.approx(height, rel=0.01)
