"""Flat observations keep what they encode."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tacsim import pose as se3
from tacsim.gym import encode
from tacsim.interface import ArmState, Observation, Pose, TactileObservation

POSES = {
    "lower": Pose(np.array([0.1, 0.2, 0.3])),
    "upper": Pose(np.array([1.0, 2.0, 3.0]), Rotation.from_euler("xyz", [3.0, 0.2, -0.4]).as_quat()),
}


def make_observation(flow: bool = True, joints: bool = False) -> Observation:
    random = np.random.default_rng(3)
    touch = TactileObservation(
        image=random.integers(0, 256, (8, 12, 3), dtype=np.uint8),
        gradient=random.normal(0, 0.1, (4, 6, 2)).astype(np.float32),
        height=random.normal(0, 1e-4, (4, 6)).astype(np.float32),
        contact=random.random((4, 6)) > 0.5,
        valid=random.random((4, 6)) > 0.2,
        flow=random.normal(0, 1e-4, (3, 5, 2)).astype(np.float32) if flow else None,
        time=1.0,
        age=0.0,
    )
    turned = Pose(POSES["upper"].position + [1e-3, 2e-3, 3e-3], POSES["upper"].quaternion)
    arm = ArmState(turned, np.arange(6.0), np.arange(6.0) - 3, np.arange(6.0) / 10 if joints else None, 1.0)
    return Observation({"finger": touch}, {"upper": arm}, 1.0)


def test_keys_shapes_and_types() -> None:
    flat = encode.flatten_observation(make_observation(joints=True), POSES)
    assert {key: (value.shape, value.dtype.name) for key, value in flat.items()} == {
        "tactile_finger": ((8, 12, 3), "uint8"),
        "contact_finger": ((4, 6), "int8"),
        "valid_finger": ((4, 6), "int8"),
        "height_finger": ((4, 6), "float32"),
        "gradient_finger": ((4, 6, 2), "float32"),
        "flow_finger": ((3, 5, 2), "float32"),
        "pose_upper": ((9,), "float32"),
        "twist_upper": ((6,), "float32"),
        "wrench_upper": ((6,), "float32"),
        "joints_upper": ((6,), "float32"),
    }
    assert not any("." in key for key in flat)


def test_what_is_not_there_has_no_key() -> None:
    flat = encode.flatten_observation(make_observation(flow=False), POSES)
    assert "flow_finger" not in flat
    assert "joints_upper" not in flat


def test_values_are_kept_and_copied() -> None:
    observation = make_observation()
    flat = encode.flatten_observation(observation, POSES)
    touch = observation.tactile["finger"]
    for key, value in (("tactile", touch.image), ("height", touch.height), ("contact", touch.contact)):
        assert value is not None
        assert np.array_equal(flat[f"{key}_finger"], value)
        assert not np.shares_memory(flat[f"{key}_finger"], value)


def test_pose_is_relative_to_reset_and_reads_back() -> None:
    observation = make_observation()
    vector = encode.flatten_observation(observation, POSES)["pose_upper"].astype(float)
    now = observation.arms["upper"].pose
    back = se3.compose(POSES["upper"], se3.from_rotation_columns(vector[:3], vector[3:]))
    assert back.position == pytest.approx(now.position, abs=1e-6)
    assert abs(back.quaternion @ now.quaternion) == pytest.approx(1.0, abs=1e-6)
    at_reset = encode.flatten_observation(Observation({}, observation.arms, 1.0), {"upper": now})["pose_upper"]
    assert at_reset == pytest.approx([0, 0, 0, 1, 0, 0, 0, 1, 0], abs=1e-7)


def test_the_space_holds_what_was_flattened_and_refuses_the_absurd() -> None:
    flat = encode.flatten_observation(make_observation(joints=True), POSES)
    space = encode.space_of(flat)
    assert flat in space
    assert flat | {"height_finger": flat["height_finger"] + np.float32(1.0)} not in space  # a metre deep
    assert {key: value for key, value in flat.items() if key != "wrench_upper"} not in space
