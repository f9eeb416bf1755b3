"""The comment of a field as its description: `radius: Length = 5e-3  # [m]`, or the lines right above it."""

from __future__ import annotations

import ast
import re
import textwrap

TOOL_COMMENT = re.compile(r"(fmt|noqa|type|ruff|pragma)\b")


def comments_of_fields(source: str) -> dict[str, str]:
    """The comment of each annotated field in the source of a class.

    Raises:
        SyntaxError: `source` is not Python.
    """
    source = textwrap.dedent(source)
    lines = source.splitlines()
    definition = ast.parse(source).body[0]
    assert isinstance(definition, ast.ClassDef)
    found = {}
    for node in definition.body:
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            first, last = node.lineno - 1, (node.end_lineno or node.lineno) - 1
            parts = [*_lines_above(lines, first), _same_line(lines[last], node.end_col_offset or 0)]
            found[node.target.id] = " ".join(part for part in parts if part)
    return found


def _lines_above(lines: list[str], number: int) -> list[str]:
    """The lines of comment right above a line."""
    start = number
    while start > 0 and lines[start - 1].lstrip().startswith("#"):
        start -= 1
    return [line.lstrip(" #") for line in lines[start:number]]


def _same_line(line: str, column: int) -> str:
    """The comment behind a statement that ends at this column (of bytes)."""
    rest = line.encode()[column:].decode().strip()
    words = rest.lstrip("#").strip()
    return words if rest.startswith("#") and not TOOL_COMMENT.match(words) else ""
