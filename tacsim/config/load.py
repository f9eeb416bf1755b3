"""Loading: read, expand references, apply overrides, validate; all problems are raised together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar, cast

from pydantic import BaseModel, TypeAdapter, ValidationError

from tacsim.config.annotation import field_default, report_errors, union_models
from tacsim.config.bundle import find_bundle
from tacsim.config.document import ConfigError, LoadState, Node, Place, Problem, dump_yaml, node_as_json, node_of_data
from tacsim.config.gel import fit_gels_to_sensors, overridden_gel_sizes
from tacsim.config.kinds import NotFound, is_name, kind_of, resolve_reference, shipped_file
from tacsim.config.references import Override, apply_override, parse_override, read_file
from tacsim.models.driver import DriversMissing
from tacsim.models.rig import RigConfig, rig_model
from tacsim.models.scene import Mesh, Scene
from tacsim.models.sensor import SensorModel
from tacsim.models.task import TaskConfig, task_annotation

Model = TypeVar("Model", bound=BaseModel)
SIMULATED = ("sim", "mujoco")  # drivers of parts that a scene is simulated for


@dataclass(frozen=True, slots=True)
class LoadedRig:
    """A rig file, resolved."""

    config: RigConfig
    sources: tuple[Path, ...]  # the files it was read from
    notes: tuple[str, ...] = ()  # notes for the user

    @property
    def text(self) -> str:
        """One YAML text with all defaults and references written out; `load_rig` reads the same `config` from it."""
        head = "# A rig, resolved: every reference and default written out, SI units."
        return f"{head}\n{dump_yaml(self.config.model_dump(mode='json'))}"


def load_rig(rig: str | Path, *, task: str | TaskConfig | None = None, overrides: Sequence[str] = ()) -> LoadedRig:
    """Reads a rig by its name ("sim") or path.

    `task` (a name or path, or the task itself) replaces the file's task. `overrides` are texts ``key.sub=value``; those
    of ``task`` are applied first. If any part of the rig is simulated, ``scene`` is the rig's own, else the task's, so
    that ``scene.preset=standard`` works in both cases. In a rig without a simulated part it is None.

    Raises ConfigError with every problem found; overrides must not weaken the limits of a real arm.
    """
    state = LoadState()
    root = _open_tree(RigConfig, rig, state)
    if task is not None:
        root = apply_override(root, RigConfig, Override(("task",), _load_task_override(task)), state)
    given = [parsed for text in require_texts(overrides) if (parsed := parse_override(text, state)) is not None]
    of_task = [override for override in given if override.path[0] == "task"]
    of_rest = [override for override in given if override.path[0] != "task"]
    for override in of_task:
        root = apply_override(root, RigConfig, override, state)
        if override.path[:2] == ("task", "scene") and _has_value(root, "scene"):
            what = f"this rig has its own scene, which is used; write {'.'.join(override.path[1:])}"
            state.report(override.value.place, ".".join(override.path), what)
    own_scene = _has_value(root, "scene") or any(override.path[0] == "scene" for override in of_rest)
    root = _take_scene_of_task(root)
    for override in of_rest:
        root = apply_override(root, RigConfig, override, state)
    root = _absolute_calibrations(_check_scene(root, own_scene, state))
    config, notes = fit_gels_to_sensors(
        _validate_tree(RigConfig, root, state), load_sensor, given=overridden_gel_sizes(each.path for each in given)
    )
    config = _share_scene(config)
    if overrides and any(arm.is_real for arm in config.arms.values()):
        _require_limits(config, load_rig(rig, task=task).config)
    if config.scene is not None:
        notes = [*notes, *describe_scene_meshes(config.scene)]
    return LoadedRig(config, tuple(dict.fromkeys(state.sources)), tuple(notes))


def _load_task_override(task: str | TaskConfig) -> Node:
    if isinstance(task, str):
        return Node(task, Place(f"--task {task}"), Path.cwd(), text=task)
    if not isinstance(task, BaseModel):
        raise TypeError(f"a task is a name, the path of a file, or a configuration; {task!r} was given")
    return node_of_data(task.model_dump(mode="json"), Place(f"--task {task.kind}"), Path.cwd())


def _share_scene(config: RigConfig) -> RigConfig:
    """The rig with its scene in the task: a task refers to the body that is simulated."""
    if config.scene is None or config.task is None or config.task.scene == config.scene:
        return config
    return config.model_copy(update={"task": config.task.model_copy(update={"scene": config.scene})})


def _require_limits(config: RigConfig, file: RigConfig) -> None:
    """Raises ConfigError for overrides that weaken the limits of real arms: these belong in a file, which is
    reviewed."""
    problems: list[str] = []
    for name, arm in config.arms.items():
        reviewed = file.arms.get(name)
        if reviewed is not None and arm.is_real:
            problems += [f"arms.{name}.{what}" for what in arm.weakened_limits(reviewed)]
    distances = {frozenset(region.arms): region.distance for region in config.keep_out}
    problems += [
        f"keep_out of {' and '.join(region.arms)}: less than {region.distance:g} m"
        for region in file.keep_out
        if distances.get(frozenset(region.arms), 0.0) < region.distance
    ]
    if problems:
        words = "would weaken the limits of a real arm; write it into the rig file"
        raise ConfigError([Problem(Place("--set"), "", f"{what}: {words}") for what in problems])


def _absolute_calibrations(root: Node) -> Node:
    """Makes the paths of calibrations absolute. Like references, they are relative to the folder of their file, those
    of options to the current folder; a bundle in the folder `sensors/` there may be given by its name."""
    root = _absolute_models(root)
    sensors = root.items.get("sensors")
    if sensors is None or not sensors.items:
        return root
    anchored = {}
    for name, sensor in sensors.items.items():
        path = sensor.items.get("calibration")
        if path is not None and isinstance(path.value, str) and path.value:
            absolute = replace(path, value=str(find_bundle(path.value, path.folder).resolve()))
            sensor = replace(sensor, value={**sensor.items, "calibration": absolute})
        anchored[name] = sensor
    return replace(root, value={**root.items, "sensors": replace(sensors, value=anchored)})


def _absolute_models(root: Node) -> Node:
    """Makes the paths of MJCF files of arms absolute, in the same way."""
    arms = root.items.get("arms")
    if arms is None or not arms.items:
        return root
    anchored = {}
    for name, arm in arms.items.items():
        path = arm.items.get("model")
        if path is not None and isinstance(path.value, str) and path.value.endswith(".xml"):
            absolute = replace(path, value=str((path.folder / path.value).resolve()))
            arm = replace(arm, value={**arm.items, "model": absolute})
        anchored[name] = arm
    return replace(root, value={**root.items, "arms": replace(arms, value=anchored)})


def _has_value(root: Node, key: str) -> bool:
    return key in root.items and root.items[key].value is not None


def _has_simulated_part(root: Node) -> bool:
    """True with a driver 'sim' or 'mujoco', or with a mock sensor, which has simulated pictures."""
    parts = [*_mapping_values(root, "arms"), *_mapping_values(root, "sensors")]
    return any(part.items["driver"].value in SIMULATED for part in parts if "driver" in part.items) or any(
        _has_value(sensor, "mock") for sensor in _mapping_values(root, "sensors")
    )


def _mapping_values(root: Node, key: str) -> list[Node]:
    return list(root.items[key].items.values()) if key in root.items else []


def _take_scene_of_task(root: Node) -> Node:
    """The rig with the task's scene, if the rig has none."""
    task = root.items.get("task")
    if _has_value(root, "scene") or task is None or not task.items:
        return root
    scene = task.items.get("scene") or node_of_data(
        field_default(task_annotation(), task, "scene"), task.place, task.folder
    )
    return root if scene.is_empty else replace(root, value={**root.items, "scene": scene})


