"""References between files: a name, a path or ``extends: NAME`` is replaced by the mapping in that file.

Overrides, ``--set key.sub=value``: a value from the command line replaces one in the expanded tree.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, get_args

from tacsim.config import bundle
from tacsim.config.annotation import (
    allowed_keys,
    child_annotation,
    describe_allowed,
    field_default,
    select_variant,
    union_models,
)
from tacsim.config.document import (
    MAX_NODES,
    LoadState,
    Node,
    Place,
    display_path,
    join_keys,
    node_of_data,
    parse_text,
    read_text,
)
from tacsim.config.kinds import Kind, NotFound, kind_of, resolve_reference, shipped_names
from tacsim.models.quantity import Quantity
from tacsim.models.text import suggest_file, suggest_word

METRE_PARTS = ("arms", "cameras", "keep_out", "start")  # parts of a rig whose lengths can be metres


def expand_references(
    node: Node, annotation: Any, state: LoadState, key: str = "", chain: tuple[Path, ...] = ()
) -> Node:
    """The tree with every reference replaced by its target. Expanding twice changes nothing."""
    kind = kind_of(union_models(annotation))
    if kind is not None and isinstance(node.value, str):
        return follow_reference(node, kind, annotation, state, key, chain)
    if kind is not None and "extends" in node.items:
        node = _extend_node(node, kind, annotation, state, key, chain)
    if isinstance(node.value, dict):
        return replace(
            node,
            value={
                name: expand_references(
                    entry, child_annotation(annotation, node, name), state, join_keys(key, name), chain
                )
                for name, entry in node.value.items()
            },
        )
    if isinstance(node.value, list):
        entries = [
            expand_references(entry, child_annotation(annotation, node, index), state, join_keys(key, index), chain)
            for index, entry in enumerate(node.value)
        ]
        return replace(node, value=entries)
    return node


def follow_reference(
    node: Node,
    kind: Kind,
    annotation: Any,
    state: LoadState,
    key: str,
    chain: tuple[Path, ...],
    reference_key: str = "",
) -> Node:
    """The expanded content of the file that a text node refers to; a broken node after a reported problem.

    `key`: of the content in the tree; `reference_key`: of the reference, if it is another (``extends``).
    """
    refuse = partial(state.report, node.place, reference_key or key)
    try:
        path = resolve_reference(kind, str(node.value), node.folder)
    except NotFound as error:
        refuse(str(error))
        return _broken_node(node)
    return read_file(path, annotation, state, refuse, key, chain)


def read_file(
    path: Path,
    annotation: Any,
    state: LoadState,
    refuse: Callable[[str], None],
    key: str = "",
    chain: tuple[Path, ...] = (),
) -> Node:
    """The expanded content of a file. `refuse` reports that it cannot be read, at the place that refers to it."""
    max_chain = 16  # files that refer to each other in a row
    broken = Node(None, Place(display_path(path), 1), path.parent, broken=True)
    path = path.absolute()  # not resolved: messages name the file as the user did
    kind = kind_of(union_models(annotation))
    if kind is not None and kind.name == "sensor" and path.name == bundle.FILE:
        state.sources.append(path)
        try:
            return bundle.sensor_node(path)
        except bundle.NoBundle as error:
            refuse(str(error))
            return broken
    try:
        resolved = path.resolve()
    except (OSError, ValueError, RuntimeError) as error:  # a name with a null byte, a loop of symbolic links
        refuse(f"cannot read '{display_path(path)}': {error}")
        return broken
    text = None
    if resolved in chain:
        circle = " -> ".join(display_path(step) for step in (*chain[chain.index(resolved) :], resolved))
        refuse(f"the references form a circle: {circle}; break it in one of them")
    elif len(chain) >= max_chain:
        refuse(f"more than {max_chain} files refer to each other in a row; shorten the chain")
    elif state.nodes <= MAX_NODES:  # otherwise reported already; each further file would report it again
        text = read_text(path, refuse, state, partial(_describe_missing_file, kind=kind))
    if text is None:
        return broken
    root = parse_text(text, display_path(path), path.parent, state)
    if root.is_empty:
        state.report(root.place, key, "the file is empty; allowed: a mapping of keys to values")
        return broken
    return expand_references(root, annotation, state, key, (*chain, resolved))


def _describe_missing_file(path: Path, kind: Kind | None) -> str:
    """What to do where there is no file of this kind."""
    if kind is not None and path.stem in shipped_names(kind.name):
        return f"; the shipped {kind.name} is called '{path.stem}', without an ending"
    near = suggest_file(path, (".yaml", ".yml"))
    if near.endswith("?") or kind is None:
        return near
    return f"{near}; `tacsim new {kind.name} NAME` writes one, `tacsim list {kind.name}` prints the shipped ones"


def _extend_node(node: Node, kind: Kind, annotation: Any, state: LoadState, key: str, chain: tuple[Path, ...]) -> Node:
    """``{extends: NAME, more: keys}``: the referenced mapping, the node's own entries merged over it."""
    entries = dict(node.items)
    reference = entries.pop("extends")
    if not isinstance(reference.value, str):
        if not reference.broken:
            what = f"{reference.describe()} does not fit; allowed: the name of a {kind.name}, or a path"
            state.report(reference.place, join_keys(key, "extends"), what)
        return _broken_node(node)
    target = follow_reference(reference, kind, annotation, state, key, chain, reference_key=join_keys(key, "extends"))
    if target.broken:
        return target
    return merge_nodes(target, replace(node, value=entries), annotation)


