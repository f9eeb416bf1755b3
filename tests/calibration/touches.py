"""Made-up touches of a fixed ball, with hidden truth."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from calibration.poses.ball_touch import BallTouch
from tacsim import pose as se3
from tacsim.interface import Pose

BALL_RADIUS = 4e-3
NOISE = (0.03e-3, 0.05e-3, 0.05e-3)  # of centre, depth, robot [m]


def posed(rotation: Rotation, position: object) -> Pose:
    return Pose(np.array(position, dtype=np.float64), rotation.as_quat())


def made_touches(
    random: np.random.Generator, number: int = 24, tilt: float = 25.0, noise: tuple[float, float, float] = NOISE
) -> tuple[list[BallTouch], Pose, np.ndarray]:
    """Touches, tool_from_sensor, and the ball's centre [m]. `tilt`: standard deviation about each axis [degrees]."""
    sensor = posed(Rotation.from_rotvec(np.array([0.2, -0.1, 0.4]) + 0.05 * random.normal(size=3)), [1e-3, 2e-3, 60e-3])
    ball = np.array([0.4, 0.1, 0.05])
    touches = []
    for _ in range(number):
        seen = np.array([random.uniform(-7e-3, 7e-3), random.uniform(-5e-3, 5e-3), random.uniform(2e-3, 2.7e-3)])
        turn = Rotation.from_rotvec(np.radians(tilt) * random.normal(size=3))
        tool = ball - turn.apply(se3.transform(sensor, seen)) + noise[2] * random.normal(size=3)
        seen = seen + np.array([noise[0], noise[0], noise[1]]) * random.normal(size=3)
        touches.append(BallTouch(posed(turn, tool), (float(seen[0]), float(seen[1])), BALL_RADIUS - float(seen[2])))
    return touches, sensor, ball
