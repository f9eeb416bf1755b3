"""Rigid transforms against worked examples with no symmetry, and their laws on random ones."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tacsim import pose as se3
from tacsim.interface import Pose

components = st.floats(-2.0, 2.0)
vectors = st.tuples(components, components, components).map(np.array)
quaternions = st.tuples(*[st.floats(-1.0, 1.0)] * 4).map(np.array).filter(lambda q: float(np.linalg.norm(q)) > 0.1)
poses = st.builds(lambda p, q: Pose(p, q / np.linalg.norm(q)), vectors, quaternions)

# b stands at (1, 2, 3) in a, turned by a quarter about z: x of b is y of a, y of b is -x of a.
QUARTER = se3.from_rotation_vector([1.0, 2.0, 3.0], [0.0, 0.0, math.pi / 2])


def same(a: Pose, b: Pose) -> bool:
    """Equal as transforms: a quaternion and its negative are one rotation."""
    return np.allclose(se3.to_matrix(a), se3.to_matrix(b), atol=1e-9)


@given(poses)
def test_axes_give_the_pose_that_scipy_finds(pose: Pose) -> None:
    axes = se3.rotation_matrix(pose)
    found = se3.from_axes(pose.position, axes)
    assert same(found, pose)
    assert found.quaternion == pytest.approx(Rotation.from_matrix(axes).as_quat(), abs=1e-15)


# worked examples


def test_points_move_and_vectors_only_turn() -> None:
    assert np.allclose(se3.transform(QUARTER, [10.0, 20.0, 30.0]), [-19.0, 12.0, 33.0])
    assert np.allclose(se3.rotate(QUARTER, [10.0, 20.0, 30.0]), [-20.0, 10.0, 30.0])
    grid = np.arange(24.0).reshape(2, 4, 3)
    moved = se3.transform(QUARTER, grid)
    assert moved.shape == grid.shape
    assert np.allclose(moved[1, 2], se3.transform(QUARTER, grid[1, 2]))


def test_matrix_has_the_axes_of_b_in_its_columns() -> None:
    assert np.allclose(se3.to_matrix(QUARTER), [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]])


def test_composition_goes_from_right_to_left() -> None:
    b_from_c = se3.from_rotation_vector([4.0, 0.0, 0.0], [math.pi / 2, 0.0, 0.0])
    a_from_c = se3.compose(QUARTER, b_from_c)
    assert np.allclose(a_from_c.position, [1.0, 6.0, 3.0])
    assert np.allclose(se3.rotate(a_from_c, np.eye(3)), [[0, 1, 0], [0, 0, 1], [1, 0, 0]])


def test_half_turn_about_x_turns_the_sensor_over_and_mirrors_nothing() -> None:
    assert np.allclose(se3.rotate(se3.HALF_TURN_X, np.eye(3)), np.diag([1.0, -1.0, -1.0]))
    assert np.linalg.det(se3.to_matrix(se3.HALF_TURN_X)) == pytest.approx(1.0)


def test_a_load_off_the_origin_makes_a_torque() -> None:
    """2 N along y of b, at b's origin (1, 2, 3); y of b is -x of a: r x f = (1, 2, 3) x (-2, 0, 0)."""
    load = se3.transform_wrench(QUARTER, [0.0, 2.0, 0.0, 0.5, 0.0, 0.0])
    assert np.allclose(load, [-2.0, 0.0, 0.0, 0.0, -6.0 + 0.5, 4.0])
    with pytest.raises(ValueError, match="3 torques"):
        se3.transform_wrench(QUARTER, [1.0, 2.0, 3.0])


def test_difference_is_in_the_outer_axes() -> None:
    after = se3.compose(QUARTER, se3.from_rotation_vector([0.5, 0.0, 0.0], [0.3, 0.0, 0.0]))
    assert np.allclose(se3.pose_difference(QUARTER, after), [0.0, 0.5, 0.0, 0.0, 0.3, 0.0])


