"""A learned policy in an ONNX file that says of itself what it sees and what its numbers do.

The graph takes the arrays that `tacsim.FeatureEncoder` makes, each with a leading axis of 1, and gives `action`, (1, n)
within [-1, 1]; whatever else a network does to its inputs is inside. Its metadata holds one JSON text
(`tacsim.models.policy.PolicySpec`). Nothing in such a file is executed but the operators of ONNX.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from robot.deploy.python_policy import PolicyNotFound
from robot.deploy.training_range import RangeWatch, names_of
from tacsim import pose as se3
from tacsim.gym.features import FeatureEncoder
from tacsim.interface import Action, Needs, Observation, Pose, RigSpec
from tacsim.models.policy import METADATA_KEY, Numbers, PolicySpec
from tacsim.models.sensor import CanonicalGrid
from tacsim.models.text import printable
from tacsim.tasks import Task
from tacsim.tasks.task import Axis, action_of_vector

if TYPE_CHECKING:
    from onnxruntime import InferenceSession

MAX_BYTES = 64 * 2**20  # of a file; ours have less than 2 MB


Goal = float | tuple[float, ...] | None  # of a task [m]
Shape = tuple[int | None, ...]  # None: whatever it is


class PolicyFailed(RuntimeError):
    """A learned policy gave no action."""


class OnnxPolicy:
    """The policy in `path`, on a rig with this canonical grid.

    An action moves an arm from where it was last asked to go, as in training; from where it stands if a limit has kept
    it from going there. The same file gives the same action for the same observations on any rig. `watch` says whether
    the observations of the episode are such as the policy met in training.

    Args:
        goal: of the task [m]; None without one.

    Raises PolicyNotFound for a file that is no such policy, IncompatibleRig for one whose maps do not fit the grid.
    """

    def __init__(self, path: Path, canonical: CanonicalGrid, goal: Goal) -> None:
        self._session = _session(path)
        self.spec = _spec(path, self._session)
        self._name, self._goal = path.name, goal
        self._encoder = FeatureEncoder(self.spec.features, canonical)
        self._axes = tuple(Axis(axis.arm, axis.direction) for axis in self.spec.axes)
        self._targets: dict[str, Pose] = {}
        _require_same_inputs(path, self.spec, self._encoder.inputs, self._session, goal)
        names = names_of(self.spec, 0 if goal is None else np.size(goal))
        try:
            self.watch = RangeWatch(self.spec.range, names, self.spec.features.frames)
        except ValueError as failure:
            raise PolicyNotFound(f"policy '{path}': {failure}") from None

    @staticmethod
    def spec_of(path: Path) -> PolicySpec:
        """What the file says of itself, without a rig. Raises PolicyNotFound."""
        return _spec(path, _session(path))

    @property
    def needs(self) -> Needs:
        seen = self._encoder.needs
        arms = seen.arms | {axis.arm for axis in self._axes}
        return Needs(seen.sensors, arms, height=seen.height, flow=seen.flow)

    def reset(self) -> None:
        self._targets = {}
        self.watch.reset()

    def __call__(self, observation: Observation) -> Action:
        """Raises PolicyFailed when the graph fails, or gives what is no action."""
        # steps between where an arm was asked to go and where it is, from which on it is asked anew from there
        max_deviation = 2.0
        first = not self._targets
        seen = self._encoder.begin(observation, self._goal) if first else self._encoder(observation)
        self.watch(seen)
        for axis in self._axes:
            now = observation.arms[axis.arm].pose
            if first or se3.pose_distance(self._targets[axis.arm], now)[0] > max_deviation * self.spec.max_step:
                self._targets[axis.arm] = now
        action = action_of_vector(self._infer(seen), self._axes, self.spec.max_step, self._targets)
        self._targets = {arm: pose for arm, pose in action.tool.items() if pose is not None}
        return action

    def _infer(self, seen: Mapping[str, NDArray[Any]]) -> NDArray[np.float32]:
        lost = sorted(key for key, value in seen.items() if not np.isfinite(value).all())
        if lost:
            raise PolicyFailed(
                f"policy '{self._name}': not all of {', '.join(lost)} is a number; no action is made of that"
            )
        try:
            (action,) = self._session.run(["action"], {key: value[None] for key, value in seen.items()})
        except Exception as failure:  # onnxruntime has no common base of its own
            raise PolicyFailed(f"policy '{self._name}' fails on this observation: {_words(failure)}") from failure
        vector: NDArray[np.float32] = np.asarray(action, np.float32)
        if (
            vector.shape != (1, len(self._axes))
            or not np.isfinite(vector).all()
            or float(np.abs(vector).max()) > 1.0 + 1e-6
        ):
            raise PolicyFailed(
                f"policy '{self._name}' gives {vector.tolist()}; an action has {len(self._axes)} finite numbers within "
                "[-1, 1]: train or export it anew"
            )
        first: NDArray[np.float32] = vector[0]
        return first


def misfits(policy: OnnxPolicy, rig: RigSpec, task: Task | None) -> list[str]:
    """How the rig and the task differ from those that the policy was trained for, beyond its `needs`; each a phrase."""
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
    if tuple(Axis(axis.arm, axis.direction) for axis in spec.axes) != task.axes:
        found.append(f"actions along {_listed(spec.axes)}, this task has {_listed(task.axes)}")
    if spec.max_step > task.config.max_step * (1 + 1e-6):
        found.append(
            f"steps of up to {1e3 * spec.max_step:g} mm, this task allows {1e3 * task.config.max_step:g} mm (max_step)"
        )
    return found


def _listed(axes: Any) -> str:
    return ", ".join(f"{axis.arm} {tuple(axis.direction)}" for axis in axes)


def _session(path: Path) -> InferenceSession:
    try:
        import onnxruntime
    except ModuleNotFoundError:
        raise PolicyNotFound(
            f"policy '{path}': learned policies need onnxruntime, which is not installed: pip install 'tacsim[policy]'"
        ) from None
    try:
        size = path.stat().st_size
        if size > MAX_BYTES:
            raise PolicyNotFound(f"policy '{path}' has {size / 2**20:,.0f} MiB, at most {MAX_BYTES >> 20} are read")
        data = path.read_bytes()
    except OSError as failure:
        raise PolicyNotFound(f"policy '{path}' cannot be read: {failure.strerror or failure}") from None
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1  # small networks; the other cores simulate
    options.log_severity_level = 4  # errors are ours to tell
    # Weights that lie in other files are looked for below a folder that cannot be: the file itself.
    options.add_session_config_entry("session.model_external_initializers_file_folder_path", str(path.absolute()))
    try:
        return onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
    except Exception as failure:  # onnxruntime has no common base of its own
        raise PolicyNotFound(f"policy '{path}' is no ONNX file that can run here: {_words(failure)}") from None


def _spec(path: Path, session: InferenceSession) -> PolicySpec:
    text = session.get_modelmeta().custom_metadata_map.get(METADATA_KEY)
    if text is None:
        raise PolicyNotFound(
            f"policy '{path}' does not say what it sees: it has no metadata '{METADATA_KEY}', which "
            "tacsim export policy writes"
        )
    try:
        return PolicySpec.model_validate_json(text)
    except ValidationError as failure:
        first = failure.errors()[0]
        where = ".".join(map(str, first["loc"])) or "text"
        raise PolicyNotFound(
            f"policy '{path}': its metadata '{METADATA_KEY}' cannot be read: {printable(where)}: "
            f"{printable(first['msg'])}; was it exported by another version?"
        ) from None


def _require_same_inputs(
    path: Path, spec: PolicySpec, made: Mapping[str, Numbers], session: InferenceSession, goal: Goal
) -> None:
    """The file's inputs are those that this version's encoder makes, number by number; and it gives one action."""
    grid, graph = spec.features.grid, {each.name: each for each in session.get_inputs()}
    beyond = {"maps": (grid.rows, grid.columns), "flow": (None, None)}  # the markers are the rig's
    wanted: dict[str, Shape] = {key: (1, len(each.names), *beyond.get(key, ())) for key, each in made.items()}
    if spec.features.goal:
        wanted["goal"] = (1, None if goal is None else np.size(goal))
    if set(graph) != set(wanted):
        raise PolicyNotFound(
            f"policy '{path}': its graph takes {', '.join(sorted(graph))}, its metadata speak of "
            f"{', '.join(sorted(wanted))}"
        )
    for key, shape in wanted.items():
        if key in made and spec.inputs.get(key) != made[key]:
            raise PolicyNotFound(
                f"policy '{path}': what it was trained on as '{key}' is not what this version of tacsim makes of the "
                "same features: train it anew, or use the version that its metadata name"
            )
        if not _fits(graph[key], shape):
            if key == "goal":
                raise PolicyNotFound(
                    f"policy '{path}' was trained for task '{spec.task}', whose goal is {_array(graph[key])}; this "
                    f"task's is {_floats(shape)}"
                )
            raise PolicyNotFound(
                f"policy '{path}': its input '{key}' is {_array(graph[key])}; wanted: {_floats(shape)}"
            )
    outputs = {each.name: each for each in session.get_outputs()}
    action: Shape = (1, len(spec.axes))
    if "action" not in outputs or not _fits(outputs["action"], action):
        gives = ", ".join(f"'{name}', {_array(each)}" for name, each in outputs.items())
        raise PolicyNotFound(f"policy '{path}': it must give 'action', {_floats(action)}; it gives {gives}")


def _fits(found: Any, shape: Shape) -> bool:
    """An array of the graph has this shape, as far as both tell."""
    sides = zip(found.shape, shape, strict=True) if len(found.shape) == len(shape) else [(0, 1)]
    told = ((side, wanted) for side, wanted in sides if isinstance(side, int) and wanted is not None)
    return found.type == "tensor(float)" and all(side == wanted for side, wanted in told)


def _array(found: Any) -> str:
    return f"{found.type} {found.shape}"


def _floats(shape: Shape) -> str:
    return f"tensor(float) {' x '.join('n' if side is None else str(side) for side in shape)}"


def _words(failure: Exception) -> str:
    """The first line of what onnxruntime says, fit for a terminal."""
    return printable((str(failure).strip().splitlines() or [repr(failure)])[0][:300])
