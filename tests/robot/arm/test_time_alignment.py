"""What the arm did at the time of an exposure (promise 10): closed forms, no clock of the machine."""

from __future__ import annotations

import threading

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from robot.arm.time_alignment import ArmHistory, NotAligned
from tacsim import pose as se3
from tacsim.interface import ArmState, Pose

AXIS = np.array([2.0, -1.0, 2.0]) / 3.0


def state(time: float, speed: float = 0.1, rate: float = 0.5, joints: bool = True) -> ArmState:
    """A screw: along x at `speed` [m/s], about a fixed axis at `rate` [rad/s]; the wrench grows with time."""
    return ArmState(
        pose=Pose(np.array([speed * time, 0.2, 0.3]), Rotation.from_rotvec(rate * time * AXIS).as_quat()),
        twist=np.concatenate([[speed, 0.0, 0.0], rate * AXIS]),
        wrench=np.arange(6.0) * time,
        joints=np.arange(6.0) + time if joints else None,
        time=time,
    )


def history(times: np.ndarray, **options: float) -> ArmHistory:
    made = ArmHistory("left", **options)  # type: ignore[arg-type]
    for time in times:
        made.append(state(float(time)))
    return made


def test_between_two_states_all_of_it_is_exact() -> None:
    made = history(np.arange(0.0, 1.0, 0.02))
    for time in (0.001, 0.5031, 0.9799):
        aligned = made.at(time)
        way, angle = se3.distance(aligned.state.pose, state(time).pose)
        assert way < 1e-12 and angle < 1e-7  # acos-free, but rounding of a quaternion is what it is
        np.testing.assert_allclose(aligned.state.wrench, state(time).wrench, atol=1e-12)
        np.testing.assert_allclose(aligned.state.twist, state(time).twist, atol=1e-12)
        np.testing.assert_allclose(aligned.state.joints, state(time).joints, atol=1e-12)
        assert aligned.state.time == time
        assert aligned.error == pytest.approx(min(time % 0.02, 0.02 - time % 0.02)) and aligned.gap == pytest.approx(
            0.02
        )


def test_at_a_state_it_is_that_state() -> None:
    made = history(np.array([0.0, 0.01, 0.02]))
    for time in (0.0, 0.01, 0.02):
        aligned = made.at(time)
        assert aligned.error == 0.0 and aligned.state.time == time
        np.testing.assert_array_equal(aligned.state.pose.position, state(time).pose.position)


def test_turns_take_the_shorter_way() -> None:
    made = ArmHistory("left")
    for time, quaternion in ((0.0, [0, 0, 0, 1]), (0.01, [0, 0, -np.sin(0.1), -np.cos(0.1)])):
        unmoving = np.zeros(6)
        made.append(ArmState(Pose(np.zeros(3), np.array(quaternion)), unmoving, unmoving, None, time))
    turned = se3.rotation(made.at(0.005).state.pose).as_rotvec()
    np.testing.assert_allclose(turned, [0, 0, 0.1], atol=1e-9)


def test_carried_on_with_its_twist_and_no_further_than_the_reach() -> None:
    made = history(np.array([0.0, 0.01]), reach=0.01)
    aligned = made.at(0.018)
    way, angle = se3.distance(aligned.state.pose, state(0.018).pose)
    assert way < 1e-12 and angle < 1e-7 and aligned.error == pytest.approx(0.008) and aligned.gap == 0.0
    with pytest.raises(NotAligned, match=r"10\.5 ms after its newest state, limit 10\.0 ms"):
        made.at(0.0205)
    with pytest.raises(NotAligned):
        made.at(float("nan"))


def test_refuses_what_it_cannot_know() -> None:
    with pytest.raises(NotAligned, match="no state yet"):
        ArmHistory("left").at(0.0)
    made = history(np.array([1.0, 1.01, 1.2]))
    with pytest.raises(NotAligned, match=r"'left'.* before the oldest of 3 states"):
        made.at(0.99)
    with pytest.raises(NotAligned, match=r"no state for 190\.0 ms .* limit 50\.0 ms; was the link lost"):
        made.at(1.1)
    assert made.at(1.2).error == 0.0


def test_keeps_the_newest_states_only() -> None:
    made = history(np.arange(100) * 0.01, length=10)
    assert len(made) == 10
    assert made.at(0.955).state.pose.position[0] == pytest.approx(0.0955)
    with pytest.raises(NotAligned, match="before the oldest"):
        made.at(0.5)


def test_what_is_no_next_state_is_refused() -> None:
    made = history(np.array([0.0, 0.01]))
    made.append(state(0.01))  # the same package
    assert len(made) == 2
    with pytest.raises(ValueError, match="times must grow"):
        made.append(state(0.005))
    with pytest.raises(ValueError, match="0 joints after 6"):
        made.append(state(0.02, joints=False))
    still = np.zeros(6)
    with pytest.raises(ValueError, match="at time nan"):
        made.append(ArmState(Pose(), still, still, still, float("nan")))
    for options in ({"length": 1}, {"max_gap": 0.0}, {"reach": -1.0}):
        with pytest.raises(ValueError, match="needs at least 2 states"):
            ArmHistory("left", **options)  # type: ignore[arg-type]


@pytest.mark.promise(10)
def test_injected_latencies_leave_less_than_a_millisecond_of_motion() -> None:
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

    made = ArmHistory("left")
    arrivals = [(time + table["arm"] + rng.uniform(0, 2e-4), time) for time in np.arange(0.0, 4.0, 0.002)]
    frames = iter((time + table["camera"] + rng.uniform(0, 2e-4), time) for time in np.arange(0.2, 3.8, 1 / 30))
    arrival, exposed = next(frames)
    count, late = 0, 0.0
    for here, time in arrivals:
        measured = truth(time)
        made.append(ArmState(measured.pose, measured.twist, measured.wrench, None, here - table["arm"]))
        while arrival <= here:
            aligned = made.at(arrival - table["camera"])
            worst = max(worst, se3.distance(aligned.state.pose, truth(exposed).pose)[0])
            late = max(late, se3.distance(measured.pose, truth(exposed).pose)[0])
            count += 1
            arrival, exposed = next(frames, (np.inf, 0.0))
    assert count > 100
    assert worst < speed * 1e-3
    assert late > speed * 50e-3  # the newest state, unaligned, is fifty times worse


def test_one_thread_may_append_while_others_ask() -> None:
    made = history(np.arange(10) * 0.002, length=50)
    failures: list[Exception] = []
    done = threading.Event()

    def ask() -> None:
        while not done.is_set():
            newest = made._states[-1].time
            try:
                aligned = made.at(newest - 0.003)
                assert se3.distance(aligned.state.pose, state(newest - 0.003).pose)[0] < 1e-9
            except Exception as failure:
                failures.append(failure)
                return

    asking = [threading.Thread(target=ask) for _ in range(2)]
    for thread in asking:
        thread.start()
    for number in range(10, 3000):
        made.append(state(0.002 * number))
    done.set()
    for thread in asking:
        thread.join()
    assert failures == []