def test_interpolation_takes_the_shorter_way_at_even_speed() -> None:
    a = se3.from_rotation_vector([0.0, 0.0, 0.0], [0.0, 0.0, math.radians(170)])
    b = se3.from_rotation_vector([4.0, -2.0, 1.0], [0.0, 0.0, math.radians(-170)])
    quarter = se3.interpolate_pose(a, b, 0.25)
    assert np.allclose(quarter.position, [1.0, -0.5, 0.25])
    assert same(quarter, se3.from_rotation_vector([1.0, -0.5, 0.25], [0.0, 0.0, math.radians(175)]))
    assert same(se3.interpolate_pose(a, b, 0.0), a)
    assert same(se3.interpolate_pose(a, b, 1.0), b)
    for s in (-0.1, 1.1, math.nan):
        with pytest.raises(ValueError, match="within 0 and 1"):
            se3.interpolate_pose(a, b, s)


def test_two_columns_are_columns() -> None:
    assert np.allclose(se3.rotation_columns(QUARTER), [0, 1, 0, -1, 0, 0])
    with pytest.raises(ValueError, match="span no plane"):
        se3.from_rotation_columns([0, 0, 0], [1, 2, 3, 2, 4, 6])


def mirrored() -> list[list[float]]:
    return np.diag([1.0, 1.0, -1.0, 1.0]).tolist()


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (mirrored(), r"determinant -1.*flipped axis"),
        (np.diag([2.0, 2.0, 2.0, 1.0]).tolist(), "no rotation"),
        (np.eye(3).tolist(), "4 x 4"),
        (np.eye(4).T[::-1].tolist(), "last row"),
        (np.full((4, 4), np.nan).tolist(), "finite"),
    ],
)
def test_what_is_no_rigid_transform_is_refused(matrix: list[list[float]], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        se3.from_matrix(matrix)


# laws


@given(poses, poses, vectors)
def test_composition_is_one_map_after_the_other(a_from_b: Pose, b_from_c: Pose, point: np.ndarray) -> None:
    through_b = se3.transform(a_from_b, se3.transform(b_from_c, point))
    assert np.allclose(se3.transform(se3.compose(a_from_b, b_from_c), point), through_b)
    assert np.allclose(
        se3.to_matrix(se3.compose(a_from_b, b_from_c)), se3.to_matrix(a_from_b) @ se3.to_matrix(b_from_c)
    )


@given(poses, poses)
def test_relative_and_inverse_undo(a: Pose, b: Pose) -> None:
    assert same(se3.compose(a, se3.inverse(a)), Pose())
    assert same(se3.compose(a, se3.relative_pose(a, b)), b)


@given(poses)
def test_representations_round_trip_and_never_mirror(pose: Pose) -> None:
    matrix = se3.to_matrix(pose)
    assert np.linalg.det(matrix[:3, :3]) == pytest.approx(1.0)
    assert same(se3.from_matrix(matrix), pose)
    assert same(se3.from_rotation_columns(pose.position, se3.rotation_columns(pose)), pose)
    assert same(se3.from_rotation_vector(pose.position, se3.rotation(pose).as_rotvec()), pose)


@given(poses, vectors, vectors, vectors, vectors)
def test_power_of_a_wrench_is_the_same_in_every_frame(
    a_from_b: Pose, force: np.ndarray, torque: np.ndarray, velocity: np.ndarray, spin: np.ndarray
) -> None:
    """f . v + t . w is invariant when the twist changes frame by its own rule: v_a = R v + p x R w."""
    turned, spun = se3.rotate(a_from_b, np.stack([velocity, spin]))
    load = se3.transform_wrench(a_from_b, np.concatenate([force, torque]))
    power = load[:3] @ (turned + np.cross(a_from_b.position, spun)) + load[3:] @ spun
    assert power == pytest.approx(force @ velocity + torque @ spin, abs=1e-8)


@given(poses, poses, st.floats(0.0, 1.0))
def test_interpolation_divides_the_way(a: Pose, b: Pose, s: float) -> None:
    metres, radians = se3.pose_distance(a, b)
    at = se3.interpolate_pose(a, b, s)
    assert se3.pose_distance(a, at) == pytest.approx((s * metres, s * radians), abs=1e-6)
    assert se3.pose_distance(at, b) == pytest.approx(((1 - s) * metres, (1 - s) * radians), abs=1e-6)
    assert radians <= math.pi + 1e-9


@given(poses, poses)
def test_relative_position_is_that_of_the_relative_pose(a: Pose, b: Pose) -> None:
    assert se3.relative_position(a, b) == pytest.approx(se3.relative_pose(a, b).position, abs=1e-12)
