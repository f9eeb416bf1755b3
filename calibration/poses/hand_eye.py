"""Where a camera sits, from pictures of one board while an arm stands in many poses.

Two cases: the camera rides on the flange and the board is fixed, or the camera is fixed and the board rides. A closed
form (Park and Martin 1994) starts least squares weighted by the noise of board and robot: an error of the robot's
rotation moves a far board by its lever arm, which no closed form knows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.spatial.transform import Rotation

from calibration.poses.ball_touch import deviation
from calibration.poses.robust_fit import (
    BadMeasurements,
    RobustFit,
    angular_spread,
    inverse_frames,
    perturb_pose,
    robust_fit,
)
from tacsim import pose as se3
from tacsim.interface import FloatArray, Pose

MIN_POSES = 6  # poses: 36 equations for 12 numbers
MIN_SPREAD = np.radians(15.0)  # of the flange, see angular_spread [rad]
SUBSETS, SUBSET_SIZE = 12, 5  # starts from a few poses each, so that one bad pose does not spoil them all
REWEIGHTINGS = 2  # times that the weights are computed anew


@dataclass(frozen=True, slots=True)
class HandEyeNoise:
    """Standard deviations in each axis by which poses are weighted [m, rad]."""

    board: float = 0.5e-3  # of the board's position in the camera
    board_turn: float = np.radians(0.15)
    robot: float = 0.05e-3  # of the flange's position
    robot_turn: float = np.radians(0.02)


@dataclass(frozen=True, slots=True, eq=False)
class BoardPose:
    """One picture of the board, and where the flange was."""

    flange: Pose  # base_from_flange
    board: Pose  # camera_from_board


@dataclass(frozen=True, slots=True, eq=False)
class HandEyeFit:
    """Where camera and board sit, and how uncertain that is."""

    camera: Pose  # flange_from_camera; of a fixed camera base_from_camera
    board: Pose  # base_from_board; with a fixed camera flange_from_board
    covariance: FloatArray  # (6, 6) of `camera`: shift [m] and rotation vector [rad], axes of the frame it is given in
    residuals: FloatArray  # (n, 2) of each board's pose in the camera: position [m], orientation [rad]
    used: tuple[bool, ...]  # False: disagrees with the others, left out
    scatter: float  # of the used poses over what the noise allows
    spread: float  # of the flange's rotations, see angular_spread [rad]

    @property
    def deviation(self) -> tuple[float, float]:
        """Standard deviations of the camera's position [m] and orientation [rad]."""
        return deviation(self.covariance)


def fit_hand_eye(poses: Sequence[BoardPose], *, fixed: bool = False, noise: HandEyeNoise | None = None) -> HandEyeFit:
    """Fits the pose of the camera. `fixed`: the camera is fixed, and the board rides on the flange.

    Raises BadMeasurements.
    """
    noise = HandEyeNoise() if noise is None else noise
    if len(poses) < MIN_POSES:
        raise BadMeasurements(f"{len(poses)} poses are too few; at least {MIN_POSES} are needed, 15 to 30 are good")
    flange = np.stack([se3.to_matrix(each.flange) for each in poses])
    board = np.stack([se3.to_matrix(each.board) for each in poses])
    spread = angular_spread(flange[:, :3, :3])
    if spread < MIN_SPREAD:
        raise BadMeasurements(
            f"the flange turns too little: one direction turns by only {np.degrees(spread):.1f} degrees, "
            f"{np.degrees(MIN_SPREAD):.0f} are needed. Turn it about all axes, 30 degrees and more"
        )
    arm = inverse_frames(flange) if fixed else flange  # arm_i camera board_i = mount, always the same
    camera, mount = _closed_form_start(arm, board)
    for _ in range(1 + REWEIGHTINGS):
        camera, mount, fit = _solve_poses(arm, board, camera, mount, noise, fixed=fixed)
    predicted = inverse_frames(camera) @ inverse_frames(arm) @ mount
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
    back = inverse_frames(arm)
    seen_turn = np.swapaxes(board[:, :3, :3], 1, 2)
    whiten = _whitening_matrices(camera, mount, arm, noise, fixed=fixed)

    def residuals(change: FloatArray) -> FloatArray:
        predicted = inverse_frames(perturb_pose(camera, change[:6])) @ back @ perturb_pose(mount, change[6:])
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
    before = (
        inverse_frames(camera) @ inverse_frames(arm)
        if fixed
        else np.broadcast_to(inverse_frames(camera), (count, 4, 4))
    )
    after = np.broadcast_to(mount, (count, 4, 4)) if fixed else inverse_frames(arm) @ mount
    lever, turn = after[:, :3, 3], before[:, :3, :3]
    effect = np.zeros((count, 6, 6))
    effect[:, :3, :3] = effect[:, 3:, 3:] = turn
    effect[:, :3, 3:] = turn @ -_cross_matrices(lever)
    robot = np.diag([noise.robot**2] * 3 + [noise.robot_turn**2] * 3)
    seen = np.diag([noise.board**2] * 3 + [noise.board_turn**2] * 3)
    covariance = seen + effect @ robot @ np.swapaxes(effect, 1, 2)
    return np.linalg.inv(np.linalg.cholesky(covariance))


