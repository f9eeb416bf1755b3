"""Pose of a camera, from pictures of one board at many poses of an arm.

Two cases: the camera is on the flange and the board is fixed, or the camera is fixed and the board is on the flange. A
closed form (Park and Martin 1994) starts a least-squares fit weighted by the noise of board and robot: an error of the
robot's rotation moves a distant board by its lever arm, which the closed form does not include.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.linalg import inv
from scipy.spatial.transform import Rotation

from calibration.poses.ball_touch import deviation
from calibration.poses.robust_fit import (
    BadMeasurements,
    RobustFit,
    angular_spread,
    perturb_pose,
    robust_fit,
)
from calibration.poses.tuning import MIN_POSES
from tacsim import pose as se3
from tacsim.interface import FloatArray, Pose, short_repr

MIN_SPREAD = np.radians(15.0)  # of the flange, see angular_spread [rad]


@dataclass(frozen=True, slots=True)
class HandEyeNoise:
    """Standard deviations in each axis by which poses are weighted [m, rad]."""

    board: float = 0.5e-3  # of the board's position in the camera
    board_turn: float = np.radians(0.15)
    robot: float = 0.05e-3  # of the flange's position
    robot_turn: float = np.radians(0.02)


@dataclass(frozen=True, slots=True, eq=False)
class BoardPose:
    """One picture of the board, and the pose of the flange."""

    flange: Pose  # base_from_flange
    board: Pose  # camera_from_board


@dataclass(frozen=True, slots=True, eq=False)
class HandEyeFit:
    """Poses of camera and board, with their uncertainty."""

    __repr__ = short_repr
    camera: Pose  # flange_from_camera; of a fixed camera base_from_camera
    board: Pose  # base_from_board; with a fixed camera flange_from_board
    covariance: FloatArray  # (6, 6) of `camera`: shift [m] and rotation vector [rad], axes of the frame it is given in
    residuals: FloatArray  # (n, 2) of each board's pose in the camera: position [m], orientation [rad]
    used: tuple[bool, ...]  # False: an outlier, left out
    scatter: float  # of the used poses over the stated noise
    spread: float  # of the flange's rotations, see angular_spread [rad]

    @property
    def deviation(self) -> tuple[float, float]:
        """Standard deviations of the camera's position [m] and orientation [rad]."""
        return deviation(self.covariance)


def fit_hand_eye(poses: Sequence[BoardPose], *, fixed: bool = False, noise: HandEyeNoise | None = None) -> HandEyeFit:
    """Fits the pose of the camera. fixed: the camera is fixed, and the board is on the flange.

    Raises BadMeasurements.
    """
    reweightings = 2  # computations of the weights
    noise = HandEyeNoise() if noise is None else noise
    if len(poses) < MIN_POSES:
        raise BadMeasurements(
            f"{len(poses)} poses are too few; at least {MIN_POSES} are needed, 15 to 30 are recommended"
        )
    flange = np.stack([se3.to_matrix(each.flange) for each in poses])
    board = np.stack([se3.to_matrix(each.board) for each in poses])
    spread = angular_spread(flange[:, :3, :3])
    if spread < MIN_SPREAD:
        raise BadMeasurements(
            f"the flange turns too little: one direction turns by only {np.degrees(spread):.1f} degrees, "
            f"{np.degrees(MIN_SPREAD):.0f} are needed. Turn it about all axes, 30 degrees and more"
        )
    # arm_i camera board_i = mount for all i
    arm = np.asarray(inv(flange) if fixed else flange, dtype=np.float64)
    camera, mount = _closed_form_start(arm, board)
    for _ in range(1 + reweightings):
        camera, mount, fit = _solve_poses(arm, board, camera, mount, noise, fixed=fixed)
    predicted = inv(camera) @ inv(arm) @ mount
    turn = Rotation.from_matrix(predicted[:, :3, :3] @ np.swapaxes(board[:, :3, :3], 1, 2)).magnitude()
    missed = np.linalg.norm(predicted[:, :3, 3] - board[:, :3, 3], axis=1)
    return HandEyeFit(
        camera=se3.from_matrix(camera),
        board=se3.from_matrix(mount),
        covariance=fit.covariance[:6, :6],
        residuals=np.stack([missed, turn], axis=1),
        used=fit.used,
        scatter=fit.scatter,
        spread=spread,
    )


