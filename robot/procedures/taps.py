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
from robot.procedures.session import POLL, CannotCalibrate, camera_sensor, hardware_arm
from robot.rig.commanded_arm import CommandedArm
from tacsim import pose as se3
from tacsim.interface import Arm, Pose
from tacsim.models.hardware import UrArmConfig
from tacsim.models.rig import RigConfig
from tacsim.rig import Rig

PAUSE = 0.8  # without contact, before the first tap and after the last [s]
CONTACT_TIME = (0.1, 0.4)  # how long it stays below, once there, from shortest to longest [s]
LIFTED_TIME = (0.2, 0.9)  # and above [s]


@dataclass(frozen=True, slots=True)
class TapPlan:
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
    change: list[float] = field(default_factory=list)  # mean change of the picture, of 255 [-]


def without_latency(config: RigConfig, arm: str, sensor: str) -> RigConfig:
    """The rig with both latencies 0, free running. Raises CannotCalibrate for unfit parts."""
    mover, camera = hardware_arm(config, arm), camera_sensor(config, sensor)
    if camera.arm != arm:
        raise CannotCalibrate(
            f"rig '{config.name}': sensor '{sensor}' is carried by {camera.arm or 'no arm'}, not by '{arm}'; tap with "
            "the arm that carries it"
        )
    return config.model_copy(
        update={
            "lock_step": False,  # a picture that waits for the arm tells no latency
            "contact": "hertz",  # nor does one that waits for a simulation; of mocks only
            "arms": {**config.arms, arm: mover.model_copy(update={"latency": 0.0})},
            "sensors": {**config.sensors, sensor: camera.model_copy(update={"latency": 0.0})},
        }
    )


def schedule(plan: TapPlan, travel: float) -> list[tuple[float, bool]]:
    """When to go where: (time since the beginning [s], down?), and at last the end. `travel`: of one motion [s]."""
    random = np.random.default_rng(plan.seed)
    now = PAUSE
    moves: list[tuple[float, bool]] = []
    for _ in range(plan.taps):
        moves.append((now, True))
        now += travel + random.uniform(*CONTACT_TIME)
        moves.append((now, False))
        now += travel + random.uniform(*LIFTED_TIME)
    return [*moves, (now + PAUSE, False)]


def record_taps(
    rig: Rig, config: RigConfig, arm: str, sensor: str, plan: TapPlan, stop: Callable[[], bool] = lambda: False
) -> TapRecord:
    """Resets the rig, taps, and leaves the arm lifted and stopped. `config`: what the rig was opened with.

    A stop ends it early. Raises what the reset, the arm or the camera raise; the arm is stopped then.
    """
    stride = 2  # of the pictures each n-th row and column counts
    limits = hardware_arm(config, arm).limits
    rig.reset()
    mover, camera = rig.arms[arm], rig.sensors[sensor]
    assert isinstance(mover, CommandedArm)
    mover.suspend_tactile_guard()  # pictures are looked at one by one here, not observed
    start = mover.state().pose
    axis = se3.rotation(start).apply([0.0, 0.0, 1.0])
    above, below = se3.translated_along_z(start, -plan.lift), se3.translated_along_z(start, plan.depth)
    travel = (plan.lift + plan.depth) / limits.speed + 2.0 * limits.speed / limits.acceleration
    reference = rig.references[sensor].image[::stride, ::stride].astype(np.int16)
    record = TapRecord()
    try:
        _hold(mover, above, travel + PAUSE)
        begun = time.monotonic()
        moves = schedule(plan, travel)
        index, last = -1, moves[-1][0]
        while (now := time.monotonic() - begun) < last and not stop():
            while moves[index + 1][0] <= now:
                index += 1
            down = index >= 0 and moves[index][1]
            mover.command(below if down else above)
            state = mover.state()
            if not record.arm_times or state.time > record.arm_times[-1]:
                record.arm_times.append(state.time)
                record.depth.append(float(axis @ (state.pose.position - start.position)))
            frame = camera.read(1.0)
            if not record.frame_times or frame.time > record.frame_times[-1]:
                record.frame_times.append(frame.time)
                record.change.append(float(np.abs(frame.image[::stride, ::stride] - reference).mean()) / 255.0)
            time.sleep(POLL)
        _hold(mover, above, travel)
    finally:
        rig.stop()
    record.clock = camera.status.clock if isinstance(camera, Camera) else None
    return record


def _hold(arm: Arm, target: Pose, seconds: float) -> None:
    """Sends the arm to `target`, and goes on asking for it."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        arm.command(target)
        time.sleep(POLL)


def latency_entries(
    measured: Latency, clock: ClockSource | None, arm: str, config: UrArmConfig, sensor: str
) -> dict[str, float]:
    """What to write into the rig file [s], by key: such that both times are those of the event.

    Pictures that bring their time of exposure along (`clock` "device" or "stamp") have no latency to be told; what is
    left is that of the arm. Otherwise the arm keeps its latency, unless the pictures would come from the future.
    """
    entries = {}
    if clock == "arrival":
        entries[f"sensors.{sensor}.latency"] = max(0.0, measured.seconds + config.latency)
    if clock != "arrival" or measured.seconds + config.latency < 0.0:
        entries[f"arms.{arm}.latency"] = max(0.0, -measured.seconds)
    return entries
