"""A learned policy in an ONNX file whose metadata describe its inputs and its action.

The graph takes the arrays of `tacsim.FeatureEncoder`, each with a leading axis of 1, and returns `action`, (1, n)
within [-1, 1]; all other processing of the inputs is inside the graph. Its metadata hold one JSON text
(`tacsim.models.policy.PolicySpec`). Only the ONNX operators of the file are executed, no other code.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from robot.deploy.axis_motion import AxisMotion
from robot.deploy.python_policy import PolicyNotFound
from robot.deploy.training_range import RangeMonitor, number_names
from tacsim.gym.features import FeatureEncoder
from tacsim.interface import Action, Needs, Observation, RigSpec
from tacsim.models.policy import METADATA_KEY, ActionAxis, Numbers, PolicySpec
from tacsim.models.sensor import CanonicalGrid
from tacsim.models.text import printable_line
from tacsim.tasks import Task
from tacsim.tasks.task import ActionAxes, Axis, GripAxis, needs_of_axes

if TYPE_CHECKING:
    from onnxruntime import InferenceSession

MAX_BYTES = 64 * 2**20  # of a file; ours have less than 2 MB


Goal = float | tuple[float, ...] | None  # of a task [m]
Shape = tuple[int | None, ...]  # None: any size


class PolicyFailed(RuntimeError):
    """A learned policy returned no valid action."""


class OnnxPolicy:
    """The policy in `path`, on a rig with this canonical grid.

    An action moves an arm as in training (AxisMotion). The same file returns the same action for the same observations
    on any rig. `range_monitor` compares the observations of the episode with those of training.

    Args:
        goal: of the task [m]; None without one.

    Raises PolicyNotFound if the file is not such a policy, IncompatibleRig if its maps do not fit the grid.
    """

    def __init__(self, path: Path, canonical: CanonicalGrid, goal: Goal) -> None:
        self._session = _open_session(path)
        self.spec = _read_spec(path, self._session)
        self._name, self._goal = path.name, goal
        self._encoder = FeatureEncoder(self.spec.features, canonical)
        self._axes = _axes_of(self.spec)
        self._motion = AxisMotion(self._axes, self.spec.max_step)
        self._is_new = True  # no observation of this episode was seen yet
        _require_same_inputs(path, self.spec, self._encoder.inputs, self._session, goal)
        names = number_names(self.spec, 0 if goal is None else np.size(goal))
        try:
            self.range_monitor = RangeMonitor(self.spec.range, names, self.spec.features.frames)
        except ValueError as failure:
            raise PolicyNotFound(f"policy '{path}': {failure}") from None

    @staticmethod
    def spec_of(path: Path) -> PolicySpec:
        """The metadata of the file; needs no rig. Raises PolicyNotFound."""
        return _read_spec(path, _open_session(path))

    @property
    def needs(self) -> Needs:
        features, moved = self._encoder.needs, needs_of_axes(self._axes)
        arms, grippers = features.arms | moved.arms, features.grippers | moved.grippers
        return Needs(features.sensors, arms, height=features.height, flow=features.flow, grippers=grippers)

    def reset(self) -> None:
        self._motion.begin()
        self._is_new = True
        self.range_monitor.reset()

    def __call__(self, observation: Observation) -> Action:
        """The action for an observation. Raises PolicyFailed if the graph fails or returns no valid action."""
        first, self._is_new = self._is_new, False
        features = self._encoder.begin(observation, self._goal) if first else self._encoder(observation)
        self.range_monitor(features)
        return self._motion.action(self._infer(features), observation)

    def _infer(self, features: Mapping[str, NDArray[Any]]) -> NDArray[np.float32]:
        not_finite = sorted(key for key, value in features.items() if not np.isfinite(value).all())
        if not_finite:
            raise PolicyFailed(
                f"policy '{self._name}': {', '.join(not_finite)} has values that are not finite; no action is computed"
            )
        try:
            (action,) = self._session.run(["action"], {key: value[None] for key, value in features.items()})
        except Exception as failure:  # onnxruntime has no common base class
            raise PolicyFailed(f"policy '{self._name}' fails on this observation: {_first_line(failure)}") from failure
        vector: NDArray[np.float32] = np.asarray(action, np.float32)
        if (
            vector.shape != (1, len(self._axes))
            or not np.isfinite(vector).all()
            or float(np.abs(vector).max()) > 1.0 + 1e-6
        ):
            raise PolicyFailed(
                f"policy '{self._name}' gives {vector.tolist()}; an action has {len(self._axes)} finite numbers within "
                "[-1, 1]: train or export it again"
            )
        first: NDArray[np.float32] = vector[0]
        return first


def find_mismatches(policy: OnnxPolicy, rig: RigSpec, task: Task | None) -> list[str]:
    """Differences of rig and task from those of the policy's training, beyond its `needs`; each a phrase."""
    spec, found = policy.spec, []
    if abs(rig.period - spec.period) > 1e-3 * spec.period:
        found.append(f"a control period of {spec.period:g} s, the rig has {rig.period:g} s (period)")
    if task is None:
        return (
            found
            if not spec.features.goal
            else [*found, f"the goal of a task '{spec.task}', there is no task (--task)"]
        )
    if task.config.kind != spec.task:
        found.append(f"task '{spec.task}', this is '{task.config.kind}'")
    if _axes_of(spec) != task.axes:
        found.append(f"actions along {_list_axes(_axes_of(spec))}, this task has {_list_axes(task.axes)}")
    if spec.max_step > task.config.max_step * (1 + 1e-6):
        found.append(
            f"steps of up to {1e3 * spec.max_step:g} mm, this task allows {1e3 * task.config.max_step:g} mm (max_step)"
        )
    return found