def _solve_poses(
    arm: FloatArray, board: FloatArray, camera: FloatArray, mount: FloatArray, noise: HandEyeNoise, *, fixed: bool
) -> tuple[FloatArray, FloatArray, RobustFit]:
    back = inv(arm)
    seen_turn = np.swapaxes(board[:, :3, :3], 1, 2)
    whiten = _whitening_matrices(camera, mount, arm, noise, fixed=fixed)

    def residuals(change: FloatArray) -> FloatArray:
        predicted = inv(perturb_pose(camera, change[:6])) @ back @ perturb_pose(mount, change[6:])
        turn = Rotation.from_matrix(predicted[:, :3, :3] @ seen_turn).as_rotvec()
        missed = np.concatenate([predicted[:, :3, 3] - board[:, :3, 3], turn], axis=1)
        whitened: FloatArray = np.einsum("nij,nj->ni", whiten, missed)
        return whitened

    fit = robust_fit(residuals, [np.zeros(12)], "poses")
    return perturb_pose(camera, fit.parameters[:6]), perturb_pose(mount, fit.parameters[6:]), fit


def _whitening_matrices(
    camera: FloatArray, mount: FloatArray, arm: FloatArray, noise: HandEyeNoise, *, fixed: bool
) -> FloatArray:
    """(n, 6, 6) matrices that make a pose's residuals six independent ones of variance 1.

    The robot's error is a small motion (shift, turn) of the flange about its own origin, between `before` (flange to
    camera) and `after` (the board in the flange): it turns the board, and shifts it by turn x lever.
    """
    count = len(arm)
    before = inv(camera) @ inv(arm) if fixed else np.broadcast_to(inv(camera), (count, 4, 4))
    after = np.broadcast_to(mount, (count, 4, 4)) if fixed else inv(arm) @ mount
    lever, turn = after[:, :3, 3], before[:, :3, :3]
    effect = np.zeros((count, 6, 6))
    effect[:, :3, :3] = effect[:, 3:, 3:] = turn
    effect[:, :3, 3:] = turn @ -_cross_matrices(lever)
    robot = np.diag([noise.robot**2] * 3 + [noise.robot_turn**2] * 3)
    seen = np.diag([noise.board**2] * 3 + [noise.board_turn**2] * 3)
    covariance = seen + effect @ robot @ np.swapaxes(effect, 1, 2)
    return inv(np.linalg.cholesky(covariance))


def _cross_matrices(vectors: FloatArray) -> FloatArray:
    """(n, 3, 3) matrices C with C w = v x w."""
    return np.swapaxes(np.cross(vectors[:, None], np.eye(3)), 1, 2)


def _closed_form_start(arm: FloatArray, board: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Camera and mount by the closed form from all poses and from subsets, the one that fits the poses best."""
    subset_count, subset_size = 12, 5  # starts from a few poses each, so that one bad pose does not affect all of them
    random = np.random.default_rng(0)
    count = len(arm)
    chosen = [np.arange(count)]
    chosen += [random.choice(count, min(subset_size, count), replace=False) for _ in range(subset_count)]
    candidates = []
    for some in chosen:
        if angular_spread(arm[some, :3, :3]) < MIN_SPREAD / 2:
            continue
        camera = _closed_form(arm[some], board[some])
        mounts = arm @ camera @ board
        between = np.linalg.norm(mounts[:, None, :3, 3] - mounts[None, :, :3, 3], axis=-1)
        between += np.linalg.norm(mounts[:, None, :3, 0] - mounts[None, :, :3, 0], axis=-1)
        typical = np.median(between, axis=1)
        candidates.append((float(typical.min()), camera, mounts[int(typical.argmin())]))
    _, camera, mount = min(candidates, key=lambda each: each[0])
    return camera, mount


def _closed_form(arm: FloatArray, board: FloatArray) -> FloatArray:
    """(4, 4) the X with the least variation of arm_i X board_i (each (n, 4, 4)) over all i (Park and Martin 1994)."""
    import cv2

    found = np.eye(4)
    turn, shift = cv2.calibrateHandEye(
        list(arm[:, :3, :3]), list(arm[:, :3, 3]), list(board[:, :3, :3]), list(board[:, :3, 3]),
        method=cv2.CALIB_HAND_EYE_PARK,
    )  # fmt: skip
    found[:3, :3], found[:3, 3] = turn, np.ravel(shift)
    return found
