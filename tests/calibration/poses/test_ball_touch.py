"""tool_from_sensor from touches of one fixed ball: against hidden truth, and against the Cramer-Rao bound."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calibration.poses.ball_touch import BallTouch, fit_touches, locate_ball
from calibration.poses.robust_fit import BadMeasurements, angular_spread
from tacsim import pose as se3
from tests.calibration.touches import BALL_RADIUS, made_touches, posed


def test_without_noise_the_truth_comes_back_from_any_mounting() -> None:
    for turned in Rotation.random(4, rng=np.random.default_rng(0)):
        touches, sensor, ball = made_touches(np.random.default_rng(1), 8, noise=(0.0, 0.0, 0.0))
        # another tool frame: the same touches of a sensor that is mounted quite differently
        other = posed(turned, [0.05, -0.02, 0.1])
        perturbed = [replace(touch, tool=se3.compose(touch.tool, se3.inverse(other))) for touch in touches]
        fit = fit_touches(perturbed, BALL_RADIUS)
        metres, radians = se3.pose_distance(fit.tool_from_sensor, se3.compose(other, sensor))
        assert metres < 1e-8 and radians < 1e-6
        np.testing.assert_allclose(fit.ball, ball, atol=1e-8)
        assert all(fit.used)


@pytest.mark.slow
def test_errors_are_those_of_the_bound_and_as_stated() -> None:
    errors = []
    for seed in range(25):
        touches, sensor, _ = made_touches(np.random.default_rng(seed))
        fit = fit_touches(touches, BALL_RADIUS)
        errors.append(
            (*se3.pose_distance(fit.tool_from_sensor, sensor), *fit.best_deviation, *fit.deviation, fit.scatter)
        )
        assert all(fit.used)
    metres, radians, best, best_turn, stated, stated_turn, scatter = np.sqrt((np.array(errors) ** 2).mean(axis=0))
    # 25 sets of 3 axes each: a ratio has a standard deviation of 8 to 12 %
    assert metres / best < 1.3 and radians / best_turn < 1.3
    assert metres / best > 0.75 and radians / best_turn > 0.75
    assert best <= stated < 1.1 * best and best_turn <= stated_turn < 1.1 * best_turn
    assert scatter == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize("off", [1.5e-3, 0.5e-3, 20e-3])
def test_one_bad_touch_is_found_and_left_out(off: float) -> None:
    touches, sensor, _ = made_touches(np.random.default_rng(3))
    bad = touches[5]
    touches[5] = replace(bad, contact=(bad.contact[0] + off, bad.contact[1]))
    fit = fit_touches(touches, BALL_RADIUS)
    assert [i for i, used in enumerate(fit.used) if not used] == [5]
    metres, radians = se3.pose_distance(fit.tool_from_sensor, sensor)
    assert metres < 0.12e-3 and np.degrees(radians) < 1.2
    assert abs(abs(fit.residuals[5, 0]) - off) < 0.2e-3  # the table says by how much


def test_a_wrong_radius_goes_along_the_sensors_axis_and_nowhere_else() -> None:
    touches, _, _ = made_touches(np.random.default_rng(4))
    right, wrong = (fit_touches(touches, radius) for radius in (BALL_RADIUS, BALL_RADIUS + 0.3e-3))
    shift = se3.relative_pose(right.tool_from_sensor, wrong.tool_from_sensor)
    np.testing.assert_allclose(shift.position, [0, 0, -0.3e-3], atol=1e-6)
    assert wrong.scatter == pytest.approx(right.scatter, rel=1e-3)


def _alike(touches: list[BallTouch], **what: object) -> list[BallTouch]:
    return [replace(touch, **what) for touch in touches]  # type: ignore[arg-type]


def test_what_tells_too_little_is_refused() -> None:
    touches, _, _ = made_touches(np.random.default_rng(5))
    with pytest.raises(BadMeasurements, match="5 touches are too few; at least 6"):
        fit_touches(touches[:5], BALL_RADIUS)
    flat, _, _ = made_touches(np.random.default_rng(5), tilt=1.0)
    with pytest.raises(BadMeasurements, match="tilts differ too little"):
        fit_touches(flat, BALL_RADIUS)
    one_axis = [
        replace(touch, tool=posed(Rotation.from_rotvec([angle, 0, 0]), touch.tool.position))
        for touch, angle in zip(touches, np.linspace(-0.8, 0.8, len(touches)), strict=True)
    ]
    with pytest.raises(BadMeasurements, match="tilts differ too little"):
        fit_touches(one_axis, BALL_RADIUS)
    with pytest.raises(BadMeasurements, match="too near to a point or a line"):
        fit_touches(_alike(touches, contact=(1e-3, 0.0)), BALL_RADIUS)
    on_a_line = [replace(touch, contact=(touch.contact[0], 2 * touch.contact[0])) for touch in touches]
    with pytest.raises(BadMeasurements, match="too near to a point or a line"):
        fit_touches(on_a_line, BALL_RADIUS)


def test_a_ball_that_moves_and_millimetres_by_mistake_are_refused() -> None:
    touches, _, _ = made_touches(np.random.default_rng(6))
    random = np.random.default_rng(0)
    rolling = [
        replace(touch, tool=replace(touch.tool, position=touch.tool.position + 1e-3 * random.normal(size=3)))
        for touch in touches
    ]
    with pytest.raises(BadMeasurements, match="disagree"):
        fit_touches(rolling, BALL_RADIUS)
    with pytest.raises(BadMeasurements, match="disagree"):
        fit_touches(_scaled(touches), BALL_RADIUS)


def _scaled(touches: list[BallTouch]) -> list[BallTouch]:
    return [replace(touch, tool=replace(touch.tool, position=1e3 * touch.tool.position)) for touch in touches]


def test_swing_is_that_of_the_direction_that_turns_least() -> None:
    angles = np.radians(30.0) * np.sqrt(3.0) * np.linspace(-1, 1, 401)
    assert angular_spread(Rotation.from_rotvec(np.outer(angles, [0, 1, 0])).as_matrix()) == pytest.approx(0.0, abs=1e-6)
    both = np.concatenate([np.outer(angles, [1, 0, 0]), np.outer(angles, [0, 1, 0])]) / 10.0
    assert np.degrees(angular_spread(Rotation.from_rotvec(both).as_matrix())) == pytest.approx(
        3.0 / np.sqrt(2.0), rel=0.02
    )


GRID = np.stack(np.meshgrid(*(0.25e-3 * (np.arange(64) - 31.5),) * 2), axis=-1)
EVERYWHERE = np.ones((64, 64), dtype=bool)


def _hertz(x: float, y: float, depth: float, ball: float) -> np.ndarray:
    """The surface of an elastic half-space under a ball (Johnson 1985, eq. 3.42a), on GRID [m]."""
    r = np.hypot(GRID[..., 0] - x, GRID[..., 1] - y)
    contact = np.sqrt(ball * depth)
    q = np.maximum(r / contact, 1.0)
    outside = depth / np.pi * ((2 - q * q) * np.arcsin(1 / q) + np.sqrt(q * q - 1))
    return np.where(r < contact, depth - r * r / (2 * ball), outside)


@pytest.mark.parametrize(("x", "y", "depth"), [(0.0, 0.0, 0.4e-3), (2.13e-3, -1.57e-3, 0.3e-3), (-3e-3, 1e-3, 0.8e-3)])
def test_the_ball_is_found_in_the_surface(x: float, y: float, depth: float) -> None:
    noise = 5e-6 * np.random.default_rng(0).normal(size=(64, 64))
    (found_x, found_y), found = locate_ball(_hertz(x, y, depth, BALL_RADIUS) + noise, EVERYWHERE, 0.25e-3, BALL_RADIUS)
    assert np.hypot(found_x - x, found_y - y) < 0.02e-3
    assert found == pytest.approx(depth, rel=0.02)


def test_what_is_no_ball_or_not_wholly_seen_is_refused() -> None:
    surface = _hertz(0.0, 0.0, 0.4e-3, BALL_RADIUS)
    with pytest.raises(BadMeasurements, match="no contact in the gel"):
        locate_ball(0.0 * surface, EVERYWHERE, 0.25e-3, BALL_RADIUS)
    with pytest.raises(BadMeasurements, match="reaches the border"):
        locate_ball(_hertz(7.5e-3, 0.0, 0.4e-3, BALL_RADIUS), EVERYWHERE, 0.25e-3, BALL_RADIUS)
    box = 0.4e-3 * (np.abs(GRID) < (3e-3, 1e-3)).all(axis=-1)
    with pytest.raises(BadMeasurements, match="not that of a ball of 4 mm"):
        locate_ball(box, EVERYWHERE, 0.25e-3, BALL_RADIUS)
    with pytest.raises(BadMeasurements, match="press deeper"):
        locate_ball(np.where(np.abs(GRID).max(axis=-1) < 0.3e-3, 1e-4, 0.0), EVERYWHERE, 0.25e-3, BALL_RADIUS)
