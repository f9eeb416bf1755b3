"""Observation -> arrays of order 1 that a learned policy sees: the same in training, on a mock and on a robot.

| key   | shape, float32                      | what                                                   |
|-------|-------------------------------------|--------------------------------------------------------|
| maps  | (frames * sensors * channels, h, w) | frame by frame (oldest first), sensor by sensor        |
| flow  | (frames * sensors * 2, m, n)        | (x, y) of each sensor's markers                        |
| touch | (frames * numbers,)                 | named by `FeatureEncoder.inputs`                        |
| goal  | (1,) or (2,)                        | of the task                                            |

Every number is its SI value over the scale of its quantity in `SCALES`; of a picture less 1, so that black is -1 and
white 1. Nothing is clipped and nothing is normalised further here: what else a network wants is inside the network.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tacsim import pose as se3
from tacsim.gym.cell_means import CellMeans, image_means
from tacsim.interface import (
    ArmState,
    FloatArray,
    GripperState,
    IncompatibleRig,
    Needs,
    Observation,
    Pose,
    TactileObservation,
)
from tacsim.models.policy import Channel, Features, MapGrid, Numbers, Quantity
from tacsim.models.sensor import CanonicalGrid
from tacsim.tasks.reposition import centre_of_pressure_in_sensor
from tacsim.tasks.turn import EdgeTurn

Arrays = dict[str, NDArray[Any]]

# The SI value that is encoded as 1.
SCALES = {
    "height": 1e-3,  # [m]
    "slope": 1.0,  # [-]
    "contact": 1.0,  # share of a cell that is in contact [-]
    "image": 1.0,  # relative change of colour, (v - 128) / 128 [-]
    "picture": 127.5,  # of the camera, from black (-1) to white (1) [grey levels]
    "flow": 0.2e-3,  # [m]
    "area": 1e-4,  # in contact [m^2]
    "depth": 1e-3,  # greatest, and mean over the contact [m]
    "centroid": 5e-3,  # of the indented volume, sensor x and y [m]
    "dragged": 1e-3,  # of the centroid since the first observation with contact, sensor x and y [m]
    "shear": 0.2e-3,  # mean flow of all markers, sensor x and y [m]
    "turned": 0.5,  # of the edges in the gel since the first observation, from sensor x to y [rad]
    "force": 10.0,  # [N]
    "torque": 0.05,  # [N m]
    "pressure": 5e-3,  # where the normal force acts, less where it did at the first touch; sensor x and y [m]
    "moved": 5e-3,  # of an arm since reset, in the axes of its sensor then [m]
    "stepped": 0.5e-3,  # of an arm since the last observation, in the axes of its sensor at reset [m]
    "between": 10e-3,  # from the first arm's sensor to another's, in the axes of the first [m]
    "turn": 0.1,  # first two columns of a rotation, less those of no rotation [-]
    "width": 20e-3,  # of a gripper [m]
    "goal": 10e-3,  # [m]
}
# What each quantity consists of, and the scale of each part.
PARTS: dict[str, dict[str, str]] = {
    "height": {"height": "height"},
    "slope": {"slope_x": "slope", "slope_y": "slope"},
    "contact": {"contact": "contact"},
    "image": dict.fromkeys(("red", "green", "blue"), "image"),
    "picture": dict.fromkeys(("picture_red", "picture_green", "picture_blue"), "picture"),
    "flow": {"flow_x": "flow", "flow_y": "flow"},
    "area": {"area": "area"},
    "depth": {"depth_greatest": "depth", "depth_mean": "depth"},
    "centroid": {"centroid_x": "centroid", "centroid_y": "centroid"},
    "dragged": {"dragged_x": "dragged", "dragged_y": "dragged"},
    "shear": {"shear_x": "shear", "shear_y": "shear"},
    "turned": {"turned": "turned"},
    "wrench": {f"{what}_{axis}": what for what in ("force", "torque") for axis in "xyz"},
    "pressure": {"pressure_x": "pressure", "pressure_y": "pressure"},
    "moved": {f"moved_{axis}": "moved" for axis in "xyz"}
    | {f"turn_{column}{axis}": "turn" for column in "xy" for axis in "xyz"},
    "stepped": {f"stepped_{axis}": "stepped" for axis in "xyz"},
    "between": {f"between_{axis}": "between" for axis in "xyz"},
    "grip": {"width": "width", "grip_force": "force"},
}
_IDENTITY_COLUMNS = np.array([1.0, 0.0, 0.0, 0.0, 1.0, 0.0])
_SENSOR_QUANTITIES = ("area", "depth", "centroid", "dragged", "shear", "turned")
_OF_HEIGHT = {"height", "slope", "depth", "centroid", "dragged", "turned"}


def default_features(canonical: CanonicalGrid, sensors: Sequence[str], arms: Sequence[str]) -> Features:
    """What an environment shows where its user names no features: the heights of all sensors, contacts and
    forces, as numbers of order 1. The map has at most 16 x 16 cells, each of whole cells of the canonical grid; a grid
    that cannot be divided so has no map."""
    max_map_cells = 16  # along a side of the default map
    position: Quantity = "between" if len(arms) > 1 else "moved"
    finer = (canonical.rows, canonical.columns)
    every = -(-max(finer) // max_map_cells)
    if every % 2 == 0 and any(have % 2 for have in finer):
        every += 1  # margins must be equal on both sides: an even number of cells is left over
    rows, columns = (have // every - (have % every) % 2 for have in finer)
    pitch = every * canonical.pitch
    fits = min(rows, columns) >= 1 and pitch <= 10e-3  # not a grid that is all but a line
    return Features(
        sensors=tuple(sensors),
        arms=tuple(arms),
        maps=("height",) if fits else (),
        grid=MapGrid(rows=rows, columns=columns, pitch=pitch) if fits else MapGrid(),
        touch=("area", "depth", "centroid", "wrench", position),
    )


class FeatureEncoder:
    """Encodes the observations of one rig. It remembers the episode's start and the last frames: `begin` it with the
    first observation, then call it with each other.

    Raises IncompatibleRig when the maps do not fit the rig's canonical grid.
    """

    def __init__(self, features: Features, canonical: CanonicalGrid) -> None:
        self.features = features
        canonical_maps = set(features.maps) - {"picture"}
        self._cell_means = CellMeans(features.grid, canonical) if canonical_maps else None
        self._rows, self._columns = (_cell_centres(n, canonical.pitch) for n in (canonical.rows, canonical.columns))
        self._cell_area = canonical.pitch**2
        self._goal: Arrays = {}
        self._start: Mapping[str, Pose] = {}
        self._pressed: dict[str, FloatArray] = {}  # where the normal force acted first
        self._gripped: dict[str, FloatArray] = {}  # centroid of each sensor's first contact
        self._turns: list[EdgeTurn] = []  # of each sensor
        self._before: Mapping[str, Pose] = {}  # poses of the last observation
        self._sums: FloatArray | float = 0.0  # of what is remembered, since the episode began
        self._count = 0
        self._frames: deque[Arrays] = deque(maxlen=features.frames)

    @property
    def needs(self) -> Needs:
        wanted = self.features
        height = not _OF_HEIGHT.isdisjoint((*wanted.maps, *wanted.touch))
        flow = wanted.flow or "shear" in wanted.touch
        sensors, arms, grippers = map(frozenset, (wanted.sensors, wanted.arms, wanted.grippers))
        return Needs(sensors, arms, height=height, flow=flow, grippers=grippers)

    @property
    def inputs(self) -> dict[str, Numbers]:
        """What the numbers of each array are, along its first axis: quantity and axis, of which sensor or arm, and with
        several frames how many periods ago. Without the goal's, which depend on the task."""
        wanted = self.features
        found: dict[str, list[tuple[str, float]]] = {}
        if wanted.maps:
            found["maps"] = [
                part for name in wanted.sensors for kind in wanted.maps for part in _named_parts(kind, name)
            ]
        if wanted.flow:
            found["flow"] = [part for name in wanted.sensors for part in _named_parts("flow", name)]
        if wanted.touch:
            found["touch"] = self._touch_parts(wanted.touch)
            found["touch"] += [(f"{name} mean", scale) for name, scale in self._touch_parts(wanted.remembered)]
        ages = [f" -{age}" if age else "" for age in reversed(range(wanted.frames))]
        return {
            key: Numbers(
                names=tuple(name + age for age in ages for name, _ in parts),
                scales=tuple(scale for _ in ages for _, scale in parts),
            )
            for key, parts in found.items()
        }

    def _touch_parts(self, quantities: Sequence[Quantity]) -> list[tuple[str, float]]:
        """Name and scale of all that `touch` says of them."""
        wanted = self.features
        owners = {
            kind: wanted.sensors if kind in _SENSOR_QUANTITIES else wanted.grippers if kind == "grip" else wanted.arms
            for kind in quantities
        }
        return [
            part
            for kind, names in owners.items()
            for name in names[kind == "between" :]
            for part in _named_parts(kind, name)
        ]

    def begin(self, observation: Observation, goal: float | Sequence[float] | None = None) -> Arrays:
        """The first observation of an episode; frames before it are taken to be like it.

        goal: of the task [m]. Raises IncompatibleRig when a policy wants one and there is none.
        """
        if self.features.goal:
            if goal is None:
                raise IncompatibleRig("the policy needs a goal, but the rig has no task: name one (--task)")
            self._goal = {"goal": np.atleast_1d(np.asarray(goal, np.float32) / np.float32(SCALES["goal"]))}
        self._start = {name: observation.arms[name].pose for name in self.features.arms}
        self._pressed, self._gripped, self._before = {}, {}, self._start
        self._turns = [EdgeTurn() for _ in self.features.sensors]
        self._sums, self._count = 0.0, 0
        self._frames.extend([self._encode(observation)] * self.features.frames)
        return self._stack_frames()

    def __call__(self, observation: Observation) -> Arrays:
        self._frames.append(self._encode(observation))
        return self._stack_frames()

    def _stack_frames(self) -> Arrays:
        arrays = {key: np.concatenate([frame[key] for frame in self._frames]) for key in self._frames[-1]}
        return arrays | {key: value.copy() for key, value in self._goal.items()}

    def _encode(self, observation: Observation) -> Arrays:
        wanted = self.features
        touches = [observation.tactile[name] for name in wanted.sensors]
        arrays: Arrays = {}
        if wanted.maps:
            arrays["maps"] = np.concatenate(
                [self._encode_map(touch, kind) for touch in touches for kind in wanted.maps]
            )
        if wanted.flow:
            arrays["flow"] = np.concatenate(
                [_require_flow(touch).transpose(2, 0, 1) / SCALES["flow"] for touch in touches]
            )
        if wanted.touch:
            arms = {name: observation.arms[name] for name in wanted.arms}
            quantities: dict[str, FloatArray] = {
                quantity: _encode_grips([observation.grippers[name] for name in wanted.grippers])
                if quantity == "grip"
                else self._encode_quantity(quantity, touches, arms)
                for quantity in wanted.touch
            }
            if wanted.remembered:
                self._sums = self._sums + np.concatenate([quantities[quantity] for quantity in wanted.remembered])
                self._count += 1
                quantities["means"] = self._sums / self._count
            arrays["touch"] = np.concatenate(list(quantities.values()))
            self._before = {name: arm.pose for name, arm in arms.items()}
        return {key: value.astype(np.float32) for key, value in arrays.items()}

    def _encode_map(self, touch: TactileObservation, kind: Channel) -> FloatArray:
        """(channels, h, w) of one sensor."""
        if kind == "picture":
            return image_means(touch.picture, self.features.grid) / SCALES["picture"] - 1.0
        assert self._cell_means is not None
        return self._cell_means(_encode_channel(touch, kind), touch.valid)

    def _encode_quantity(
        self, quantity: Quantity, touches: Sequence[TactileObservation], arms: Mapping[str, ArmState]
    ) -> FloatArray:
        """All that `touch` says of one quantity."""
        each: list[FloatArray]
        if quantity == "area":
            each = [np.array([touch.contact.sum() * self._cell_area / SCALES["area"]]) for touch in touches]
        elif quantity == "depth":
            each = [_depths(touch) / SCALES["depth"] for touch in touches]
        elif quantity == "centroid":
            each = [_or_middle(self._centroid(touch)) / SCALES["centroid"] for touch in touches]
        elif quantity == "dragged":
            named = zip(self.features.sensors, touches, strict=True)
            each = [self._centroid_shift(name, touch) / SCALES["dragged"] for name, touch in named]
        elif quantity == "shear":
            each = [_require_flow(touch).mean(axis=(0, 1)) / SCALES["shear"] for touch in touches]
        elif quantity == "turned":
            turns = zip(self._turns, touches, strict=True)
            each = [np.array([turn(touch) / SCALES["turned"]]) for turn, touch in turns]
        elif quantity == "wrench":
            each = [
                np.concatenate([a.wrench[:3] / SCALES["force"], a.wrench[3:] / SCALES["torque"]]) for a in arms.values()
            ]
        elif quantity == "pressure":
            each = [self._pressure_centre_shift(name, arm) / SCALES["pressure"] for name, arm in arms.items()]
        elif quantity == "moved":
            each = [encode_pose_change(self._start[name], arm.pose) for name, arm in arms.items()]
        elif quantity == "stepped":
            each = [self._last_displacement(name, arm.pose) / SCALES["stepped"] for name, arm in arms.items()]
        else:
            first, *others = arms.values()
            each = [se3.relative_position(first.pose, arm.pose) / SCALES["between"] for arm in others]
        return np.concatenate(each)

    def _pressure_centre_shift(self, name: str, arm: ArmState) -> FloatArray:
        """(2,) since the first touch of the episode [m]; 0 without contact."""
        here = centre_of_pressure_in_sensor(arm)
        return np.zeros(2) if here is None else here - self._pressed.setdefault(name, here)

    def _last_displacement(self, name: str, pose: Pose) -> FloatArray:
        """(3,) since the last observation [m]."""
        now, before = (se3.relative_position(self._start[name], each) for each in (pose, self._before[name]))
        return now - before

    def _centroid_shift(self, name: str, touch: TactileObservation) -> FloatArray:
        """(2,) since the episode's first observation with contact [m]; 0 without contact."""
        here = self._centroid(touch)
        return np.zeros(2) if here is None else here - self._gripped.setdefault(name, here)

    def _centroid(self, touch: TactileObservation) -> FloatArray | None:
        """(2,) of what is pressed in where there is contact [m]; None without contact."""
        pressed = _require_height(touch).clip(min=0.0) * touch.contact
        total = float(pressed.sum())
        if total == 0.0:
            return None
        return np.array([pressed.sum(axis=0) @ self._columns, pressed.sum(axis=1) @ self._rows]) / total


