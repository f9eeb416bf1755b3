"""Ramped paths."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tacsim.interface import Pose
from tacsim.physics.controller import RISE, plan, ramp


@pytest.mark.parametrize("rise", [0.5, 0.2])
def test_ramp_starts_and_ends_at_rest_and_goes_steadily_between(rise: float) -> None:
    t = np.linspace(0, 1, 2001)
    s = ramp(t, rise)
    speed = np.gradient(s, t)
    acceleration = np.gradient(speed, t)
    assert (s[0], s[-1]) == (0, 1)
    assert speed[[0, -1]] == pytest.approx(0, abs=1e-4) and acceleration[[0, -1]] == pytest.approx(0, abs=0.2)
    assert speed.max() == pytest.approx(1 / (1 - rise), rel=1e-4)
    assert np.abs(np.diff(acceleration)).max() < 0.1  # no jump
    steady = (t > rise + 0.01) & (t < 1 - rise - 0.01)
    assert speed[steady] == pytest.approx(speed.max(), rel=1e-6)


def test_a_long_motion_keeps_to_the_speed_and_a_short_one_to_the_acceleration() -> None:
    """Acceleration grows no further than mach / RISE wave times (x 1.5, the peak of a smooth start over its mean)."""
    dt, mach, thickness = 0.1, 0.02, 4.0
    limit = 1.5 * mach / (RISE * thickness)
    for length, fastest in ((3e-3, mach), (0.05e-3, None)):
        path = plan([Pose()], [Pose(np.array([0, 0, length]))], mach, dt, 10.0, thickness)
        velocity = path.drive(0, path.substeps)[:, 0, 4, 2].astype(float)
        acceleration = np.abs(np.diff(velocity)).max() / dt
        assert acceleration == pytest.approx(limit, rel=0.02)
        if fastest:
            assert velocity.max() == pytest.approx(fastest, rel=0.01)
        else:
            assert velocity.max() < 0.3 * mach
            half = plan([Pose()], [Pose(np.array([0, 0, length / 4]))], mach, dt, 10.0, thickness)
            assert path.substeps == pytest.approx(2 * half.substeps, abs=2)


def test_path_never_exceeds_its_mach_number_and_ends_on_target() -> None:
    start = Pose()
    end = Pose(np.array([0.3e-3, -0.2e-3, 1e-3]), Rotation.from_rotvec([0, 0, 0.2]).as_quat())
    path = plan([start], [end], mach=0.05, dt=0.4, lever=10.0, thickness=4.0)
    drive = path.drive(0, path.substeps).astype(float)
    rim = np.linalg.norm(drive[:, 0, 4], axis=1) + 10.0 * np.linalg.norm(drive[:, 0, 5], axis=1)
    assert rim.max() <= 0.05 * 1.001
    assert drive[-1, 0, 3] == pytest.approx(end.position * 1e3, abs=1e-6)
    assert drive[-1, 0, :3] == pytest.approx(Rotation.from_quat(end.quaternion).as_matrix(), abs=1e-6)
    assert drive[:, 0, 4].sum(axis=0) * 0.4 == pytest.approx(end.position * 1e3, abs=1e-5)


def test_refining_cuts_the_same_path_finer() -> None:
    path = plan([Pose()], [Pose(np.array([0, 0, 1e-3]))], mach=0.05, dt=0.4, lever=10.0, thickness=4.0)
    coarse, fine = path.drive(5, 9), replace(path, refine=4).drive(5, 9)
    assert len(fine) == 16
    assert fine[3::4, 0, 3] == pytest.approx(coarse[:, 0, 3], abs=1e-6)


def test_no_motion_needs_no_substeps() -> None:
    assert plan([Pose()], [Pose()], mach=0.05, dt=0.4, lever=10.0, thickness=4.0).substeps == 0
