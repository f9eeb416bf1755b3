"""The contact circle is found in images whose light the fit does not know."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from calibration.light.circle import NoCircle, find_contact_circle

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
