"""YAML text -> a tree of nodes with their lines, and problems of a configuration with their places. Nothing is
executed, and sizes are checked first. All problems are collected, then raised as one ConfigError.

A subset of YAML: numbers, booleans and null as in YAML 1.2 (so ``1e5`` is a number, ``no`` and ``12:30`` are
texts); no anchors, aliases, merge keys, tags or duplicate keys; at most 1 MB, 32 levels and 20,000 values.
"""

from __future__ import annotations

import json
import math
import re
import stat
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import yaml

from tacsim.models.text import printable_line

MAX_NODES = 20_000  # of one load, with referenced files


@dataclass(frozen=True, slots=True)
class Place:
    """Where something was written: a line of a file, or the command line (``--set key=value``, which has no line)."""

    source: str
    line: int | None = None

    def __str__(self) -> str:
        return self.source if self.line is None else f"{self.source}:{self.line}"


@dataclass(frozen=True, slots=True)
class Problem:
    """One problem, at `place`, of the value with the dotted `key` (empty: of the whole file)."""

    place: Place
    key: str
    text: str

    def __str__(self) -> str:
        return printable_line(": ".join(part for part in (str(self.place), self.key, self.text) if part))


class ConfigError(ValueError):
    """The configuration cannot be used. ``str(error)`` is the complete message: lines ``file:line: key: what``."""

    def __init__(self, problems: Sequence[Problem]) -> None:
        max_shown = 30  # a broken file can have thousands of problems
        sources = list(dict.fromkeys(problem.place.source for problem in problems))
        self.problems = tuple(
            sorted(dict.fromkeys(problems), key=lambda p: (sources.index(p.place.source), p.place.line or 0))
        )
        lines = [str(problem) for problem in self.problems[:max_shown]]
        if len(self.problems) > max_shown:
            lines.append(f"... and {len(self.problems) - max_shown} more problems")
        super().__init__("\n".join(lines))

    def __reduce__(self) -> tuple[type[ConfigError], tuple[tuple[Problem, ...]]]:
        """By its problems, not by its text: it is sent from one process to another."""
        return type(self), (self.problems,)


def join_keys(key: str, name: str | int) -> str:
    """Dotted key of an entry."""
    return f"{key}.{name}" if key else str(name)


_FLOAT = re.compile(
    r"[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?$|[-+]?\.(?:inf|Inf|INF)$|\.(?:nan|NaN|NAN)$"
)
_RESOLVERS = (  # tag, pattern, first characters: the core schema of YAML 1.2
    ("bool", re.compile(r"(?:true|True|TRUE|false|False|FALSE)$"), "tTfF"),
    ("null", re.compile(r"(?:null|Null|NULL|~|)$"), ["n", "N", "~", ""]),
    ("int", re.compile(r"[-+]?[0-9]+$"), "-+0123456789"),
    ("float", _FLOAT, "-+.0123456789"),
)


@dataclass(frozen=True, slots=True)
class Node:
    """A value of a configuration file, and where it was written."""

    value: bool | int | float | str | dict[str, Node] | list[Node] | None
    place: Place  # of the key, if it has one
    folder: Path  # base of relative references in this node
    text: str = ""  # a scalar as it was written
    broken: bool = False  # its problem has been reported; no further problem is reported

    @property
    def items(self) -> dict[str, Node]:
        """The entries of a mapping; empty for anything else."""
        return self.value if isinstance(self.value, dict) else {}

    @property
    def is_empty(self) -> bool:
        return self.value is None and not self.broken

    def describe(self) -> str:
        """The value, for a message."""
        if isinstance(self.value, dict):
            return "a mapping"
        if isinstance(self.value, list):
            return f"a list of {len(self.value)}"
        if self.value is None:
            return "nothing (null)"
        short = printable_line(self.text, 80)
        return f"'{short}'" if isinstance(self.value, str) else short


@dataclass(slots=True)
class LoadState:
    """Problems found, files read and values counted by one load."""

    problems: list[Problem] = field(default_factory=list)
    sources: list[Path] = field(default_factory=list)
    nodes: int = 0

    def report(self, place: Place, key: str, text: str) -> None:
        self.problems.append(Problem(place, key, text))


class _Forbidden(yaml.MarkedYAMLError):
    """Valid YAML that is not allowed in a configuration."""