def _check_scene(root: Node, own_scene: bool, state: LoadState) -> Node:
    if root.broken or not isinstance(root.value, dict):
        return root
    if _has_simulated_part(root):
        root = _take_scene_of_task(root)  # an override may have removed it
        if not _has_value(root, "scene") and not root.items.get("task", root).broken:
            what = (
                "is missing: something here is simulated (driver 'sim' or 'mujoco', or a camera's `mock`); allowed: a "
                "scene, or a task (which has one)"
            )
            state.report(root.place, "scene", what)
        return root
    if own_scene and _has_value(root, "scene"):
        what = "no arm and no sensor of this rig has driver 'sim' or 'mujoco', so nothing is simulated; leave scene out"
        state.report(root.items["scene"].place, "scene", what)
    return replace(root, value={name: entry for name, entry in root.items.items() if name != "scene"})


def describe_scene_meshes(scene: Scene) -> list[str]:
    """What the files of a scene's meshes do not show: their units, what was repaired, and which side presses.

    Sentences; empty without a readable mesh.
    """
    from tacsim.geometry.pressing_side import describe_side
    from tacsim.geometry.shapes import describe_meshes

    try:
        words = describe_meshes(scene)
        if scene.indenter is not None and isinstance(scene.indenter.geometry, Mesh):
            side = describe_side(scene.indenter)
            words.append(f"pressing side: {side}; indenter.roll and indenter.pitch choose another")
    except (OSError, ValueError):  # making the world raises it
        return []
    return words


