"""Names and shapes of an episode's data in LeRobot, the columns as Arrow tables, and their statistics.

| feature                         | what                                                               |
|---------------------------------|--------------------------------------------------------------------|
| `observation.state`             | (n,) f32: poses relative to reset, wrenches, touch, goal of a task |
| `observation.environment_state` | (k,) f32: of the state what is no pose of an arm, if wanted        |
| `observation.images.{sensor}`   | (H, W, 3) u8: the canonical picture                                |
| `observation.height.{sensor}`   | (h, w) f32 [m], if the sensor measures it                          |
| `observation.gradient.{sensor}` | (h, w, 2) f32 [-], if the sensor measures it                       |
| `observation.flow.{sensor}`     | (m, n, 2) f32 [m], of sensors with markers                         |
| `action`                        | (9 arms + 2 grippers,) f32: target pose of each arm relative to    |
|                                 | reset; target width and largest force of each gripper              |
| `next.reward`, `next.done`      | of the step that the action led to                                 |

Numbers of `observation.state` and `action` are those of `tacsim.FeatureEncoder`: SI values divided by the scale of
their quantity (`tacsim.gym.features.SCALES`). A pose is (9,): position, and the first two columns of the rotation
matrix minus those of the identity. Policies such as ACT read the state, the images and the action, not the rest.

LeRobot's rollout passes to a policy only numbers whose names end in `.pos` or `.vel`, and at its end moves the robot
back by all numbers that end in `.pos`. So the numbers of an action end in `.pos`, in the state also, and all other
numbers of the state, velocities or not, end in `.vel`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tacsim.gym.features import PARTS, SCALES, FeatureEncoder, decode_pose_change, encode_pose_change
from tacsim.interface import Action, GripperTarget, IncompatibleRig, Needs, Observation, Pose, RigSpec
from tacsim.limits import ActionError
from tacsim.models.policy import Features, Numbers, Quantity
from tacsim.models.sensor import CanonicalGrid
from tacsim.record.episode import Step

if TYPE_CHECKING:
    import pyarrow as pa

Row = dict[str, NDArray[Any]]
Goal = float | tuple[float, ...] | None  # of a task [m]

STATE, ACTION, REWARD, DONE = "observation.state", "action", "next.reward", "next.done"
ENVIRONMENT = "observation.environment_state"
IMAGE = "observation.images."
MAPS = {"height": "observation.height.", "gradient": "observation.gradient.", "flow": "observation.flow."}
MAP_AXES = ("rows", "columns", "xy")
DRIVEN, OTHER = ".pos", ".vel"
LABEL = "label"  # dtype of a feature whose numbers are indices of its names
Column = NDArray[Any] | Sequence[bytes]  # (rows, ...), or PNG pictures
Statistics = dict[str, NDArray[Any]]

QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}


@dataclass(frozen=True, slots=True)
class Feature:
    """One column: dtype ("image": PNG in the file, uint8 in memory), shape, and names of the entries of its first axis
    (for an image or a map: names of its axes)."""

    dtype: str
    shape: tuple[int, ...]
    names: tuple[str, ...] | None


class LeRobotMapping:
    """Converts observations and actions of a rig to LeRobot's features.

    It stores the poses at the start of the episode and the last targets, so call `begin` with the first observation of
    each episode.

    maps: include heights, gradients and flow.
    goal: of the task [m], the last numbers of the state, as policies such as ACT read no words; None without a task.
    environment: give what is no pose of an arm (touch, goal) as the state of the environment too, with which LeRobot's
        ACT needs no pictures.

    Raises:
        IncompatibleRig: the rig has no sensor or no arm, or a name that LeRobot does not allow.
    """

    def __init__(
        self,
        spec: RigSpec,
        canonical: CanonicalGrid,
        *,
        maps: bool = True,
        goal: Goal = None,
        environment: bool = False,
    ) -> None:
        for kind, names in (("sensor", tuple(spec.sensors)), ("arm", spec.arms)):
            if not names:
                raise IncompatibleRig(f"no {kind}: LeRobot's policies learn from pictures and actions of arms")
            for name in names:
                if "/" in name:
                    raise IncompatibleRig(f"{kind} '{name}': LeRobot allows no '/' in names; rename it in the rig file")
        self._maps, self._has_environment = maps, environment
        self.set_goal(goal)
        self._encoder = FeatureEncoder(_sensor_features(spec), canonical)
        self._start: dict[str, Pose] = {}
        self._targets: dict[str, Pose] = {}
        self._grips: dict[str, GripperTarget] = {}

    @property
    def needs(self) -> Needs:
        """What an observation must have."""
        return self._encoder.needs

    @property
    def state(self) -> Numbers:
        """Names and scales of the numbers of `observation.state`."""
        found, targets = self._encoder.inputs["touch"], set(self.action.names)
        names = [name + DRIVEN if name + DRIVEN in targets else name + OTHER for name in found.names]
        names += [f"goal_{number}{OTHER}" for number in range(len(self._goal))]
        return Numbers(names=tuple(names), scales=(*found.scales, *[SCALES["goal"]] * len(self._goal)))

    @property
    def action(self) -> Numbers:
        """Names and scales of the numbers of `action`."""
        parts = [(f"{part}_{arm}{DRIVEN}", SCALES[kind]) for arm in self._encoder.features.arms for part, kind in _POSE]
        grippers = self._encoder.features.grippers
        parts += [(f"{part}_{name}{DRIVEN}", SCALES[kind]) for name in grippers for part, kind in _GRIP]
        return Numbers(names=tuple(name for name, _ in parts), scales=tuple(scale for _, scale in parts))

    @property
    def environment(self) -> tuple[str, ...]:
        """Names of the numbers of the state that are no pose of an arm."""
        return tuple(name for name in self.state.names if name.endswith(OTHER))

    def set_goal(self, goal: Goal) -> None:
        """The goal [m] of the next observations; it has as many numbers as that of the constructor."""
        self._goal = np.atleast_1d(np.asarray(() if goal is None else goal, np.float32) / np.float32(SCALES["goal"]))

    def begin(self, observation: Observation) -> Row:
        """Starts an episode: the row of its first observation."""
        self._start = {arm: observation.arms[arm].pose for arm in self._encoder.features.arms}
        self._targets = dict(self._start)
        states = {name: observation.grippers[name] for name in self._encoder.features.grippers}
        self._grips = {name: GripperTarget(each.width, each.force or 0.0) for name, each in states.items()}
        return self._make_row(observation, self._encoder.begin(observation)["touch"])

    def encode_observation(self, observation: Observation) -> Row:
        """The row of each later observation."""
        return self._make_row(observation, self._encoder(observation)["touch"])

    def encode_action(self, action: Action) -> NDArray[np.float32]:
        """(9 arms + 2 grippers,) targets; what has none keeps its last one."""
        self._targets |= {arm: pose for arm in self._targets if (pose := action.tool.get(arm)) is not None}
        self._grips |= {name: grip for name in self._grips if (grip := action.grippers.get(name)) is not None}
        return self.encode_targets(self._targets, self._grips)

    def encode_targets(self, poses: Mapping[str, Pose], grips: Mapping[str, GripperTarget]) -> NDArray[np.float32]:
        """(9 arms + 2 grippers,) the pose of each arm relative to its start, width and force of each gripper; of one
        that is not in `grips`, its last target."""
        each = [encode_pose_change(start, poses[arm]) for arm, start in self._start.items()]
        found = {**self._grips, **grips}
        pairs = [(found[name].width, found[name].force) for name in self._grips]
        each += [np.array(pair) / [SCALES[kind] for _, kind in _GRIP] for pair in pairs]
        return np.concatenate(each).astype(np.float32)

    def decode_action(self, numbers: NDArray[np.floating[Any]]) -> Action:
        """The action of (9 arms + 2 grippers,) numbers; a width or a force below 0 is 0. Raises ActionError for numbers
        that are no poses, or not finite."""
        values = np.asarray(numbers, np.float64)
        poses, pairs = np.split(values, [len(_POSE) * len(self._start)])
        tool: dict[str, Pose | None] = {}
        for (arm, start), of_arm in zip(self._start.items(), poses.reshape(-1, len(_POSE)), strict=True):
            try:
                tool[arm] = decode_pose_change(start, of_arm)
            except ValueError as failure:
                raise ActionError(f"the action of arm '{arm}', {of_arm.tolist()}, is no pose: {failure}") from None
        grips: dict[str, GripperTarget | None] = {}
        for name, pair in zip(self._grips, pairs.reshape(-1, len(_GRIP)), strict=True):
            if not np.isfinite(pair).all():
                raise ActionError(f"the action of gripper '{name}', {pair.tolist()}, is no width and force")
            width, force = (max(float(v) * SCALES[kind], 0.0) for v, (_, kind) in zip(pair, _GRIP, strict=True))
            grips[name] = GripperTarget(width, force)
        return Action(tool, grips)

    def features(self, row: Mapping[str, NDArray[Any]]) -> dict[str, Feature]:
        """The features of the columns of a row of this rig."""
        return {key: self._feature(key, value) for key, value in row.items()}

    def _feature(self, key: str, value: NDArray[Any]) -> Feature:
        if key.startswith(IMAGE):
            return Feature("image", value.shape, ("height", "width", "channels"))
        names = {STATE: self.state.names, ACTION: self.action.names, ENVIRONMENT: self.environment}.get(key)
        return Feature(value.dtype.name, value.shape, MAP_AXES[: value.ndim] if value.ndim > 1 else names)

    def _make_row(self, observation: Observation, state: NDArray[Any]) -> Row:
        row: Row = {STATE: np.concatenate([state, self._goal])}
        if self._has_environment:
            row[ENVIRONMENT] = row[STATE][[name.endswith(OTHER) for name in self.state.names]]
        row |= {IMAGE + name: touch.image for name, touch in observation.tactile.items()}
        for kind, key in MAPS.items() if self._maps else ():
            found = {key + name: getattr(touch, kind) for name, touch in observation.tactile.items()}
            row |= {name: value for name, value in found.items() if value is not None}
        return row


_POSE = tuple(PARTS["moved"].items())
_GRIP = tuple(PARTS["grip"].items())


def _sensor_features(spec: RigSpec) -> Features:
    """All arms and grippers, and the quantities that every sensor measures."""
    sensors = spec.sensors.values()
    touch: list[Quantity] = ["moved", "wrench"]
    touch += ["between"] if len(spec.arms) > 1 else []
    touch += ["area"]
    touch += ["depth", "centroid"] if all(sensor.height for sensor in sensors) else []
    touch += ["shear"] if all(sensor.flow for sensor in sensors) else []
    touch += ["grip"] if spec.grippers else []
    return Features(
        sensors=tuple(spec.sensors),
        arms=spec.arms,
        grippers=tuple(spec.grippers),
        maps=(),
        touch=tuple(touch),
        goal=False,
    )


def outcome(step: Step, last: bool) -> Row:
    """Result of an action: the reward, if the episode has one, and whether the episode ended."""
    row: Row = {} if step.reward is None else {REWARD: np.array([step.reward], np.float32)}
    return row | {DONE: np.array([last])}


def frames_per_second(period: float) -> int | float:
    """Rate of a control period [s], as an integer if it is within 0.1 % of one, because LeRobot needs an integer."""
    rate = 1.0 / period
    return round(rate) if abs(rate - round(rate)) <= 1e-3 * rate else rate


def task_in_words(kind: str | None, goal: Goal) -> str:
    """Description of a task with this goal [m], for policies that read language."""
    goal = () if goal is None else goal if isinstance(goal, tuple) else (goal,)
    sizes = [f"{1e3 * size:g} mm" for size in goal]
    if kind == "squeeze" and len(sizes) == 1:
        return f"squeeze the body to a height of {sizes[0]}"
    if kind == "reposition" and len(sizes) == 2:
        return f"move the body by {sizes[0]} in x and {sizes[1]} in y"
    if kind == "knead" and len(sizes) == 3:
        return f"knead the body to a size of {sizes[0]} by {sizes[1]} by {sizes[2]}"
    return kind or "touch the body"


def arrow_table(features: Mapping[str, Feature], columns: Mapping[str, Column]) -> pa.Table:
    """The rows of one row group, with columns in the order of `features`."""
    import pyarrow as pa

    arrays = [_arrow_array(feature, columns[name]) for name, feature in features.items()]
    info = {"info": {"features": {name: _feature_type(feature) for name, feature in features.items()}}}
    schema = pa.schema(
        [pa.field(name, array.type) for name, array in zip(features, arrays, strict=True)],
        metadata={"huggingface": json.dumps(info)},
    )
    return pa.Table.from_arrays(arrays, schema=schema)


def _arrow_array(feature: Feature, column: Column) -> pa.Array:
    import pyarrow as pa

    if feature.dtype == "image":
        data = pa.array(column, pa.binary())
        return pa.StructArray.from_arrays([data, pa.nulls(len(data), pa.string())], ["bytes", "path"])
    numbers = np.ascontiguousarray(column)
    array = pa.array(numbers.ravel())
    if feature.shape == (1,):
        return array
    if len(feature.shape) == 1:
        return pa.FixedSizeListArray.from_arrays(array, feature.shape[0])
    for side in reversed(feature.shape):  # `datasets` stores maps as lists of lists
        array = pa.ListArray.from_arrays(np.arange(0, len(array) + 1, side, dtype=np.int32), array)
    return array


def _feature_type(feature: Feature) -> dict[str, Any]:
    """Description of the feature in the format of `datasets`."""
    if feature.dtype == "image":
        return {"_type": "Image"}
    if feature.dtype == LABEL:
        return {"names": list(feature.names or ()), "_type": "ClassLabel"}
    number = {"dtype": feature.dtype, "_type": "Value"}
    if feature.shape == (1,):
        return number
    if len(feature.shape) == 1:
        return {"feature": number, "length": feature.shape[0], "_type": "List"}
    return {"shape": list(feature.shape), "dtype": feature.dtype, "_type": f"Array{len(feature.shape)}D"}


class ImageCounts:
    """Histogram of each channel over the pictures of an episode, from which all statistics follow exactly."""

    def __init__(self) -> None:
        self._counts = np.zeros((3, 256), np.int64)
        self._pictures = 0

    def add(self, image: NDArray[np.uint8]) -> None:
        """Adds a picture (H, W, 3)."""
        self._pictures += 1
        for channel in range(3):
            self._counts[channel] += np.bincount(image[..., channel].ravel(), minlength=256)

    def statistics(self) -> Statistics:
        """Statistics of values / 255, (3, 1, 1) each; `count` of pictures, (1,)."""
        values = np.arange(256) / 255.0
        total = self._counts.sum(axis=1)
        mean = self._counts @ values / total
        found = {
            "min": values[(self._counts > 0).argmax(axis=1)],
            "max": values[255 - (self._counts[:, ::-1] > 0).argmax(axis=1)],
            "mean": mean,
            "std": np.sqrt((self._counts * (values - mean[:, None]) ** 2).sum(axis=1) / total),
        }
        below = self._counts.cumsum(axis=1)
        for name, share in QUANTILES.items():  # the smallest value with at least this share at or below it
            found[name] = values[(below >= share * total[:, None]).argmax(axis=1)]
        return {name: each.reshape(3, 1, 1) for name, each in found.items()} | {"count": np.array([self._pictures])}


def column_statistics(values: NDArray[Any]) -> Statistics:
    """Statistics of a column (frames, ...) of an episode: for each number; for a map (frames, h, w[, 2]) over all
    cells, in a shape that broadcasts to the map."""
    numbers = values.astype(np.float64)
    over = (0,) if values.ndim <= 2 else (0, 1, 2)

    def shaped(found: Any) -> NDArray[Any]:
        return np.asarray(found).reshape(values.shape[1:] if len(over) == 1 else (1, 1, *values.shape[3:]))

    found = {
        "min": shaped(numbers.min(axis=over)),
        "max": shaped(numbers.max(axis=over)),
        "mean": shaped(numbers.mean(axis=over)),
        "std": shaped(numbers.std(axis=over)),
        "count": np.array([len(values)]),
    }
    quantiles = np.quantile(numbers, list(QUANTILES.values()), axis=over)
    return found | {name: shaped(each) for name, each in zip(QUANTILES, quantiles, strict=True)}


def merge_statistics(each: Sequence[Statistics]) -> Statistics:
    """Statistics of several episodes together, as LeRobot merges them: exact except for the quantiles, which are means
    over the episodes, weighted by their frames."""
    counts = np.array([float(found["count"][0]) for found in each])

    def mean(name: str) -> NDArray[Any]:
        return np.asarray(np.tensordot(counts, np.stack([found[name] for found in each]), axes=1) / counts.sum())

    total = mean("mean")
    spread = np.stack([found["std"] ** 2 + (found["mean"] - total) ** 2 for found in each])
    whole = {
        "min": np.min([found["min"] for found in each], axis=0),
        "max": np.max([found["max"] for found in each], axis=0),
        "mean": total,
        "std": np.sqrt(np.tensordot(counts, spread, axes=1) / counts.sum()),
        "count": np.array([int(counts.sum())]),
    }
    return whole | {name: mean(name) for name in QUANTILES}