class _Loader(yaml.SafeLoader):
    """Composes nodes within the limits. Raises _Forbidden, with its place, for YAML that is not allowed."""

    yaml_implicit_resolvers: ClassVar[dict[str, Any]] = {}  # type: ignore[misc]  # PyYAML declares none, but has one

    def __init__(self, text: str, room: int) -> None:
        super().__init__(text)
        self.remaining_values = room
        self.depth = 0

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        max_depth = 32
        event = self.peek_event()  # type: ignore[no-untyped-call]
        self.remaining_values -= 1
        self.depth += 1
        problem = None
        if isinstance(event, yaml.AliasEvent) or getattr(event, "anchor", None) is not None:
            problem = "anchors (&) and aliases (*) are not allowed; write the value out, or refer to a file by its name"
        elif getattr(event, "tag", None) is not None:
            problem = f"tags are not allowed ({event.tag}); leave it out"
        elif self.depth > max_depth:
            problem = f"nested too deeply; at most {max_depth} levels are allowed"
        elif self.remaining_values < 0:
            problem = f"too many values; at most {MAX_NODES} are allowed, referenced files included"
        if problem is not None:
            raise _Forbidden(problem=problem, problem_mark=event.start_mark)
        node = super().compose_node(parent, index)
        self.depth -= 1
        return node