def load_model(model: type[Model], source: str | Path, overrides: Sequence[str] = ()) -> Model:
    """Reads one configuration file into its model; `source` is a name of that kind, or a path. Raises ConfigError."""
    config: Model = _load_annotation(model, source, overrides)
    return config


def load_scene(source: str | Path, overrides: Sequence[str] = ()) -> Scene:
    """Reads a scene. Raises ConfigError."""
    return load_model(Scene, source, overrides)


def load_sensor(source: str | Path, overrides: Sequence[str] = ()) -> SensorModel:
    """Reads a sensor. Raises ConfigError."""
    return load_model(SensorModel, source, overrides)


def load_task(source: str | Path, overrides: Sequence[str] = ()) -> TaskConfig:
    """Reads a task of any kind. Raises ConfigError."""
    config: TaskConfig = _load_annotation(task_annotation(), source, overrides)
    return config


def _load_annotation(annotation: Any, source: str | Path, overrides: Sequence[str]) -> Any:
    state = LoadState()
    root = _open_tree(annotation, source, state)
    for text in require_texts(overrides):
        override = parse_override(text, state)
        if override is not None:
            root = apply_override(root, annotation, override, state)
    return _validate_tree(annotation, root, state)


def require_texts(overrides: object) -> Sequence[str]:
    """Returns `overrides`. Raises TypeError unless it is a list of texts; a single text would be split into letters."""
    if isinstance(overrides, str):
        raise TypeError(f"overrides are lists of texts, [{overrides!r}]; a single text was given")
    if not (isinstance(overrides, Sequence) and all(isinstance(text, str) for text in overrides)):
        raise TypeError(f"overrides are lists of texts, such as ['scene.preset=learn']; {overrides!r} was given")
    return cast(Sequence[str], overrides)


def _open_tree(annotation: Any, source: str | Path, state: LoadState) -> Node:
    """The expanded tree of a file that is given by a path, or by the name of a shipped file or of a user's sensor.
    Raises TypeError for another type."""
    if not isinstance(source, str | Path):
        raise TypeError(f"a configuration is given by its name or by the path of its file; {source!r} was given")
    place = Place(str(source) or "(no name)")
    if annotation is RigConfig:
        try:
            rig_model()
        except DriversMissing as missing:
            raise ConfigError([Problem(place, "", str(missing))]) from None
    kind = kind_of(union_models(annotation))
    try:
        path = Path(source)
        if kind is not None and kind.name == "sensor" and path.suffix not in (".yaml", ".yml"):
            path = resolve_reference(kind, str(source), Path.cwd())
        elif kind is not None and isinstance(source, str) and is_name(source):
            path = shipped_file(kind, source, Path.cwd())
    except NotFound as error:
        raise ConfigError([Problem(place, "", str(error))]) from None
    return read_file(path, annotation, state, lambda what: state.report(place, "", what))


def _validate_tree(annotation: Any, root: Node, state: LoadState) -> Any:
    """The model of a tree. Raises ConfigError with every problem, including those of reading the files."""
    config = None
    if not root.broken:
        try:
            config = TypeAdapter(annotation).validate_json(node_as_json(root), strict=True)
        except ValidationError as error:
            report_errors(error, root, annotation, state)
    if state.problems:
        raise ConfigError(state.problems)
    return config
