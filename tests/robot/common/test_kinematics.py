"""UR kinematics: against DH matrices multiplied out, against differences, and there and back."""

from __future__ import annotations

import math
from typing import get_args

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from robot.common.kinematics import (
    JOINT_RANGE,
    MODELS,
    Kinematics,
    displacement,
    inverse_frame,
    matrix,
    pose,
    rotation_vector,
)
from tacsim.interface import FloatArray
from tacsim.models.hardware import Model

TOOL = matrix([0.01, -0.02, 0.15, 0.3, -0.2, 0.5])
ALPHA = (math.pi / 2, 0.0, 0.0, math.pi / 2, -math.pi / 2, 0.0)
every_model = pytest.mark.parametrize("model", sorted(MODELS))


def multiplied_out(model: Model, q: FloatArray) -> FloatArray:
    """Product of the six DH matrices, as in any textbook."""
    k = MODELS[model]
    frame = np.eye(4)
    for angle, alpha, a, d in zip(q, ALPHA, (0, k.a2, k.a3, 0, 0, 0), (k.d1, 0, 0, k.d4, k.d5, k.d6), strict=True):
        c, s, ca, sa = math.cos(angle), math.sin(angle), math.cos(alpha), math.sin(alpha)
        frame = frame @ np.array(
            [[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0, sa, ca, d], [0, 0, 0, 1]]
        )
    return frame


def random_joints(seed: int, count: int) -> FloatArray:
    return np.random.default_rng(seed).uniform(-JOINT_RANGE, JOINT_RANGE, (count, 6))


def test_models_match_rig_file_models() -> None:
    assert set(MODELS) == set(get_args(Model))


@pytest.mark.parametrize(
    ("model", "position"),
    # All joints 0: stretched along -x, so x = a2 + a3, y = -(d4 + d6), z = d1 - d5, by the published lengths.
    [
        ("ur3e", (-0.45675, -0.22315, 0.0665)),
        ("ur5e", (-0.8172, -0.2329, 0.0628)),
        ("ur10e", (-1.18425, -0.2907, 0.06085)),
    ],
)
def test_forward_zero_joints_gives_known_flange(model: Model, position: tuple[float, ...]) -> None:
    frame = Kinematics(model).forward([0.0] * 6)
    np.testing.assert_allclose(frame[:3, 3], position, atol=1e-12)
    np.testing.assert_allclose(frame[:3, :3], [[1, 0, 0], [0, 0, -1], [0, 1, 0]], atol=1e-12)


@every_model
def test_forward_equals_product_of_dh_matrices(model: Model) -> None:
    arm = Kinematics(model)
    for q in random_joints(1, 200):
        np.testing.assert_allclose(arm.forward(q), multiplied_out(model, q), atol=1e-13)
        np.testing.assert_allclose(arm.forward(q, TOOL), multiplied_out(model, q) @ TOOL, atol=1e-13)


@every_model
def test_jacobian_equals_numerical_derivative(model: Model) -> None:
    arm, h = Kinematics(model), 1e-6
    for q in random_joints(2, 30):
        columns = [
            displacement(arm.forward(q - step, TOOL), arm.forward(q + step, TOOL)) / (2 * h) for step in h * np.eye(6)
        ]
        np.testing.assert_allclose(arm.jacobian(q, TOOL), np.stack(columns, axis=1), atol=1e-8)


@every_model
def test_inverse_near_and_far_seed_reach_target(model: Model) -> None:
    arm, generator = Kinematics(model), np.random.default_rng(3)
    for q in random_joints(4, 300):
        target = arm.forward(q, TOOL)
        far = arm.inverse(target, generator.uniform(-6, 6, 6), TOOL)
        assert far is not None
        np.testing.assert_allclose(arm.forward(far, TOOL), target, atol=1e-8)
        inside = np.clip(q, -6.2, 6.2)
        target = arm.forward(inside, TOOL)
        near = arm.inverse(target, inside + generator.uniform(-1e-3, 1e-3, 6), TOOL)
        assert near is not None
        if arm.singularity(inside) > 0.02:
            np.testing.assert_allclose(near, inside, atol=1e-7)


