"""Each sent pose keeps the limits exactly; the target is reached from any motion, and walls hold."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robot.arm.trajectory import (
    PERIOD,
    MotionState,
    find_stopping_point,
    max_landing_speed,
    motion_at_rest,
    step_braking,
    step_towards,
    stopping_distance,
)
from robot.common.kinematics import rotation, rotation_vector
from tacsim.limits import box_region

BOX = box_region([-0.1, -0.1, -0.1], [0.1, 0.1, 0.1], planes=[([0, 0, 0.12], [-1.0, 0.0, -1.0])])
inside = st.tuples(*[st.floats(-0.1, 0.1)] * 3).map(np.array).filter(lambda point: bool(BOX.excess(point) <= 0))
turns = st.tuples(*[st.floats(-1.5, 1.5)] * 3).map(np.array)
rates = st.builds(
    SimpleNamespace,
    speed=st.floats(1e-3, 1.0),
    acceleration=st.floats(0.05, 10.0),
    turn_rate=st.floats(0.01, 3.0),
    turn_acceleration=st.floats(0.1, 50.0),
)


def stays_inside(limits: SimpleNamespace) -> Callable[[MotionState], bool]:
    return lambda motion: bool(BOX.excess(find_stopping_point(motion, limits.acceleration)) <= 1e-9)


def check_step(before: MotionState, after: MotionState, limits: SimpleNamespace) -> None:
    """The poses themselves, not what the planner says of them."""
    moved, turned = after.position - before.position, rotation_vector(after.rotation @ before.rotation.T)
    assert np.abs(moved - after.velocity * PERIOD).max() <= 1e-12
    assert np.abs(turned - after.spin * PERIOD).max() <= 1e-9
    assert np.linalg.norm(after.velocity) <= limits.speed * (1 + 1e-9)
    assert np.linalg.norm(after.spin) <= limits.turn_rate * (1 + 1e-9)
    assert np.linalg.norm(after.velocity - before.velocity) <= limits.acceleration * PERIOD * (1 + 1e-9)
    assert np.linalg.norm(after.spin - before.spin) <= limits.turn_acceleration * PERIOD * (1 + 1e-9)


def drive(
    motion: MotionState, position: np.ndarray, turn: np.ndarray, limits: SimpleNamespace, steps: int
) -> list[MotionState]:
    """Up to `steps` periods towards a target, or until it is reached at rest."""
    path = [motion]
    for _ in range(steps):
        path.append(step_towards(path[-1], position, rotation(turn), limits, stays_inside(limits)))
        check_step(path[-2], path[-1], limits)
        if path[-1].is_at_rest and (path[-1].position == position).all():
            break
    return path


@pytest.mark.slow
@settings(deadline=None, max_examples=30)
@given(inside, inside, turns, rates)
def test_step_towards_from_rest_reaches_target_without_overshoot(
    start: np.ndarray, end: np.ndarray, turn: np.ndarray, limits: SimpleNamespace
) -> None:
    quick = SimpleNamespace(**{**vars(limits), "speed": max(limits.speed, 0.05), "turn_rate": 3.0})
    path = drive(motion_at_rest(start, np.eye(3)), end, turn, quick, 20_000)
    assert (path[-1].position == end).all() and path[-1].is_at_rest
    assert np.allclose(path[-1].rotation, rotation(turn), atol=1e-12)
    way = end - start
    length = np.linalg.norm(way)
    if length > 1e-6:
        along = np.array([(motion.position - start) @ way / length for motion in path])
        assert (np.diff(along) >= -1e-12).all() and along.max() <= length + 1e-12
        aside = [np.linalg.norm(m.position - start - a * way / length) for m, a in zip(path, along, strict=True)]
        assert max(aside) < 1e-9
        # Nothing is given away: no slower than the best law of continuous time by more than a few periods.
        peak = min(quick.speed, np.sqrt(length * quick.acceleration))
        moving = sum(bool(motion.velocity.any()) for motion in path)
        assert moving * PERIOD <= length / peak + peak / quick.acceleration + 4 * PERIOD


@pytest.mark.slow
@pytest.mark.promise(2)
@settings(deadline=None, max_examples=30)
@given(inside, st.lists(st.tuples(inside, turns, st.integers(1, 120)), min_size=2, max_size=8), rates)
def test_step_towards_changing_target_stays_inside(
    start: np.ndarray, targets: list[tuple[np.ndarray, np.ndarray, int]], limits: SimpleNamespace
) -> None:
    motion = motion_at_rest(start, np.eye(3))
    for position, turn, steps in targets:
        for each in drive(motion, position, turn, limits, steps)[1:]:
            motion = each
            assert BOX.excess(motion.position) <= 1e-9
    position, turn, _ = targets[-1]
    slow = max(1.0 / limits.speed, np.sqrt(1.0 / limits.acceleration), 6.0 / limits.turn_rate)
    steps = int((2 * slow + 2.0 / limits.acceleration + 2.0) / PERIOD)
    if steps < 20_000:
        motion = drive(motion, position, turn, limits, steps)[-1]
        assert (motion.position == position).all()


def test_step_towards_without_wall_leaves_box() -> None:
    """Guards the test above: a turn at full speed close to a wall bulges out unless it is braked first."""
    limits = SimpleNamespace(speed=0.2, acceleration=0.5, turn_rate=1.0, turn_acceleration=5.0)
    worst = {True: -1.0, False: -1.0}
    for guarded in worst:
        motion = motion_at_rest(np.array([0.0, 0.0, 0.0]), np.eye(3))
        for k in range(2000):
            target = np.array([0.0, 0.0, -0.1]) if k < 280 else np.array([0.1, 0.1, -0.1])
            admissible = stays_inside(limits) if guarded else None
            motion = step_towards(motion, target, np.eye(3), limits, admissible)
            worst[guarded] = max(worst[guarded], float(BOX.excess(motion.position)))
    assert worst[True] <= 1e-9
    assert worst[False] > 1e-4


@given(st.floats(1e-9, 1.0), st.floats(0.01, 20.0))
def test_max_landing_speed_stops_exactly_at_distance(distance: float, acceleration: float) -> None:
    speed, covered, slowing = max_landing_speed(distance, acceleration), 0.0, acceleration * PERIOD
    while speed > 1e-12:
        covered += speed * PERIOD
        speed -= slowing
    assert speed >= -slowing * (1 + 1e-6)  # the last period too brakes no harder than allowed
    assert covered == pytest.approx(distance, rel=1e-6)


@pytest.mark.slow
@settings(deadline=None, max_examples=30)
@given(st.floats(0.0, 1.0), st.floats(0.05, 10.0), st.floats(0.0, 3.0))
def test_step_braking_stops_at_stopping_point(speed: float, deceleration: float, spin: float) -> None:
    limits = SimpleNamespace(speed=1.0, acceleration=deceleration, turn_rate=3.0, turn_acceleration=5.0)
    motion = MotionState(np.zeros(3), np.eye(3), np.array([0.0, 0.6, 0.8]) * speed, np.array([spin, 0.0, 0.0]))
    promised = find_stopping_point(motion, deceleration)
    assert stopping_distance(speed, deceleration) <= speed**2 / (2 * deceleration) + 1e-12
    for _ in range(20_000):
        before, motion = motion, step_braking(motion, deceleration, 5.0)
        check_step(before, motion, limits)
        assert np.allclose(find_stopping_point(motion, deceleration), promised, atol=1e-9)
        if motion.is_at_rest:
            break
    assert motion.is_at_rest
    assert np.allclose(motion.position, promised, atol=1e-9)
