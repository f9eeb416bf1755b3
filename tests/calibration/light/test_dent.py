"""The dent of a ball in closed form, and the contact circle found in pictures."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from calibration.light.dent import ContactCircle, NoCircle, dent_gradient, dent_slope, find_contact_circle, layer_slope


def test_the_slope_is_the_balls_inside_meets_it_at_the_rim_and_dies_away() -> None:
    r = np.array([0.5, 1.0 - 1e-9, 1.0 + 1e-9, 1.5, 20.0])
    slope = dent_slope(r, 1.0, 3.0)
    assert slope[0] == pytest.approx(0.5 / np.sqrt(9 - 0.25))
    assert slope[1] == pytest.approx(slope[2], rel=1e-3)
    assert slope[2] > slope[3] > slope[4]
    # far away Hertz is a point force: u = 4 a^3 / (3 pi R r)
    assert slope[4] * np.sqrt(9 - 1) == pytest.approx(4 / (3 * np.pi * 400), rel=0.01)


@pytest.mark.parametrize(
    ("thinness", "slopes"),
    [
        (0.25, (0.5278, 0.3922, 0.2094, 0.0978, 0.0274)),
        (0.5, (0.4972, 0.3509, 0.1530, 0.0390, -0.0083)),
        (1.0, (0.3867, 0.2140, 0.0166, -0.0317, -0.0093)),
        (1.5, (0.2685, 0.0850, -0.0585, -0.0340, -0.0062)),
    ],
)
def test_a_thin_layer_against_the_pressure_that_makes_the_dent(thinness: float, slopes: tuple[float, ...]) -> None:
    """Numbers of a least-squares solution of the contact on a layer (Poisson's ratio 0.48): five pressures
    (1 - r^2)^(m + 1/2), by Hankel transforms, whose surface has the ball's slope inside to 1e-4."""
    at = np.array([1.1, 1.2, 1.5, 2.0, 3.0])
    np.testing.assert_allclose(layer_slope(at, thinness), slopes, atol=0.011)
    assert layer_slope(np.array([1.0]), thinness) == pytest.approx(1.0)


def test_a_blur_is_that_of_the_slopes_themselves() -> None:
    """Against the same dent blurred by SciPy as a picture, away from the axis, where the rim bends."""
    from scipy.ndimage import gaussian_filter

    v, u = np.mgrid[:161, :161] / 2.0
    circle = ContactCircle(40.0, 40.0, 20.0)
    sharp = dent_gradient(u, v, circle, 60.0, 30.0)
    seen = dent_gradient(u, v, circle, 60.0, 30.0, 1.5)
    wanted = np.stack([gaussian_filter(sharp[..., k], 3.0) for k in range(2)], axis=-1)
    inner = np.hypot(u - 40, v - 40)
    there = (inner > 5) & (inner < 32)
    rim = 20 / np.sqrt(30**2 - 20**2)
    assert np.abs(seen - wanted)[there].max() < 0.03 * rim
    assert np.abs(sharp - wanted)[there].max() > 0.15 * rim


def test_a_circle_as_large_as_the_ball_is_refused() -> None:
    with pytest.raises(ValueError, match=r"no contact circle of 30\.0 px"):
        dent_slope(np.array([1.0]), 30.0, 30.0)


PITCH = 0.0625e-3


@pytest.mark.parametrize(
    ("ball", "depth", "centre"),
    [(2e-3, 0.2e-3, (100, 100)), (3e-3, 0.5e-3, (80, 115)), (5e-3, 0.8e-3, (110, 95)), (3e-3, 0.5e-3, (180, 30))],
    ids=["small", "middle", "large", "near a corner"],
)
def test_the_circle_is_that_of_the_contact(
    press_image: Callable[..., Any], ball: float, depth: float, centre: tuple[int, int]
) -> None:
    image, empty, truth = press_image(ball, depth, centre)
    found = find_contact_circle(image, empty, ball / PITCH)
    assert (found.x, found.y) == pytest.approx(centre, abs=0.7)
    assert found.radius == pytest.approx(truth, abs=1.2)
    assert found.explained_share > 0.85


def test_what_shows_no_ball_is_refused(press_image: Callable[..., Any]) -> None:
    _, empty, _ = press_image(3e-3, 0.5e-3, (100, 100))
    with pytest.raises(NoCircle, match="is the one without contact"):
        find_contact_circle(empty, empty, 48.0)
    noisy = np.clip(empty + np.random.default_rng(5).normal(0, 4, empty.shape), 0, 255).astype(np.uint8)
    with pytest.raises(NoCircle, match="70% are needed"):
        find_contact_circle(noisy, empty, 48.0)
    with pytest.raises(ValueError, match="of one camera"):
        find_contact_circle(empty[:100], empty, 48.0)


def test_a_contact_wider_than_the_ball_is_told_as_such(press_image: Callable[..., Any]) -> None:
    """A ball of 5 mm pressed 0.8 mm deep touches within 2 mm: no ball of 1 mm does."""
    image, empty, _ = press_image(5e-3, 0.8e-3, (110, 95))
    with pytest.raises(NoCircle, match=r"wider than the ball .* pixel pitch"):
        find_contact_circle(image, empty, 1e-3 / PITCH)
