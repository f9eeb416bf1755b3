"""The pages of the YAML files, from the models that read them; the comments of their fields are the descriptions."""

from __future__ import annotations

import inspect
import types
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from tacsim.config.kinds import KINDS, config_root
from tacsim.models.quantity import UNITS, Quantity
from tools.site.comments import comments_of_fields

# A model stands on the page of the first kind that uses it.
TITLES = {
    "material": "Material files", "scene": "Scene files", "sensor": "Sensor files", "task": "Task files",
    "rig": "Rig files", "randomisation": "Randomisation files", "training": "Training files",
    "benchmark": "Benchmark task files",
}  # fmt: skip
INTRODUCTION = """Generated from the models that read these files, and from the comments in their code.
`tacsim schema {kind}` prints the same as a JSON schema, which completes and checks the file in an editor. Every value
can be set on the command line (`--set KEY=VALUE`). A number without a unit is in SI units; a text names its unit
(`"2 mm"`)."""
BOUNDS = {"gt": ">", "ge": "≥", "lt": "<", "le": "≤"}


def comment_of(model: type[BaseModel], name: str) -> str:
    """The comment of a field in the class that defines it."""
    for each in model.__mro__:
        if name in vars(each).get("__annotations__", {}):
            try:
                return comments_of_fields(inspect.getsource(each)).get(name, "")
            except OSError:  # a model that is made when the drivers are known has no source
                return ""
    return ""


def describe_type(annotation: Any, metadata: Sequence[Any] = ()) -> str:
    """A type in words, with its bounds: "length [m] > 0 or `null`"."""
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return describe_type(arguments[0], [*arguments[1:], *metadata])
    for each in metadata:
        if isinstance(each, Quantity):
            return f"{each.kind} [{next(iter(UNITS[each.kind]))}]{_bounds(metadata)}"
    if origin is Literal:
        return " or ".join(f"`{value}`" for value in arguments)
    if origin in (Union, types.UnionType):
        return " or ".join(
            dict.fromkeys(describe_type(each, () if each is type(None) else metadata) for each in arguments)
        )
    if origin is tuple:
        return _describe_sequence(arguments)
    if origin is not None and issubclass(origin, Mapping):
        return f"mapping of names to {describe_type(arguments[1])}"
    if inspect.isclass(annotation) and issubclass(annotation, BaseModel):
        return f"[{annotation.__name__}]({page_of(annotation)}#{annotation.__name__.lower()})"
    names = {float: "number", int: "whole number", bool: "`true` or `false`", str: "text", type(None): "`null`"}
    return f"{names.get(annotation, getattr(annotation, '__name__', 'value'))}{_bounds(metadata)}"


def _describe_sequence(arguments: Sequence[Any]) -> str:
    if len(arguments) == 2 and arguments[1] is Ellipsis:
        return f"list of {describe_type(arguments[0])}"
    kinds = list(dict.fromkeys(map(describe_type, arguments)))
    return f"{len(arguments)} × {kinds[0]}" if len(kinds) == 1 else f"list of {', '.join(kinds)}"


def _bounds(metadata: Sequence[Any]) -> str:
    """The bounds in the metadata of a field, or in the Field(...) of an Annotated type."""
    whole = [part for each in metadata for part in (each.metadata if isinstance(each, FieldInfo) else [each])]
    shown = [f"{sign} {getattr(each, key):g}" for each in whole for key, sign in BOUNDS.items() if hasattr(each, key)]
    return f" {', '.join(shown)}" if shown else ""


def show_default(field: FieldInfo) -> str:
    """The default value as it is written in a file."""
    value = field.default
    if value is PydanticUndefined:
        return "**required**" if field.default_factory is None else ""
    if isinstance(value, BaseModel):
        return "its defaults"
    if value is None or isinstance(value, bool):
        return {None: "`null`", True: "`true`", False: "`false`"}[value]
    if isinstance(value, tuple) and any(isinstance(each, BaseModel) for each in value):
        return f"{len(value)} entries"
    text = f"{value:g}" if isinstance(value, float) else str(list(value) if isinstance(value, tuple) else value)
    return f"`{text}`" if text else ""


def models_in_fields(model: type[BaseModel]) -> Iterator[type[BaseModel]]:
    """The models that the fields of `model` name, in order."""
    waiting = [field.annotation for field in model.model_fields.values()]
    while waiting:
        each: Any = waiting.pop(0)
        if inspect.isclass(each) and get_origin(each) is None and issubclass(each, BaseModel):
            yield each
        waiting = [*get_args(each), *waiting] if get_origin(each) is not Literal else waiting


def all_models(first: Sequence[type[BaseModel]]) -> list[type[BaseModel]]:
    """These models and all that are models_in_fields in them, each once."""
    found = list(first)
    for model in found:
        found += [each for each in dict.fromkeys(models_in_fields(model)) if each not in found]
    return found


@cache
def models_by_kind() -> dict[str, list[type[BaseModel]]]:
    """The models on the page of each kind of file. Each model is on one page."""
    assert set(TITLES) == set(KINDS), "a kind of file has no title here"
    placed: set[type[BaseModel]] = set()
    found = {}
    for kind in TITLES:
        first = [KINDS[kind].annotate()] if kind == "rig" else KINDS[kind].models
        found[kind] = [each for each in all_models(first) if each not in placed]
        placed.update(found[kind])
    return found


def page_of(model: type[BaseModel]) -> str:
    """The name of the page that describes `model`."""
    return next(f"{kind}.md" for kind, models in models_by_kind().items() if model in models)


def table(model: type[BaseModel]) -> str:
    rows = ["| Key | Value | Default | Meaning |", "|---|---|---|---|"]
    for name, field in model.model_fields.items():
        words = " ".join(filter(None, [field.description, comment_of(model, name)]))
        kind = describe_type(field.annotation, field.metadata)
        rows.append("| " + " | ".join(
            each.replace("|", "\\|") for each in (f"`{name}`", kind, show_default(field), words)) + " |")  # fmt: skip
    return "\n".join(rows)


def markdown(kind: str) -> str:
    """The page of one kind of file: its keys, those of the parts in it, and the shipped files."""
    parts = [f"# {TITLES[kind]}", INTRODUCTION.format(kind=kind)]
    for model in models_by_kind()[kind]:
        documentation = inspect.cleandoc(model.__doc__ or "") if "__doc__" in vars(model) else ""
        parts += [f"## {model.__name__}", *([documentation] if documentation else []), table(model)]
    parts += ["## Shipped files"]
    for path in sorted((config_root() / KINDS[kind].folder).glob("*.yaml")):
        parts += [f"### {path.stem}", f"```yaml\n{path.read_text(encoding='utf-8').strip()}\n```"]
    return "\n\n".join(parts) + "\n"