def _axes_of(spec: PolicySpec) -> tuple[Axis | GripAxis, ...]:
    return tuple(
        Axis(axis.arm, axis.direction)
        if isinstance(axis, ActionAxis)
        else GripAxis(axis.gripper, axis.min_force, axis.max_force)
        for axis in spec.axes
    )


def _list_axes(axes: ActionAxes) -> str:
    return ", ".join(
        f"{axis.arm} {tuple(axis.direction)}"
        if isinstance(axis, Axis)
        else f"{axis.gripper} {axis.min_force:g} to {axis.max_force:g} N"
        for axis in axes
    )


def read_policy_spec(path: Path) -> PolicySpec:
    """What a learned policy's file says of itself. Raises PolicyNotFound for a file that is none."""
    return _read_spec(path, _open_session(path))


def _open_session(path: Path) -> InferenceSession:
    try:
        import onnxruntime
    except ModuleNotFoundError:
        raise PolicyNotFound(
            f"policy '{path}': learned policies need onnxruntime, which is not installed: pip install 'tacsim[policy]'"
        ) from None
    try:
        size = path.stat().st_size
        if size > MAX_BYTES:
            raise PolicyNotFound(f"policy '{path}' has {size / 2**20:,.0f} MiB, the maximum is {MAX_BYTES >> 20} MiB")
        data = path.read_bytes()
    except OSError as failure:
        raise PolicyNotFound(f"policy '{path}' cannot be read: {failure.strerror or failure}") from None
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1  # small networks; other cores simulate
    options.log_severity_level = 4  # errors are reported here
    # Weights in other files are searched in a folder that cannot exist: the file itself.
    options.add_session_config_entry("session.model_external_initializers_file_folder_path", str(path.absolute()))
    try:
        return onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
    except Exception as failure:  # onnxruntime has no common base class
        raise PolicyNotFound(f"policy '{path}' is not an ONNX file that can run here: {_first_line(failure)}") from None


def _read_spec(path: Path, session: InferenceSession) -> PolicySpec:
    text = session.get_modelmeta().custom_metadata_map.get(METADATA_KEY)
    if text is None:
        raise PolicyNotFound(
            f"policy '{path}' does not describe its inputs: it has no metadata '{METADATA_KEY}', which "
            "tacsim export policy writes"
        )
    try:
        return PolicySpec.model_validate_json(text)
    except ValidationError as failure:
        first = failure.errors()[0]
        where = ".".join(map(str, first["loc"])) or "text"
        raise PolicyNotFound(
            f"policy '{path}': its metadata '{METADATA_KEY}' cannot be read: {printable_line(where)}: "
            f"{printable_line(first['msg'])}; was it exported by another version?"
        ) from None


def _require_same_inputs(
    path: Path, spec: PolicySpec, encoder_inputs: Mapping[str, Numbers], session: InferenceSession, goal: Goal
) -> None:
    """Raises PolicyNotFound unless the inputs equal those of the encoder, number by number, with one action."""
    grid, graph = spec.features.grid, {each.name: each for each in session.get_inputs()}
    map_shapes = {"maps": (grid.rows, grid.columns), "flow": (None, None)}  # the rig has the markers
    expected: dict[str, Shape] = {
        key: (1, len(each.names), *map_shapes.get(key, ())) for key, each in encoder_inputs.items()
    }
    if spec.features.goal:
        expected["goal"] = (1, None if goal is None else np.size(goal))
    if set(graph) != set(expected):
        raise PolicyNotFound(
            f"policy '{path}': its graph takes {', '.join(sorted(graph))}, its metadata list "
            f"{', '.join(sorted(expected))}"
        )
    for key, shape in expected.items():
        if key in encoder_inputs and spec.inputs.get(key) != encoder_inputs[key]:
            raise PolicyNotFound(
                f"policy '{path}': its training had another input '{key}' than this version of tacsim computes from "
                "the same features: train it again, or use the version in its metadata"
            )
        if not _has_shape(graph[key], shape):
            if key == "goal":
                raise PolicyNotFound(
                    f"policy '{path}' was trained for task '{spec.task}', whose goal is "
                    f"{_describe_array(graph[key])}; the goal of this task is {_describe_shape(shape)}"
                )
            raise PolicyNotFound(
                f"policy '{path}': its input '{key}' is {_describe_array(graph[key])}; wanted: {_describe_shape(shape)}"
            )
    outputs = {each.name: each for each in session.get_outputs()}
    action: Shape = (1, len(spec.axes))
    if "action" not in outputs or not _has_shape(outputs["action"], action):
        outputs_found = ", ".join(f"'{name}', {_describe_array(each)}" for name, each in outputs.items())
        raise PolicyNotFound(
            f"policy '{path}': it must give 'action', {_describe_shape(action)}; it gives {outputs_found}"
        )


def _has_shape(found: Any, shape: Shape) -> bool:
    """True if an array of the graph has this shape, where both give a size."""
    sides = zip(found.shape, shape, strict=True) if len(found.shape) == len(shape) else [(0, 1)]
    known_sides = ((side, expected) for side, expected in sides if isinstance(side, int) and expected is not None)
    return found.type == "tensor(float)" and all(side == expected for side, expected in known_sides)


def _describe_array(found: Any) -> str:
    return f"{found.type} {found.shape}"


def _describe_shape(shape: Shape) -> str:
    return f"tensor(float) {' x '.join('n' if side is None else str(side) for side in shape)}"


def _first_line(failure: Exception) -> str:
    """First line of the message of onnxruntime, printable on a terminal."""
    return printable_line((str(failure).strip().splitlines() or [repr(failure)])[0][:300])