def _or_middle(centroid: FloatArray | None) -> FloatArray:
    """(2,) [m]; the middle of the gel without contact."""
    return np.zeros(2) if centroid is None else centroid


def _encode_grips(grippers: Sequence[GripperState]) -> FloatArray:
    """Width and force of each. Raises IncompatibleRig for a gripper that does not measure its force."""
    numbers: list[float] = []
    for gripper in grippers:
        if gripper.force is None:
            raise IncompatibleRig("the policy sees grip forces, and this gripper does not measure its own")
        numbers += [gripper.width / SCALES["width"], gripper.force / SCALES["force"]]
    return np.array(numbers)


def _named_parts(kind: str, owner: str) -> list[tuple[str, float]]:
    return [(f"{part}_{owner}", SCALES[scale]) for part, scale in PARTS[kind].items()]


def _cell_centres(cells: int, pitch: float) -> FloatArray:
    """(cells,) of the cells along one axis, sensor frame [m]."""
    return (np.arange(cells, dtype=np.float64) - (cells - 1) / 2) * pitch


def _encode_channel(touch: TactileObservation, kind: Channel) -> FloatArray:
    """(h, w, channels) of the canonical grid, encoded."""
    values: NDArray[Any]
    if kind == "height":
        values = _require_height(touch)[..., None]
    elif kind == "slope":
        if touch.gradient is None:
            raise IncompatibleRig("the policy sees slopes, and this sensor delivers none")
        values = touch.gradient
    elif kind == "contact":
        values = touch.contact[..., None]
    else:
        rows, columns = touch.contact.shape
        scale = touch.image.shape[0] // rows
        values = touch.image.reshape(rows, scale, columns, scale, 3).mean(axis=(1, 3)) / 128.0 - 1.0
    encoded: FloatArray = values.astype(np.float64) / SCALES[kind]
    return encoded