@every_model
def test_solutions_reach_target_and_differ(model: Model) -> None:
    arm = Kinematics(model)
    q = np.array([0.3, -1.2, 1.4, -1.1, -1.3, 0.4])
    found = arm.solutions(arm.forward(q), q)
    assert len(found) == 8
    for solution in found:
        np.testing.assert_allclose(arm.forward(solution), arm.forward(q), atol=1e-9)
    gaps = [np.abs(a - b).max() for i, a in enumerate(found) for b in found[:i]]
    assert min(gaps) > 0.01


def test_inverse_returns_solution_nearest_to_seed() -> None:
    arm = Kinematics("ur5e")
    q = np.array([0.3, -1.2, 1.4, -1.1, -1.3, 0.4])
    for wanted in arm.solutions(arm.forward(q), q):
        found = arm.inverse(arm.forward(q), wanted + 0.05)
        assert found is not None
        np.testing.assert_allclose(found, wanted, atol=1e-8)


def test_inverse_out_of_reach_or_nan_returns_none() -> None:
    arm, seed = Kinematics("ur5e"), np.array([0, -1.5, 1.5, -1.5, -1.5, 0])
    assert arm.inverse(matrix([5.0, 0, 0, 0, 0, 0]), seed) is None
    assert arm.inverse(matrix([0.05, 0, 0.3, math.pi, 0, 0]), seed) is None  # the wrist inside the shoulder's cylinder
    assert arm.inverse(np.full((4, 4), np.nan), seed) is None
    assert arm.inverse(arm.forward(seed), np.full(6, np.nan)) is None


def test_inverse_joints_stay_in_range() -> None:
    arm = Kinematics("ur5e")
    end = np.array([JOINT_RANGE - 1e-3, -1.5, 1.5, -1.5, -1.5, 0])
    beyond = end + [2e-3, 0, 0, 0, 0, 0]
    found = arm.inverse(arm.forward(beyond), end)
    assert found is not None and np.abs(found).max() <= JOINT_RANGE
    np.testing.assert_allclose(arm.forward(found), arm.forward(beyond), atol=1e-9)


def test_singularity_is_zero_only_in_singular_poses() -> None:
    arm = Kinematics("ur5e")
    assert arm.singularity([0.2, -1.2, 1.4, -1.1, -1.5, 0.4]) > 0.1
    assert arm.singularity([0.2, -1.2, 0.0, -1.1, -1.5, 0.4]) < 1e-9  # elbow stretched
    assert arm.singularity([0.2, -1.2, 1.4, -1.1, 0.0, 0.4]) < 1e-9  # axes 4 and 6 parallel


def test_rotation_vector_round_trip_up_to_half_turn() -> None:
    generator = np.random.default_rng(5)
    for index in range(3000):
        axis = generator.normal(size=3)
        angle = generator.uniform(0, math.pi) if index % 2 else math.pi - 10.0 ** generator.uniform(-14, 0)
        turn = Rotation.from_rotvec(angle * axis / np.linalg.norm(axis)).as_matrix()
        vector = rotation_vector(turn)
        assert np.linalg.norm(vector) <= math.pi + 1e-12
        np.testing.assert_allclose(Rotation.from_rotvec(vector).as_matrix(), turn, atol=1e-14)


def test_pose_matrix_round_trip_is_equal() -> None:
    given = np.array([0.1, -0.2, 0.3, 0.4, -0.5, 0.6])
    np.testing.assert_allclose(pose(matrix(given)), given, atol=1e-15)
    np.testing.assert_allclose(inverse_frame(TOOL) @ TOOL, np.eye(4), atol=1e-15)
