"""Observation -> flat dict of arrays, and their spaces: what learning code sees of the contract.

Keys carry no dots: `tactile_upper`, `height_upper`, `pose_upper` ... All values are SI. What a sensor does not deliver
has no key.

| key             | array                                                                             |
|-----------------|-----------------------------------------------------------------------------------|
| tactile_SENSOR  | (H, W, 3) uint8, normalised difference image                                      |
| contact_SENSOR  | (h, w) int8, 0 or 1                                                               |
| valid_SENSOR    | (h, w) int8, 0 or 1                                                               |
| height_SENSOR   | (h, w) float32 [m]                                                                |
| gradient_SENSOR | (h, w, 2) float32 [-]                                                             |
| flow_SENSOR     | (m, n, 2) float32 [m]                                                             |
| pose_ARM        | (9,) float32, relative to the pose at reset: position [m], two columns of rotation |
| twist_ARM       | (6,) float32 [m/s, rad/s]                                                         |
| wrench_ARM      | (6,) float32 [N, N m]                                                             |
| joints_ARM      | (n,) float32 [rad]                                                                |
| view_CAMERA     | (H, W, 3) uint8 RGB, of a camera that looks at the scene                          |
| grip_GRIPPER    | (2,) float32, width [m] and force [N]; (1,) where the force is not measured       |
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from tacsim import pose as se3
from tacsim.gym.features import FeatureEncoder
from tacsim.interface import (
    ArmState,
    GripperState,
    IncompatibleRig,
    Needs,
    Observation,
    Pose,
    TactileObservation,
    View,
)
from tacsim.models.rig import RigConfig
from tacsim.tasks import make_task

FlatObservation = dict[str, NDArray[Any]]

# Largest magnitude of each kind of float key: far beyond what is physical here, so a value outside is an error.
BOUNDS = {
    "height": 0.05,  # [m]
    "gradient": 100.0,  # [-]
    "flow": 0.05,  # [m]
    "pose": 10.0,  # [m], and rotation columns within 1
    "twist": 100.0,  # [m/s, rad/s]
    "wrench": 1e4,  # [N, N m]
    "joints": 4 * math.pi,  # [rad]
    "grip": 1e4,  # [m, N]
}


def flatten_observation(observation: Observation, start: Mapping[str, Pose]) -> FlatObservation:
    """The observation as a flat dict of fresh arrays; `start` holds each arm's pose at reset."""
    flat: FlatObservation = {}
    for name, touch in observation.tactile.items():
        flat |= {f"{key}_{name}": value for key, value in _flatten_touch(touch).items()}
    for name, arm in observation.arms.items():
        flat |= {f"{key}_{name}": value for key, value in _flatten_arm(arm, start[name]).items()}
    for name, gripper in observation.grippers.items():
        numbers = [gripper.width] if gripper.force is None else [gripper.width, gripper.force]
        flat[f"grip_{name}"] = np.array(numbers, np.float32)
    return flat | {f"view_{name}": view.image.copy() for name, view in observation.views.items()}


def _flatten_touch(touch: TactileObservation) -> FlatObservation:
    flat: FlatObservation = {
        "tactile": touch.image.copy(),
        "contact": touch.contact.astype(np.int8),
        "valid": touch.valid.astype(np.int8),
    }
    optional = {"height": touch.height, "gradient": touch.gradient, "flow": touch.flow}
    return flat | {key: value.astype(np.float32) for key, value in optional.items() if value is not None}


def _flatten_arm(arm: ArmState, start: Pose) -> FlatObservation:
    moved = se3.relative_pose(start, arm.pose)
    pose = np.concatenate([moved.position, se3.rotation_columns(moved)])
    flat: FlatObservation = {"pose": pose, "twist": arm.twist, "wrench": arm.wrench}
    if arm.joints is not None:
        flat["joints"] = arm.joints
    return {key: value.astype(np.float32) for key, value in flat.items()}


class FlatView:
    """What an environment shows where no features are chosen: all that there is, by `flatten`."""

    needs = Needs()

    def begin(self, observation: Observation, goal: object = None) -> FlatObservation:
        """The first observation of an episode."""
        self._start = {name: arm.pose for name, arm in observation.arms.items()}
        return flatten_observation(observation, self._start)

    def __call__(self, observation: Observation) -> FlatObservation:
        return flatten_observation(observation, self._start)


