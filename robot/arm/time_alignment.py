"""The state of an arm at the time a picture was exposed.

A camera frame arrives tens of milliseconds after its exposure, a state of the arm a few milliseconds after its
measurement. Each driver subtracts its calibrated latency (`UrArmConfig.latency`, `CameraSensorConfig.latency`), so all
times are those of the event, on one monotonic clock. The state of the arm is interpolated between two packages.
"""

from __future__ import annotations

import math
import time as wall
from bisect import bisect_left
from collections.abc import Callable, Sequence

from scipy.spatial.transform import Rotation

from robot.arm.trajectory import PERIOD
from robot.errors import DeviceError
from tacsim import pose as se3
from tacsim.interface import ArmState, FloatArray, Pose


class NotAligned(DeviceError):
    """No state of the arm is near enough to the requested time."""


def state_at(
    time: float,
    states: Sequence[ArmState],
    arm: str,
    max_gap: float = 50e-3,
    max_extrapolation: float = 10e-3,
) -> tuple[ArmState, float]:
    """The state at `time` [s], interpolated: pose on the straight path (slerp); twist, wrench and joints linearly.
    Also the time distance to the nearer of the two states, 0 at one of them [s].

    Args:
        states: in order of time, such as the last two seconds.
        arm: its name, for messages.

    Raises NotAligned if `time` is before all states, after the newest by more than `max_extrapolation`, or in a gap.
    """
    if not states:
        raise NotAligned(f"arm '{arm}': no state yet")
    if not time <= states[-1].time:  # also NaN
        return _extrapolate(states[-1], time, arm, max_extrapolation)
    after = bisect_left(states, time, key=lambda state: state.time)
    b = states[after]
    if time == b.time:
        return b, 0.0
    if after == 0:
        raise NotAligned(
            f"arm '{arm}': {time:.6f} s is {1e3 * (b.time - time):.1f} ms before the oldest of {len(states)} states; "
            "keep more of them, or check the latency of the camera"
        )
    a = states[after - 1]
    if b.time - a.time > max_gap:
        raise NotAligned(
            f"arm '{arm}': no state for {1e3 * (b.time - a.time):.1f} ms around {time:.6f} s, limit "
            f"{1e3 * max_gap:.1f} ms; was the link lost?"
        )
    return _interpolate(a, b, time), min(time - a.time, b.time - time)


def await_state_at(
    time: float,
    newest: Callable[[], ArmState],
    history: Callable[[int | None], list[ArmState]],
    arm: str,
    link_timeout: float,
) -> tuple[ArmState, float]:
    """`state_at` for a past time of the wall clock [s], whose packages may not have arrived yet.

    newest: reads the newest state. history: the last so many states, or all that are kept (None). link_timeout: a
    longer gap between packages is a lost link [s]. Raises NotAligned for a moment that no package covers.
    """
    deadline = wall.monotonic() + link_timeout
    while newest().time < time and wall.monotonic() < deadline:
        wall.sleep(1e-3)
    packages = max(8, math.ceil((wall.monotonic() - time) / PERIOD) + 8)  # from before that moment to now
    states = history(packages)
    if states and states[0].time > time:  # this process was delayed
        states = history(None)
    return state_at(time, states, arm, link_timeout)


def _extrapolate(newest: ArmState, time: float, arm: str, max_extrapolation: float) -> tuple[ArmState, float]:
    ahead = time - newest.time
    if not ahead <= max_extrapolation:  # also NaN
        raise NotAligned(
            f"arm '{arm}': {time:.6f} s is {1e3 * ahead:.1f} ms after its newest state, limit "
            f"{1e3 * max_extrapolation:.1f} ms; "
            "has the arm stopped sending, or is a latency wrong?"
        )
    turn = Rotation.from_rotvec(ahead * newest.twist[3:]) * se3.rotation(newest.pose)
    pose = Pose(newest.pose.position + ahead * newest.twist[:3], turn.as_quat())
    return ArmState(pose=pose, twist=newest.twist, wrench=newest.wrench, joints=newest.joints, time=time), ahead


def _interpolate(a: ArmState, b: ArmState, time: float) -> ArmState:
    s = (time - a.time) / (b.time - a.time)

    def mix(before: FloatArray, after: FloatArray) -> FloatArray:
        mixed: FloatArray = (1.0 - s) * before + s * after
        return mixed

    return ArmState(
        pose=se3.interpolate_pose(a.pose, b.pose, s),
        twist=mix(a.twist, b.twist),
        wrench=mix(a.wrench, b.wrench),
        joints=None if a.joints is None or b.joints is None else mix(a.joints, b.joints),
        time=time,
    )
