"""Our results next to those of independent solvers, a line for each case and a column for each resolution."""

from __future__ import annotations

from collections.abc import Sequence

from benchmarks.harness.schema import Row

UNITS = {"n": "N", "mm": "mm", "nmm": "N mm", "ratio": ""}  # of figures found_... and truth_...


def lines(rows: Sequence[Row]) -> tuple[list[str], list[list[str]]]:
    """Header and lines: case, oracle, and for each resolution our result and its error."""
    resolutions = list(dict.fromkeys(row.resolution for row in rows))
    by_case: dict[str, dict[str, Row]] = {}
    for row in rows:
        by_case.setdefault(row.variant, {})[row.resolution] = row
    cells = [
        [case, _truth(next(iter(found.values()))), *(_found(found.get(each)) for each in resolutions)]
        for case, found in by_case.items()
    ]
    return ["case", "oracle", *resolutions], cells


def _values(row: Row) -> tuple[float, float, str]:
    """Found, true, and their unit."""
    (unit,) = (name.removeprefix("found_") for name in row.figures if name.startswith("found_"))
    return row.figures[f"found_{unit}"], row.figures[f"truth_{unit}"], UNITS[unit]


def _truth(row: Row) -> str:
    _, true, unit = _values(row)
    return f"{true:.4g} {unit}".strip()


def _found(row: Row | None) -> str:
    if row is None:
        return ""
    found, true, _ = _values(row)
    words = f"{found:.4g} ({found / true - 1:+.1%})".replace("%", " %")
    return f"{words}, {row.note}" if row.note else words
