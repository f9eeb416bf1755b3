"""Type annotations of the models for a node: its model, the annotations of its children, the allowed values; and
pydantic's errors as problems with a place, in words for the author of the file."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from annotated_types import Ge, Gt, Le, Lt
from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails, to_jsonable_python

from tacsim.config.document import LoadState, Node, join_keys
from tacsim.config.kinds import kind_of, shipped_names
from tacsim.models.driver import refused_driver
from tacsim.models.quantity import UNITS, Quantity, list_units
from tacsim.models.text import printable_line, suggest_word

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


@dataclass(frozen=True, slots=True)
class Location:
    """Place of an error: the nearest node, its annotation and key, and the missing key, if that is the error."""

    node: Node
    annotation: Any
    key: str
    absent: str | int | None = None
    of_key: bool = False  # the error is in the key itself
    parent: Any = None  # annotation of the mapping that holds the node
    holder: Node | None = None


def report_errors(error: ValidationError, root: Node, annotation: Any, state: LoadState) -> None:
    """Reports each error of a failed validation, except those that follow from a problem already reported."""
    for detail in error.errors(include_url=False):
        context = detail.get("ctx", {})
        location = find_location(root, annotation, (*detail["loc"], *context.get("at", ())))
        if not location.node.broken:
            absent = location.absent
            key = join_keys(location.key, absent) if isinstance(absent, str) else location.key
            state.report(location.node.place, key, _message_text(detail, location))


def find_location(root: Node, annotation: Any, loc: tuple[str | int, ...]) -> Location:
    """Follows pydantic's location through the tree. At a union, pydantic names the variant ("box"), which is no key."""
    location = Location(root, annotation, "")
    steps = list(loc)
    while steps:
        node = location.node
        step = steps.pop(0)
        if step == "[key]":
            return replace(location, of_key=True)
        if len(union_members(location.annotation)) > 1:
            member = _select_member(location.annotation, node)
            if member is None:
                return location
            location = replace(location, annotation=member)
            continue
        entry = _entry_of(node, step)
        inner = child_annotation(location.annotation, node, step)
        if entry is None:
            return Location(node, location.annotation, location.key, absent=step)
        location = Location(entry, inner, join_keys(location.key, step), parent=location.annotation, holder=node)
    return location


def _entry_of(node: Node, step: str | int) -> Node | None:
    if isinstance(node.value, list):
        return node.value[step] if isinstance(step, int) and step < len(node.value) else None
    return node.items.get(str(step))


def _select_member(annotation: Any, node: Node) -> Any:
    """The alternative of a union that fits the node."""
    model = select_variant(annotation, node)
    if model is not None:
        return model
    wanted: tuple[type, ...] = (float, int, bool)
    for kind, fits in ((list, (tuple, list)), (dict, (dict,)), (str, (str,))):
        wanted = fits if isinstance(node.value, kind) else wanted
    fitting = [
        part
        for part in union_members(annotation)
        if (get_origin(split_annotation(part)[0]) or split_annotation(part)[0]) in wanted
    ]
    return fitting[0] if len(fitting) == 1 else None


def _message_text(detail: ErrorDetails, location: Location) -> str:
    kind, context = detail["type"], detail.get("ctx", {})
    if kind == "extra_forbidden" or location.of_key:
        return _unknown_key(detail, location)
    if kind == "missing" and isinstance(location.absent, str):
        what = describe_allowed(child_annotation(location.annotation, location.node, location.absent))
        return f"is missing; allowed: {what}"
    if kind in ("missing", "too_long", "too_short"):
        return _wrong_length(kind, context, location)
    if kind in ("union_tag_not_found", "union_tag_invalid"):
        return _wrong_variant(location)
    if kind == "value_error" and (isinstance(location.node.value, (str, dict))):
        return str(context["error"])
    if "at" in context:  # a model's own message
        return detail["msg"]
    if kind == "literal_error" and location.node.text:
        options = [
            str(option) for part in union_members(location.annotation) for option in get_args(split_annotation(part)[0])
        ]
        hint = suggest_word(location.node.text, options)
        return f"{location.node.describe()} is unknown; allowed: {describe_allowed(location.annotation)}{hint}"
    if kind.startswith(("greater_than", "less_than")):
        return f"{location.node.text} is out of range; allowed: {describe_allowed(location.annotation)}"
    if location.annotation is None or not union_members(location.annotation):
        return printable_line(detail["msg"])
    return f"{location.node.describe()} does not fit; allowed: {describe_allowed(location.annotation)}"


def _unknown_key(detail: ErrorDetails, location: Location) -> str:
    name = location.key.rpartition(".")[2]
    known = allowed_keys(location.parent, location.holder)
    if known:
        return f"unknown key; allowed: {', '.join(known)}{suggest_word(name, known)}"
    if detail["type"] == "string_pattern_mismatch":
        return f"'{name}' is no name; allowed: lower-case letters, digits and _, a letter first"
    return printable_line(f"unknown key; {detail['msg']}")


def _wrong_length(kind: str, context: dict[str, Any], location: Location) -> str:
    if isinstance(location.node.value, list):
        count = len(location.node.value)
        what = f"has {count} {'entry' if count == 1 else 'entries'}"
        limit = f"at most {context['max_length']}" if kind == "too_long" and "max_length" in context else None
        fixed = describe_allowed(location.annotation)
        return f"{what}; allowed: {limit if limit and fixed == 'a list' else fixed}"
    if isinstance(location.node.value, dict):
        return f"has {len(location.node.value)} entries; allowed: at least {context.get('min_length', 1)}"
    return f"{location.node.describe()} does not fit; allowed: {describe_allowed(location.annotation)}"


def _wrong_variant(location: Location) -> str:
    tags = [tag for model in union_models(location.annotation) if (tag := tag_of(model)) is not None]
    name, options = tags[0][0], [tag[1] for tag in tags]
    given = location.node.items.get(name)
    if given is None:
        beside = location.holder.items if location.holder is not None else {}
        others = [key for key, node in beside.items() if node is not location.node]
        hint = suggest_word(location.key.rpartition(".")[2], others)  # a mistyped name makes a new entry
        return f"'{name}' is missing; allowed: {name}: {' | '.join(options)}{hint}"
    if name == "driver" and (reason := refused_driver(location.key.partition(".")[0], given.text)) is not None:
        return f"driver {given.describe()} is refused: {reason}; allowed: {' | '.join(options)}"
    hint = suggest_word(given.text, options)
    return f"{name} {given.describe()} is unknown; allowed: {' | '.join(options)}{hint}"
