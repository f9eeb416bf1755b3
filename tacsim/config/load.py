"""Loading: read, expand references, apply overrides, validate; all problems are raised together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar, cast

from pydantic import BaseModel, TypeAdapter, ValidationError

from tacsim.config.annotation import default, models
from tacsim.config.bundle import find_bundle
from tacsim.config.document import LoadState, Node, as_json, dump, from_plain
from tacsim.config.errors import ConfigError, Place, Problem
from tacsim.config.gel import gel_sizes_given, with_gels_of_sensors
from tacsim.config.kinds import NotFound, is_name, kind_of, resolve, shipped_file
from tacsim.config.messages import report_errors
from tacsim.config.references import Override, apply, parse_override, read_file
from tacsim.models.driver import DriversMissing
from tacsim.models.rig import RigConfig, TaskConfig, rig_model, task_annotation
from tacsim.models.scene import Mesh, Scene
from tacsim.models.sensor import SensorModel

Model = TypeVar("Model", bound=BaseModel)


@dataclass(frozen=True, slots=True)
class LoadedRig:
    """A rig file, resolved."""

    config: RigConfig
    sources: tuple[Path, ...]  # the files it was read from
    notes: tuple[str, ...] = ()  # what a person should know of it, in words

    @property
    def text(self) -> str:
        """As one YAML text, every default and reference written out; load_rig reads `config` back from it."""
        head = "# A rig, resolved: every reference and default written out, SI units."
        return f"{head}\n{dump(self.config.model_dump(mode='json'))}"


def load_rig(rig: str | Path, *, task: str | TaskConfig | None = None, overrides: Sequence[str] = ()) -> LoadedRig:
    """Reads a rig by its name ("sim") or path.

    `task` (a name or path, or the task itself) replaces the file's task. `overrides` are texts ``key.sub=value``; those
    of ``task`` are applied first. If any part of the rig is simulated, ``scene`` is the rig's own, else the task's, so
    that ``scene.preset=standard`` works in both cases. In a rig without a simulated part it is None.

    Raises ConfigError with every problem found; overrides must not weaken the limits of a real arm.
    """
    state = LoadState()
    root = _open(RigConfig, rig, state)
    if task is not None:
        root = apply(root, RigConfig, Override(("task",), _task(task)), state)
    given = [parsed for text in texts(overrides) if (parsed := parse_override(text, state)) is not None]
    of_task = [override for override in given if override.path[0] == "task"]
    of_rest = [override for override in given if override.path[0] != "task"]
    for override in of_task:
        root = apply(root, RigConfig, override, state)
        if override.path[:2] == ("task", "scene") and _has(root, "scene"):
            what = f"this rig has a scene of its own, which is used; say {'.'.join(override.path[1:])}"
            state.report(override.value.place, ".".join(override.path), what)
    own_scene = _has(root, "scene") or any(override.path[0] == "scene" for override in of_rest)
    root = _scene_of_task(root)
    for override in of_rest:
        root = apply(root, RigConfig, override, state)
    root = _absolute_calibrations(_check_scene(root, own_scene, state))
    config, notes = with_gels_of_sensors(
        _validate(RigConfig, root, state), load_sensor, given=gel_sizes_given(each.path for each in given)
    )
    config = _with_one_scene(config)
    if overrides and any(arm.is_real for arm in config.arms.values()):
        _require_limits(config, load_rig(rig, task=task).config)
    if config.scene is not None:
        notes = [*notes, *say_side(config.scene)]
    return LoadedRig(config, tuple(dict.fromkeys(state.sources)), tuple(notes))


def _task(task: str | TaskConfig) -> Node:
    if isinstance(task, str):
        return Node(task, Place(f"--task {task}"), Path.cwd(), text=task)
    if not isinstance(task, BaseModel):
        raise TypeError(f"a task is a name, the path of a file, or a configuration; {task!r} was given")
    return from_plain(task.model_dump(mode="json"), Place(f"--task {task.kind}"), Path.cwd())


def _with_one_scene(config: RigConfig) -> RigConfig:
    """The task speaks of the body that is simulated: where a rig has a scene, its task has the same."""
    if config.scene is None or config.task is None or config.task.scene == config.scene:
        return config
    return config.model_copy(update={"task": config.task.model_copy(update={"scene": config.scene})})


def _require_limits(config: RigConfig, file: RigConfig) -> None:
    """Overrides may narrow, not weaken, the limits of real arms: a file is reviewed, a command line is typed."""
    problems: list[str] = []
    for name, arm in config.arms.items():
        there = file.arms.get(name)
        if there is not None and arm.is_real:
            problems += [f"arms.{name}.{what}" for what in arm.weakened_limits(there)]
    kept = {frozenset(apart.arms): apart.distance for apart in config.keep_out}
    problems += [
        f"keep_out of {' and '.join(apart.arms)}: less than {apart.distance:g} m"
        for apart in file.keep_out
        if kept.get(frozenset(apart.arms), 0.0) < apart.distance
    ]
    if problems:
        words = "would weaken the limits of a real arm; write it into the rig file"
        raise ConfigError([Problem(Place("--set"), "", f"{what}: {words}") for what in problems])


def _absolute_calibrations(root: Node) -> Node:
    """Makes the paths of calibrations absolute: like references, they start from the folder of their file, those of
    options from the current folder. One in `sensors/` there goes by its name."""
    sensors = root.items.get("sensors")
    if sensors is None or not sensors.items:
        return root
    anchored = {}
    for name, sensor in sensors.items.items():
        path = sensor.items.get("calibration")
        if path is not None and isinstance(path.value, str) and path.value:
            there = replace(path, value=str(find_bundle(path.value, path.folder).resolve()))
            sensor = replace(sensor, value={**sensor.items, "calibration": there})
        anchored[name] = sensor
    return replace(root, value={**root.items, "sensors": replace(sensors, value=anchored)})


def _has(root: Node, key: str) -> bool:
    return key in root.items and root.items[key].value is not None


def _simulated(root: Node) -> bool:
    """True with a driver 'sim', or with a mock sensor, whose pictures are simulated."""
    parts = [*_entries(root, "arms"), *_entries(root, "sensors")]
    return any(part.items["driver"].value == "sim" for part in parts if "driver" in part.items) or any(
        _has(sensor, "mock") for sensor in _entries(root, "sensors")
    )


def _entries(root: Node, key: str) -> list[Node]:
    return list(root.items[key].items.values()) if key in root.items else []


def _scene_of_task(root: Node) -> Node:
    """The task's scene becomes the rig's, where the rig has none."""
    task = root.items.get("task")
    if _has(root, "scene") or task is None or not task.items:
        return root
    scene = task.items.get("scene") or from_plain(default(task_annotation(), task, "scene"), task.place, task.folder)
    return root if scene.is_empty else replace(root, value={**root.items, "scene": scene})


def _check_scene(root: Node, own_scene: bool, state: LoadState) -> Node:
    if root.broken or not isinstance(root.value, dict):
        return root
    if _simulated(root):
        root = _scene_of_task(root)  # an override may have taken it away
        if not _has(root, "scene") and not root.items.get("task", root).broken:
            what = (
                "is missing: something here is simulated (driver 'sim', or a camera's `mock`); allowed: a scene, or a "
                "task (which has one)"
            )
            state.report(root.place, "scene", what)
        return root
    if own_scene and _has(root, "scene"):
        what = "no arm and no sensor of this rig has driver 'sim', so nothing is simulated; leave scene out"
        state.report(root.items["scene"].place, "scene", what)
    return replace(root, value={name: entry for name, entry in root.items.items() if name != "scene"})


def say_side(scene: Scene) -> list[str]:
    """In words, which side of a scene's mesh presses, for a file does not show it. Empty without a readable mesh."""
    from tacsim.geometry.pressing_side import describe_side

    if scene.indenter is None or not isinstance(scene.indenter.geometry, Mesh):
        return []
    try:
        return [f"pressing side: {describe_side(scene.indenter)}; indenter.roll and indenter.pitch choose another"]
    except (OSError, ValueError):  # who makes the world says it
        return []


