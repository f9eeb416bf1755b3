"""pydantic's errors -> problems at a place, in words for the person who wrote the file."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, get_args, get_origin

from pydantic import ValidationError
from pydantic_core import ErrorDetails

from tacsim.config.annotation import allowed, child, keys, members, models, split, tag_of, variant
from tacsim.config.document import Node, Reading
from tacsim.config.errors import did_you_mean, join, printable

_OUT_OF_RANGE = ("greater_than", "greater_than_equal", "less_than", "less_than_equal")


@dataclass(frozen=True, slots=True)
class Spot:
    """Where an error is: the nearest node, its annotation and key, and the key that it lacks, if that is the error."""

    node: Node
    annotation: Any
    key: str
    absent: str | int | None = None
    of_key: bool = False  # the error is in the key itself
    parent: Any = None  # annotation of the mapping that holds the node
    holder: Node | None = None


def report_errors(error: ValidationError, root: Node, annotation: Any, reading: Reading) -> None:
    """Each error of a failed validation as a problem; what follows from a problem already reported is left out."""
    for detail in error.errors(include_url=False):
        context = detail.get("ctx", {})
        spot = find(root, annotation, (*detail["loc"], *context.get("at", ())))
        if not spot.node.broken:
            reading.report(spot.node.place, _key(spot), _text(detail, spot))


def find(root: Node, annotation: Any, loc: tuple[str | int, ...]) -> Spot:
    """Follows pydantic's location through the tree.

    At a union pydantic's location names the variant ("box"), which is no key of the file.
    """
    spot = Spot(root, annotation, "")
    steps = list(loc)
    while steps:
        node = spot.node
        step = steps.pop(0)
        if step == "[key]":
            return replace(spot, of_key=True)
        if len(members(spot.annotation)) > 1:
            member = _member(spot.annotation, node)
            if member is None:
                return spot
            spot = replace(spot, annotation=member)
            continue
        entry = _entry(node, step)
        inner = child(spot.annotation, node, step)
        if entry is None:
            return Spot(node, spot.annotation, spot.key, absent=step)
        spot = Spot(entry, inner, join(spot.key, step), parent=spot.annotation, holder=node)
    return spot


def _entry(node: Node, step: str | int) -> Node | None:
    if isinstance(node.value, list):
        return node.value[step] if isinstance(step, int) and step < len(node.value) else None
    return node.items.get(str(step))


def _member(annotation: Any, node: Node) -> Any:
    """The alternative of a union that the node means."""
    model = variant(annotation, node)
    if model is not None:
        return model
    wanted: tuple[type, ...] = (float, int, bool)
    for kind, fits in ((list, (tuple, list)), (dict, (dict,)), (str, (str,))):
        wanted = fits if isinstance(node.value, kind) else wanted
    fitting = [part for part in members(annotation) if (get_origin(split(part)[0]) or split(part)[0]) in wanted]
    return fitting[0] if len(fitting) == 1 else None


def _key(spot: Spot) -> str:
    return join(spot.key, spot.absent) if isinstance(spot.absent, str) else spot.key


def _text(detail: ErrorDetails, spot: Spot) -> str:
    kind, context = detail["type"], detail.get("ctx", {})
    if kind == "extra_forbidden" or spot.of_key:
        return _unknown_key(detail, spot)
    if kind == "missing" and isinstance(spot.absent, str):
        what = allowed(child(spot.annotation, spot.node, spot.absent))
        return f"is missing; allowed: {what}"
    if kind in ("missing", "too_long", "too_short"):
        return _wrong_length(kind, context, spot)
    if kind in ("union_tag_not_found", "union_tag_invalid"):
        return _wrong_variant(spot)
    if kind == "value_error" and (isinstance(spot.node.value, (str, dict))):
        return str(context["error"])
    if "at" in context:  # a model's own message
        return detail["msg"]
    if kind == "literal_error" and spot.node.text:
        options = [str(option) for part in members(spot.annotation) for option in get_args(split(part)[0])]
        hint = did_you_mean(spot.node.text, options)
        return f"{spot.node.describe()} is unknown; allowed: {allowed(spot.annotation)}{hint}"
    if kind in _OUT_OF_RANGE:
        return f"{spot.node.text} is out of range; allowed: {allowed(spot.annotation)}"
    if spot.annotation is None or not members(spot.annotation):
        return printable(detail["msg"])
    return f"{spot.node.describe()} does not fit; allowed: {allowed(spot.annotation)}"


def _unknown_key(detail: ErrorDetails, spot: Spot) -> str:
    name = spot.key.rpartition(".")[2]
    known = keys(spot.parent, spot.holder)
    if known:
        return f"unknown key; allowed: {', '.join(known)}{did_you_mean(name, known)}"
    if detail["type"] == "string_pattern_mismatch":
        return f"'{name}' is no name; allowed: lower-case letters, digits and _, a letter first"
    return printable(f"unknown key; {detail['msg']}")


def _wrong_length(kind: str, context: dict[str, Any], spot: Spot) -> str:
    if isinstance(spot.node.value, list):
        count = len(spot.node.value)
        what = f"has {count} {'entry' if count == 1 else 'entries'}"
        limit = f"at most {context['max_length']}" if kind == "too_long" and "max_length" in context else None
        fixed = allowed(spot.annotation)
        return f"{what}; allowed: {limit if limit and fixed == 'a list' else fixed}"
    if isinstance(spot.node.value, dict):
        return f"has {len(spot.node.value)} entries; allowed: at least {context.get('min_length', 1)}"
    return f"{spot.node.describe()} does not fit; allowed: {allowed(spot.annotation)}"


def _wrong_variant(spot: Spot) -> str:
    tags = [tag for model in models(spot.annotation) if (tag := tag_of(model)) is not None]
    name, options = tags[0][0], [tag[1] for tag in tags]
    said = spot.node.items.get(name)
    if said is None:
        return f"'{name}' is missing; allowed: {name}: {' | '.join(options)}"
    hint = did_you_mean(said.text, options)
    return f"{name} {said.describe()} is unknown; allowed: {' | '.join(options)}{hint}"
