"""Where a camera sits: against hidden truth, with noise and bad poses, and with an OpenCV that lacks its solver."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calibration.poses.hand_eye import BoardPose, HandEyeNoise, _whitening_matrices, fit_hand_eye
from calibration.poses.robust_fit import BadMeasurements
from tacsim import pose as se3
from tacsim.interface import Pose
from tests.calibration.touches import posed

CAMERA = posed(Rotation.from_rotvec([0.1, -0.2, 1.4]), [0.01, 0.03, 0.08])
BOARD = posed(Rotation.from_rotvec([0.3, 0.1, -0.2]), [0.5, 0.1, 0.0])
NOISE = HandEyeNoise()


def made_sights(
    random: np.random.Generator,
    number: int = 30,
    spread: float = 30.0,
    *,
    fixed: bool = False,
    noise: float = 1.0,
    stated: HandEyeNoise = NOISE,
) -> list[BoardPose]:
    """`spread`: standard deviation of the flange's rotation about each axis [degrees]; `noise`: of NOISE."""

    def shaken(pose: Pose, metres: float, radians: float) -> Pose:
        turn = Rotation.from_rotvec(noise * radians * random.normal(size=3))
        return se3.compose(pose, posed(turn, noise * metres * random.normal(size=3)))

    found = []
    for _ in range(number):
        turn = Rotation.from_rotvec(np.radians(spread) * random.normal(size=3))
        flange = posed(turn, np.array([0.5, 0.1, 0.3]) + 0.05 * random.normal(size=3))
        carried = se3.compose(flange, BOARD if fixed else CAMERA)
        seen = se3.relative_pose(CAMERA, carried) if fixed else se3.relative_pose(carried, BOARD)
        found.append(
            BoardPose(shaken(flange, stated.robot, stated.robot_turn), shaken(seen, stated.board, stated.board_turn))
        )
    return found


@pytest.mark.parametrize("fixed", [False, True])
def test_without_noise_the_truth_comes_back(fixed: bool) -> None:
    fit = fit_hand_eye(made_sights(np.random.default_rng(0), 8, fixed=fixed, noise=0.0), fixed=fixed)
    for found, true in ((fit.camera, CAMERA), (fit.board, BOARD)):
        metres, radians = se3.pose_distance(found, true)
        assert metres < 1e-8 and radians < 1e-7
    assert fit.residuals.max() < 1e-7 and all(fit.used)


@pytest.mark.slow
@pytest.mark.parametrize("fixed", [False, True])
def test_errors_with_the_noise_of_the_notes_are_as_stated(fixed: bool) -> None:
    errors = []
    for seed in range(8):
        fit = fit_hand_eye(made_sights(np.random.default_rng(seed), fixed=fixed), fixed=fixed)
        errors.append((*se3.pose_distance(fit.camera, CAMERA), *fit.deviation, fit.scatter))
        assert all(fit.used)
    metres, radians, stated, stated_turn, scatter = np.sqrt((np.array(errors) ** 2).mean(axis=0))
    assert np.median([each[0] for each in errors]) < 0.45e-3
    assert np.degrees(np.median([each[1] for each in errors])) < 0.08
    assert 0.6 < metres / stated < 1.5 and 0.6 < radians / stated_turn < 1.5
    assert scatter == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize("fixed", [False, True])
def test_weights_know_the_lever_of_a_robots_rotation(fixed: bool) -> None:
    stated = HandEyeNoise(board=0.3e-3, board_turn=np.radians(0.05), robot_turn=np.radians(0.2))
    seen = made_sights(np.random.default_rng(5), 900, fixed=fixed, stated=stated)
    flange, board = (np.stack([se3.to_matrix(getattr(each, name)) for each in seen]) for name in ("flange", "board"))
    arm = np.linalg.inv(flange) if fixed else flange
    camera, mount = se3.to_matrix(CAMERA), se3.to_matrix(BOARD)
    predicted = np.linalg.inv(camera) @ np.linalg.inv(arm) @ mount
    turn = Rotation.from_matrix(predicted[:, :3, :3] @ np.swapaxes(board[:, :3, :3], 1, 2)).as_rotvec()
    missed = np.concatenate([predicted[:, :3, 3] - board[:, :3, 3], turn], axis=1)
    even = np.einsum("nij,nj->ni", _whitening_matrices(camera, mount, arm, stated, fixed=fixed), missed)
    np.testing.assert_allclose(np.cov(even.T), np.eye(6), atol=0.25)  # standard deviation of an entry: 0.05


def test_bad_poses_are_found_and_left_out() -> None:
    seen = made_sights(np.random.default_rng(1), 20)
    for index in (3, 11, 17):
        off = posed(Rotation.from_rotvec([0.3, 0.2, 0.0]), [0.05, 0.0, 0.02])
        seen[index] = replace(seen[index], board=se3.compose(seen[index].board, off))
    fit = fit_hand_eye(seen)
    assert [i for i, used in enumerate(fit.used) if not used] == [3, 11, 17]
    metres, radians = se3.pose_distance(fit.camera, CAMERA)
    assert metres < 1.5e-3 and np.degrees(radians) < 0.25


def test_what_tells_too_little_is_refused() -> None:
    seen = made_sights(np.random.default_rng(2))
    with pytest.raises(BadMeasurements, match="5 poses are too few; at least 6"):
        fit_hand_eye(seen[:5])
    with pytest.raises(BadMeasurements, match="turns too little: one direction turns by only"):
        fit_hand_eye(made_sights(np.random.default_rng(2), spread=8.0))


def test_poses_that_disagree_are_refused() -> None:
    seen = made_sights(np.random.default_rng(3))
    shifted = [BoardPose(one.flange, other.board) for one, other in zip(seen, seen[1:] + seen[:1], strict=True)]
    with pytest.raises(BadMeasurements, match="disagree"):
        fit_hand_eye(shifted)  # pictures and poses of different moments
    with pytest.raises(BadMeasurements, match="disagree"):
        fit_hand_eye(seen, fixed=True)  # the other mounting
