import numpy as np
import pytest

from calibration.markers.tracker import DotTracker
from tests.calibration.dotted import lattice_points

PITCH = 1.5
REST = lattice_points(9, 11, PITCH).reshape(-1, 2)


def drag(far: tuple[float, float], width: float = 4.0, centre: tuple[float, float] = (0.7, 0.0)) -> np.ndarray:
    """(n, 2) displacement of a gel dragged along at one place, held at its border."""
    return np.exp(-((REST - centre) ** 2).sum(axis=1) / width**2)[:, None] * np.array(far)


def seen_points(
    moved: np.ndarray, rng: np.random.Generator, lost: float = 0.0, dirt: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Points in any order, and (n,) which dots are among them."""
    there = rng.random(len(REST)) >= lost
    points = (REST + moved + rng.normal(0, 3e-3, REST.shape))[there]
    return rng.permutation(np.concatenate([points, rng.uniform(-9, 9, (dirt, 2))])), there


def wrong(
    tracker: DotTracker, points: np.ndarray, there: np.ndarray, moved: np.ndarray, ahead: int = 1
) -> tuple[int, int]:
    """How many dots that are there were taken for another or not found, and how many were found."""
    found = tracker(points, ahead)
    assert np.isfinite(found.displacement).all()
    error = np.linalg.norm(found.displacement - moved, axis=1)
    return int((error[found.visible & there] > 0.1).sum()), int((found.visible & there).sum())


@pytest.mark.parametrize(("lost", "dirt", "least"), [(0.0, 0, 1.0), (0.1, 3, 0.99), (0.3, 0, 0.98)])
def test_dots_are_followed_over_more_than_a_pitch(lost: float, dirt: int, least: float) -> None:
    for seed in range(5):
        rng = np.random.default_rng(seed)
        tracker = DotTracker(REST, PITCH)
        for step in range(13):
            moved = drag((0.15 * step, 0.05 * step))
            points, there = seen_points(moved, rng, lost, dirt)
            bad, found = wrong(tracker, points, there, moved)
            assert bad == 0
            assert found >= least * there.sum() - 1
        assert np.linalg.norm(moved, axis=1).max() > PITCH


def test_prediction_carries_over_more_than_half_a_pitch_a_frame() -> None:
    """Also in a lattice without borders to go by: every dot has a neighbour's place to be mistaken for."""
    tracker = DotTracker(REST, PITCH)
    rng = np.random.default_rng(0)
    at = 0.0
    for speed in (0.2, 0.45, 0.8, 1.1, 1.2):  # [mm a frame], up to 0.8 pitches
        at += speed
        moved = np.full_like(REST, (at, 0.0))
        more = lattice_points(9, 31, PITCH).reshape(-1, 2) + (at, 0.0)  # dots that come into view on both sides
        found = tracker(rng.permutation(more))
        np.testing.assert_allclose(found.displacement, moved, atol=1e-9)


@pytest.mark.parametrize("jump", [(1.5, 0.0), (2.25, 0.0), (-2.25, 1.4), (0.8, 0.7)])
@pytest.mark.parametrize("lost", [0.0, 0.3])
def test_a_jump_of_the_whole_lattice_does_not_mislabel(jump: tuple[float, float], lost: float) -> None:
    for seed in range(3):
        rng = np.random.default_rng(seed)
        tracker = DotTracker(REST, PITCH)
        moved = np.full_like(REST, jump)
        points, there = seen_points(moved, rng, lost)
        bad, found = wrong(tracker, points, there, moved, ahead=40)
        assert bad == 0
        assert found > 0.9 * there.sum()


@pytest.mark.parametrize("far", [(1.2, 0.3), (2.2, 0.6), (-1.0, 1.8)])
def test_a_sudden_drag_of_up_to_one_and_a_half_pitches_does_not_mislabel(far: tuple[float, float]) -> None:
    rng = np.random.default_rng(0)
    moved = drag(far)
    points, there = seen_points(moved, rng)
    bad, found = wrong(DotTracker(REST, PITCH), points, there, moved)
    assert bad == 0
    assert found > 0.95 * there.sum()


def test_a_lost_dot_moves_with_its_neighbours_and_is_known_when_it_comes_back() -> None:
    tracker = DotTracker(REST, PITCH)
    gone = 49
    for step in range(10):
        moved = drag((0.2 * step, 0.0))
        points = REST + moved
        found = tracker(points if step in (0, 9) else np.delete(points, gone, axis=0))
        assert found.visible[gone] == (step in (0, 9))
        assert found.visible.sum() == 99 - (step not in (0, 9))
        # what a mean over those round it, 1.5 mm away, misses of a bump 4 mm wide
        assert np.linalg.norm(found.displacement[gone] - moved[gone]) <= 0.25 * np.linalg.norm(moved[gone])


def test_the_same_frame_again_changes_nothing_and_keeps_the_velocity() -> None:
    tracker = DotTracker(REST, PITCH)
    for step in range(1, 4):
        moved = np.full_like(REST, (0.6 * step, 0.0))
        more = lattice_points(9, 31, PITCH).reshape(-1, 2) + moved[0]
        for ahead in (1, 0, 0):
            np.testing.assert_allclose(tracker(more, ahead).displacement, moved, atol=1e-9)


def test_nothing_seen_keeps_the_last_and_says_so() -> None:
    tracker = DotTracker(REST, PITCH)
    tracker(REST + 0.2)
    blind = tracker(np.zeros((0, 2)))
    assert blind.visible_share == 0.0
    np.testing.assert_allclose(blind.displacement, 0.2)
    tracker.reset()
    np.testing.assert_allclose(tracker(np.zeros((0, 2))).displacement, 0.0)


def test_too_few_or_scattered_dots_are_refused() -> None:
    with pytest.raises(ValueError, match="3 dots are no lattice"):
        DotTracker(REST[:3], PITCH)
    with pytest.raises(ValueError, match=r"no neighbour within 2\.4"):
        DotTracker(REST * 3, PITCH)


def test_a_drag_that_snaps_back_is_followed_by_what_the_neighbours_do() -> None:
    """The fastest dot is then almost half a pitch from where its velocity would have it."""
    tracker = DotTracker(REST, PITCH)
    for far in (0.3, 0.6, 0.9, 0.5, 0.0):
        found = tracker(REST + drag((far, 0.0), centre=(0.0, 0.0)))
        assert found.visible_share == 1.0
        np.testing.assert_allclose(found.displacement, drag((far, 0.0), centre=(0.0, 0.0)), atol=1e-9)


@pytest.mark.parametrize("gap", [2, 40])
def test_another_drag_after_a_gap_is_recognised_from_rest(gap: int) -> None:
    """Neither the last displacement nor a shift of it is near; the border of the gel has hardly moved from rest."""
    for seed in range(3):
        rng = np.random.default_rng(seed)
        tracker = DotTracker(REST, PITCH)
        for step in range(7):
            tracker(seen_points(drag((0.35 * step, 0.1 * step)), rng)[0])
        moved = drag((-1.2, 0.8), 4.0, (-2.0, -1.0))
        points, there = seen_points(moved, rng)
        assert wrong(tracker, points, there, moved, gap) == (0, len(REST))


def test_a_speck_where_a_dot_was_expected_is_not_taken_for_it() -> None:
    """Dust on the lens stays where the dot was; the dot itself has gone on with its neighbours."""
    moved = drag((0.5, 0.1))
    gone = np.flatnonzero(np.linalg.norm(moved, axis=1) > 0.25 * PITCH)
    assert len(gone) > 5
    for dot in gone[::3]:
        rng = np.random.default_rng(int(dot))
        points, there = seen_points(moved, rng)
        bad, found = wrong(DotTracker(REST, PITCH), rng.permutation([*points, REST[dot]]), there, moved)
        assert (bad, found) == (0, len(REST))
