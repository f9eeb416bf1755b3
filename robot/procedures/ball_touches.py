"""Touches of a fixed ball with one sensor, from many tilts: the record from which calibration.poses.ball_touch finds
where the sensor sits on its arm.

The arm begins above the ball, at the rig's start. It goes down until it sees the ball; that tells where the ball is,
nearly. Then it goes round: back along the sensor's axis, tilted about the ball, down again, elsewhere on the gel. Every
motion goes through the arm's limits; what they would shorten is left out.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from calibration.poses.ball_touch import BallTouch, locate_ball
from calibration.poses.robust_fit import BadMeasurements
from robot.errors import DeviceError
from robot.rig.hardware_rig import RigArm
from robot.rig.reset import NoTouch
from tacsim import pose as se3
from tacsim.interface import ArmState, FloatArray, Pose, TactileObservation
from tacsim.limits import ActionError
from tacsim.models.hardware import CameraSensorConfig, UrArmConfig
from tacsim.models.rig import RigConfig
from tacsim.rig import Rig

LOOK = 2e-3  # between two looks at the arm [s]
TRAVEL = 60.0  # longest way between two touches [s]
CLOSE, TURNED = 20e-6, 2e-4  # of the target: there [m, rad]
STILL = 1e-3  # slower than this is standing still [m/s]
SETTLE = 0.2  # a picture that counts is exposed so long after the arm came to rest [s]
NEAR = 1e-3  # from here on the arm goes slowly, once the ball's place is known [m]
BEYOND = 3e-3  # an approach ends so far beyond where the ball should be [m]
MOST_MISSED = 0.5  # of the touches; with more, something is wrong with the way
GOLDEN = math.pi * (3.0 - math.sqrt(5.0))  # turns that never repeat


class CannotTouch(ValueError):
    """This arm and this sensor are not such that touches could tell where the sensor sits."""


@dataclass(frozen=True, slots=True)
class TouchPlan:
    """How to touch."""

    ball_radius: float  # [m]
    touches: int = 24
    tilt: float = math.radians(25.0)  # largest [rad]
    spread: float = 3e-3  # contacts lie at most so far from the middle of the gel [m]
    depth: float = 0.4e-3  # pressed so deep [m]
    lift: float = 6e-3  # back along the sensor's axis between touches [m]
    step: float = 0.1e-3  # of the approach, between two looks at the gel [m]


def alone(config: RigConfig, arm: str, sensor: str) -> RigConfig:
    """The rig without a task, so that a reset approaches nothing. Raises CannotTouch for parts that cannot do it."""
    there, eye = config.arms.get(arm), config.sensors.get(sensor)
    if not isinstance(there, UrArmConfig):
        known = ", ".join(name for name, each in config.arms.items() if isinstance(each, UrArmConfig)) or "none"
        raise CannotTouch(f"rig '{config.name}': '{arm}' is no arm of hardware, real or mock; there are: {known}")
    if eye is None or eye.arm != arm:
        carried = ", ".join(name for name, each in config.sensors.items() if each.arm == arm) or "none"
        raise CannotTouch(f"rig '{config.name}': arm '{arm}' carries no sensor '{sensor}'; it carries: {carried}")
    if isinstance(eye, CameraSensorConfig) and eye.model is None and eye.calibration is None:
        raise CannotTouch(
            f"sensors.{sensor} cannot tell how deep it is pressed; calibrate its light first (tacsim calibrate sensor)"
        )
    quiet = config.start.model_copy(update={"touch_signal": None})
    return config.model_copy(update={"task": None, "start": quiet})


def schedule(plan: TouchPlan) -> list[tuple[Rotation, FloatArray]]:
    """How the sensor is turned (in its own axes) and where on the gel the ball is met (2,) [m], touch by touch. The
    first is straight and in the middle; the others are spread evenly over all directions, tilts and places."""
    found = [(Rotation.identity(), np.zeros(2))]
    for index in range(1, plan.touches):
        part = index / max(1, plan.touches - 1)
        tilt, place = plan.tilt * math.sqrt(part), plan.spread * math.sqrt((index * 0.618034) % 1.0)
        towards, at = index * GOLDEN, index * GOLDEN * 1.7 + 1.0
        axis = np.array([math.cos(towards), math.sin(towards), 0.0])
        found.append((Rotation.from_rotvec(tilt * axis), place * np.array([math.cos(at), math.sin(at)])))
    return found


@dataclass(slots=True)
class TouchRecord:
    """What came of a plan."""

    touches: list[BallTouch]
    missed: list[str]  # touches that were left out, and why


def record_touches(
    rig: Rig,
    config: RigConfig,
    arm: str,
    sensor: str,
    plan: TouchPlan,
    stop: Callable[[], bool] = lambda: False,
    tell: Callable[[int], None] = lambda done: None,
    keep: Callable[[Sequence[BallTouch]], None] = lambda touches: None,
) -> TouchRecord:
    """Resets the rig, touches, and leaves the arm lifted and stopped. `facts`: those that the rig was opened with.
    `keep` is given all touches so far after each one.

    A stop ends it early. Raises NoTouch when the first approach meets nothing, DeviceError when most of the others
    fail, and what the reset, the arm or the camera raise; the arm is stopped then.
    """
    there = config.arms[arm]
    assert isinstance(there, UrArmConfig)
    rig.reset()
    toucher = _Toucher(rig, config, arm, sensor, plan)
    sensor_from_tool = se3.inverse(there.tool_from_sensor.pose)
    begun = rig.arms[arm].state().pose
    record = TouchRecord([], [])
    balls: list[FloatArray] = []
    try:
        for done, (turn, place) in enumerate(schedule(plan)):
            tell(done)
            if stop():
                break
            lifted = begin = begun
            way = config.start.approach_way
            if balls:
                tilted = Pose(quaternion=(se3.rotation(begun) * turn).as_quat())
                at = se3.rotate(tilted, np.array([*place, plan.ball_radius]))
                touching = Pose(np.mean(balls, axis=0) - at, tilted.quaternion)
                lifted, begin, way = _along(touching, -plan.lift), _along(touching, -NEAR), NEAR + BEYOND
            try:
                contact, depth, pose = toucher.touch(lifted, begin, way)
            except MISSES as missed:
                if not balls:
                    raise
                record.missed.append(f"touch {done + 1}: {missed}")
                if len(record.missed) > MOST_MISSED * plan.touches:
                    raise DeviceError("most touches failed; the last:\n" + record.missed[-1]) from missed
                continue
            balls.append(se3.transform(pose, np.array([*contact, plan.ball_radius - depth])))
            record.touches.append(BallTouch(se3.compose(pose, sensor_from_tool), contact, depth))
            keep(record.touches)
    finally:
        rig.stop()
    return record


class Shortened(ValueError):
    """A pose of the plan lies outside the arm's limits."""


