"""Type annotations of the models for a node: its model, the annotations of its children, the allowed values."""

from __future__ import annotations

from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from annotated_types import Ge, Gt, Le, Lt
from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import to_jsonable_python

from tacsim.config.document import Node
from tacsim.config.kinds import kind_of, shipped_names
from tacsim.models.quantity import UNITS, Quantity, list_units

_BOUNDS = ((Gt, "gt", ">"), (Ge, "ge", ">="), (Lt, "lt", "<"), (Le, "le", "<="))


def split_annotation(annotation: Any) -> tuple[Any, list[Any]]:
    """The bare type of an annotation, and its metadata (bounds, quantity), nested ones included."""
    metadata: list[Any] = []
    while get_origin(annotation) is Annotated:
        annotation, *more = get_args(annotation)
        for item in more:
            metadata += item.metadata if isinstance(item, FieldInfo) else [item]
    return annotation, metadata


def union_members(annotation: Any) -> list[Any]:
    """The alternatives of a union without None; any other type is its own only member."""
    bare, metadata = split_annotation(annotation)
    if get_origin(bare) in (Union, UnionType):
        return [member for part in get_args(bare) for member in union_members(part)]
    if bare is NoneType:
        return []
    return [Annotated[(bare, *metadata)] if metadata else bare]


def union_models(annotation: Any) -> list[type[BaseModel]]:
    """The models among the members."""
    bare = [split_annotation(member)[0] for member in union_members(annotation)]
    return [model for model in bare if isinstance(model, type) and issubclass(model, BaseModel)]


def tag_of(model: type[BaseModel]) -> tuple[str, str] | None:
    """The field that distinguishes this model from the others of a union, and its value: ("shape", "box")."""
    for name, field in model.model_fields.items():
        options = get_args(field.annotation)
        if get_origin(field.annotation) is Literal and len(options) == 1:
            return name, str(options[0])
    return None


def select_variant(annotation: Any, node: Node | None) -> type[BaseModel] | None:
    """The model of a mapping node: the only one, or the one of a union that the node's tag names. None for
    another node, where it may be something else than a model."""
    options = union_models(annotation)
    if node is not None and not isinstance(node.value, dict) and len(union_members(annotation)) > len(options):
        return None
    if len(options) == 1:
        return options[0]
    for model in options:
        tag = tag_of(model)
        if tag is not None and node is not None and tag[0] in node.items and node.items[tag[0]].value == tag[1]:
            return model
    return None


def child_annotation(annotation: Any, node: Node | None, key: str | int) -> Any:
    """The annotation of an entry of a mapping or a list; None for an unknown one."""
    model = select_variant(annotation, node)
    if model is not None:
        field = model.model_fields.get(str(key))
        if field is None:
            return None
        return Annotated[(field.annotation, *field.metadata)] if field.metadata else field.annotation
    for member in union_members(annotation):
        bare = split_annotation(member)[0]
        origin, args = get_origin(bare), get_args(bare)
        if origin is dict and isinstance(key, str):
            return args[1]
        if origin in (tuple, list) and isinstance(key, int):
            if len(args) == 1 or args[1:] == (...,):
                return args[0]
            return args[key] if key < len(args) else None
    return None


def field_default(annotation: Any, node: Node | None, key: str) -> Any:
    """The default of a field as plain data; None if it has none."""
    model = select_variant(annotation, node)
    field = model.model_fields.get(key) if model is not None else None
    if field is None or field.is_required():
        return None
    return to_jsonable_python(field.get_default(call_default_factory=True))


def allowed_keys(annotation: Any, node: Node | None) -> list[str]:
    """The keys that a mapping node may have; empty where any name is allowed."""
    model = select_variant(annotation, node)
    if model is not None:
        return list(model.model_fields)
    bare = [split_annotation(member)[0] for member in union_members(annotation)]
    key_types = [get_args(part)[0] for part in bare if get_origin(part) is dict]
    return [str(option) for part in key_types for option in get_args(split_annotation(part)[0])]


def describe_allowed(annotation: Any) -> str:
    """The allowed values, as a phrase: "a length > 0 m, with unit (m, mm, cm, um), or null"."""
    phrases = [_describe_member(member) for member in union_members(annotation)]
    if len(union_models(annotation)) > 1:
        phrases = [_describe_models(annotation)]
    if _is_nullable(annotation):
        phrases.append("null")
    return ", or ".join(phrases)


def _is_nullable(annotation: Any) -> bool:
    bare, _ = split_annotation(annotation)
    if get_origin(bare) in (Union, UnionType):
        return any(_is_nullable(part) for part in get_args(bare))
    return bare is NoneType


def _describe_member(annotation: Any) -> str:
    bare, metadata = split_annotation(annotation)
    origin, args = get_origin(bare), get_args(bare)
    quantity = next((item.kind for item in metadata if isinstance(item, Quantity)), None)
    if quantity is not None:
        si = next(iter(UNITS[quantity]))
        return (
            f"a {quantity}{_describe_bounds(metadata, ' ' + si)}, bare in {si} or with a unit ({list_units(quantity)})"
        )
    if origin is Literal:
        return " | ".join(str(option) for option in args)
    if origin in (tuple, list):
        return _describe_list(args)
    if origin is dict:
        keys = [str(option) for option in get_args(split_annotation(args[0])[0])]
        return f"a mapping of {' | '.join(keys) or 'names'} to {_describe_entry(args[1])}"
    if union_models(bare):
        return _describe_models(bare)
    name = {float: "a number", int: "a whole number", str: "a text", bool: "true | false"}.get(bare, "another value")
    return name + _describe_bounds(metadata, "")


def _describe_list(args: tuple[Any, ...]) -> str:
    if not args or args[1:] == (...,):
        return "a list"
    entries = {_describe_entry(part) for part in args}
    return f"a list of {len(args)}" + (f", each {entries.pop()}" if len(entries) == 1 else "")


def _describe_entry(annotation: Any) -> str:
    return describe_allowed(annotation) if not union_models(annotation) else "mappings"


def _describe_models(annotation: Any) -> str:
    kind = kind_of(union_models(annotation))
    reference = f"the name of a {kind.name} ({', '.join(shipped_names(kind.name))}), or " if kind is not None else ""
    options = union_models(annotation)
    if len(options) > 1:
        tags = [tag for model in options if (tag := tag_of(model)) is not None]
        return f"{reference}a mapping with {tags[0][0]}: {' | '.join(tag[1] for tag in tags)}"
    return f"{reference}a mapping with keys among {', '.join(options[0].model_fields)}"


def _describe_bounds(metadata: list[Any], unit: str) -> str:
    parts = []
    for item in metadata:
        for bound, attribute, sign in _BOUNDS:
            if isinstance(item, bound):
                parts.append(f"{sign} {getattr(item, attribute):.12g}{unit}")
    return " " + " and ".join(parts) if parts else ""
