"""A board seen by a camera from many poses of an arm: the record from which calibration.poses.hand_eye finds where the
camera sits.

The arm begins where it stands, with the board in view. It turns the sensor about a point before it, so that a camera
that rides along keeps looking at the board. Every motion passes the arm's limits; poses that they would shorten, or
from which the board is not seen, are left out.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from calibration.lens.board import BadBoard, Board, find_board
from calibration.lens.view import BadView, Lens, board_pose
from calibration.poses.hand_eye import MIN_SPREAD, BoardPose
from calibration.poses.robust_fit import angular_spread
from robot.arm.ur import URArm
from robot.camera.camera import Camera
from robot.mock.cell.cell import MockCell
from robot.procedures.session import (
    GOLDEN_ANGLE,
    GOLDEN_RATIO,
    PICTURE_TIMEOUT,
    SETTLE,
    CannotCalibrate,
    FrameSource,
    OutsideLimits,
    Session,
    frame_after,
    hardware_arm,
    move_to,
)
from tacsim import pose as se3
from tacsim.interface import Pose
from tacsim.limits import ActionError
from tacsim.models.hardware import CameraSensorConfig
from tacsim.models.rig import RigConfig

LARGEST_RESIDUAL = 2.0  # of a board's pose, root mean square [px]


@dataclass(frozen=True, slots=True)
class BoardPosePlan:
    """From where to look."""

    board: Board
    lens: Lens
    poses: int = 20
    tilt: float = math.radians(30.0)  # largest, about each axis [rad]
    pivot: float = 0.0  # distance of the point that the sensor turns about, before the sensor [m]


def schedule(plan: BoardPosePlan) -> list[Rotation]:
    """Rotations of the sensor, in its own axes: tilts in all directions, and twists both ways. The first is none."""
    rotations = [Rotation.identity()]
    for index in range(1, plan.poses):
        share = math.sqrt(index / max(1, plan.poses - 1))
        twist = 2.0 * ((index * GOLDEN_RATIO) % 1.0) - 1.0
        direction = index * GOLDEN_ANGLE
        vector = np.array([share * math.cos(direction), share * math.sin(direction), twist])
        rotations.append(Rotation.from_rotvec(plan.tilt * vector))
    return rotations


@contextmanager
def open_arm(config: RigConfig, arm: str) -> Iterator[URArm]:
    """The arm of a rig, and with it those that it must keep out of. Starts the mocks that the file asks for.

    Raises CannotCalibrate for an arm that is none of hardware, and what connecting raises.
    """
    hardware_arm(config, arm)
    apart: dict[str, float] = {}  # [m]
    for rule in config.keep_out:
        if arm in rule.arms:
            other = rule.arms[1 - rule.arms.index(arm)]
            apart[other] = max(rule.distance, apart.get(other, 0.0))
    with ExitStack() as stack:
        # neither gels nor bodies: only arms
        stack.enter_context(MockCell(config.model_copy(update={"sensors": {}, "scene": None, "task": None})))
        arms = {}
        for name in (*apart, arm):
            keep_out = apart if name == arm else {arm: apart[name]}
            arms[name] = stack.enter_context(URArm(hardware_arm(config, name), name, keep_out=keep_out))
        yield arms[arm]


def open_camera(source: str, lens: Lens) -> Camera:
    """The camera at `source`, at the size of its lens. Raises DeviceError."""
    config = CameraSensorConfig(
        driver="camera", source=source, width=lens.width, height=lens.height, max_age=PICTURE_TIMEOUT
    )
    return Camera(config, "camera", PICTURE_TIMEOUT)


def record_board_poses(arm: URArm, camera: FrameSource, plan: BoardPosePlan, session: Session[BoardPose]) -> None:
    """Looks at the board from all poses of the plan and returns to the first.

    Raises CannotCalibrate when the plan turns too little, or the board is not in view at the beginning, before anything
    has moved; and what the arm or the camera raise: the arm is stopped then.
    """
    spread = angular_spread(np.stack([rotation.as_matrix() for rotation in schedule(plan)]))
    if spread < MIN_SPREAD:
        raise CannotCalibrate(
            f"with a tilt of {np.degrees(plan.tilt):.0f} degrees and {plan.poses} poses one direction would span "
            f"only {np.degrees(spread):.1f} degrees; {np.degrees(MIN_SPREAD):.0f} are needed: give a larger --tilt"
        )
    config = arm.config
    sensor_from_flange = se3.inverse(se3.compose(config.flange_from_tool.pose, config.tool_from_sensor.pose))
    base_from_world = se3.inverse(config.world_from_base.pose)
    try:
        _find_board(camera, plan)
    except (BadBoard, BadView) as error:
        raise CannotCalibrate(f"put the arm so that the camera sees the board, then begin: {error}") from error
    start = arm.state().pose
    try:
        with session.until_stopped():
            for done, rotation in enumerate(schedule(plan)):
                session.progress(done)
                session.check()
                turned = se3.compose(se3.translated_along_z(start, plan.pivot), Pose(quaternion=rotation.as_quat()))
                try:
                    move_to(arm, arm.name, se3.translated_along_z(turned, -plan.pivot))
                    board = _find_board(camera, plan)
                except (OutsideLimits, ActionError, BadBoard, BadView) as failure:
                    session.left_out.append(f"pose {done + 1}: {failure}")
                    continue
                sensor = se3.compose(base_from_world, arm.state().pose)
                session.take(BoardPose(se3.compose(sensor, sensor_from_flange), board))
            move_to(arm, arm.name, start)
    finally:
        arm.stop()


def _find_board(camera: FrameSource, plan: BoardPosePlan) -> Pose:
    """camera_from_board in a picture exposed after the arm came to rest. Raises BadBoard, BadView."""
    pose, residual = board_pose(plan.lens, find_board(frame_after(camera, SETTLE).image, plan.board))
    if residual > LARGEST_RESIDUAL:
        raise BadView(f"the board does not fit what is seen: {residual:.1f} px, {LARGEST_RESIDUAL:g} at most")
    return pose
