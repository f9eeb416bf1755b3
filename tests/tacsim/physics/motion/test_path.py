"""Ramped paths: rest to rest, never too fast, never too hard a stop."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tacsim.interface import Pose
from tacsim.physics.motion.path import PEAK_SLOPE, Path, plan_flow, plan_path, ramp
from tacsim.physics.motion.tuning import MAX_SUBSTEPS


@pytest.mark.parametrize("rise", [0.5, 0.1])
def test_ramp_starts_and_ends_at_rest(rise: float) -> None:
    t = np.linspace(0, 1, 20001)
    s = ramp(t, rise)
    speed = np.gradient(s, t)
    assert s[0] == 0 and s[-1] == pytest.approx(1, abs=1e-12)
    assert speed[[0, -1]] == pytest.approx(0, abs=1e-5)
    assert np.gradient(speed, t)[[0, -1]] == pytest.approx(0, abs=0.05)
    assert np.abs(np.gradient(speed, t)).max() > 3  # of which that is nothing
    assert speed.max() == pytest.approx(PEAK_SLOPE, rel=1e-4) and t[speed.argmax()] == pytest.approx(rise, abs=1e-4)
    assert (np.diff(s) >= -1e-15).all()


def test_a_ramp_that_rises_as_long_as_it_falls_is_that_of_minimum_jerk() -> None:
    t = np.linspace(0, 1, 101)
    assert ramp(t) == pytest.approx(t**3 * (10 - 15 * t + 6 * t * t), abs=1e-14)


def test_path_never_exceeds_its_mach_number_and_ends_on_target() -> None:
    start = Pose()
    end = Pose(np.array([0.3e-3, -0.2e-3, 1e-3]), Rotation.from_rotvec([0, 0, 0.2]).as_quat())
    path = plan_path([start], [end], mach=0.05, dt=0.4, lever=10.0, thickness=4.0)
    drive = path.drive(0, path.substeps).astype(float)
    rim = np.linalg.norm(drive[:, 0, 4], axis=1) + 10.0 * np.linalg.norm(drive[:, 0, 5], axis=1)
    assert rim.max() <= 0.05 * 1.001
    assert drive[-1, 0, 3] == pytest.approx(end.position * 1e3, abs=1e-6)
    assert drive[-1, 0, :3] == pytest.approx(Rotation.from_quat(end.quaternion).as_matrix(), abs=1e-6)
    assert drive[:, 0, 4].sum(axis=0) * 0.4 == pytest.approx(end.position * 1e3, abs=1e-5)


def test_short_ways_of_what_yields_brake_no_harder_than_long_ones() -> None:
    """Half a gel thickness at full speed, and less the slower, with the same braking; the rest is not held back."""

    def braking(millimetres: float, yields: bool) -> float:
        end = Pose(np.array([0, 0, millimetres * 1e-3]))
        path = plan_path(
            [Pose()], [end], mach=0.05, dt=0.01, lever=10.0, thickness=4.0, memory_length=millimetres if yields else 0.0
        )
        speed = path.drive(0, path.substeps)[:, 0, 4, 2].astype(float)
        assert speed.max() <= 0.05 * 1.001
        return speed.max() / (path.substeps * path.dt)

    assert braking(2.0, yields=True) == pytest.approx(braking(2.0, yields=False))
    for short in (0.1, 0.5, 1.0):
        assert braking(short, yields=True) == pytest.approx(braking(2.0, yields=True), rel=1e-2)
        assert braking(short, yields=False) > 1.9 * braking(short, yields=True)


@pytest.mark.parametrize("by", [2.0, 0.3])
def test_a_path_that_lingers_ends_as_if_it_were_driven_more_slowly(by: float) -> None:
    """Three times as slowly over the last 0.25 mm, from 0.5 mm on ever more so, and before that as it was."""
    start, end = [Pose()], [Pose(np.array([by * 1e-3, 0.0, 0.0]))]
    usual = plan_path(start, end, mach=0.02, dt=0.02, lever=10.0, thickness=4.0)
    path = plan_path(start, end, mach=0.02, dt=0.02, lever=10.0, thickness=4.0, end_slowdown=3.0, end_length=0.25)

    def drive(of: Path) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Where it is, and how fast."""
        rows = of.drive(0, of.substeps)[:, 0].astype(float)
        return rows[:, 3, 0], rows[:, 4, 0]

    (x, speed), (usual_x, usual_speed) = drive(path), drive(usual)
    assert x[-1] == pytest.approx(by, abs=1e-6) and (speed >= 0.0).all()
    for left, slower in ((0.05, 3.0), (0.2, 3.0), (0.375, 2.0), (0.55, 1.0), (1.0, 1.0)):
        if left < by - 0.01:
            was = np.interp(by - left, usual_x, usual_speed)
            assert was / np.interp(by - left, x, speed) == pytest.approx(slower, rel=0.02)
    assert speed.max() <= path.peak_mach(10.0) * 1.001
    assert path.peak_mach(10.0) == pytest.approx(0.02, rel=1e-3)
    refined = replace(path, refine=2).drive(0, path.substeps)[1::2, 0, 3, 0]
    assert refined == pytest.approx(x, abs=1e-6)


