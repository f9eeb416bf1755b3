"""Touches of a fixed ball with one sensor, from many tilts: the record from which calibration.poses.ball_touch finds
where the sensor sits on its arm.

The arm begins above the ball, at the rig's start. It goes down until it sees the ball, which tells roughly where the
ball is. For each further touch it retreats along the sensor's axis, tilts about the ball, and goes down again,
elsewhere on the gel. Every motion passes the arm's limits; touches whose motion they would shorten are left out.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from calibration.poses.ball_touch import BallTouch, locate_ball
from calibration.poses.robust_fit import BadMeasurements
from robot.errors import DeviceError
from robot.procedures.session import (
    GOLDEN_ANGLE,
    GOLDEN_RATIO,
    SETTLE,
    CannotCalibrate,
    OutsideLimits,
    Session,
    frame_after,
    hardware_arm,
    move_to,
)
from robot.procedures.tuning import MAX_LEFT_OUT, MAX_RELEASED_DEPTH
from tacsim import pose as se3
from tacsim.control.contact_signal import NoTouch, approach
from tacsim.interface import FloatArray, Pose, TactileObservation
from tacsim.limits import ActionError
from tacsim.models.rig import RigConfig
from tacsim.rig import Rig

FAILURES = (NoTouch, BadMeasurements, ActionError, OutsideLimits)  # what spoils one touch, and no more


@dataclass(frozen=True, slots=True)
class BallTouchPlan:
    ball_radius: float  # [m]
    touches: int = 24
    tilt: float = math.radians(25.0)  # largest [rad]
    spread: float = 3e-3  # contacts lie at most so far from the middle of the gel [m]
    depth: float = 0.4e-3  # pressed so deep [m]
    lift: float = 6e-3  # back along the sensor's axis between touches [m]
    step: float = 0.1e-3  # of the approach, between two looks at the gel [m]


def without_task(config: RigConfig, arm: str, sensor: str) -> RigConfig:
    """The rig without a task, whose reset therefore approaches nothing. Raises CannotCalibrate for unfit parts."""
    hardware_arm(config, arm)
    gel = config.sensors.get(sensor)
    if gel is None or gel.arm != arm:
        carried = ", ".join(name for name, each in config.sensors.items() if each.arm == arm) or "none"
        raise CannotCalibrate(f"rig '{config.name}': arm '{arm}' carries no sensor '{sensor}'; it carries: {carried}")
    if not gel.may_find_height:
        raise CannotCalibrate(
            f"sensors.{sensor} cannot tell how deep it is pressed; calibrate its light first (tacsim calibrate sensor)"
        )
    return config.model_copy(update={"task": None, "start": config.start.model_copy(update={"touch_signal": None})})


def schedule(plan: BallTouchPlan) -> list[tuple[Rotation, FloatArray]]:
    """For each touch the rotation of the sensor, in its own axes, and the place on the gel that meets the ball (2,)
    [m]. The first is straight and in the middle; the others are spread evenly over all directions, tilts and places."""
    touches = [(Rotation.identity(), np.zeros(2))]
    for index in range(1, plan.touches):
        share = index / max(1, plan.touches - 1)
        tilt, radius = plan.tilt * math.sqrt(share), plan.spread * math.sqrt((index * GOLDEN_RATIO) % 1.0)
        # twice as fast as tilts: even six touches then tell apart how the sensor is turned and where it sits
        direction, at = index * GOLDEN_ANGLE, index * GOLDEN_ANGLE * 2.0
        axis = np.array([math.cos(direction), math.sin(direction), 0.0])
        touches.append((Rotation.from_rotvec(tilt * axis), radius * np.array([math.cos(at), math.sin(at)])))
    return touches


def record_ball_touches(
    rig: Rig, config: RigConfig, arm: str, sensor: str, plan: BallTouchPlan, session: Session[BallTouch]
) -> None:
    """Resets the rig, touches, and leaves the arm lifted and stopped. `config`: what the rig was opened with.

    Raises NoTouch when the first approach meets nothing, DeviceError when most of the others fail, and what the reset,
    the arm or the camera raise; the arm is stopped then.
    """
    overshoot = 3e-3  # and ends so far beyond where the ball should be [m]
    slow_distance = 1e-3  # the approach begins so far before the ball, once its place is known [m]
    sensor_from_tool = se3.inverse(hardware_arm(config, arm).tool_from_sensor.pose)
    rig.reset()
    prober = _BallProber(rig, config, arm, sensor, plan)
    start = rig.arms[arm].state().pose
    centres: list[FloatArray] = []  # of the ball, as each touch finds it, (3,) in world [m]
    try:
        with session.until_stopped():
            for done, (rotation, place) in enumerate(schedule(plan)):
                session.progress(done)
                session.check()
                lifted = begin = start
                travel = config.start.approach_distance
                if centres:
                    tilted = Pose(quaternion=(se3.rotation(start) * rotation).as_quat())
                    centre = se3.rotate(tilted, np.array([*place, plan.ball_radius]))
                    touching = Pose(np.mean(centres, axis=0) - centre, tilted.quaternion)
                    lifted, begin = (
                        se3.translated_along_z(touching, -plan.lift),
                        se3.translated_along_z(touching, -slow_distance),
                    )
                    travel = slow_distance + overshoot
                try:
                    contact, depth, pose = prober.touch(lifted, begin, travel)
                except FAILURES as failure:
                    if not centres:
                        raise
                    session.left_out.append(f"touch {done + 1}: {failure}")
                    if len(session.left_out) > MAX_LEFT_OUT * plan.touches:
                        raise DeviceError("most touches failed; the last:\n" + session.left_out[-1]) from failure
                    continue
                centres.append(se3.transform(pose, np.array([*contact, plan.ball_radius - depth])))
                session.take(BallTouch(se3.compose(pose, sensor_from_tool), contact, depth))
    finally:
        rig.stop()


class _BallProber:
    """One arm, and the gel that it carries."""

    def __init__(self, rig: Rig, config: RigConfig, arm: str, sensor: str, plan: BallTouchPlan) -> None:
        self._rig, self._arm, self._name, self._sensor, self._plan = rig, rig.arms[arm], arm, sensor, plan
        self._speed, self._pitch = config.start.approach_speed, config.canonical.pitch

    def touch(self, lifted: Pose, begin: Pose, travel: float) -> tuple[tuple[float, float], float, Pose]:
        """One touch, from `lifted` (clear of the ball) over `begin`, and back to `lifted`: contact (x, y) [m], depth
        [m], and world_from_sensor as the arm has it. Raises one of FAILURES, and is lifted then, too; whatever else is
        raised leaves the arm as it is, for a person to look at."""
        move_to(self._arm, self._name, lifted)
        try:
            left = self._depth(self._observe(SETTLE))
            if left > MAX_RELEASED_DEPTH * self._plan.depth:
                raise BadMeasurements(
                    f"lifted off the ball, the gel is still pressed by {1e3 * left:.2f} mm, so its picture is no "
                    "reference: does something stick to it, did the light change, is the camera late?"
                )
            self._rig.normalisers[self._sensor].take_reference(self._rig.frames[self._sensor])
            move_to(self._arm, self._name, begin)
            touch = self._approach(begin, travel)
        except FAILURES:
            move_to(self._arm, self._name, lifted)
            raise
        move_to(self._arm, self._name, lifted)
        return touch

    def _approach(self, begin: Pose, travel: float) -> tuple[tuple[float, float], float, Pose]:
        """From `begin`, where the arm stands, along the sensor's axis until the gel is pressed deep enough: the touch.
        Raises NoTouch, BadMeasurements."""

        step_timeout = 5.0  # of one step of the approach [s]
        min_picture_delay = 0.02  # a picture of the approach is exposed at least so long after the last step [s]

        def touches() -> bool:
            return self._depth(self._observe(min_picture_delay)) >= self._plan.depth

        def advance(distance: float) -> None:
            due = time.monotonic() + self._plan.step / self._speed
            move_to(self._arm, self._name, se3.translated_along_z(begin, distance), step_timeout)
            time.sleep(max(0.0, due - time.monotonic()))

        advice = (
            "does the ball stand before the gel, and its start above it? (start.approach_distance in the rig file "
            "bounds the first approach)"
        )
        approach(touches, advance, self._plan.step, travel, advice)
        seen = self._observe(SETTLE)
        assert seen.height is not None
        contact, depth = locate_ball(seen.height.astype(np.float64), seen.valid, self._pitch, self._plan.ball_radius)
        return contact, depth, self._arm.state().pose

    @staticmethod
    def _depth(seen: TactileObservation) -> float:
        """How deep the gel is pressed at most [m]."""
        assert seen.height is not None
        return float(seen.height.max(where=seen.valid, initial=0.0))

    def _observe(self, wait: float) -> TactileObservation:
        """What is seen in a picture exposed at least `wait` [s] from now."""
        frame_after(self._rig.sensors[self._sensor], wait, 1.0)
        return self._rig.observe().tactile[self._sensor]
