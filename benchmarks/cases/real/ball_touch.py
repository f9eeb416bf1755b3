"""Real group: pose of a sensor on its arm, from synthetic touches of a ball with known truth; no frame is needed."""

from __future__ import annotations

from functools import partial

import numpy as np

from benchmarks.harness.measure import Measurement, timed
from benchmarks.harness.runner import Case
from tacsim import pose as se3
from tacsim.interface import Pose

CASE = "touch_ball"
BALL = 4e-3  # radius [m]
TILT = np.radians(25.0)  # standard deviation
SETS = 60  # of touches, for the root mean squares of the ratio


def touch_ball(touches: int, repeat: int) -> list[Measurement]:
    """Touches of one fixed ball at many tilts, with the noise that weights the fit."""
    from scipy.spatial.transform import Rotation

    from calibration.poses.ball_touch import BallTouch, TouchNoise, fit_touches

    rng, noise, ball = np.random.default_rng(0), TouchNoise(), np.array([0.4, 0.1, 0.05])

    def made_up() -> tuple[Pose, list[BallTouch]]:
        turn = Rotation.from_rotvec(np.array([0.2, -0.1, 0.4]) + 0.05 * rng.normal(size=3))
        mount = Pose(np.array([1e-3, 2e-3, 60e-3]), turn.as_quat())
        found = []
        for _ in range(touches):
            centre = np.array([rng.uniform(-7e-3, 7e-3), rng.uniform(-5e-3, 5e-3), rng.uniform(2e-3, 2.7e-3)])
            tilt = Rotation.from_rotvec(TILT * rng.normal(size=3))
            tool = ball - tilt.apply(se3.transform(mount, centre)) + noise.robot * rng.normal(size=3)
            x, y = centre[:2] + noise.centre * rng.normal(size=2)
            depth = BALL - centre[2] + noise.depth * rng.normal()
            found.append(BallTouch(Pose(tool, tilt.as_quat()), (float(x), float(y)), float(depth)))
        return mount, found

    errors, bounds = np.empty((SETS, 2)), np.empty((SETS, 2))
    for k in range(SETS):
        mount, found = made_up()
        fit = fit_touches(found, BALL)
        errors[k], bounds[k] = se3.pose_distance(fit.tool_from_sensor, mount), fit.best_deviation
    timing, _ = timed(lambda: fit_touches(found, BALL), repeat)
    ratios = np.sqrt((errors**2).mean(axis=0) / (bounds**2).mean(axis=0))
    millimetres, degrees = float(np.median(errors[:, 0])) * 1e3, float(np.degrees(np.median(errors[:, 1])))
    figures = {
        "bound_ratio": float(ratios.max()), "place_ratio": float(ratios[0]), "turn_ratio": float(ratios[1]),
        "degrees": degrees,
    }  # fmt: skip
    return [Measurement(timing, millimetres, "mm", "hidden truth, median", f"{SETS} sets", None, figures)]


CASES = (Case("real", CASE, "tacsim", "24 touches", partial(touch_ball, 24), long=True, cpu=True),)