def _cross_matrices(vectors: FloatArray) -> FloatArray:
    """(n, 3, 3) matrices C with C w = v x w."""
    matrix = np.zeros((len(vectors), 3, 3))
    x, y, z = vectors.T
    matrix[:, 0, 1], matrix[:, 0, 2], matrix[:, 1, 2] = -z, y, -x
    return matrix - np.swapaxes(matrix, 1, 2)


def _closed_form_start(arm: FloatArray, board: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The closed form's camera and mount from all poses or a subset, whichever the poses agree with most."""
    random = np.random.default_rng(0)
    count = len(arm)
    chosen = [np.arange(count)]
    chosen += [random.choice(count, min(SUBSET_SIZE, count), replace=False) for _ in range(SUBSETS)]
    candidates = []
    for some in chosen:
        if angular_spread(arm[some, :3, :3]) < MIN_SPREAD / 2:
            continue
        camera = solve_closed_form(arm[some], board[some])
        mounts = arm @ camera @ board
        between = np.linalg.norm(mounts[:, None, :3, 3] - mounts[None, :, :3, 3], axis=-1)
        between += np.linalg.norm(mounts[:, None, :3, 0] - mounts[None, :, :3, 0], axis=-1)
        typical = np.median(between, axis=1)
        candidates.append((float(typical.min()), camera, mounts[int(typical.argmin())]))
    _, camera, mount = min(candidates, key=lambda each: each[0])
    return camera, mount


def solve_closed_form(arm: FloatArray, board: FloatArray) -> FloatArray:
    """(4, 4) the X for which arm_i X board_i (each (n, 4, 4)) is most nearly the same for all i (Park and Martin 1994):
    rotation first (Procrustes over all pairs), then the shift."""
    pairs = list(combinations(range(len(arm)), 2))
    a = np.stack([inverse_frames(arm[j]) @ arm[i] for i, j in pairs])
    b = np.stack([board[j] @ inverse_frames(board[i]) for i, j in pairs])
    axes_a, axes_b = (Rotation.from_matrix(each[:, :3, :3]).as_rotvec() for each in (a, b))
    u, _, vt = np.linalg.svd(axes_a.T @ axes_b)
    found = np.eye(4)
    found[:3, :3] = turn = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    matrix = (np.eye(3) - a[:, :3, :3]).reshape(-1, 3)
    known = (a[:, :3, 3] - b[:, :3, 3] @ turn.T).reshape(-1)
    found[:3, 3] = np.linalg.lstsq(matrix, known, rcond=None)[0]
    return found
