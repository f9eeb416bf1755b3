"""The kinds of configuration files: their folders, the files of names, and their JSON schema for editors; and what is
shipped and installed, by kind and name (configuration files, learned policies, drivers)."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from pydantic import BaseModel, TypeAdapter
from pydantic.json_schema import GenerateJsonSchema, JsonSchemaValue
from pydantic_core import core_schema

from tacsim.config.bundle import FILE, SENSORS_FOLDER, is_bundle, user_sensor_names
from tacsim.models.benchmark import BenchmarkTask
from tacsim.models.driver import BASE_CLASSES, installed_drivers
from tacsim.models.material import BodyMaterial, GelMaterial
from tacsim.models.policy import Training
from tacsim.models.randomisation import Randomisation
from tacsim.models.rig import RigConfig, rig_model
from tacsim.models.scene import Scene
from tacsim.models.sensor import SensorModel
from tacsim.models.task import TASKS, task_annotation
from tacsim.models.text import suggest_word

_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_-]{0,99}")


@dataclass(frozen=True, slots=True)
class Kind:
    """One kind of file: ``configs/<folder>/<name>.yaml`` holds one of `models`."""

    name: str
    folder: str
    models: Sequence[type[BaseModel]]  # of a task: those that are registered at present
    annotate: Callable[[], Any]  # type of a file's content


KINDS = {
    kind.name: kind
    for kind in (
        Kind("rig", "rigs", (RigConfig,), rig_model),
        Kind("task", "tasks", TASKS, task_annotation),
        Kind("scene", "scenes", (Scene,), lambda: Scene),
        Kind("sensor", "sensors", (SensorModel,), lambda: SensorModel),
        Kind("randomisation", "randomisations", (Randomisation,), lambda: Randomisation),
        Kind("training", "trainings", (Training,), lambda: Training),
        Kind("benchmark", "benchmark/v1", (BenchmarkTask,), lambda: BenchmarkTask),
        Kind("material", "materials", (GelMaterial, BodyMaterial), lambda: GelMaterial | BodyMaterial),
    )
}


class NotFound(ValueError):
    """A reference without a file; the text gives the reason and lists the files that exist."""


@cache
def config_root() -> Path:
    """The folder of the shipped configuration: inside an installed package, or ``configs/`` of a checkout.

    Raises FileNotFoundError when there is neither (a broken installation).
    """
    package = Path(__file__).resolve().parents[1]
    for folder in (package / "_configs", package.parent / "configs"):
        if (folder / "rigs").is_dir():
            return folder
    raise FileNotFoundError(f"no configuration at {package / '_configs'}; install tacsim again")


def shipped_names(kind: str) -> list[str]:
    """Sorted names of the shipped files of a kind (a key of KINDS). Raises KeyError on another."""
    return sorted(path.stem for path in (config_root() / KINDS[kind].folder).glob("*.yaml"))


def kind_of(models: Sequence[type[BaseModel]]) -> Kind | None:
    """The kind of file whose name may be given instead of one of `models`."""
    for kind in KINDS.values():
        if models and set(models) <= set(kind.models):
            return kind
    return None


def is_name(text: str) -> bool:
    return _NAME.fullmatch(text) is not None


def shipped_file(kind: Kind, name: str, folder: Path | None = None) -> Path:
    """The shipped file of that name. Raises NotFound, which hints at a file of that name in `folder`."""
    path = config_root() / kind.folder / f"{name}.yaml"
    if path.is_file():
        return path
    known = shipped_names(kind.name)
    hint = suggest_word(name, known)
    if folder is not None and (folder / f"{name}.yaml").is_file():
        hint = f"; did you mean the file '{name}.yaml'?"
    raise NotFound(f"no {kind.name} '{name}'; allowed: {', '.join(known) or '(none)'}{hint}")


def resolve_reference(kind: Kind, reference: str, folder: Path) -> Path:
    """The file that `reference`, written in a file of `folder`, refers to. Raises NotFound.

    A name refers to a shipped file of that kind. A path ends in .yaml and must be, symbolic links followed, below
    `folder` or below the shipped configuration. A sensor may also be a calibrated bundle, by its path or, with those
    in `sensors/` of `folder`, by name; then the file is the calibration in it.
    """
    if kind.name == "sensor" and "\0" not in reference and not reference.endswith((".yml", ".yaml")):
        return _sensor_file(kind, reference, folder)
    if kind.name == "sensor" and is_bundle(folder / reference):
        return folder / reference
    if is_name(reference):
        return shipped_file(kind, reference, folder)
    if not reference.endswith((".yaml", ".yml")) or "\0" in reference:
        known = ", ".join(shipped_names(kind.name))
        raise NotFound(f"{reference!r} is no {kind.name}; allowed: a name ({known}), or a path ending in .yaml")
    try:
        path = (folder / reference).resolve()
    except (OSError, RuntimeError) as error:  # a loop of symbolic links
        raise NotFound(f"cannot follow {reference!r}: {error}") from None
    if not any(path.is_relative_to(home.resolve()) for home in (folder, config_root())):
        raise NotFound(f"{reference!r} leads outside; allowed: files below the referring file's own folder or configs/")
    return path


def _sensor_file(kind: Kind, reference: str, folder: Path) -> Path:
    """The only sensor with this name or bundle path. Raises NotFound for none, and for two."""
    places = [folder / reference / FILE]
    if is_name(reference):
        places.append(config_root() / kind.folder / f"{reference}.yaml")
    if Path(reference).name == reference:
        places += [folder / SENSORS_FOLDER / reference / FILE, folder / SENSORS_FOLDER / f"{reference}.yaml"]
    try:
        found = list({path.resolve(): path for path in places if path.is_file()}.values())
    except (OSError, RuntimeError) as error:  # a loop of symbolic links
        raise NotFound(f"cannot follow {reference!r}: {error}") from None
    if len(found) == 1:
        return found[0]
    if found:
        raise NotFound(f"'{reference}' may be {' or '.join(map(str, found))}; write the path of one of them")
    if (folder / reference).is_dir():
        raise NotFound(f"'{reference}' is a folder without {FILE}, so it is no calibrated sensor")
    known = [*shipped_names(kind.name), *user_sensor_names(folder)]
    raise NotFound(
        f"no sensor '{reference}'; allowed: {', '.join(known)}, a path ending in .yaml, or that of a calibrated sensor "
        f"(a folder with {FILE}){suggest_word(reference, [*known, *_bundle_paths(folder, reference)])}"
    )


def _bundle_paths(folder: Path, reference: str) -> list[str]:
    """Paths of the bundles in the folder of a missing one, as references."""
    parent = Path(reference).parent
    try:
        return [str(parent / path.name) for path in (folder / parent).iterdir() if is_bundle(path)]
    except OSError:
        return []


def json_schema(kind: str = "rig") -> dict[str, Any]:
    """The JSON schema of a kind of file (a key of KINDS), string references and units included.

    For completion and checks while you type, write it to a file and name that in the first line of the YAML file; any
    editor with yaml-language-server (VS Code's YAML extension, Neovim, Emacs, JetBrains) understands::

        tacsim schema rig > rig.schema.json
        # yaml-language-server: $schema=rig.schema.json

    Raises KeyError on another kind.
    """
    schema = TypeAdapter(KINDS[kind].annotate()).json_schema(schema_generator=_Generator, mode="validation")
    schema["$schema"] = _Generator.schema_dialect
    schema["title"] = f"tacsim {kind}"
    return schema


class _Generator(GenerateJsonSchema):
    """Adds the other forms that the loader accepts: the name of a file, and ``extends``."""

    def model_schema(self, schema: core_schema.ModelSchema) -> JsonSchemaValue:
        mapping = super().model_schema(schema)
        kind = kind_of([schema["cls"]])
        if kind is None:
            return mapping
        reference: dict[str, Any] = {
            "description": f"name of a {kind.name}, or path of a .yaml file below this folder",
            "anyOf": [{"enum": shipped_names(kind.name)}, {"type": "string", "pattern": r"\.ya?ml$"}],
        }
        if kind.name == "sensor":
            reference["description"] += (
                f", or of a calibrated sensor (a folder with {FILE}; by name from {SENSORS_FOLDER}/)"
            )
            reference["anyOf"] = [{"enum": shipped_names(kind.name)}, {"type": "string", "minLength": 1}]
        mapping["properties"]["extends"] = {
            **reference,
            "description": f"{reference['description']}, to change a few keys of",
        }
        required = mapping.pop("required", [])
        if required:
            mapping["anyOf"] = [{"required": required}, {"required": ["extends"]}]
        return {"anyOf": [reference, mapping]}

    def tagged_union_schema(self, schema: core_schema.TaggedUnionSchema) -> JsonSchemaValue:
        union = super().tagged_union_schema(schema)
        union.pop("discriminator", None)  # a keyword of OpenAPI, not of JSON schema
        union["anyOf"] = union.pop("oneOf")  # a reference by name fits every variant
        return union


POLICY, DRIVER = "policy", "driver"
CATALOGUE_KINDS = (*KINDS, POLICY, DRIVER)


@dataclass(frozen=True, slots=True)
class CatalogueEntry:
    """Something with a name that a command or a file may use."""

    kind: str  # of CATALOGUE_KINDS
    name: str  # as it is written in files and commands; of drivers "sensor.NAME" or "arm.NAME"
    summary: str  # one sentence
    path: Path | None  # its file; of a driver the module; None if it is not known


def list_entries(kind: str) -> list[CatalogueEntry]:
    """What there is of a kind of CATALOGUE_KINDS, sorted by name. Raises KeyError for another kind."""
    if kind == DRIVER:
        return list(_installed_drivers())
    if kind == POLICY:
        paths = sorted((config_root() / "policies").glob("*.onnx"))
        return [CatalogueEntry(kind, path.stem, f"Learned policy of the task {path.stem}.", path) for path in paths]
    paths = sorted((config_root() / KINDS[kind].folder).glob("*.yaml"))
    return [CatalogueEntry(kind, path.stem, _first_sentence(path.read_text("utf-8")), path) for path in paths]


def find_entries(name: str, kind: str | None = None) -> list[CatalogueEntry]:
    """Every entry of that name, of one kind or (None) of all. Raises NotFound, with the nearest name."""
    kinds = CATALOGUE_KINDS if kind is None else (kind,)
    known = [entry for each in kinds for entry in list_entries(each)]
    found = [entry for entry in known if entry.name == name]
    if not found:
        names = [entry.name for entry in known]
        what = "nothing is" if kind is None else f"no {kind} is"
        where = "tacsim list" if kind is None else f"tacsim list {kind}"
        raise NotFound(f"{what} called '{name}'{suggest_word(name, names)}; `{where}` prints all names")
    return found


def _installed_drivers() -> Iterable[CatalogueEntry]:
    drivers = installed_drivers()
    for kind in sorted(BASE_CLASSES):
        for name, driver in sorted(drivers.usable[kind].items()):
            summary = inspect.cleandoc(driver.__doc__ or "").partition("\n\n")[0].replace("\n", " ")
            yield CatalogueEntry(DRIVER, f"{kind}.{name}", summary, Path(inspect.getfile(driver)))
        for name, why in sorted(drivers.refused[kind].items()):
            yield CatalogueEntry(DRIVER, f"{kind}.{name}", f"Refused: {why}", None)


def _first_sentence(text: str) -> str:
    """The first sentence of the comment that a file begins with; empty without one."""
    lines = []
    for line in text.splitlines():
        if not line.startswith("#"):
            break
        lines.append(line.lstrip("# ").rstrip())
    return re.split(r"(?<=[.!?]) ", " ".join(lines), maxsplit=1)[0]
