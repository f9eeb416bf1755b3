"""Arms whose measured pose is wrong: an episode begins where they measure their start."""

from __future__ import annotations

import numpy as np
import pytest

from robot.fixtures import rig_addresses
from robot.open import open_rig
from tacsim.config import load_rig
from tests.robot.rig.test_hardware_rig_simulated import SMALL, TINY

pytestmark = pytest.mark.usefixtures("no_pause")


def find_contacts(rig: str, *overrides: str) -> list[float]:
    """Centre of the contact in the middle row and column of the lower, then of the upper gel, after a reset [m]."""
    with open_rig(load_rig(rig, task="squeeze", overrides=[*TINY, *overrides])) as found:
        observation = found.reset()
    assert observation.arms["lower"].pose.position[:2] == pytest.approx([0.0, 0.0], abs=1e-6)
    width = 16e-3  # of the canonical grid, here and there
    heights = [observation.tactile[name].height for name in ("lower", "upper")]
    # Grids differ, so a pressed cell counts by its centre, not by its index.
    pressed = [(np.argwhere(each > 0.5 * each.max()) + 0.5) / len(each) for each in heights if each is not None]
    return [float(value) for each in pressed for value in width * (each.mean(axis=0) - 0.5)]


@pytest.mark.slow
def test_arms_with_the_same_error_touch_at_the_same_place_simulated_and_mocked() -> None:
    """At the start an arm measures that it is below the middle of the body, and is not."""
    error = "error.position=[0.6 mm, 0.3 mm, 0]"
    exact = find_contacts("sim")
    simulated = np.subtract(find_contacts("sim", f"arms.lower.{error}"), exact)
    mocked = np.subtract(find_contacts("mock", f"arms.lower.mock.{error}", *SMALL, *rig_addresses()), exact)
    assert sorted(np.abs(simulated[:2])) == pytest.approx([0.3e-3, 0.6e-3], abs=0.125e-3)  # half a cell
    assert mocked == pytest.approx(simulated, abs=0.25e-3)  # half a cell of the mock's grid


@pytest.mark.parametrize("error", ["[0, 0, -0.5 mm]", "[0, 0, -1.5 mm]", "[0, 0, 3 mm]"])
def test_an_error_along_the_approach_presses_nothing(error: str) -> None:
    """The gap of the scene is smaller: the sensor would begin inside the body."""
    words = [*TINY, "scene.preset=learn", f"arms.lower.error.position={error}"]
    with open_rig(load_rig("sim", task="squeeze", overrides=words)) as rig:
        observation, truth = rig.reset(), rig.truth()
    assert truth is not None
    assert truth.height == pytest.approx(4e-3, rel=0.01)
    assert -observation.arms["lower"].wrench[2] == pytest.approx(0.05, rel=0.2)
    assert truth.poses["lower"].position[2] == pytest.approx(0.11e-3, abs=0.02e-3)


def test_a_hand_with_an_error_measures_its_start_and_is_not_there() -> None:
    """It opens so far that its fingers are clear of the object on both sides."""
    error = "arms.hand.error.position=[0.6 mm, 0, 0.3 mm]"
    with open_rig("hand", overrides=("scene=hold", "task=null", error)) as rig:
        observation, truth = rig.reset(), rig.truth()
        assert truth is not None
        assert observation.arms["hand"].pose.position == pytest.approx([0, 0, 0.038], abs=1e-9)
        assert observation.grippers["hand"].width == pytest.approx(0.0252)
        middle = (truth.poses["left"].position + truth.poses["right"].position) / 2
        assert middle == pytest.approx([-0.6e-3, 0, 0.0383], abs=1e-9)  # the hand's z points down
        assert truth.objects["object"].position == pytest.approx([0, 0, 0.038])


def test_a_hand_grips_a_handle_that_cannot_move_aside() -> None:
    """One pad presses more than the other; their mean is the force of the motor."""
    words = ["scene.preset=learn", "motion=flowing", "arms.hand.error.position=[0.3 mm, 0, 0]"]
    with open_rig(load_rig("hand", task="drawer", overrides=words)) as rig:
        observation, truth = rig.reset(), rig.truth()
    assert truth is not None
    left, right = (truth.forces[f"hand/{side}"] for side in ("left", "right"))
    assert left < 0.8 * right
    assert (left + right) / 2 == pytest.approx(observation.grippers["hand"].force, rel=1e-3)
    assert observation.grippers["hand"].force == pytest.approx(6.0, rel=1e-3)