def _require_height(touch: TactileObservation) -> FloatArray:
    if touch.height is None:
        raise IncompatibleRig("the policy sees heights, and this sensor delivers none")
    return touch.height.astype(np.float64)


def _require_flow(touch: TactileObservation) -> FloatArray:
    if touch.flow is None:
        raise IncompatibleRig("the policy sees tactile flow, and this sensor has no markers")
    return touch.flow.astype(np.float64)


def _depths(touch: TactileObservation) -> FloatArray:
    """(2,) greatest depth, and mean depth where there is contact [m]; 0 without contact."""
    height = _require_height(touch)
    greatest = height.max(where=touch.valid, initial=0.0)
    touching = height[touch.contact]  # `mean(where=...)` takes three times as long
    mean = touching.mean() if touching.size else 0.0
    return np.array([greatest, mean])


def encode_pose_change(start: Pose, pose: Pose) -> FloatArray:
    """(9,) where an arm is, seen from where it was at reset, encoded: position, and two columns of the rotation."""
    away = se3.relative_pose(start, pose)
    return np.concatenate(
        [away.position / SCALES["moved"], (se3.rotation_columns(away) - _IDENTITY_COLUMNS) / SCALES["turn"]]
    )


def decode_pose_change(start: Pose, numbers: NDArray[np.floating[Any]]) -> Pose:
    """The pose that `moved` makes these numbers of (9,). Raises ValueError for columns that span no plane, and for
    numbers that are not finite."""
    values = np.asarray(numbers, np.float64)
    away = se3.from_rotation_columns(values[:3] * SCALES["moved"], values[3:] * SCALES["turn"] + _IDENTITY_COLUMNS)
    return se3.compose(start, away)