def load(model: type[Model], source: str | Path, overrides: Sequence[str] = ()) -> Model:
    """Reads one configuration file into its model; `source` is a name of that kind, or a path. Raises ConfigError."""
    config: Model = _load(model, source, overrides)
    return config


def load_scene(source: str | Path, overrides: Sequence[str] = ()) -> Scene:
    """Reads a scene. Raises ConfigError."""
    return load(Scene, source, overrides)


def load_sensor(source: str | Path, overrides: Sequence[str] = ()) -> SensorModel:
    """Reads a sensor. Raises ConfigError."""
    return load(SensorModel, source, overrides)


def load_task(source: str | Path, overrides: Sequence[str] = ()) -> TaskConfig:
    """Reads a task of any kind. Raises ConfigError."""
    config: TaskConfig = _load(task_annotation(), source, overrides)
    return config


def _load(annotation: Any, source: str | Path, overrides: Sequence[str]) -> Any:
    state = LoadState()
    root = _open(annotation, source, state)
    for text in texts(overrides):
        override = parse_override(text, state)
        if override is not None:
            root = apply(root, annotation, override, state)
    return _validate(annotation, root, state)


def texts(overrides: object) -> Sequence[str]:
    """The same. Raises TypeError for what is no list of texts; of a single text, letters would be taken one by one."""
    if isinstance(overrides, str):
        raise TypeError(f"overrides are lists of texts, [{overrides!r}]; a single text was given")
    if not (isinstance(overrides, Sequence) and all(isinstance(text, str) for text in overrides)):
        raise TypeError(f"overrides are lists of texts, such as ['scene.preset=learn']; {overrides!r} was given")
    return cast(Sequence[str], overrides)


def _open(annotation: Any, source: str | Path, state: LoadState) -> Node:
    """The expanded tree of a file that was named by any path, or by the name of a shipped file or of a sensor of one's
    own. Raises TypeError for what is neither."""
    if not isinstance(source, str | Path):
        raise TypeError(f"a configuration is given by its name, or by the path of its file; {source!r} was given")
    place = Place(str(source) or "(no name)")
    if annotation is RigConfig:
        try:
            rig_model()
        except DriversMissing as missing:
            raise ConfigError([Problem(place, "", str(missing))]) from None
    kind = kind_of(models(annotation))
    try:
        path = Path(source)
        if kind is not None and kind.name == "sensor" and path.suffix not in (".yaml", ".yml"):
            path = resolve(kind, str(source), Path.cwd())
        elif kind is not None and isinstance(source, str) and is_name(source):
            path = shipped_file(kind, source)
    except NotFound as error:
        raise ConfigError([Problem(place, "", str(error))]) from None
    return read_file(path, annotation, state, lambda what: state.report(place, "", what))


def _validate(annotation: Any, root: Node, state: LoadState) -> Any:
    """The model of a tree. Raises ConfigError with every problem, including those of reading the files."""
    config = None
    if not root.broken:
        try:
            config = TypeAdapter(annotation).validate_json(as_json(root), strict=True)
        except ValidationError as error:
            report_errors(error, root, annotation, state)
    if state.problems:
        raise ConfigError(state.problems)
    return config
