"""Taps with one arm, seen by its camera: the record from which calibration.poses.latency finds how late pictures come.

The arm begins where a reset leaves it, in gentle touch; it lifts, and taps some times at uneven intervals. Both signals
are kept over times of arrival: latencies that the rig file knows already are taken as 0 meanwhile.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from calibration.poses.latency import Latency
from robot.camera.camera import Camera, ClockSource
from robot.rig.hardware_rig import RigArm
from tacsim import pose as se3
from tacsim.interface import Pose
from tacsim.models.hardware import CameraSensorConfig, UrArmConfig
from tacsim.models.rig import RigConfig
from tacsim.rig import Rig

LOOK = 2e-3  # between two looks at arm and camera [s]
PAUSE = 0.8  # without touch, before the first tap and after the last [s]
STAY = (0.1, 0.4)  # how long it stays below, once there, from shortest to longest [s]
AWAY = (0.2, 0.9)  # and above [s]
GRAIN = 2  # of the pictures each n-th row and column counts


class CannotTap(ValueError):
    """This arm and this sensor are not such that taps could tell a latency."""


@dataclass(frozen=True, slots=True)
class TapPlan:
    """How to tap."""

    taps: int = 8
    depth: float = 0.2e-3  # beyond where the reset left the sensor, along its own z [m]
    lift: float = 1e-3  # back from there, between taps [m]
    seed: int = 0  # of the intervals


@dataclass(slots=True)
class TapRecord:
    """Two signals of one motion, over times of arrival."""

    clock: ClockSource | None = None  # where the times of the pictures are from
    arm_times: list[float] = field(default_factory=list)  # [s]
    depth: list[float] = field(default_factory=list)  # along the sensor's z [m]
    frame_times: list[float] = field(default_factory=list)  # [s]
    touch: list[float] = field(default_factory=list)  # mean change of the picture, of 255 [-]


def untimed(config: RigConfig, arm: str, sensor: str) -> RigConfig:
    """The rig with both latencies 0, free running. Raises CannotTap for parts that are none, or belong apart."""
    there, eye = config.arms.get(arm), config.sensors.get(sensor)
    if not isinstance(there, UrArmConfig):
        known = ", ".join(name for name, each in config.arms.items() if isinstance(each, UrArmConfig)) or "none"
        raise CannotTap(
            f"rig '{config.name}': '{arm}' is no arm that can tap; arms with a driver for hardware: {known}"
        )
    if not isinstance(eye, CameraSensorConfig):
        known = (
            ", ".join(name for name, each in config.sensors.items() if isinstance(each, CameraSensorConfig)) or "none"
        )
        raise CannotTap(f"rig '{config.name}': '{sensor}' is no sensor with a camera; cameras: {known}")
    if eye.arm != arm:
        raise CannotTap(
            f"rig '{config.name}': sensor '{sensor}' is carried by {eye.arm or 'no arm'}, not by '{arm}'; tap with the "
            "arm that carries it"
        )
    return config.model_copy(
        update={
            "lock_step": False,  # a picture that waits for the arm tells no latency
            "contact": "hertz",  # nor does one that waits for a simulation; of mocks only
            "arms": {**config.arms, arm: there.model_copy(update={"latency": 0.0})},
            "sensors": {**config.sensors, sensor: eye.model_copy(update={"latency": 0.0})},
        }
    )


def schedule(plan: TapPlan, travel: float) -> list[tuple[float, bool]]:
    """When to go where: (time since the beginning [s], down?), and at last the end. `travel`: of one way [s]."""
    random = np.random.default_rng(plan.seed)
    now = PAUSE
    moves: list[tuple[float, bool]] = []
    for _ in range(plan.taps):
        moves.append((now, True))
        now += travel + random.uniform(*STAY)
        moves.append((now, False))
        now += travel + random.uniform(*AWAY)
    return [*moves, (now + PAUSE, False)]


def record_taps(
    rig: Rig, config: RigConfig, arm: str, sensor: str, plan: TapPlan, stop: Callable[[], bool] = lambda: False
) -> TapRecord:
    """Resets the rig, taps, and leaves the arm lifted and stopped. `facts`: those that the rig was opened with.

    A stop ends it early. Raises what the reset, the arm or the camera raise; the arm is stopped then.
    """
    arm_facts = config.arms[arm]
    assert isinstance(arm_facts, UrArmConfig)
    rig.reset()
    mover, eye = rig.arms[arm], rig.sensors[sensor]
    assert isinstance(mover, RigArm)
    mover.unwatch()  # pictures are looked at one by one here, not observed
    begun = mover.state().pose
    axis = se3.rotation(begun).apply([0.0, 0.0, 1.0])
    above = se3.compose(begun, Pose(np.array([0.0, 0.0, -plan.lift])))
    below = se3.compose(begun, Pose(np.array([0.0, 0.0, plan.depth])))
    limits = arm_facts.limits
    travel = (plan.lift + plan.depth) / limits.speed + 2.0 * limits.speed / limits.acceleration
    reference = rig.references[sensor].image[::GRAIN, ::GRAIN].astype(np.int16)
    taken = TapRecord()
    try:
        _hold(rig, above, arm, travel + PAUSE)
        began = time.monotonic()
        moves = schedule(plan, travel)
        index, last = -1, moves[-1][0]
        while (now := time.monotonic() - began) < last and not stop():
            while moves[index + 1][0] <= now:
                index += 1
            down = index >= 0 and moves[index][1]
            mover.command(below if down else above)
            state = mover.state()
            if not taken.arm_times or state.time > taken.arm_times[-1]:
                taken.arm_times.append(state.time)
                taken.depth.append(float(axis @ (state.pose.position - begun.position)))
            frame = eye.read(1.0)
            if not taken.frame_times or frame.time > taken.frame_times[-1]:
                taken.frame_times.append(frame.time)
                taken.touch.append(float(np.abs(frame.image[::GRAIN, ::GRAIN] - reference).mean()) / 255.0)
            time.sleep(LOOK)
        _hold(rig, above, arm, travel)
    finally:
        rig.stop()
    taken.clock = eye.status.clock if isinstance(eye, Camera) else None
    return taken


def _hold(rig: Rig, target: Pose, arm: str, seconds: float) -> None:
    """Sends the arm to `target`, and goes on asking for it."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        rig.arms[arm].command(target)
        time.sleep(LOOK)


def entries(
    found: Latency, clock: ClockSource | None, arm: str, arm_facts: UrArmConfig, sensor: str
) -> dict[str, float]:
    """What to write into the rig file [s], by key: such that both times are those of the event.

    Pictures that bring their time of exposure along (`clock` "device" or "stamp") have no latency to be told; what is
    left is that of the arm. Otherwise the arm keeps its latency, unless the pictures would come from the future.
    """
    lines = {}
    if clock == "arrival":
        lines[f"sensors.{sensor}.latency"] = max(0.0, found.seconds + arm_facts.latency)
    if clock != "arrival" or found.seconds + arm_facts.latency < 0.0:
        lines[f"arms.{arm}.latency"] = max(0.0, -found.seconds)
    return lines
