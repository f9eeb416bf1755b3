"""What the arm did when the picture was taken: states of an arm over time, asked for at the time of an exposure.

A camera frame comes tens of milliseconds after its exposure, an arm's state a few after its measurement. Each driver
takes its calibrated latency off (`UrArmFacts.latency`, `CameraSensorFacts.latency`), so that all times are those of the
event, on one monotonic clock. Between two states the arm is interpolated. NumPy only.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import deque
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from robot.errors import DeviceError
from tacsim import pose as se3
from tacsim.interface import ArmState, FloatArray, Pose


class NotAligned(DeviceError):
    """There is no state of the arm near enough to the time that was asked for."""


@dataclass(frozen=True, slots=True, eq=False)
class AlignedState:
    """What an arm did at some time."""

    state: ArmState  # interpolated; `time` is the time that was asked for
    error: float  # to the nearer of the two states it is made of; 0 at one of them [s]
    gap: float  # between these two; 0 where it was carried on from the newest alone [s]


class ArmHistory:
    """The last states of one arm. One thread may append while others ask."""

    def __init__(self, name: str, length: int = 1000, max_gap: float = 50e-3, reach: float = 10e-3) -> None:
        """Keeps `length` states (1000: two seconds at 500 Hz). Two states further apart than `max_gap` [s] say
        nothing of the time between them. Beyond the newest, a state is carried on with its twist for `reach` [s]."""
        if length < 2 or not max_gap > 0.0 or not reach >= 0.0:
            raise ValueError(
                f"history of arm '{name}': needs at least 2 states, a gap above 0 s and a reach of 0 s or more, got "
                f"length {length}, max_gap {max_gap}, reach {reach}"
            )
        self._name, self._max_gap, self._reach = name, max_gap, reach
        self._states: deque[ArmState] = deque(maxlen=length)

    def append(self, state: ArmState) -> None:
        """Takes the next state; one with the time of the last is the same package, and is passed over.

        Raises ValueError for one that is older than the last, or has another number of joints.
        """
        if not np.isfinite(state.time):
            raise ValueError(f"history of arm '{self._name}': a state at time {state.time}")
        if self._states:
            last = self._states[-1]
            if state.time == last.time:
                return
            if state.time < last.time:
                raise ValueError(
                    f"history of arm '{self._name}': a state at {state.time:.6f} s after one at {last.time:.6f} s; "
                    "times must grow (after a new connection, start a new history)"
                )
            if _joints(state) != _joints(last):
                raise ValueError(f"history of arm '{self._name}': {_joints(state)} joints after {_joints(last)}")
        self._states.append(state)

    def __len__(self) -> int:
        return len(self._states)

    def at(self, time: float) -> AlignedState:
        """The state at `time` [s]: pose on the straight way (slerp), twist, wrench and joints in proportion.

        Raises NotAligned when `time` is older than all states, newer than the newest by more than the reach, or lies
        in a gap.
        """
        states = list(self._states)  # a consistent copy: appending goes on meanwhile
        if not states:
            raise NotAligned(f"arm '{self._name}': no state yet")
        newest = states[-1]
        if time > newest.time:
            return self._carry_on(newest, time)
        after = bisect_left(states, time, key=lambda state: state.time)
        if after == 0:
            if time == states[0].time:
                return AlignedState(state=states[0], error=0.0, gap=0.0)
            raise NotAligned(
                f"arm '{self._name}': {time:.6f} s is {1e3 * (states[0].time - time):.1f} ms before the oldest of "
                f"{len(states)} states; keep more of them, or look at the latency of the camera"
            )
        a, b = states[after - 1], states[after]
        gap = b.time - a.time
        if time == b.time:
            return AlignedState(state=b, error=0.0, gap=gap)
        if gap > self._max_gap:
            raise NotAligned(
                f"arm '{self._name}': no state for {1e3 * gap:.1f} ms around {time:.6f} s, limit "
                f"{1e3 * self._max_gap:.1f} ms; was the link lost?"
            )
        return AlignedState(state=_between(a, b, time), error=min(time - a.time, b.time - time), gap=gap)

    def _carry_on(self, newest: ArmState, time: float) -> AlignedState:
        ahead = time - newest.time
        if not ahead <= self._reach:  # also NaN
            raise NotAligned(
                f"arm '{self._name}': {time:.6f} s is {1e3 * ahead:.1f} ms after its newest state, limit "
                f"{1e3 * self._reach:.1f} ms; has the arm stopped sending, or is a latency wrong?"
            )
        turn = Rotation.from_rotvec(ahead * newest.twist[3:]) * se3.rotation(newest.pose)
        pose = Pose(newest.pose.position + ahead * newest.twist[:3], turn.as_quat())
        state = ArmState(pose=pose, twist=newest.twist, wrench=newest.wrench, joints=newest.joints, time=time)
        return AlignedState(state=state, error=ahead, gap=0.0)


def _between(a: ArmState, b: ArmState, time: float) -> ArmState:
    s = (time - a.time) / (b.time - a.time)
    joints = None if a.joints is None or b.joints is None else _mix(a.joints, b.joints, s)
    return ArmState(
        pose=se3.interpolate(a.pose, b.pose, s),
        twist=_mix(a.twist, b.twist, s),
        wrench=_mix(a.wrench, b.wrench, s),
        joints=joints,
        time=time,
    )


def _mix(a: FloatArray, b: FloatArray, s: float) -> FloatArray:
    mixed: FloatArray = (1.0 - s) * a + s * b
    return mixed


def _joints(state: ArmState) -> int:
    return 0 if state.joints is None else len(state.joints)
