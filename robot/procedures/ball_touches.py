"""Records touches of a fixed ball by one sensor at many tilts. calibration.poses.ball_touch finds the pose of the
sensor on its arm from this record.

The arm begins above the ball, at the rig's start pose. It moves down until the gel touches the ball, which gives a
first position of the ball. For each further touch it retracts along the sensor's axis, tilts about the ball, and moves
down again, with another contact position on the gel. Limits of the arm apply to every motion; a touch whose target they
clip is left out.
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
    SETTLING_TIME,
    CannotCalibrate,
    OutsideLimits,
    Session,
    frame_after,
    hardware_arm,
    move_to,
)
from tacsim import pose as se3
from tacsim.control import NoTouch, approach
from tacsim.interface import FloatArray, Pose, TactileObservation
from tacsim.limits import ActionError
from tacsim.models.rig import RigConfig
from tacsim.rig import Rig

MAX_LEFT_OUT_SHARE = 0.5  # of the touches; more indicates a fault of the set-up
MAX_FREE_DEPTH_SHARE = 0.5  # of the depth of a touch; a lifted gel with more is not free
TOUCH_ERRORS = (NoTouch, BadMeasurements, ActionError, OutsideLimits)  # these end one touch only


@dataclass(frozen=True, slots=True)
class BallTouchPlan:
    ball_radius: float  # [m]
    touches: int = 24
    tilt: float = math.radians(25.0)  # maximum [rad]
    spread: float = 3e-3  # maximum distance of a contact from the centre of the gel [m]
    depth: float = 0.4e-3  # indentation depth of a touch [m]
    lift: float = 6e-3  # back along the sensor's axis between touches [m]
    step: float = 0.1e-3  # of the approach, between two readings of the gel [m]


def without_task(config: RigConfig, arm: str, sensor: str) -> RigConfig:
    """The rig without a task, so its reset makes no approach. Raises CannotCalibrate for unsuitable parts."""
    hardware_arm(config, arm)
    gel = config.sensors.get(sensor)
    if gel is None or gel.arm != arm:
        carried = ", ".join(name for name, each in config.sensors.items() if each.arm == arm) or "none"
        raise CannotCalibrate(f"rig '{config.name}': arm '{arm}' carries no sensor '{sensor}'; it carries: {carried}")
    if not gel.may_find_height:
        raise CannotCalibrate(
            f"sensors.{sensor} does not measure its depth; calibrate its light first (tacsim calibrate sensor)"
        )
    return config.model_copy(update={"task": None, "start": config.start.model_copy(update={"touch_signal": None})})


def schedule(plan: BallTouchPlan) -> list[tuple[Rotation, FloatArray]]:
    """For each touch the rotation of the sensor, in its own axes, and the contact position on the gel (2,) [m]. The
    first has no tilt and is at the centre; the others are spread evenly over directions, tilts and positions."""
    touches = [(Rotation.identity(), np.zeros(2))]
    for index in range(1, plan.touches):
        share = index / max(1, plan.touches - 1)
        tilt, radius = plan.tilt * math.sqrt(share), plan.spread * math.sqrt((index * GOLDEN_RATIO) % 1.0)
        # twice the angle of the tilts: six touches are then enough to separate rotation and position of the sensor
        direction, at = index * GOLDEN_ANGLE, index * GOLDEN_ANGLE * 2.0
        axis = np.array([math.cos(direction), math.sin(direction), 0.0])
        touches.append((Rotation.from_rotvec(tilt * axis), radius * np.array([math.cos(at), math.sin(at)])))
    return touches


def record_ball_touches(
    rig: Rig, config: RigConfig, arm: str, sensor: str, plan: BallTouchPlan, session: Session[BallTouch]
) -> None:
    """Resets the rig, makes the touches, and leaves the arm lifted and stopped. `config`: that of the open rig.

    Raises NoTouch if the first approach finds no contact, DeviceError if most of the others fail, and the errors of the
    reset, the arm and the camera; the arm is stopped in each case.
    """
    overshoot = 3e-3  # of the approach beyond the expected ball position [m]
    slow_distance = 1e-3  # between start of the approach and ball, once the ball position is known [m]
    sensor_from_tool = se3.inverse(hardware_arm(config, arm).tool_from_sensor.pose)
    rig.reset()
    prober = _BallProber(rig, config, arm, sensor, plan)
    start = rig.arms[arm].state().pose
    centres: list[FloatArray] = []  # of the ball by each touch, (3,) in world [m]
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
                except TOUCH_ERRORS as failure:
                    if not centres:
                        raise
                    session.left_out.append(f"touch {done + 1}: {failure}")
                    if len(session.left_out) > MAX_LEFT_OUT_SHARE * plan.touches:
                        raise DeviceError("most touches failed; the last:\n" + session.left_out[-1]) from failure
                    continue
                centres.append(se3.transform(pose, np.array([*contact, plan.ball_radius - depth])))
                session.add_measurement(BallTouch(se3.compose(pose, sensor_from_tool), contact, depth))
    finally:
        rig.stop()


class _BallProber:
    """One arm and its gel."""

    def __init__(self, rig: Rig, config: RigConfig, arm: str, sensor: str, plan: BallTouchPlan) -> None:
        self._rig, self._arm, self._name, self._sensor, self._plan = rig, rig.arms[arm], arm, sensor, plan
        self._speed, self._pitch = config.start.approach_speed, config.canonical.pitch

    def touch(self, lifted: Pose, begin: Pose, travel: float) -> tuple[tuple[float, float], float, Pose]:
        """Makes one touch, from `lifted` (clear of the ball) by `begin` back to `lifted`. Returns contact (x, y) [m],
        depth [m], and world_from_sensor measured by the arm. After one of TOUCH_ERRORS the arm is lifted too; any other
        error leaves it where it is, for a person to check."""
        move_to(self._arm, self._name, lifted)
        try:
            left = self._depth(self._observe(SETTLING_TIME))
            if left > MAX_FREE_DEPTH_SHARE * self._plan.depth:
                raise BadMeasurements(
                    f"lifted off the ball, the gel is still pressed by {1e3 * left:.2f} mm, so its picture is not a "
                    "reference: does something stick to it, did the light change, is the camera late?"
                )
            self._rig.normalisers[self._sensor].take_reference(self._rig.frames[self._sensor])
            move_to(self._arm, self._name, begin)
            touch = self._approach(begin, travel)
        except TOUCH_ERRORS:
            move_to(self._arm, self._name, lifted)
            raise
        move_to(self._arm, self._name, lifted)
        return touch

    def _approach(self, begin: Pose, travel: float) -> tuple[tuple[float, float], float, Pose]:
        """Moves from `begin`, the present pose, along the sensor's axis until the depth of a touch is reached. Returns
        the touch. Raises NoTouch, BadMeasurements."""

        step_timeout = 5.0  # of one step of the approach [s]
        min_picture_delay = 0.02  # of a picture of the approach, after the last step [s]

        def touches() -> bool:
            return self._depth(self._observe(min_picture_delay)) >= self._plan.depth

        def advance(distance: float) -> None:
            due = time.monotonic() + self._plan.step / self._speed
            move_to(self._arm, self._name, se3.translated_along_z(begin, distance), step_timeout)
            time.sleep(max(0.0, due - time.monotonic()))

        advice = (
            "is the ball in front of the gel, and the start pose above it? (start.approach_distance in the rig file "
            "limits the first approach)"
        )
        approach(touches, advance, self._plan.step, travel, advice)
        observation = self._observe(SETTLING_TIME)
        assert observation.height is not None
        contact, depth = locate_ball(
            observation.height.astype(np.float64), observation.valid, self._pitch, self._plan.ball_radius
        )
        return contact, depth, self._arm.state().pose

    @staticmethod
    def _depth(observation: TactileObservation) -> float:
        """Maximum indentation depth of the gel [m]."""
        assert observation.height is not None
        return float(observation.height.max(where=observation.valid, initial=0.0))

    def _observe(self, wait: float) -> TactileObservation:
        """The observation of a picture exposed at least `wait` [s] from now."""
        frame_after(self._rig.sensors[self._sensor], wait, 1.0)
        return self._rig.observe().tactile[self._sensor]
