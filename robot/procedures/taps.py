"""Records taps of one arm and the pictures of its camera; calibration.poses.latency finds the latency from the record.

The arm begins in the light contact after a reset; it lifts, and taps several times at uneven intervals. Both signals
are recorded over times of arrival: latencies of the rig file are set to 0 during the record.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from calibration.poses.latency import Latency
from robot.camera.camera import Camera, ClockSource
from robot.procedures.session import POLL_PERIOD, CannotCalibrate, camera_sensor, hardware_arm
from robot.rig.commanded_arm import CommandedArm
from tacsim import pose as se3
from tacsim.interface import Arm, Pose
from tacsim.models.hardware import UrArmConfig
from tacsim.models.rig import RigConfig
from tacsim.rig import Rig

PAUSE_TIME = 0.8  # without contact, before the first and after the last tap [s]
CONTACT_TIME = (0.1, 0.4)  # in contact after arrival, minimum and maximum [s]
LIFTED_TIME = (0.2, 0.9)  # lifted after arrival, minimum and maximum [s]


@dataclass(frozen=True, slots=True)
class TapPlan:
    taps: int = 8
    depth: float = 0.2e-3  # beyond the pose after the reset, along sensor z [m]
    lift: float = 1e-3  # back from that pose, between taps [m]
    seed: int = 0  # of the intervals


@dataclass(slots=True)
class TapRecord:
    """Two signals of one motion over times of arrival."""

    clock: ClockSource | None = None  # source of the picture times
    arm_times: list[float] = field(default_factory=list)  # [s]
    depth: list[float] = field(default_factory=list)  # along the sensor's z [m]
    frame_times: list[float] = field(default_factory=list)  # [s]
    change: list[float] = field(default_factory=list)  # mean change of the picture, of 255 [-]


def without_latency(config: RigConfig, arm: str, sensor: str) -> RigConfig:
    """The rig with both latencies 0, without lock step. Raises CannotCalibrate for unsuitable parts."""
    tapping_arm, camera = hardware_arm(config, arm), camera_sensor(config, sensor)
    if camera.arm != arm:
        raise CannotCalibrate(
            f"rig '{config.name}': sensor '{sensor}' is carried by {camera.arm or 'no arm'}, not by '{arm}'; tap with "
            "the arm that carries it"
        )
    return config.model_copy(
        update={
            "lock_step": False,  # a picture that waits for the arm has no latency
            "contact": "hertz",  # also without waits for a simulation; mocks only
            "arms": {**config.arms, arm: tapping_arm.model_copy(update={"latency": 0.0})},
            "sensors": {**config.sensors, sensor: camera.model_copy(update={"latency": 0.0})},
        }
    )


def schedule(plan: TapPlan, travel: float) -> list[tuple[float, bool]]:
    """Moves as (time since the beginning [s], down?), the last is the end. `travel`: time of one motion [s]."""
    random = np.random.default_rng(plan.seed)
    now = PAUSE_TIME
    moves: list[tuple[float, bool]] = []
    for _ in range(plan.taps):
        moves.append((now, True))
        now += travel + random.uniform(*CONTACT_TIME)
        moves.append((now, False))
        now += travel + random.uniform(*LIFTED_TIME)
    return [*moves, (now + PAUSE_TIME, False)]


def record_taps(
    rig: Rig, config: RigConfig, arm: str, sensor: str, plan: TapPlan, stop: Callable[[], bool] = lambda: False
) -> TapRecord:
    """Resets the rig, taps, and leaves the arm lifted and stopped. `config`: that of the open rig.

    `stop` ends it early. Raises the errors of the reset, the arm and the camera, after stopping the arm.
    """
    stride = 2  # only every n-th row and column of a picture is used
    limits = hardware_arm(config, arm).limits
    rig.reset()
    tapping_arm, camera = rig.arms[arm], rig.sensors[sensor]
    assert isinstance(tapping_arm, CommandedArm)
    tapping_arm.suspend_tactile_guard()  # pictures are read here, without observations
    start = tapping_arm.state().pose
    axis = se3.rotation(start).apply([0.0, 0.0, 1.0])
    above, below = se3.translated_along_z(start, -plan.lift), se3.translated_along_z(start, plan.depth)
    travel = (plan.lift + plan.depth) / limits.speed + 2.0 * limits.speed / limits.acceleration
    reference = rig.references[sensor].image[::stride, ::stride].astype(np.int16)
    record = TapRecord()
    try:
        _hold_target(tapping_arm, above, travel + PAUSE_TIME)
        begun = time.monotonic()
        moves = schedule(plan, travel)
        index, last = -1, moves[-1][0]
        while (now := time.monotonic() - begun) < last and not stop():
            while moves[index + 1][0] <= now:
                index += 1
            down = index >= 0 and moves[index][1]
            tapping_arm.command(below if down else above)
            state = tapping_arm.state()
            if not record.arm_times or state.time > record.arm_times[-1]:
                record.arm_times.append(state.time)
                record.depth.append(float(axis @ (state.pose.position - start.position)))
            frame = camera.read(1.0)
            if not record.frame_times or frame.time > record.frame_times[-1]:
                record.frame_times.append(frame.time)
                record.change.append(float(np.abs(frame.image[::stride, ::stride] - reference).mean()) / 255.0)
            time.sleep(POLL_PERIOD)
        _hold_target(tapping_arm, above, travel)
    finally:
        rig.stop()
    record.clock = camera.status.clock if isinstance(camera, Camera) else None
    return record


def _hold_target(arm: Arm, target: Pose, seconds: float) -> None:
    """Commands `target` repeatedly for `seconds` [s]."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        arm.command(target)
        time.sleep(POLL_PERIOD)


def latency_entries(
    measured: Latency, clock: ClockSource | None, arm: str, config: UrArmConfig, sensor: str
) -> dict[str, float]:
    """Entries for the rig file [s], by key, with which both times are those of the event.

    Pictures with their own time of exposure (`clock` "device" or "stamp") have no latency entry; the remaining latency
    is that of the arm. Otherwise the arm keeps its latency, unless pictures would then precede their events.
    """
    entries = {}
    if clock == "arrival":
        entries[f"sensors.{sensor}.latency"] = max(0.0, measured.seconds + config.latency)
    if clock != "arrival" or measured.seconds + config.latency < 0.0:
        entries[f"arms.{arm}.latency"] = max(0.0, -measured.seconds)
    return entries