class Mover(Protocol):
    """What `go` needs of an arm."""

    def command(self, target: Pose | None) -> Pose | None: ...
    def state(self) -> ArmState: ...
    def stop(self) -> None: ...


def go(mover: Mover, name: str, target: Pose, timeout: float) -> None:
    """Drives an arm to a pose of its sensor and waits for rest. Raises Shortened, ActionError for what is out of reach,
    DeviceError after `timeout` [s] and for what stops an arm."""
    if isinstance(mover, RigArm):
        mover.unwatch()  # nothing is observed on the way
    deadline = time.monotonic() + timeout
    while True:
        sent = mover.command(target)
        if sent is not None and max(se3.distance(sent, target)) > 1e-6:
            mover.stop()
            raise Shortened("the way leads out of the arm's limits (workspace, planes or keep_out)")
        state = mover.state()
        metres, radians = se3.distance(state.pose, target)
        if metres < CLOSE and radians < TURNED and np.linalg.norm(state.twist[:3]) < STILL:
            return
        if time.monotonic() > deadline:
            raise DeviceError(f"arm '{name}' did not come to its target within {timeout:g} s")
        time.sleep(LOOK)


MISSES = (NoTouch, BadMeasurements, ActionError, Shortened)  # what spoils one touch, and no more


class _Toucher:
    """One arm, and the gel that it carries."""

    def __init__(self, rig: Rig, config: RigConfig, arm: str, sensor: str, plan: TouchPlan) -> None:
        self._rig, self._arm, self._sensor, self._plan = rig, arm, sensor, plan
        self._speed, self._pitch = config.start.approach_speed, config.canonical.pitch

    def touch(self, lifted: Pose, begin: Pose, way: float) -> tuple[tuple[float, float], float, Pose]:
        """One touch, from `lifted` (clear of the ball) over `begin`, and back to `lifted`: contact (x, y) [m], depth
        [m], and world_from_sensor as the arm has it. Raises one of MISSES, and is lifted then, too; whatever else is
        raised leaves the arm as it is, for a person to look at."""
        self._go(lifted, TRAVEL)
        try:
            self._take_reference()
            self._go(begin, TRAVEL)
            found = self._approach(begin, way)
        except MISSES:
            self._go(lifted, TRAVEL)
            raise
        self._go(lifted, TRAVEL)
        return found

    def _go(self, target: Pose, timeout: float) -> None:
        go(self._rig.arms[self._arm], self._arm, target, timeout)

    def _take_reference(self) -> None:
        """The gel as it is now is the gel without contact."""
        self._observe(SETTLE)
        self._rig.normalisers[self._sensor].take_reference(self._rig.frames[self._sensor])

    def _approach(self, begin: Pose, way: float) -> tuple[tuple[float, float], float, Pose]:
        """From `begin`, where the arm stands, along the sensor's axis until the gel is pressed deep enough: contact
        (x, y) [m], depth [m], and world_from_sensor as the arm has it. Raises NoTouch, BadMeasurements."""
        gone = 0.0
        while True:
            seen = self._observe(0.02)
            assert seen.height is not None
            if float(seen.height.max(where=seen.valid, initial=0.0)) >= self._plan.depth:
                break
            gone += self._plan.step
            if gone > way:
                raise NoTouch(
                    f"no touch after an approach of {1e3 * way:.3g} mm; does the ball stand before the gel, and its "
                    "start above it? (start.approach_way in the rig file bounds the first approach)"
                )
            due = time.monotonic() + self._plan.step / self._speed
            self._go(_along(begin, gone), 5.0)
            time.sleep(max(0.0, due - time.monotonic()))
        seen = self._observe(SETTLE)
        assert seen.height is not None
        contact, depth = locate_ball(seen.height.astype(np.float64), seen.valid, self._pitch, self._plan.ball_radius)
        return contact, depth, self._rig.arms[self._arm].state().pose

    def _observe(self, settle: float) -> TactileObservation:
        """What is seen in a picture exposed at least `settle` [s] from now."""
        source, since = self._rig.sensors[self._sensor], time.monotonic() + settle
        while source.read(1.0).time < since:
            time.sleep(LOOK)
        return self._rig.observe().tactile[self._sensor]


def _along(pose: Pose, way: float) -> Pose:
    """`pose`, shifted along its own z axis [m]."""
    return se3.compose(pose, Pose(np.array([0.0, 0.0, way])))
