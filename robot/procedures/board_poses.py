"""A board seen by a camera from many poses of an arm: the record from which calibration.poses.hand_eye finds where the
camera sits.

The arm begins where it stands, with the board in view. It turns the sensor about a point before it, so that a camera
that rides along keeps looking at the board; every motion goes through the arm's limits, and poses that they would
shorten, or from which the board is not seen, are left out.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from calibration.errors import CalibrationError
from calibration.lens.board import BadBoard, Board, find_board
from calibration.lens.view import BadView, Lens, board_pose
from calibration.poses.hand_eye import MIN_SPREAD, BoardPose
from calibration.poses.robust_fit import angular_spread
from robot.arm.ur import URArm
from robot.camera.camera import Camera
from robot.mock.cell.cell import MockCell
from robot.procedures.ball_touches import GOLDEN, LOOK, SETTLE, TRAVEL, Shortened, go
from tacsim import pose as se3
from tacsim.interface import Pose
from tacsim.limits import ActionError
from tacsim.models.hardware import CameraSensorConfig, UrArmConfig
from tacsim.models.rig import RigConfig

LARGEST_RESIDUAL = 2.0  # of a board's pose, root mean square [px]
PICTURE = 15.0  # longest wait for one [s]


class CannotSee(CalibrationError):
    """This arm or this camera is not such that a board could tell where the camera sits."""


@dataclass(frozen=True, slots=True)
class SightPlan:
    """How to look."""

    board: Board
    lens: Lens
    poses: int = 20
    tilt: float = math.radians(30.0)  # largest, about each axis [rad]
    pivot: float = 0.0  # how far before the sensor the point lies that it turns about [m]


@dataclass(slots=True)
class SightRecord:
    """What came of a plan."""

    board_poses: list[BoardPose]
    missed: list[str]  # poses that were left out, and why


def schedule(plan: SightPlan) -> list[Rotation]:
    """How the sensor is turned, in its own axes: tilts round about, and twists to both sides. The first is none."""
    turns = [Rotation.identity()]
    for index in range(1, plan.poses):
        part = math.sqrt(index / max(1, plan.poses - 1))
        twist = 2.0 * ((index * 0.618034) % 1.0) - 1.0
        towards = index * GOLDEN
        turns.append(
            Rotation.from_rotvec(plan.tilt * np.array([part * math.cos(towards), part * math.sin(towards), twist]))
        )
    return turns


@contextmanager
def opened(config: RigConfig, arm: str) -> Iterator[URArm]:
    """The arm of a rig, and with it those that it must keep out of. Starts the mocks that the file asks for.

    Raises CannotSee for an arm that is none of hardware, and what connecting raises.
    """
    if not isinstance(config.arms.get(arm), UrArmConfig):
        known = ", ".join(name for name, each in config.arms.items() if isinstance(each, UrArmConfig)) or "none"
        raise CannotSee(f"rig '{config.name}': '{arm}' is no arm of hardware, real or mock; there are: {known}")
    apart: dict[str, float] = {}
    for rule in config.keep_out:
        if arm in rule.arms:
            other = rule.arms[1 - rule.arms.index(arm)]
            apart[other] = max(rule.distance, apart.get(other, 0.0))
    with ExitStack() as stack:
        # neither gels nor bodies: only arms
        stack.enter_context(MockCell(config.model_copy(update={"sensors": {}, "scene": None, "task": None})))
        arms = {}
        for name in (arm, *apart):
            there = config.arms[name]
            assert isinstance(there, UrArmConfig)
            arms[name] = stack.enter_context(URArm(there, name, keep_out=apart if name == arm else {arm: apart[name]}))
        yield arms[arm]


def open_camera(source: str, lens: Lens) -> Camera:
    """The camera at `source`, at the size of its lens. Raises DeviceError."""
    config = CameraSensorConfig(driver="camera", source=source, width=lens.width, height=lens.height, max_age=PICTURE)
    return Camera(config, "camera", PICTURE)


def record_sights(
    arm: URArm,
    camera: Camera,
    plan: SightPlan,
    stop: Callable[[], bool] = lambda: False,
    tell: Callable[[int], None] = lambda done: None,
    keep: Callable[[Sequence[BoardPose]], None] = lambda board_poses: None,
) -> SightRecord:
    """Looks at the board from all poses of the plan and returns to the first; `keep` is given all sights so far after
    each one. Raises CannotSee when the board is not
    in view at the beginning, before anything has moved; and what the arm or the camera raise: the arm is stopped then.
    """
    spread = angular_spread(np.stack([turn.as_matrix() for turn in schedule(plan)]))
    if spread < MIN_SPREAD:
        raise CannotSee(
            f"with a tilt of {np.degrees(plan.tilt):.0f} degrees and {plan.poses} poses one direction would swing by "
            f"only {np.degrees(spread):.1f} degrees; {np.degrees(MIN_SPREAD):.0f} are needed: give a larger --tilt"
        )
    config = arm.config
    sensor_from_flange = se3.inverse(se3.compose(config.flange_from_tool.pose, config.tool_from_sensor.pose))
    base_from_world = se3.inverse(config.world_from_base.pose)
    record = SightRecord([], [])
    try:
        _seen(camera, plan)
    except (BadBoard, BadView) as error:
        raise CannotSee(f"put the arm so that the camera sees the board, then begin: {error}") from error
    begun = arm.state().pose
    ahead = Pose(np.array([0.0, 0.0, plan.pivot]))
    try:
        for done, turn in enumerate(schedule(plan)):
            tell(done)
            if stop():
                return record
            turned = Pose(quaternion=turn.as_quat())
            target = se3.compose(se3.compose(se3.compose(begun, ahead), turned), se3.inverse(ahead))
            try:
                go(arm, arm.name, target, TRAVEL)
                board = _seen(camera, plan)
            except (Shortened, ActionError, BadBoard, BadView) as missed:
                record.missed.append(f"pose {done + 1}: {missed}")
                continue
            sensor = se3.compose(base_from_world, arm.state().pose)
            record.board_poses.append(BoardPose(se3.compose(sensor, sensor_from_flange), board))
            keep(record.board_poses)
        go(arm, arm.name, begun, TRAVEL)
    finally:
        arm.stop()
    return record


def _seen(camera: Camera, plan: SightPlan) -> Pose:
    """camera_from_board in a picture exposed after the arm came to rest. Raises BadBoard, BadView."""
    since = time.monotonic() + SETTLE
    while (frame := camera.read(PICTURE)).time < since:
        time.sleep(LOOK)
    pose, residual = board_pose(plan.lens, find_board(frame.image, plan.board))
    if residual > LARGEST_RESIDUAL:
        raise BadView(f"the board does not fit what is seen: {residual:.1f} px, {LARGEST_RESIDUAL:g} at most")
    return pose
