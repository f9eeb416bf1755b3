"""Views of a board by a camera: held before it by a person, or from many poses of an arm.

A person has both hands at the board: a view is taken once the whole board is found, stands still, and differs from all
views before. What is not taken is reported with the reason.

With an arm, the record is that from which calibration.poses.hand_eye finds where the camera sits. The arm begins where
it stands, with the board in view. It turns the sensor about a point before it, so that a camera that rides along keeps
looking at the board. Every motion passes the arm's limits; poses that they would shorten, or from which the board is
not seen, are left out.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from calibration.lens.board import BadBoard, Board, Points, find_board
from calibration.lens.view import BadView, Lens, board_pose
from calibration.poses.hand_eye import MIN_SPREAD, BoardPose
from calibration.poses.robust_fit import angular_spread
from robot.arm.ur import URArm
from robot.camera.camera import Camera
from robot.procedures.session import (
    GOLDEN_ANGLE,
    GOLDEN_RATIO,
    PICTURE_TIMEOUT,
    SETTLING_TIME,
    CannotCalibrate,
    FrameSource,
    OutsideLimits,
    Session,
    frame_after,
    hardware_arm,
    move_to,
)
from robot.rig.parts import companion_of
from tacsim import pose as se3
from tacsim.interface import FloatArray, Image, Pose, TactileFrame
from tacsim.limits import ActionError
from tacsim.models.hardware import CameraSensorConfig
from tacsim.models.rig import RigConfig

MAX_RESIDUAL = 2.0  # of a board's pose, root mean square [px]
MAX_STILL_MOTION = 0.003  # of the longer side of the picture: a board whose points move less stands still
STILL_TIME = 0.4  # minimum time of standing still [s]
MIN_VIEW_DISTANCE = 0.04  # of the longer side: two views are equal if their points differ by less, root mean square
REMINDER_INTERVAL = 4.0  # between two reports of a reason [s]
PROMPTS = (
    "facing the camera, so that it fills the picture",
    "its left side nearer to the camera, by 30 degrees",
    "its right side nearer to the camera, by 30 degrees",
    "its upper side nearer to the camera, by 30 degrees",
    "its lower side nearer to the camera, by 30 degrees",
    "tilted, towards the upper left corner of the picture",
    "tilted, towards the lower right corner of the picture",
    "tilted, towards the upper right corner of the picture",
    "tilted, towards the lower left corner of the picture",
)
ON_GEL = "lay the board on the gel, print side down, and leave it there"


@dataclass(frozen=True, slots=True)
class BoardPosePlan:
    """Poses of the record."""

    board: Board
    lens: Lens
    poses: int = 20
    tilt: float = math.radians(30.0)  # maximum, about each axis [rad]
    pivot: float = 0.0  # distance of the rotation centre in front of the sensor [m]


def schedule(plan: BoardPosePlan) -> list[Rotation]:
    """Rotations of the sensor, in its own axes: tilts in all directions and twists both ways. The first is zero."""
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
    """Opens an arm of a rig and the other arms of its keep-outs. Starts the mocks of the rig file.

    Raises CannotCalibrate for an arm that is not hardware, and the errors of connecting.
    """
    hardware_arm(config, arm)
    distances: dict[str, float] = {}  # [m]
    for rule in config.keep_out:
        if arm in rule.arms:
            other = rule.arms[1 - rule.arms.index(arm)]
            distances[other] = max(rule.distance, distances.get(other, 0.0))
    with ExitStack() as stack:
        # only arms, without gels and bodies
        stack.enter_context(companion_of(config.model_copy(update={"sensors": {}, "scene": None, "task": None})))
        arms = {}
        for name in (*distances, arm):
            keep_out = distances if name == arm else {arm: distances[name]}
            arms[name] = stack.enter_context(URArm(hardware_arm(config, name), name, keep_out=keep_out))
        yield arms[arm]


def open_camera(source: str, lens: Lens) -> Camera:
    """Opens the camera at `source`, with the picture size of its lens. Raises DeviceError."""
    config = CameraSensorConfig(
        driver="camera", source=source, width=lens.width, height=lens.height, max_age=PICTURE_TIMEOUT
    )
    return Camera(config, "camera", PICTURE_TIMEOUT)


def record_board_poses(arm: URArm, camera: FrameSource, plan: BoardPosePlan, session: Session[BoardPose]) -> None:
    """Records the board from all poses of the plan and returns to the first.

    Raises CannotCalibrate, before any motion, if the rotations of the plan are too small or the board is not in view;
    and the errors of the arm and the camera, after stopping the arm.
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
        raise CannotCalibrate(f"move the arm until the board is in view of the camera, then begin: {error}") from error
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
                session.add_measurement(BoardPose(se3.compose(sensor, sensor_from_flange), board))
            move_to(arm, arm.name, start)
    finally:
        arm.stop()