def space_of(flat: FlatObservation) -> spaces.Space[FlatObservation]:
    """The Gymnasium space that `flat` and everything flattened from the same rig lies in."""
    space: spaces.Space[Any] = spaces.Dict({key: _box_space(key, value) for key, value in flat.items()})
    return space


def space_of_rig(config: RigConfig) -> spaces.Space[FlatObservation]:
    """The same of a simulated rig that is described, but need not be opened."""
    grid = config.canonical
    touches: dict[str, TactileObservation] = {}
    cells, pixels = (grid.rows, grid.columns), (grid.rows * grid.image_scale, grid.columns * grid.image_scale, 3)
    height, contact = np.zeros(cells, np.float32), np.zeros(cells, np.bool_)
    for name, sensor in config.sensors.items():
        assert sensor.sensor_model is not None
        dots = sensor.sensor_model.markers
        touches[name] = TactileObservation(
            np.zeros(pixels, np.uint8), gradient=np.zeros((*cells, 2), np.float32), height=height, contact=contact,
            valid=contact, flow=None if dots is None else np.zeros((dots.rows, dots.columns, 2), np.float32),
            time=0.0, age=0.0,
        )  # fmt: skip
    arms = {
        name: ArmState(Pose(), np.zeros(6), np.zeros(6), np.zeros(arm.joint_count) if arm.joint_count else None, 0.0)
        for name, arm in config.arms.items()
    }
    grippers = dict.fromkeys(config.grippers, GripperState(0.0, 0.0, 0.0))
    views = {
        name: View(np.zeros((*reversed(view.size), 3), np.uint8), time=0.0) for name, view in config.cameras.items()
    }
    observation = Observation(touches, arms, 0.0, grippers, views)
    return space_of(flatten_observation(observation, dict.fromkeys(config.arms, Pose())))


def space_of_features(encoder: FeatureEncoder, config: RigConfig) -> spaces.Space[FlatObservation]:
    """Of what `encoder` makes of this rig, whose task has a goal."""
    max_feature = 100.0  # the same of features, which are numbers of order 1: a height of 100 mm, a force of 1 kN
    features = encoder.features
    numbers = {key: len(each.names) for key, each in encoder.inputs.items()}
    shapes: dict[str, tuple[int, ...]] = {}
    if features.maps:
        shapes["maps"] = (numbers["maps"], features.grid.rows, features.grid.columns)
    if features.flow:
        lattices = {name: _marker_shape(name, config) for name in features.sensors}
        if len(set(lattices.values())) > 1:
            raise IncompatibleRig(f"flow of sensors with different markers makes no array: {lattices}")
        shapes["flow"] = (numbers["flow"], *next(iter(lattices.values())))
    if features.touch:
        shapes["touch"] = (numbers["touch"],)
    if features.goal:
        assert config.task is not None
        shapes["goal"] = np.atleast_1d(make_task(config.task).goal).shape
    space: spaces.Space[Any] = spaces.Dict(
        {key: spaces.Box(-max_feature, max_feature, shape, np.float32) for key, shape in shapes.items()}
    )
    return space


def _marker_shape(name: str, config: RigConfig) -> tuple[int, int]:
    """Rows and columns of a sensor's markers. Raises IncompatibleRig without such a sensor or markers."""
    sensor = config.sensors.get(name)
    model = None if sensor is None else sensor.sensor_model
    markers = None if model is None else model.markers
    if markers is None:
        raise IncompatibleRig(f"the features ask for tactile flow, and sensor '{name}' of this rig has no markers")
    return markers.rows, markers.columns


def _box_space(key: str, value: NDArray[Any]) -> spaces.Space[Any]:
    if value.dtype == np.uint8:
        return spaces.Box(0, 255, value.shape, np.uint8)
    if value.dtype == np.int8:
        return spaces.MultiBinary(value.shape)
    bound = BOUNDS[key.split("_", 1)[0]]
    return spaces.Box(-bound, bound, value.shape, np.float32)
