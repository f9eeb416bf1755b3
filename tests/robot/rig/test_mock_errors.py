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


@pytest.mark.slow
def test_soft_mock_mounts_come_to_rest_on_a_stiff_body() -> None:
    """Where the force alone, without the stiffness of the contact, would move both sensors to and fro."""
    mounts = [
        f"arms.{arm}.mock.mount.{word}"
        for arm in ("lower", "upper")
        for word in ("stiffness=0.5 N/mm", "damping_time=0.1 s")
    ]
    stiff = ["scene.body.material.youngs_modulus=1 MPa", "start.approach_step=0.2 mm"]
    with opened("mock", *SMALL, *TINY, *mounts, *stiff, *rig_addresses()) as found:
        pose = found.rig.reset().arms["upper"].pose
        found.rig.step(Action({"upper": Pose(pose.position - [0.0, 0.0, 0.5e-3], pose.quaternion)}))
        forces = [-found.rig.step(Action({}))[0].arms["upper"].wrench[2] for _ in range(10)]
    assert forces[-3:] == pytest.approx([forces[-1]] * 3, rel=0.02)
    # The arms have closed in by 0.5 mm since a light touch: three springs in series, two of them the mounts.
    assert 0.03 < forces[-1] < 0.5e-3 * 250.0 + 0.1
