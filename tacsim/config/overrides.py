"""``--set key.sub=value``: a value from the command line replaces one of the expanded tree."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from tacsim.config.annotation import allowed, child, default, keys
from tacsim.config.document import FORMER_KEYS, LoadState, Node, from_plain, parse_text
from tacsim.config.errors import Place, did_you_mean, join
from tacsim.config.references import drop_foreign_keys, expand


@dataclass(frozen=True, slots=True)
class Override:
    path: tuple[str, ...]
    value: Node

    @property
    def place(self) -> Place:
        return self.value.place


def parse_override(text: str, state: LoadState) -> Override | None:
    """``key.sub=value``, the value read as YAML; None after a reported problem."""
    place = Place(f"--set {text}")
    key, equals, value = text.partition("=")
    path = tuple(FORMER_KEYS.get(part, part) for part in key.strip().split("."))
    if not equals or not all(path):
        state.report(place, "", "allowed: key.sub=value, for example scene.preset=standard")
        return None
    node = parse_text(value, place.source, Path.cwd(), state, place)
    return Override(path, node)


def apply(root: Node, annotation: Any, override: Override, state: LoadState) -> Node:
    """The tree with the override, references in its value expanded."""
    return expand(_put(root, annotation, override, 0, state), annotation, state)


def _put(node: Node, annotation: Any, override: Override, depth: int, state: LoadState) -> Node:
    if depth == len(override.path):
        return override.value
    if node.broken:
        return node
    step = override.path[depth]
    if isinstance(node.value, list):
        return _put_in_list(node, annotation, override, depth, state)
    if node.value is not None and not isinstance(node.value, dict):
        where = ".".join(override.path[:depth])
        what = f"'{where}' is {node.describe()}, which has no keys" if where else "the file holds no mapping"
        state.report(override.place, ".".join(override.path), what)
        return node
    if node.value is None:
        node = Node({}, override.place, override.value.folder)
    entry = node.items.get(step)
    inner = child(annotation, node, step)
    if depth + 1 < len(override.path) and (entry is None or entry.is_empty):
        if inner is None and keys(annotation, node):
            known = keys(annotation, node)
            what = f"unknown key; allowed: {', '.join(known)}{did_you_mean(step, known)}"
            state.report(override.place, ".".join(override.path[: depth + 1]), what)
            return node
        entry = from_plain(default(annotation, node, step), override.place, override.value.folder)
    entry = entry or Node(None, override.place, override.value.folder)
    changed = replace(node, value={**node.items, step: _put(entry, inner, override, depth + 1, state)})
    return drop_foreign_keys(node, changed, annotation, keep={step})


def _put_in_list(node: Node, annotation: Any, override: Override, depth: int, state: LoadState) -> Node:
    entries = list(node.value) if isinstance(node.value, list) else []
    step = override.path[depth]
    if not (step.isascii() and step.isdigit() and len(step) < 6 and int(step) < len(entries)):
        range_text = (
            f"an index from 0 to {len(entries) - 1}" if entries else f"(the list is empty) {allowed(annotation)}"
        )
        state.report(
            override.place, join(".".join(override.path[:depth]), step), f"no such entry; allowed: {range_text}"
        )
        return node
    index = int(step)
    entries[index] = _put(entries[index], child(annotation, node, index), override, depth + 1, state)
    return replace(node, value=entries)
