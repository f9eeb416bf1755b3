"""What an episode takes of the arms, against closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from tacsim.interface import ArmState, Pose
from tacsim.pose import HALF_TURN_X
from tacsim.tasks.task import Effort


def upper(z: float, force: tuple[float, float, float]) -> ArmState:
    """Faces down: pressing gives a negative force along its own z."""
    pose = Pose(np.array([0.0, 0.0, z]), HALF_TURN_X.quaternion)
    return ArmState(pose, np.zeros(6), np.array([*force, 0, 0, 0]), None, 0.0)


def test_work_on_a_spring_is_its_energy_and_its_release_gives_it_back() -> None:
    stiffness, start = 2e3, 10e-3
    depths = np.linspace(0, 2e-3, 21)
    effort = Effort({"upper": upper(start, (0, 0, 0))})
    for depth in depths[1:]:
        effort.add({"upper": upper(start - depth, (0, 0, -stiffness * depth))})
    assert effort.work == pytest.approx(stiffness * (2e-3) ** 2 / 2)
    assert effort.peak == pytest.approx(4.0)
    for depth in depths[-2::-1]:
        effort.add({"upper": upper(start - depth, (0, 0, -stiffness * depth))})
    assert effort.work == pytest.approx(0.0, abs=1e-12)
    assert effort.peak == pytest.approx(4.0)


def test_work_of_a_drag_is_friction_times_way_whichever_way_the_sensor_faces() -> None:
    def dragged(y: float) -> ArmState:
        pose = Pose(np.array([0.0, y, 0.0]), HALF_TURN_X.quaternion)
        # The body holds the sensor back: against world y, which is along its own y.
        return ArmState(pose, np.zeros(6), np.array([0, 1.5, -3.0, 0, 0, 0]), None, 0.0)

    effort = Effort({"upper": dragged(0.0)})
    effort.add({"upper": dragged(4e-3)})
    assert effort.work == pytest.approx(1.5 * 4e-3)
    assert effort.peak == 3.0
