"""Guards refuse with a reason, or shorten and show it."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tacsim import pose as se3
from tacsim.interface import Action, Pose
from tacsim.limits import (
    ROUNDING,
    ActionError,
    box_region,
    check_action,
    clip_to_region,
    exceeds_wrench,
    finite_targets,
    fraction_clear,
    fraction_inside,
    joint_speed_ratio,
    limit_step,
    stopping_position,
)
from tests.promises import Record

START = se3.from_rotation_vector([0.1, -0.2, 0.3], [0.4, 0.0, 0.0])
ARMS = ("lower", "upper")


def moved(shift: list[float], turn: list[float]) -> Pose:
    """START, shifted and turned in the outer axes."""
    return Pose(START.position + shift, se3.compose(se3.from_rotation_vector([0, 0, 0], turn), START).quaternion)


def test_a_motion_within_the_limits_is_returned_itself() -> None:
    target = moved([0.3e-3, 0.0, -0.4e-3], [0.0, 0.02, 0.0])
    assert limit_step(target, START, 0.5e-3, 0.02) is target
    assert limit_step(START, START, 0.5e-3, 0.02) is START


@pytest.mark.parametrize(
    ("longest", "widest", "share"), [(0.25e-3, 1.0, 0.5), (1.0, 0.005, 0.25), (0.25e-3, 0.005, 0.25)]
)
def test_a_longer_motion_is_cut_on_the_straight_way(longest: float, widest: float, share: float) -> None:
    """The tighter limit shortens shift and turn alike, so that the way stays straight."""
    target = moved([0.3e-3, 0.0, -0.4e-3], [0.0, 0.02, 0.0])
    sent = limit_step(target, START, longest, widest)
    assert np.allclose(sent.position - START.position, share * np.array([0.3e-3, 0, -0.4e-3]), atol=1e-12)
    assert np.allclose(se3.pose_difference(START, sent)[3:], [0.0, share * 0.02, 0.0], atol=1e-9)


@given(
    st.lists(st.floats(-0.1, 0.1), min_size=3, max_size=3),
    st.lists(st.floats(-1.5, 1.5), min_size=3, max_size=3),
    st.floats(1e-4, 0.2),
    st.floats(1e-3, 3.0),
)
def test_what_is_sent_never_exceeds_a_limit(
    shift: list[float], turn: list[float], longest: float, widest: float
) -> None:
    target = moved(shift, turn)
    sent = limit_step(target, START, longest, widest)
    metres, radians = se3.pose_distance(START, sent)
    assert metres <= longest * (1 + 1e-6)
    assert radians <= widest + 1e-6
    if sent is not target:  # nothing was given away: one limit is used up
        assert metres >= longest * (1 - 1e-6) or radians >= widest - 1e-6


def test_a_good_action_passes() -> None:
    action = Action({"upper": START, "lower": None})
    assert check_action(action, ARMS, "bench") is action
    assert check_action(Action(), ARMS, "bench").tool == {}


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (Action({"left": START}), "action for 'left', but rig 'bench' moves only: lower, upper"),
        (
            Action({"upper": [0.0, 0.0, 0.0]}),
            r"action for 'upper' must be a tacsim.Pose or None \(holds\), got \[",
        ),  # type: ignore[dict-item]
        ({"upper": START}, r"rig 'bench' takes a tacsim.Action, got dict"),
        (None, "got NoneType"),
        (Action([START]), "Action.tool must map arm names to poses of the sensor.*got list"),  # type: ignore[arg-type]
        (Action({"upper": Pose(np.array([0.0, 1e308, 0.0]))}), "target of arm 'upper' is at .* more than 1000 m"),
    ],
)
def test_what_a_rig_cannot_take_is_refused(action: object, message: str) -> None:
    with pytest.raises(ActionError, match=message):
        check_action(action, ARMS, "bench")


def test_a_pose_that_is_not_finite_cannot_even_be_made() -> None:
    for bad in (math.nan, math.inf):
        with pytest.raises(ValueError, match="finite"):
            Pose(np.array([0.0, bad, 0.0]))


BOX = ([-0.1, -0.2, 0.0], [0.1, 0.2, 0.3])
SLOPE = box_region(*BOX, planes=[([0.0, 0.0, 0.1], [1.0, 0.0, 1.0])])  # keeps x + z >= 0.1
points = st.tuples(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5), st.floats(-0.5, 0.5)).map(np.array)


def hostile(number: int, seed: int = 0) -> np.ndarray:
    """(number, 7) rows in the shape of poses: sound ones, NaN, infinities, huge numbers, lengths that are wrong."""
    rng = np.random.default_rng(seed)
    rows = np.concatenate([rng.uniform(-2, 2, (number, 3)), rng.normal(size=(number, 4))], axis=1)
    rows[:, 3:] /= np.linalg.norm(rows[:, 3:], axis=1, keepdims=True)
    poison = np.array([np.nan, np.inf, -np.inf, 1e308, -1e308, 1e200, 1e4, 5e-324])
    bad = rng.random(number) < 0.5
    rows[bad, rng.integers(0, 7, number)[bad]] = rng.choice(poison, number)[bad]
    return rows


@pytest.mark.promise(1)
def test_a_million_hostile_targets_none_passes_that_is_no_pose() -> None:
    rows = hostile(1_000_000)
    passed = rows[finite_targets(rows)]
    assert 0.4e6 < len(passed) < 0.7e6  # the sound half, and those poisoned with a number so small that it does no harm
    assert np.isfinite(passed).all()
    assert np.abs(passed[:, :3]).max() <= 1e3
    assert np.abs(np.linalg.norm(passed[:, 3:], axis=1) - 1.0).max() <= 1e-3
    for row in passed[:1000]:
        Pose(row[:3], row[3:])  # raises for what is no pose


@pytest.mark.parametrize("bad", [None, "up", [1, 2, 3], np.zeros(6), [[0.0] * 7, [0.0] * 6], 3.0, [], [1j] * 7])
def test_what_has_the_wrong_shape_is_no_target(bad: object) -> None:
    assert not finite_targets(bad).any()  # type: ignore[arg-type]


@pytest.mark.slow
def test_many_hostile_targets_are_refused_or_shortened_into_the_box() -> None:
    """What is admitted ends in the box, on the straight way."""
    now = Pose(np.array([0.05, 0.0, 0.15]))
    rows = hostile(5_000, seed=1)
    shortened = 0
    for row in rows[finite_targets(rows)]:
        wanted = Pose(row[:3], row[3:])
        sent, share = clip_to_region(wanted, now, SLOPE)
        assert SLOPE.excess(sent.position) <= 1e-9
        assert (sent is wanted) == (share == 1.0)
        shortened += share < 1.0
        way, whole = sent.position - now.position, wanted.position - now.position
        assert np.allclose(way, share * whole, atol=1e-9)
    assert shortened > 1_000


@pytest.mark.slow
@pytest.mark.promise(1)
def test_a_million_hostile_ways_end_inside(figure: Record) -> None:
    rows = hostile(1_000_000, seed=2)
    ends = rows[finite_targets(rows), :3]
    starts = np.random.default_rng(2).uniform([0.0, -0.2, 0.1], BOX[1], ends.shape)  # on the free side of the slope
    shares = fraction_inside(starts, ends, SLOPE)
    assert ((shares >= 0.0) & (shares <= 1.0)).all()
    assert (shares < 1.0).sum() > 100_000
    excess = SLOPE.excess(starts + shares[:, None] * (ends - starts))
    figure("of 1,000,000 hostile actions through the guard, outside", (~(excess <= ROUNDING)).sum())
    assert excess.max() <= 1e-9
    some = range(0, len(ends), 5_000)
    assert [fraction_inside(starts[k], ends[k], SLOPE) for k in some] == pytest.approx(shares[some].tolist(), abs=1e-12)


@given(points, points)
def test_the_way_inside_is_as_long_as_can_be(start: np.ndarray, end: np.ndarray) -> None:
    share = fraction_inside(start, end, SLOPE)
    if SLOPE.excess(start) <= 0:
        last = start + share * (end - start)
        assert SLOPE.excess(last) <= 1e-8
        if share < 1.0:
            assert SLOPE.excess(start + min(1.0, share + 1e-3) * (end - start)) > 0
    else:  # from outside, only a way in
        assert share == (1.0 if SLOPE.excess(end) <= 1e-9 else share)
        if SLOPE.excess(end) > SLOPE.excess(start) + 1e-6:
            assert share < 1.0


@given(points, points, points, st.floats(0.01, 0.3))
def test_the_way_keeps_clear_of_a_sphere(
    start: np.ndarray, end: np.ndarray, centre: np.ndarray, distance: float
) -> None:
    share = fraction_clear(start, end, centre, distance)
    begin = float(np.linalg.norm(start - centre))
    for s in np.linspace(0.0, share, 20):
        assert np.linalg.norm(start + s * (end - start) - centre) >= min(distance, begin) - 1e-7
    if share < 1.0 and begin > distance:
        beyond = start + min(1.0, share + 1e-3) * (end - start)
        assert np.linalg.norm(beyond - centre) < distance + 1e-6


def test_a_region_says_which_wall_is_broken() -> None:
    assert SLOPE.violated_face([0.05, 0.0, 0.15]) == ""
    assert "2 mm beyond the workspace's upper x = 0.1 m" in SLOPE.violated_face([0.102, 0.0, 0.15])
    assert "beyond plane 0" in SLOPE.violated_face([-0.05, 0.0, 0.05])
    with pytest.raises(ValueError, match="plane 0 has no normal"):
        box_region(*BOX, planes=[([0, 0, 0], [0, 0, 0])])
    with pytest.raises(ValueError, match="lower to an upper corner"):
        box_region(BOX[1], BOX[0])


def test_braking_ends_where_the_speed_is_spent() -> None:
    assert np.allclose(stopping_position([0, 0, 0.1], [0, 0, -0.1], 0.5), [0, 0, 0.09])
    assert np.allclose(stopping_position([0, 0, 0.1], [0, 0, 0], 0.5), [0, 0, 0.1])


def test_loads_and_steps_that_are_too_large_or_no_numbers() -> None:
    assert not exceeds_wrench([3.0, 0, 4.0, 0, 0, 1.0], 5.0, 1.0)
    assert exceeds_wrench([3.0, 0, 4.1, 0, 0, 0.0], 5.0, 1.0)
    assert exceeds_wrench([0, 0, 0, 0.8, 0, 0.8], 5.0, 1.0)
    assert exceeds_wrench([math.nan, 0, 0, 0, 0, 0], 5.0, 1.0) and exceeds_wrench([0, 0, 0, 0, math.nan, 0], 5.0, 1.0)
    assert joint_speed_ratio(np.zeros(6), [0, 0, -0.002, 0, 0, 0.001], 1.0, 2e-3) == pytest.approx(1.0)
    assert joint_speed_ratio(np.zeros(6), [0, 0, math.nan, 0, 0, 0], 1.0, 2e-3) == math.inf
