"""What the arm did at the time of an exposure (promise 10): closed forms, no clock of the machine."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from robot.arm.time_alignment import NotAligned, state_at
from tacsim import pose as se3
from tacsim.interface import ArmState, Pose

AXIS = np.array([2.0, -1.0, 2.0]) / 3.0


def state(time: float, speed: float = 0.1, rate: float = 0.5) -> ArmState:
    """A screw: along x at `speed` [m/s], about a fixed axis at `rate` [rad/s]; the wrench grows with time."""
    return ArmState(
        pose=Pose(np.array([speed * time, 0.2, 0.3]), Rotation.from_rotvec(rate * time * AXIS).as_quat()),
        twist=np.concatenate([[speed, 0.0, 0.0], rate * AXIS]),
        wrench=np.arange(6.0) * time,
        joints=np.arange(6.0) + time,
        time=time,
    )


def states(times: np.ndarray | list[float]) -> list[ArmState]:
    return [state(float(time)) for time in times]


def test_state_at_between_two_states_interpolates_exactly() -> None:
    made = states(np.arange(0.0, 1.0, 0.02))
    for time in (0.001, 0.5031, 0.9799):
        found, error = state_at(time, made, "left")
        shift, angle = se3.pose_distance(found.pose, state(time).pose)
        assert shift < 1e-12 and angle < 1e-7  # acos-free, but rounding of a quaternion is what it is
        np.testing.assert_allclose(found.wrench, state(time).wrench, atol=1e-12)
        np.testing.assert_allclose(found.twist, state(time).twist, atol=1e-12)
        np.testing.assert_allclose(found.joints, state(time).joints, atol=1e-12)
        assert found.time == time
        assert error == pytest.approx(min(time % 0.02, 0.02 - time % 0.02))


def test_state_at_time_of_state_returns_it() -> None:
    made = states([0.0, 0.01, 0.02])
    for each in made:
        assert state_at(each.time, made, "left") == (each, 0.0)


def test_state_at_rotation_takes_shorter_path() -> None:
    still = np.zeros(6)
    made = [
        ArmState(Pose(np.zeros(3), np.array(quaternion)), still, still, None, time)
        for time, quaternion in ((0.0, [0, 0, 0, 1]), (0.01, [0, 0, -np.sin(0.1), -np.cos(0.1)]))
    ]
    turned = se3.rotation(state_at(0.005, made, "left")[0].pose).as_rotvec()
    np.testing.assert_allclose(turned, [0, 0, 0.1], atol=1e-9)


def test_state_at_after_newest_extrapolates_to_limit() -> None:
    made = states([0.0, 0.01])
    found, error = state_at(0.018, made, "left", max_extrapolation=0.01)
    shift, angle = se3.pose_distance(found.pose, state(0.018).pose)
    assert shift < 1e-12 and angle < 1e-7 and error == pytest.approx(0.008)
    with pytest.raises(NotAligned, match=r"10\.5 ms after its newest state, limit 10\.0 ms"):
        state_at(0.0205, made, "left", max_extrapolation=0.01)
    with pytest.raises(NotAligned):
        state_at(float("nan"), made, "left")


def test_state_at_unknown_time_raises() -> None:
    with pytest.raises(NotAligned, match="no state yet"):
        state_at(0.0, [], "left")
    made = states([1.0, 1.01, 1.2])
    with pytest.raises(NotAligned, match=r"'left'.* before the oldest of 3 states"):
        state_at(0.99, made, "left")
    with pytest.raises(NotAligned, match=r"no state for 190\.0 ms .* limit 50\.0 ms; was the link lost"):
        state_at(1.1, made, "left")
    assert state_at(1.2, made, "left")[1] == 0.0


@pytest.mark.promise(10)
def test_state_at_injected_latency_error_below_one_millisecond() -> None:
    """Promise 10: camera 125 ms late, arm 10 ms late, both jittering; times of arrival minus latency find the pose."""
    rng = np.random.default_rng(0)
    table = {"camera": 0.125, "arm": 0.010}
    speed, worst = 0.25, 0.0

    def truth(time: float) -> ArmState:
        return ArmState(
            Pose(np.array([speed / 8.0 * np.sin(8.0 * time), 0.0, 0.0])),
            np.array([speed * np.cos(8.0 * time), 0, 0, 0, 0, 0]),
            np.zeros(6),
            None,
            time,
        )

    made: list[ArmState] = []
    arrivals = [(time + table["arm"] + rng.uniform(0, 2e-4), time) for time in np.arange(0.0, 4.0, 0.002)]
    frames = iter((time + table["camera"] + rng.uniform(0, 2e-4), time) for time in np.arange(0.2, 3.8, 1 / 30))
    arrival, exposed = next(frames)
    count, late = 0, 0.0
    for here, time in arrivals:
        measured = truth(time)
        made.append(ArmState(measured.pose, measured.twist, measured.wrench, None, here - table["arm"]))
        while arrival <= here:
            aligned, _ = state_at(arrival - table["camera"], made, "left")
            worst = max(worst, se3.pose_distance(aligned.pose, truth(exposed).pose)[0])
            late = max(late, se3.pose_distance(measured.pose, truth(exposed).pose)[0])
            count += 1
            arrival, exposed = next(frames, (np.inf, 0.0))
    assert count > 100
    assert worst < speed * 1e-3
    assert late > speed * 50e-3  # the newest state, unaligned, is fifty times worse