def test_refining_cuts_the_same_path_finer() -> None:
    path = plan_path([Pose()], [Pose(np.array([0, 0, 1e-3]))], mach=0.05, dt=0.4, lever=10.0, thickness=4.0)
    coarse, fine = path.drive(5, 9), replace(path, refine=4).drive(5, 9)
    assert len(fine) == 16
    assert fine[3::4, 0, 3] == pytest.approx(coarse[:, 0, 3], abs=1e-6)


def test_no_motion_needs_no_substeps() -> None:
    assert plan_path([Pose()], [Pose()], mach=0.05, dt=0.4, lever=10.0, thickness=4.0).substeps == 0


def test_the_shortest_motion_lets_the_gel_follow() -> None:
    """It takes twice as long as the gel's wave needs through it, however short its path."""
    short = plan_path([Pose()], [Pose(np.array([0, 0, 1e-6]))], mach=0.05, dt=0.4, lever=10.0, thickness=4.0)
    assert short.substeps == 20
    far = plan_path([Pose()], [Pose(np.array([0, 0, 1e-3]))], mach=0.05, dt=0.4, lever=10.0, thickness=4.0)
    assert far.substeps == 94
    assert short.rise == 0.5 and far.rise * far.substeps * far.dt == pytest.approx(4.0, rel=0.01)


def flow(to: float, before: float) -> NDArray[np.float64]:
    """Where a step that flows takes a frame, after each substep [mm]: to `to` [mm] from 0, left at `before` [-]."""
    rates = np.array([[0.0, 0.0, before, 0.0, 0.0, 0.0]])
    path = plan_flow([Pose()], [Pose(np.array([0, 0, to * 1e-3]))], rates, mach=0.03, dt=0.1, lever=9.0, thickness=4.0)
    places: NDArray[np.float64] = path.drive(0, path.substeps)[:, 0, 3, 2].astype(float)
    assert places[-1] == pytest.approx(to, abs=1e-6)
    assert path.rates is not None and path.rates[1][0, 2] == pytest.approx(np.diff(places)[-1] / 0.1, abs=2e-4)
    return places


@pytest.mark.parametrize("to", [0.05, 0.2, 1.0])
def test_flowing_step_has_small_overshoot_for_any_next_step(to: float) -> None:
    """Clay keeps what goes beyond. A cubic from mean speed to mean speed, told to stay, went a seventh beyond."""
    onward = flow(to, before=0.0)
    assert onward.max() <= to + 1e-6 and (np.diff(onward) >= 0).all()
    passed = np.diff(onward)[-1] / 0.1
    assert passed == pytest.approx(0.5 * 0.03 * np.sqrt(to / 2.0), rel=0.05)
    assert (np.diff(flow(to, passed)) >= 0).all()
    beyond = [flow(next_step, passed).max() for next_step in (0.0, -to)]
    assert 0.0 < max(beyond) < 0.021 * to


def test_a_path_that_would_take_for_ever_is_refused() -> None:
    """Millimetres given as metres; but not what is slow and meant: 50 mm at Mach 0.001, in fine steps."""
    far = [Pose(np.array([0, 0, 500.0]))]
    words = r"500 m at Mach 0\.03 would take 7\.8e\+07 substeps \(limit 1,000,000\); are the targets in metres\?"
    with pytest.raises(ValueError, match=words):
        plan_path([Pose()], far, mach=0.03, dt=0.4, lever=10.0, thickness=4.0)
    with pytest.raises(ValueError, match=r"500 m at Mach 0\.01 would take 1\.2e\+08 substeps"):
        plan_flow([Pose()], far, np.zeros((1, 6)), mach=0.01, dt=0.4, lever=10.0, thickness=4.0)
    slow = plan_path([Pose()], [Pose(np.array([0, 0, 50e-3]))], mach=0.001, dt=0.125, lever=10.0, thickness=4.0)
    assert 0.7 * MAX_SUBSTEPS < slow.substeps < MAX_SUBSTEPS
