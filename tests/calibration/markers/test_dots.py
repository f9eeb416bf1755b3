"""Dots found in pictures, and the lattice in scattered points."""

import numpy as np
import pytest

from calibration.markers.dots import DotFinder, NoLattice, fill_from_neighbours, find_lattice
from tests.calibration.dotted import draw, lattice_points, uneven

MIDDLE = np.array([159.3, 119.8])


def found_near(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    """(n,) distance from each true dot to the nearest found one [px]."""
    return np.linalg.norm(true.reshape(-1, 2)[:, None] - found[None], axis=2).min(axis=1)


@pytest.mark.parametrize("radius", [2.5, 4.0, 7.0])
def test_centres_are_found_to_a_fraction_of_a_pixel(radius: float) -> None:
    true = lattice_points(6, 8, 5.3 * radius, angle=0.1) + MIDDLE
    dots = DotFinder(radius)(draw(true, radius, noise=1.0))
    assert len(dots.centres) == 48
    assert np.sqrt((found_near(dots.centres, true) ** 2).mean()) < 0.04
    assert dots.radius == pytest.approx(radius, rel=0.25)


def test_dots_are_found_in_uneven_light_and_across_a_step_of_it() -> None:
    true = lattice_points(8, 10, 25.0) + MIDDLE
    away = found_near(DotFinder(4.0)(draw(true, 4.0, light=uneven(), noise=1.5)).centres, true)
    assert (away < 0.5).all()
    assert np.median(away) < 0.05


def test_a_step_of_light_and_a_line_are_no_dots() -> None:
    light = uneven()
    light[:, 60:66] *= 0.4  # a scratch
    dots = DotFinder(4.0)(draw(np.zeros((0, 2)), 4.0, light=light, noise=1.5))
    assert len(dots.centres) == 0


def test_dots_of_other_sizes_are_found_and_specks_are_not() -> None:
    true = np.array([(60.0, 60.0), (150.0, 60.0), (240.0, 60.0)])
    image = np.minimum(draw(true[:1], 3.0), np.minimum(draw(true[1:2], 5.0), draw(true[2:], 7.5)))
    image = np.minimum(image, draw(np.array([(100.0, 150.0)]), 1.0))
    centres = DotFinder(5.0)(image).centres
    assert len(centres) == 3
    assert (found_near(centres, true) < 0.1).all()


def test_a_dot_on_a_dark_ridge_is_parted_from_it() -> None:
    """As between the ridges of a fingerprint: the lowest level joins both."""
    light = np.full((240, 320, 3), 150.0)
    light[:, 96:103] = 105.0
    true = np.array([(99.0, 80.0), (99.0, 160.0)])
    assert (found_near(DotFinder(5.0)(draw(true, 5.0, light=light)).centres, true) < 0.5).all()


def test_a_dark_or_empty_picture_shows_nothing() -> None:
    for level in (0, 90, 255):
        assert len(DotFinder(3.0)(np.full((60, 80, 3), level, dtype=np.uint8)).centres) == 0


def test_dots_too_small_to_be_found_are_refused() -> None:
    with pytest.raises(ValueError, match=r"radius 0\.9 px cannot be found"):
        DotFinder(0.9)


def shuffled(points: np.ndarray, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).permutation(points.reshape(-1, 2))


@pytest.mark.parametrize("angle", [-0.6, -0.2, 0.0, 0.35, 0.7])
def test_rows_and_columns_are_found_whatever_the_order_and_the_turn(angle: float) -> None:
    true = lattice_points(7, 9, 2.0, angle) + (0.3, -0.4)
    for shape, pitch in ((None, None), ((7, 9), 2.0)):
        lattice = find_lattice(shuffled(true), shape, pitch)
        np.testing.assert_allclose(lattice.positions, true, atol=1e-9)
        assert lattice.present.all()
        assert lattice.extra_points == 0
        assert lattice.pitch == pytest.approx(2.0)


def test_a_lattice_bent_as_by_a_wide_lens_keeps_its_rows() -> None:
    flat = lattice_points(11, 13, 1.0)
    true = flat * (1 + 0.004 * (flat**2).sum(axis=-1, keepdims=True))  # 1.7 times as wide in the corners
    np.testing.assert_allclose(find_lattice(shuffled(true)).positions, true, atol=1e-9)


def test_gaps_are_continued_and_strays_left_out() -> None:
    rng = np.random.default_rng(1)
    true = lattice_points(9, 11, 1.5, 0.15)
    gone = rng.random((9, 11)) < 0.15
    dirt = rng.uniform(-8, 8, (12, 2))
    lattice = find_lattice(rng.permutation(np.concatenate([true[~gone], dirt])), (9, 11), 1.5)
    assert np.abs(lattice.positions - true)[lattice.present].max() < 0.45  # dirt may sit where a dot is gone
    right = np.abs(lattice.positions - true).max(axis=2) < 0.05
    assert (right | gone).mean() > 0.97
    assert np.abs(lattice.positions - true).max() < 0.6


def test_of_a_larger_lattice_the_part_nearest_the_middle_is_taken() -> None:
    true = lattice_points(9, 11, 1.0)
    lattice = find_lattice(shuffled(true), (5, 5), 1.0)
    np.testing.assert_allclose(lattice.positions, true[2:7, 3:8], atol=1e-9)
    assert lattice.extra_points == 99 - 25


def test_what_is_no_lattice_is_refused() -> None:
    with pytest.raises(NoLattice, match="3 dots found"):
        find_lattice(np.array([(0.0, 0.0), (1.0, 0.0), (0.0, 1.0)]))
    with pytest.raises(NoLattice, match="no rows and columns"):
        find_lattice(np.stack([np.arange(8.0), np.zeros(8)], axis=1))
    with pytest.raises(NoLattice, match="no rows and columns"):
        find_lattice(lattice_points(5, 5, 2.0).reshape(-1, 2), (5, 5), 1.0)


def test_what_is_unknown_takes_the_mean_of_its_neighbours() -> None:
    values = np.arange(12.0).reshape(3, 4, 1)
    known = np.ones((3, 4), dtype=bool)
    known[1, 1] = False
    np.testing.assert_allclose(fill_from_neighbours(values, known), values)  # linear, so the mean is right
    known[:, 2:] = False
    assert np.isfinite(fill_from_neighbours(values, known)).all()
