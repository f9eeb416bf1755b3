"""pydantic's errors -> problems with a place, in words for the author of the file."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, get_args, get_origin

from pydantic import ValidationError
from pydantic_core import ErrorDetails

from tacsim.config.annotation import (
    allowed_keys,
    child_annotation,
    describe_allowed,
    select_variant,
    split_annotation,
    tag_of,
    union_members,
    union_models,
)
from tacsim.config.document import LoadState, Node
from tacsim.config.errors import join_keys
from tacsim.models.driver import refused_driver
from tacsim.models.text import printable_line, suggest_word


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
