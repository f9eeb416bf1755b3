"""Requirements and aims (targets.yaml), and the computation of each figure from the rows of one run.

Ratios are taken within one run only, so that both values have the same machine and the same load.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Literal

import yaml
from pydantic import BaseModel, ConfigDict, TypeAdapter

from benchmarks.harness.schema import Row

Verdict = Literal["aim met", "met", "missed", "aim missed", "not measured"]


class _Frozen(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Selection(_Frozen):
    """A number of the rows of a case: the worst (largest), or the mean. `variant` and `resolution` are prefixes."""

    what: str  # name of a field of the row or of a figure
    case: str
    variant: str = ""
    ending: str = ""  # suffix of the variant
    method: str = "tacsim"
    resolution: str = ""
    gel: str = ""  # part of the resolution
    from_depth_mm: float | None = None  # minimum depth of the presses
    scale: float = 1.0
    mean: bool = False

    def __call__(self, rows: Iterable[Row]) -> float | None:
        """The number, or None without such rows."""
        found = [value for row in rows if self._holds_for(row) and (value := _number(row, self.what)) is not None]
        if not found:
            return None
        return (sum(found) / len(found) if self.mean else max(found)) * self.scale

    def _holds_for(self, row: Row) -> bool:
        deep = self.from_depth_mm is None or row.figures.get("depth_mm", 0.0) >= self.from_depth_mm - 1e-9
        return (
            (row.case, row.method) == (self.case, self.method)
            and row.variant.startswith(self.variant)
            and row.variant.endswith(self.ending)
            and row.resolution.startswith(self.resolution)
            and self.gel in row.resolution
            and deep
        )


class Target(_Frozen):
    """One figure. `must` is a requirement, `aim` is an aim; either may be missing."""

    name: str
    unit: str = ""
    must: float | None = None
    aim: float | None = None
    value: Selection | None = None
    over: Selection | None = None  # divisor of the value
    is_min_limit: bool = False  # larger is better
    remark: str = ""  # shown if it is missed
    elsewhere: str = ""  # reason why no row has it

    def find(self, rows: Sequence[Row]) -> float | None:
        """The value in these rows, or None without such rows."""
        value = None if self.value is None else self.value(rows)
        if value is None or self.over is None:
            return value
        over = self.over(rows)
        return None if over is None or over == 0 else value / over

    def evaluate(self, value: float | None) -> Verdict:
        """The verdict on a value. A value equal to a limit is within it."""
        if value is None:
            return "not measured"
        reached = [limit is not None and self._within(value, limit) for limit in (self.must, self.aim)]
        if self.must is not None and not reached[0]:
            return "missed"
        if self.aim is None or reached[1]:
            return "met" if self.aim is None else "aim met"
        return "aim missed" if self.must is None else "met"

    def _within(self, value: float, limit: float) -> bool:
        return value >= limit if self.is_min_limit else value <= limit

    def cells(self, value: float | None) -> list[str]:
        """A line of the table, as text."""
        verdict = self.evaluate(value)
        text = "" if value is None else f"{value:.3g} {self.unit}".strip()
        words = f"**{verdict}**" if verdict == "missed" else verdict
        reason = {"missed": self.remark, "not measured": self.elsewhere}.get(verdict)
        return [self.name, text, *map(self._limit, (self.must, self.aim)), words + (f": {reason}" if reason else "")]

    def _limit(self, limit: float | None) -> str:
        return "" if limit is None else f"{'≥' if self.is_min_limit else '≤'} {limit:g}"


def _number(row: Row, what: str) -> float | None:
    if what in ("seconds", "cpu_seconds", "error", "peak_mb"):
        return float(getattr(row, what))
    return row.figures.get(what)


def _read() -> tuple[Target, ...]:
    text = Path(__file__).with_suffix(".yaml").read_text(encoding="utf-8")
    return TypeAdapter(tuple[Target, ...]).validate_python(yaml.safe_load(text))


TARGETS = _read()
HEADER = ("figure", "measured", "must", "aim", "verdict")


def lines(rows: Sequence[Row], targets: Iterable[Target] = TARGETS) -> list[list[str]]:
    """The table as text, a list of cells for each target."""
    return [target.cells(target.find(rows)) for target in targets]
