"""How an indenter is slid: how far it is pressed in, how far its drag turns, and which slides are not followed."""

import math

import numpy as np
import pytest

from tacsim.physics.motion.slide import Slide, growth_share, release_share, speed_share, turn_share, wall_slowdown


@pytest.mark.parametrize(
    ("by", "grows"),
    [
        ([1e-3, 0.0, 0.0], 0.0), ([1e-3, 0.0, -0.1e-3], 0.4), ([0.0, 1e-3, -0.5e-3], 1.0), ([1e-3, 0.0, 0.1e-3], 0.0),
        ([0.0, 0.0, -1e-3], 0.0),
    ],
)  # fmt: skip
def test_indentation_during_slide_gives_growth_share(by: list[float], grows: float) -> None:
    assert growth_share(np.array(by)) == pytest.approx(grows)


@pytest.mark.parametrize(
    ("by", "force", "turns"),
    [
        ([1e-3, 0.0, 0.0], [0.3, 0.0, -1.0], 0.0),  # on along it, or straight back
        ([-1e-3, 0.0, 0.0], [0.3, 0.0, -1.0], 0.0),
        ([0.0, 1e-3, 0.0], [0.3, 0.0, -1.0], 0.5),  # across half of the drag that friction allows
        ([1e-3, 1e-3, 0.0], [0.6, 0.0, -1.0], math.sqrt(0.5)),
        ([0.0, 1e-3, 0.0], [0.9, 0.0, -1.0], 1.0),
        ([0.0, 0.0, -1e-3], [0.3, 0.0, -1.0], 0.0),
        ([1e-3, 0.0, 0.0], [0.0, 0.0, 0.0], 0.0),  # nothing is touched
    ],
)
def test_slide_across_drag_gives_turn_share(by: list[float], force: list[float], turns: float) -> None:
    assert turn_share(np.array(by), np.array(force), 0.6) == pytest.approx(turns)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("by", "force", "released"),
    [
        ([0.0, 0.0, 1e-3], [0.6, 0.0, -1.0], 1.0),
        ([0.0, 0.0, 1e-3], [0.0, 0.3, -1.0], 0.5),  # half of the drag that friction allows
        ([0.0, 0.0, 1e-3], [0.9, 0.0, -1.0], 1.0),
        ([1e-3, 0.0, 1e-3], [0.6, 0.0, -1.0], math.sqrt(0.5)),
        ([0.0, 0.0, -1e-3], [0.6, 0.0, -1.0], 0.0),
        ([1e-3, 0.0, 0.0], [0.6, 0.0, -1.0], 0.0),
        ([0.0, 0.0, 1e-3], [0.0, 0.0, 0.0], 0.0),  # nothing is touched
    ],
)
def test_what_is_lifted_with_its_drag_is_released(by: list[float], force: list[float], released: float) -> None:
    assert release_share(np.array(by), np.array(force), 0.6) == pytest.approx(released)


@pytest.mark.parametrize(
    ("by", "force", "friction", "share"),
    [
        ([1e-3, 0.0, 0.0], [0.6, 0.0, -1.0], 0.6, 1.0),
        ([0.0, 1e-3, 0.0], [0.9, 0.0, -1.0], 0.3, 0.35),
        ([0.0, 1e-3, 0.0], [0.9, 0.0, -1.0], 0.9, 0.5),
        ([0.0, 0.0, 1e-3], [0.9, 0.0, -1.0], 0.6, 0.35),
        ([1e-3, 0.0, 0.0], [0.0, 0.0, -1.0], 1.5, 1.0),
    ],
)
def test_pace(by: list[float], force: list[float], friction: float, share: float) -> None:
    assert speed_share(np.array(by), np.array(force), friction) == pytest.approx(share)


@pytest.mark.parametrize(
    ("by", "friction", "slower"),
    [
        ([1e-3, 0.0, 0.0], 0.95, 1.5),  # where walls stick at two thirds of it
        ([0.0, 1e-3, -1e-3], 0.95, 1.0 + math.sqrt(0.5) / 2.0),
        ([1e-3, 0.0, 0.0], 1.5, 4.5 / 1.9),
        ([1e-3, 0.0, 0.0], 100.0, 4.5 / 1.9),  # it sticks
        ([0.0, 0.0, -1e-3], 1.5, 1.0),
        ([1e-3, 0.0, 0.0], 0.6, 1.0),
        ([0.0, 0.0, 0.0], 1.5, 1.0),
    ],
)
def test_walls_with_much_friction_end_a_slide_more_slowly(by: list[float], friction: float, slower: float) -> None:
    assert wall_slowdown(np.array(by), friction, 1 / 9) == pytest.approx(slower)


def slide(**changes: float) -> Slide:
    usual = {
        "length": 1.0,
        "earlier_length": 0.0,
        "end_distance": 1.0,
        "depth": 0.5,
        "shear_mach": 0.1,
        "friction": 0.6,
        "edge_radius": 0.5,
    }
    return Slide(**{**usual, **changes})


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({}, ""),
        ({"shear_mach": 0.16}, "slips by inertia"),
        ({"edge_radius": 0.4}, "sharper than 0.5 mm catches"),
        ({"edge_radius": 0.4, "length": 0.5}, ""),
        (
            {"edge_radius": 0.4, "length": 0.1, "earlier_length": 0.5},
            "sharper than 0.5 mm catches",
        ),  # one of several short ones
        ({"edge_radius": 0.4, "length": 0.0, "depth": 2.0, "friction": 2.0}, ""),
        ({"length": 2.1, "friction": 1.1, "depth": 0.0}, ""),  # lifted
        ({"length": 2.1}, ""),
        ({"length": 2.1, "depth": 0.7}, "2 mm.*friction of 0.6 and a depth of more than 0.6 mm"),
        ({"length": 0.1, "end_distance": 2.1, "depth": 0.7}, "friction of 0.6"),  # one of many small ones
        ({"length": 2.1, "depth": 0.7, "edge_radius": math.inf}, ""),
        ({"length": 2.1, "depth": 1.1, "edge_radius": math.inf}, "a depth of more than 1 mm"),
        ({"length": 2.1, "friction": 1.1}, "friction above 1"),
        ({"length": 1.9, "friction": 1.1}, ""),
        ({"length": 1.9, "friction": 1.1, "depth": 0.7}, "1.6 mm.*friction above 1"),
    ],
)
def test_slide_beyond_limits_gives_reason(changes: dict[str, float], words: str) -> None:
    """Elements of 1 mm, a gel 4 mm thick."""
    said = slide(**changes).unsettled_reason(1.0, 4.0)
    assert bool(said) == bool(words)
    if words:
        with pytest.raises(AssertionError, match=words):
            raise AssertionError(said)
