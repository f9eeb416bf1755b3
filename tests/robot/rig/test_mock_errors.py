"""A mock rig that differs from its file: late pictures, elastic mounts."""

from __future__ import annotations

import numpy as np
import pytest

from robot.fixtures import rig_addresses
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