def merge_nodes(below: Node, above: Node, annotation: Any) -> Node:
    """`above` merged over `below`: mappings entry by entry; anything else, another reference included, is replaced."""
    if not isinstance(below.value, dict) or not isinstance(above.value, dict) or "extends" in above.value:
        return above
    entries = dict(below.value)
    for name, entry in above.value.items():
        inner = child_annotation(annotation, above, name) or child_annotation(annotation, below, name)
        entries[name] = merge_nodes(entries[name], entry, inner) if name in entries else entry
    return drop_foreign_keys(below, replace(above, value=entries), annotation, keep=set(above.value))


def drop_foreign_keys(old: Node, new: Node, annotation: Any, keep: set[str]) -> Node:
    """The node without the keys of the old variant only (``size`` after ``shape: sphere`` over a box)."""
    before, after = select_variant(annotation, old), select_variant(annotation, new)
    if before is None or after is None or before is after:
        return new
    foreign = set(before.model_fields) - set(after.model_fields) - keep
    return replace(new, value={name: entry for name, entry in new.items.items() if name not in foreign})


def _broken_node(node: Node) -> Node:
    return replace(node, value=None, broken=True)


@dataclass(frozen=True, slots=True)
class Override:
    path: tuple[str, ...]
    value: Node


def parse_override(text: str, state: LoadState) -> Override | None:
    """``key.sub=value``, the value read as YAML; None after a reported problem."""
    place = Place(f"--set {text}")
    key, equals, value = text.partition("=")
    path = tuple(key.strip().split("."))
    if not equals or not all(path):
        state.report(place, "", "allowed: key.sub=value, for example scene.preset=standard")
        return None
    node = parse_text(value, place.source, Path.cwd(), state, place)
    return Override(path, node)


def apply_override(root: Node, annotation: Any, override: Override, state: LoadState) -> Node:
    """The tree with the override, references in its value expanded."""
    return _set_value(root, annotation, override, 0, state)


def _set_value(node: Node, annotation: Any, override: Override, depth: int, state: LoadState) -> Node:
    if depth == len(override.path):
        _require_unit(annotation, override, state)
        return expand_references(override.value, annotation, state, ".".join(override.path))
    if node.broken:
        return node
    step = override.path[depth]
    if isinstance(node.value, list):
        return _set_list_item(node, annotation, override, depth, state)
    if node.value is not None and not isinstance(node.value, dict):
        where = ".".join(override.path[:depth])
        what = f"'{where}' is {node.describe()}, which has no keys" if where else "the file holds no mapping"
        state.report(override.value.place, ".".join(override.path), what)
        return node
    if node.value is None:
        node = Node({}, override.value.place, override.value.folder)
    entry = node.items.get(step)
    inner = child_annotation(annotation, node, step)
    if depth + 1 < len(override.path) and (entry is None or entry.is_empty):
        if inner is None and allowed_keys(annotation, node):
            known = allowed_keys(annotation, node)
            what = f"unknown key; allowed: {', '.join(known)}{suggest_word(step, known)}"
            state.report(override.value.place, ".".join(override.path[: depth + 1]), what)
            return node
        entry = node_of_data(field_default(annotation, node, step), override.value.place, override.value.folder)
    entry = entry or Node(None, override.value.place, override.value.folder)
    changed = replace(node, value={**node.items, step: _set_value(entry, inner, override, depth + 1, state)})
    return drop_foreign_keys(node, changed, annotation, keep={step})


def _require_unit(annotation: Any, override: Override, state: LoadState) -> None:
    """Reports lengths without a unit that are too large for metres, of gels, bodies and sensors, but not of arms."""
    max_bare_length = 0.1  # for anything else that `--set` gives as a bare number [m]
    if override.path[0] in METRE_PARTS or not _is_length(annotation):
        return
    values = override.value.value if isinstance(override.value.value, list) else [override.value]
    for node in values:
        number = node.value
        if isinstance(number, int | float) and not isinstance(number, bool) and abs(number) >= max_bare_length:
            what = f"{number} without a unit would be {number:g} m; write a unit, such as '{number:g} mm'"
            state.report(override.value.place, ".".join(override.path), what)


def _is_length(annotation: Any) -> bool:
    parts = (*getattr(annotation, "__metadata__", ()), *get_args(annotation))
    return any(part.kind == "length" if isinstance(part, Quantity) else _is_length(part) for part in parts)


def _set_list_item(node: Node, annotation: Any, override: Override, depth: int, state: LoadState) -> Node:
    entries = list(node.value) if isinstance(node.value, list) else []
    step = override.path[depth]
    if not (step.isascii() and step.isdigit() and len(step) < 6 and int(step) < len(entries)):
        fits = (
            f"an index from 0 to {len(entries) - 1}"
            if entries
            else f"(the list is empty) {describe_allowed(annotation)}"
        )
        state.report(override.value.place, ".".join(override.path[: depth + 1]), f"no such entry; allowed: {fits}")
        return node
    index = int(step)
    entries[index] = _set_value(entries[index], child_annotation(annotation, node, index), override, depth + 1, state)
    return replace(node, value=entries)
