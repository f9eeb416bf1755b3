"""A mock rig that differs from its file: late pictures, elastic mounts, errors of the arms."""

from __future__ import annotations

import numpy as np
import pytest

from robot.fixtures import rig_addresses
from robot.open import open_rig
from tacsim.config import load_rig
from tacsim.interface import Action, Pose
from tests.robot.rig.bare_rig import opened
from tests.robot.rig.test_hardware_rig_simulated import SMALL, TINY

pytestmark = pytest.mark.usefixtures("no_pause")


@pytest.mark.slow
def test_second_reset_has_the_references_of_the_first_with_late_pictures() -> None:
    """Not those of the last contact."""
    with opened("mock", *SMALL, *TINY, "sensors.upper.mock.delay=2", *rig_addresses()) as found:
        rig = found.rig
        pose = rig.reset().arms["upper"].pose
        first = rig.references["upper"].image.astype(int)
        for _ in range(3):  # the last picture is that of the first motion
            rig.step(Action({"upper": Pose(pose.position - [0.0, 0.0, 0.3e-3], pose.quaternion)}))
        contact = np.abs(rig.frames["upper"].image - first).mean()
        rig.reset()
        assert np.abs(rig.references["upper"].image - first).mean() < 0.2 * contact


@pytest.mark.slow
def test_mock_mount_gives_way_and_the_arm_does_not_observe_it() -> None:
    """A spring of 2 N/mm: the sensor is where the arm reports it, plus force / stiffness."""
    mount = [f"arms.upper.mock.mount.{word}" for word in ("stiffness=2 N/mm", "damping_time=0.1 s")]
    with opened("mock", *SMALL, *TINY, *mount, *rig_addresses(), "start.approach_step=0.2 mm") as found:
        arms = found.rig.reset().arms
        pose = arms["upper"].pose
        found.rig.step(Action({"upper": Pose(pose.position - [0.0, 0.0, 0.3e-3], pose.quaternion)}))
        for _ in range(8):  # of 0.1 s each: at rest
            observation, _ = found.rig.step(Action({}))
        truth, arm, below = found.rig.truth(), observation.arms["upper"], observation.arms["lower"]
    assert truth is not None
    given = truth.poses["upper"].position - arm.pose.position
    assert given[2] == pytest.approx(-arm.wrench[2] / 2000.0, rel=0.02) and given[2] > 0.1e-3
    assert truth.poses["lower"].position == pytest.approx(below.pose.position, abs=5e-6)


def find_contacts(rig: str, *overrides: str) -> list[float]:
    """Centre of the contact in the middle row and column of the lower, then of the upper gel, after a reset [m]."""
    with open_rig(load_rig(rig, task="squeeze", overrides=[*TINY, *overrides])) as found:
        observation = found.reset()
    assert observation.arms["lower"].pose.position[:2] == pytest.approx([0.0, 0.0], abs=1e-6)
    width = 16e-3  # of the canonical grid, here and there
    heights = [observation.tactile[name].height for name in ("lower", "upper")]
    pressed = [np.argwhere(height > 0.5 * height.max()) / len(height) for height in heights if height is not None]
    return [float(value) for each in pressed for value in width * (each.mean(axis=0) - 0.5)]


@pytest.mark.slow
def test_arms_with_the_same_error_touch_at_the_same_place_simulated_and_mocked() -> None:
    """At the start an arm measures that it is below the middle of the body, and is not."""
    error = "error.position=[0.6 mm, 0.3 mm, 0]"
    exact = find_contacts("sim")
    simulated = np.subtract(find_contacts("sim", f"arms.lower.{error}"), exact)
    mocked = np.subtract(find_contacts("mock", f"arms.lower.mock.{error}", *SMALL, *rig_addresses()), exact)
    assert sorted(np.abs(simulated[:2])) == pytest.approx([0.3e-3, 0.6e-3], abs=0.125e-3)  # half a cell
    assert mocked == pytest.approx(simulated, abs=0.25e-3)