def _find_board(camera: FrameSource, plan: BoardPosePlan) -> Pose:
    """camera_from_board from a picture exposed after the arm came to rest. Raises BadBoard, BadView."""
    pose, residual = board_pose(plan.lens, find_board(frame_after(camera, SETTLING_TIME).image, plan.board))
    if residual > MAX_RESIDUAL:
        raise BadView(f"the board does not fit the picture: residual {residual:.1f} px, maximum {MAX_RESIDUAL:g} px")
    return pose


@dataclass(frozen=True, slots=True)
class BoardViewPlan:
    board: Board
    views: int = 12
    on_gel: bool = False  # the board lies on the gel: one view
    reference: Image | None = None  # native picture without the board, for low contrast
    timeout: float = 180.0  # for each view [s]


def record_board_views(camera: FrameSource, plan: BoardViewPlan, session: Session[tuple[str, Image]]) -> None:
    """Guides a person through the views of `plan` and records name and native picture of each.

    Raises CannotCalibrate if no view is found within the timeout, and the errors of the camera.
    """
    earlier: list[Points] = []
    frames = session.frames(camera)
    with session.until_stopped():
        while len(earlier) < plan.views:
            number = len(earlier) + 1
            session.progress(len(earlier))
            prompt = ON_GEL if plan.on_gel else f"hold the board still, {PROMPTS[len(earlier) % len(PROMPTS)]}"
            session.report(f"View {number} of {plan.views}: {prompt}.")
            image, points = _next_view(frames, plan, earlier, session)
            earlier.append(points)
            session.add_measurement((f"view_{number:02d}.png", image))
            session.report(f"Taken: {len(points.image)} points, {points.spacing:.0f} px apart.")
        session.progress(len(earlier))


def _next_view(
    frames: Iterator[TactileFrame], plan: BoardViewPlan, earlier: list[Points], session: Session[tuple[str, Image]]
) -> tuple[Image, Points]:
    """A picture of a board that stands still and differs from the earlier views. Reports from time to time why no
    picture is taken. Raises Stopped, CannotCalibrate."""
    frame = next(frames)
    begun = reminded = since = frame.time
    anchor: Points | None = None  # first points of the still board
    while True:
        try:
            points = find_board(frame.image, plan.board, plan.reference)
        except BadBoard as missing:
            reason, anchor = str(missing), None
        else:
            side = max(frame.image.shape[:2])
            if anchor is None or _point_distance(anchor, points) > MAX_STILL_MOTION * side:
                anchor, since = points, frame.time
            alike = (
                k for k, other in enumerate(earlier, 1) if _point_distance(other, points) < MIN_VIEW_DISTANCE * side
            )
            same = next(alike, None)
            if same is None and frame.time - since >= STILL_TIME:
                return frame.image, points
            reason = "the board moves; hold it still"
            if same is not None:
                reason = f"the board is as in view {same}; tilt it, or hold it elsewhere"
        if frame.time - reminded >= REMINDER_INTERVAL:
            session.left_out.append(reason)
            session.report(f"Skipped: {reason}.")
            reminded = frame.time
        if frame.time - begun > plan.timeout:
            raise CannotCalibrate(f"given up after {plan.timeout:g} s without a view; the last: {reason}")
        frame = next(frames)


def _point_distance(one: Points, other: Points) -> float:
    """Root mean square distance of common points in the picture [px]; infinite without a common point."""
    places = {tuple(place): at for place, at in zip(np.round(one.board, 9).tolist(), one.image, strict=True)}
    pairs = [
        (places[tuple(place)], at)
        for place, at in zip(np.round(other.board, 9).tolist(), other.image, strict=True)
        if tuple(place) in places
    ]
    if not pairs:
        return float("inf")
    distances: FloatArray = np.array([first - second for first, second in pairs])
    return float(np.sqrt((distances**2).sum(axis=1).mean()))