class _Dumper(yaml.SafeDumper):
    """Writes without aliases, and quotes every text that _Loader would read as a number."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


for _tag, _pattern, _first in _RESOLVERS:
    _Loader.add_implicit_resolver(f"tag:yaml.org,2002:{_tag}", _pattern, list(_first))
    _Dumper.add_implicit_resolver(f"tag:yaml.org,2002:{_tag}", _pattern, list(_first))


def dump_yaml(data: Any) -> str:
    """Plain data (mappings, lists, scalars) as YAML that :func:`parse_text` reads back to the same."""
    text: str = yaml.dump(data, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=100)
    return text


def read_text(
    path: Path, refuse: Callable[[str], None], state: LoadState, describe_missing: Callable[[Path], str]
) -> str | None:
    """The text of a file, checked before and while reading; None after a reported problem.

    `refuse` reports a problem of the file itself, at the place that refers to it. `describe_missing` gives the end of
    the message about a missing file.
    """
    max_bytes = 1_000_000
    try:
        mode = path.stat()
        if not stat.S_ISREG(mode.st_mode):
            what = "is a folder" if stat.S_ISDIR(mode.st_mode) else "is no regular file"
            refuse(f"'{display_path(path)}' {what}; give a YAML file")
            return None
        size = mode.st_size
        if size <= max_bytes:
            with path.open("rb") as file:
                content = file.read(max_bytes + 1)
            size = len(content)  # it may have grown
        if size > max_bytes:
            refuse(f"'{display_path(path)}' has {size / 1e6:.1f} MB; at most {max_bytes / 1e6:.0f} MB is allowed")
            return None
        state.sources.append(path)
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        what = f"byte 0x{content[error.start]:02x} is not UTF-8; save the file as UTF-8 text"
        state.report(Place(display_path(path), line), "", what)
    except FileNotFoundError:
        shown = display_path(path)
        refuse(f"there is no file '{shown}'{describe_missing(Path(shown))}")
    except (OSError, ValueError) as error:
        what = getattr(error, "strerror", None) or str(error)
        refuse(f"cannot read '{display_path(path)}': {what}")
    return None


def display_path(path: Path) -> str:
    """`path` for a message: relative to the current folder if it is inside."""
    try:
        return str(path.relative_to(Path.cwd()))
    except (ValueError, OSError):
        return str(path)


def parse_text(text: str, source: str, folder: Path, state: LoadState, place: Place | None = None) -> Node:
    """The tree of a YAML text. Problems are reported to `state`; an unreadable value becomes a broken node.

    `place`: of the whole text (an override); None: each node has its own line in `source`.
    """
    start = place or Place(source, 1)
    broken = Node(None, start, folder, broken=True)
    loader = None
    try:
        loader = _Loader(text, MAX_NODES - state.nodes)
        root = loader.get_single_node()
    except yaml.reader.ReaderError as error:
        character = text[error.position : error.position + 1]
        what = f"not valid YAML: the character {character!a} is not allowed"
        state.report(place or Place(source, text.count("\n", 0, error.position) + 1), "", what)
        return broken
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        what = error.problem or error.context or "cannot be read"
        if not isinstance(error, _Forbidden):
            what = "not valid YAML: " + ", ".join(part for part in (error.context, error.problem) if part)
        state.report(place or Place(source, mark.line + 1 if mark else 1), "", what)
        return broken
    except (
        ValueError,
        OverflowError,
    ) as error:  # raised by PyYAML for \U escapes and %YAML versions that are too large
        line = loader.line + 1 if loader is not None else 1
        state.report(place or Place(source, line), "", f"not valid YAML: {error}")
        return broken
    finally:
        if loader is not None:
            state.nodes = MAX_NODES - loader.remaining_values
            loader.dispose()
    if root is None:
        return Node(None, start, folder)
    return _convert_node(root, _Origin(source, folder, place, state), (), None)


@dataclass(frozen=True, slots=True)
class _Origin:
    source: str
    folder: Path
    place: Place | None
    state: LoadState

    def at(self, node: yaml.Node) -> Place:
        return self.place or Place(self.source, node.start_mark.line + 1)


def _convert_node(node: yaml.Node, origin: _Origin, path: tuple[str, ...], key_place: Place | None) -> Node:
    place = key_place or origin.at(node)
    if isinstance(node, yaml.MappingNode):
        entries = {
            key: _convert_node(child, origin, (*path, key), at)
            for key, child, at in _mapping_entries(node, origin, path)
        }
        return Node(entries, place, origin.folder)
    if isinstance(node, yaml.SequenceNode):
        items = [_convert_node(child, origin, (*path, str(i)), None) for i, child in enumerate(node.value)]
        return Node(items, place, origin.folder)
    text = str(node.value)
    value, problem = _parse_scalar(node.tag.rpartition(":")[2], text)
    if problem:
        origin.state.report(place, ".".join(path), problem)
    return Node(None if problem else value, place, origin.folder, text=text, broken=bool(problem))


def _mapping_entries(
    node: yaml.MappingNode, origin: _Origin, path: tuple[str, ...]
) -> Iterator[tuple[str, yaml.Node, Place]]:
    """Key, value and place of each valid entry; the others are reported."""
    first: dict[str, Place] = {}
    for key_node, child in node.value:
        place = origin.at(key_node)
        if not isinstance(key_node, yaml.ScalarNode):
            origin.state.report(place, ".".join(path), "a key must be a plain text, not a list or a mapping")
            continue
        key = str(key_node.value)
        dotted = ".".join((*path, key))
        if key == "<<":
            origin.state.report(place, dotted, "merge keys are not allowed; use 'extends: NAME' instead")
        elif _parse_scalar("str", key)[1]:
            origin.state.report(place, ".".join(path), f"the key {key!a} is no Unicode text")
        elif key in first:
            origin.state.report(place, dotted, f"the key occurs twice, first at {first[key]}; keep one")
        else:
            first[key] = place
            yield key, child, place


def _parse_scalar(tag: str, text: str) -> tuple[bool | int | float | str | None, str]:
    """Value of a scalar, and its problem (empty: none)."""
    max_digits = 64  # of a whole number
    if tag == "null":
        return None, ""
    if tag == "bool":
        return text.lower() == "true", ""
    if tag == "int" and len(text) <= max_digits:
        return int(text), ""
    if tag in ("int", "float"):
        number = float(text.lower().replace(".inf", "inf").replace(".nan", "nan"))
        return number, "" if math.isfinite(
            number
        ) else f"{printable_line(text, 80)} is not finite; give a finite number"
    try:
        text.encode("utf-8")
    except UnicodeEncodeError:
        return None, f"{text!a} is no Unicode text (it holds half of a surrogate pair)"
    return text, ""


def node_as_json(node: Node) -> str:
    """The tree as JSON. Whole floats become integers, so that ``1e5`` is a valid count."""
    return json.dumps(plain_data(node, integers=True))


def plain_data(node: Node, *, integers: bool = False) -> Any:
    """The tree as plain data, as it was written; with `integers`, whole floats become integers."""
    value = node.value
    if isinstance(value, dict):
        return {key: plain_data(child, integers=integers) for key, child in value.items()}
    if isinstance(value, list):
        return [plain_data(child, integers=integers) for child in value]
    if integers and isinstance(value, float) and value.is_integer() and abs(value) < 2**53:
        return int(value)
    return value


def node_of_data(data: Any, place: Place, folder: Path) -> Node:
    """A tree of plain data (a model's defaults), as if written at `place`."""
    if isinstance(data, dict):
        return Node({str(key): node_of_data(value, place, folder) for key, value in data.items()}, place, folder)
    if isinstance(data, list):
        return Node([node_of_data(value, place, folder) for value in data], place, folder)
    return Node(data, place, folder, text=str(data))
