"""Guards refuse with a reason, or shorten and show it."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tacsim import pose as se3
from tacsim.interface import Action, Pose
from tacsim.limits import ActionError, check_action, check_workspace, shorten

START = se3.from_rotation_vector([0.1, -0.2, 0.3], [0.4, 0.0, 0.0])
ARMS = ("lower", "upper")


def moved(shift: list[float], turn: list[float]) -> Pose:
    """START, shifted and turned in the outer axes."""
    return Pose(START.position + shift, se3.compose(se3.from_rotation_vector([0, 0, 0], turn), START).quaternion)


def test_a_motion_within_the_limits_is_returned_itself() -> None:
    target = moved([0.3e-3, 0.0, -0.4e-3], [0.0, 0.02, 0.0])
    assert shorten(target, START, 0.5e-3, 0.02) is target
    assert shorten(START, START, 0.5e-3, 0.02) is START


@pytest.mark.parametrize(
    ("longest", "widest", "share"), [(0.25e-3, 1.0, 0.5), (1.0, 0.005, 0.25), (0.25e-3, 0.005, 0.25)]
)
def test_a_longer_motion_is_cut_on_the_straight_way(longest: float, widest: float, share: float) -> None:
    """The tighter limit shortens shift and turn alike, so that the way stays straight."""
    target = moved([0.3e-3, 0.0, -0.4e-3], [0.0, 0.02, 0.0])
    sent = shorten(target, START, longest, widest)
    assert np.allclose(sent.position - START.position, share * np.array([0.3e-3, 0, -0.4e-3]), atol=1e-12)
    assert np.allclose(se3.difference(START, sent)[3:], [0.0, share * 0.02, 0.0], atol=1e-9)


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
    sent = shorten(target, START, longest, widest)
    metres, radians = se3.distance(START, sent)
    assert metres <= longest * (1 + 1e-6)
    assert radians <= widest + 1e-6
    if sent is not target:  # nothing was given away: one limit is used up
        assert metres >= longest * (1 - 1e-6) or radians >= widest - 1e-6


@pytest.mark.parametrize("limits", [(0.0, 1.0), (1.0, -1.0), (math.nan, 1.0)])
def test_limits_must_be_positive(limits: tuple[float, float]) -> None:
    with pytest.raises(ValueError, match="must be positive"):
        shorten(START, START, *limits)


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
            r"action for 'upper' must be a tacsim.interface.Pose or None \(holds\), got \[",
        ),  # type: ignore[dict-item]
        ({"upper": START}, r"rig 'bench' takes a tacsim.interface.Action, got dict"),
        (None, "got NoneType"),
        (Action([START]), "Action.tool must be a mapping from arm names to poses.*got list"),  # type: ignore[arg-type]
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


def test_workspace_names_the_axis_that_leaves_it() -> None:
    lower, upper = [-0.1, -0.2, 0.0], [0.1, 0.2, 0.3]
    assert check_workspace(START, lower, upper, "upper") is START  # on a corner: inside
    with pytest.raises(ActionError, match=r"arm 'upper' is outside its workspace: z = -0\.001 m, allowed 0 to 0\.3 m"):
        check_workspace(Pose(np.array([0.0, 0.0, -0.001])), lower, upper, "upper")
    with pytest.raises(ActionError, match=r"y = 0\.25 m, allowed -0\.2 to 0\.2 m"):
        check_workspace(Pose(np.array([0.0, 0.25, 0.1])), lower, upper, "lower")
    with pytest.raises(ValueError, match="lower to an upper corner"):
        check_workspace(START, upper, lower, "upper")
