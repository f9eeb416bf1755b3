"""Short texts of dataclasses with arrays, for terminals and notebooks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields
from textwrap import indent
from typing import Any

import numpy as np
from numpy.typing import NDArray


def short_repr(self: Any) -> str:
    """`__repr__` of a dataclass: one line, or a line a field; of an array its shape, type and range."""
    own = getattr(self, "__dict__", None)  # with a LazyField as it was given: it is not made for its description
    values = {each.name: getattr(self, each.name) if own is None else own[each.name] for each in fields(self)}
    parts = [f"{name}={_describe_value(value)}" for name, value in values.items()]
    return _join_parts(f"{type(self).__name__}(", parts, ")")


def _join_parts(begin: str, parts: list[str], end: str) -> str:
    max_line = 80  # [characters]
    line = f"{begin}{', '.join(parts)}{end}"
    if len(line) <= max_line and "\n" not in line:
        return line
    return "\n".join([begin, *(indent(f"{part},", "    ") for part in parts), end])


def _describe_value(value: Any) -> str:
    max_entries = 8  # of an array or a sequence that is written out
    if isinstance(value, np.ndarray):
        return _describe_array(value, max_entries)
    if isinstance(value, Mapping):
        return _join_parts("{", [f"{key!r}: {_describe_value(each)}" for key, each in value.items()], "}")
    if isinstance(value, bytes):
        return f"{len(value)} bytes"
    if isinstance(value, Sequence) and not isinstance(value, str) and len(value) > max_entries:
        return f"{type(value).__name__} of {len(value)}"
    if isinstance(value, np.generic):
        value = value.item()
    return "not made yet" if callable(value) else repr(value)


def _describe_array(array: NDArray[Any], max_entries: int) -> str:
    if array.ndim == 1 and len(array) <= max_entries and array.dtype.kind in "iuf":
        return f"[{', '.join(f'{value:.4g}' for value in array + 0.0)}]"  # + 0.0: no minus before a zero
    text = f"{array.dtype} {array.shape}"
    if array.dtype == np.bool_ and array.size:
        return f"{text} {100 * array.mean():.3g} % true"
    if array.dtype.kind not in "iuf" or not array.size:
        return text
    finite = array[np.isfinite(array)]
    scope = f" {finite.min():.4g} to {finite.max():.4g}" if finite.size else ""
    return f"{text}{scope}{f', {array.size - finite.size} not finite' if finite.size < array.size else ''}"
