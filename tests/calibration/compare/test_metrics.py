"""Metrics against closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest

from calibration.compare import metrics

RNG = np.random.default_rng(0)
NOISE = RNG.integers(0, 256, (40, 50, 3)).astype(np.uint8)


def disc(x: float, y: float, radius: float, shape: tuple[int, int] = (120, 160)) -> np.ndarray:
    v, u = np.mgrid[: shape[0], : shape[1]]
    return np.hypot(u - x, v - y) <= radius


def test_a_constant_difference_has_known_errors() -> None:
    one = np.full((20, 30, 3), 100, dtype=np.uint8)
    other = one - 10  # uint8 must not wrap the other way round
    assert metrics.mean_absolute_error(one, other) == metrics.mean_absolute_error(other, one) == 10.0
    assert metrics.peak_signal_to_noise(one, other) == pytest.approx(20 * math.log10(255 / 10))
    # without variance SSIM is its luminance term alone
    c1 = (0.01 * 255) ** 2
    assert metrics.structural_similarity(one, other) == pytest.approx((2 * 100 * 90 + c1) / (100**2 + 90**2 + c1))


def test_equal_pictures_are_perfect() -> None:
    assert metrics.mean_absolute_error(NOISE, NOISE) == 0
    assert metrics.peak_signal_to_noise(NOISE, NOISE) == math.inf
    assert metrics.structural_similarity(NOISE, NOISE) == pytest.approx(1.0)


def test_similarity_is_the_published_formula_in_a_window() -> None:
    """Wang et al. 2004, one 7 x 7 window by hand, with the unbiased covariance."""
    one, other = (RNG.integers(0, 256, (15, 15, 3)).astype(np.uint8) for _ in range(2))
    c1, c2 = (0.01 * 255) ** 2, (0.03 * 255) ** 2
    wanted = []
    for channel in range(3):
        a, b = (picture[4:11, 3:10, channel].astype(float).ravel() for picture in (one, other))
        covariance = np.cov(a, b)
        above = (2 * a.mean() * b.mean() + c1) * (2 * covariance[0, 1] + c2)
        wanted.append(above / ((a.mean() ** 2 + b.mean() ** 2 + c1) * (covariance[0, 0] + covariance[1, 1] + c2)))
    assert metrics.similarity_map(one, other)[7, 6] == pytest.approx(np.mean(wanted), rel=1e-9)


def test_a_mask_limits_every_number_to_its_pixels() -> None:
    one = np.full((20, 30, 3), 100, dtype=np.uint8)
    other = one.copy()
    other[5:9, 5:9] += 40
    where = np.zeros((20, 30), dtype=bool)
    where[5:9, 5:9] = True
    assert metrics.mean_absolute_error(one, other, where) == 40.0
    assert metrics.mean_absolute_error(one, other, ~where) == 0.0
    assert metrics.structural_similarity(one, other, where) < metrics.structural_similarity(one, other) < 1.0
    nowhere = np.zeros_like(where)
    for of in (metrics.mean_absolute_error, metrics.peak_signal_to_noise, metrics.structural_similarity,
               metrics.image_correlation):  # fmt: skip
        assert math.isnan(of(one, other, nowhere))


def test_correlation_knows_sign_and_scale_but_not_a_blank() -> None:
    change = RNG.normal(0, 1, (20, 30, 3))
    assert metrics.image_correlation(change, 3 * change + 7) == pytest.approx(1.0)
    assert metrics.image_correlation(change, -change) == pytest.approx(-1.0)
    assert metrics.image_correlation(np.zeros_like(change), change) == 0.0
    assert abs(metrics.image_correlation(change, RNG.normal(0, 1, change.shape))) < 0.1


@pytest.mark.parametrize("degrees", [0.0, 1e-4, 3.0, 30.0, 80.0])
def test_the_angle_between_a_tilted_and_a_flat_surface(degrees: float) -> None:
    flat = np.zeros((6, 7, 2))
    tilted = np.zeros((6, 7, 2))
    tilted[..., 1] = math.tan(math.radians(degrees))
    assert metrics.mean_normal_angle(flat, tilted) == pytest.approx(degrees, abs=1e-9)
    assert metrics.mean_normal_angle(tilted, tilted) == 0.0


def test_opposite_slopes_are_twice_as_far_apart() -> None:
    slopes = np.full((4, 4, 2), [0.3, 0.0])
    assert metrics.mean_normal_angle(slopes, -slopes) == pytest.approx(2 * math.degrees(math.atan(0.3)))


def test_heights_and_markers() -> None:
    height = RNG.normal(0, 1e-4, (8, 9))
    assert metrics.height_error(height, height + 3e-5) == pytest.approx(3e-5)
    flow = np.zeros((3, 4, 2))
    assert metrics.end_point_error(flow, flow + np.array([3e-5, 4e-5])) == pytest.approx(5e-5)
    lost = flow + np.array([3e-5, 4e-5])
    lost[0, 0] = np.nan  # a marker that was not found
    assert metrics.end_point_error(flow, lost) == pytest.approx(5e-5)


def test_two_shifted_squares_overlap_by_a_third() -> None:
    one, other = np.zeros((20, 20), dtype=bool), np.zeros((20, 20), dtype=bool)
    one[5:15, 2:12], other[5:15, 7:17] = True, True
    assert metrics.intersection_over_union(one, other) == pytest.approx(50 / 150)
    assert math.isnan(metrics.intersection_over_union(np.zeros_like(one), np.zeros_like(one)))


def test_a_disc_is_a_patch_of_its_centre_and_radius() -> None:
    patch = metrics.circle_of_region(disc(70.0, 50.0, 20.0))
    assert patch is not None
    assert (patch.x, patch.y) == pytest.approx((70.0, 50.0))
    assert patch.radius == pytest.approx(20.0, abs=0.1)
    assert metrics.circle_of_region(np.zeros((5, 5), dtype=bool)) is None


def test_contact_is_found_beside_noise_and_drift_and_its_hole_is_filled() -> None:
    ring = disc(80, 60, 25) & ~disc(80, 60, 10)  # the flat middle of a press keeps its colour
    change = RNG.normal(0, 2, (120, 160, 3)) + np.array([6.0, -3.0, 8.0])
    change[ring] += [40.0, -30.0, 0.0]
    region = metrics.contact_region(change)
    assert metrics.intersection_over_union(region, disc(80, 60, 25)) > 0.85
    assert region[60, 80]


def test_the_region_means_the_same_in_a_dim_picture() -> None:
    v, u = np.mgrid[:120, :160]
    bump = np.exp(-((u - 80) ** 2 + (v - 60) ** 2) / (2 * 15**2))[..., None] * np.array([1.0, -0.5, 0.2])
    bright, dim = metrics.contact_region(90 * bump), metrics.contact_region(30 * bump)
    assert metrics.intersection_over_union(bright, dim) > 0.97


@pytest.mark.parametrize("deviation", [0.5, 2.0, 5.0])
def test_noise_alone_is_no_contact(deviation: float) -> None:
    change = RNG.normal(0, deviation, (240, 320, 3)) + 9.0
    assert not metrics.contact_region(change).any()


def test_the_pressed_region_of_hertz_is_the_contact_circle() -> None:
    a, radius = 20.0, 60.0  # [cells]
    v, u = np.mgrid[:161, :161]
    r = np.hypot(u - 80, v - 80)
    depth = a**2 / radius
    q = np.maximum(r / a, 1.0)
    outside = depth / np.pi * ((2 - q**2) * np.arcsin(1 / q) + np.sqrt(q * q - 1))
    height = np.where(r < a, depth - r**2 / (2 * radius), outside)
    patch = metrics.circle_of_region(metrics.pressed_region(height, 1e-3))
    assert patch is not None
    assert patch.radius == pytest.approx(a, abs=0.4)
    assert not metrics.pressed_region(height, 2 * depth).any()


def test_what_does_not_fit_together_is_refused() -> None:
    with pytest.raises(ValueError, match="shapes differ"):
        metrics.mean_absolute_error(NOISE, NOISE[:-1])
    with pytest.raises(ValueError, match="shapes differ"):
        metrics.similarity_map(NOISE, NOISE[:-1])
    with pytest.raises(ValueError, match="smaller than SSIM's window"):
        metrics.similarity_map(NOISE[:5], NOISE[:5])
    with pytest.raises(ValueError, match="slopes must be"):
        metrics.mean_normal_angle(np.zeros((3, 3, 2)), np.zeros((3, 4, 2)))
    with pytest.raises(ValueError, match="shapes differ"):
        metrics.intersection_over_union(np.zeros((2, 2), dtype=bool), np.zeros((2, 3), dtype=bool))


def test_grain_is_what_a_small_blur_takes_away() -> None:
    """White noise of deviation s loses s^2 (2 K(0) - sum of K^2), K the Gaussian of deviation 1 on whole pixels; a
    smooth dent has none."""
    x = np.arange(-9, 10)
    line = np.exp(-(x**2) / 2) / np.exp(-(x**2) / 2).sum()
    kernel = np.outer(line, line)
    left = 1 - 2 * kernel[9, 9] + (kernel**2).sum()
    where = disc(80, 60, 40)
    noise = RNG.normal(0, 3, (120, 160, 3))
    v, u = np.mgrid[:120, :160]
    dent = 60 * np.exp(-((u - 80) ** 2 + (v - 60) ** 2) / (2 * 20**2))[..., None] * np.ones(3)
    assert metrics.grain_deviation(noise + dent, where) == pytest.approx(3 * math.sqrt(left), rel=0.02)
    assert metrics.grain_deviation(dent, where) < 0.2
    assert math.isnan(metrics.grain_deviation(noise, np.zeros_like(where)))
