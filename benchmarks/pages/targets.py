"""What must be reached and is aimed for (targets.yaml), and how each figure follows from the rows of one run.

Ratios are taken within a run, never between two: both sides then met the same machine and the same load.
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
    """A number of the rows of a case: the worst (largest), or the mean. Variant and resolution must begin so."""

    what: str  # a field of the row, else one of its figures
    case: str
    variant: str = ""
    ending: str = ""  # of the variant
    method: str = "tacsim"
    resolution: str = ""
    gel: str = ""  # somewhere in the resolution
    from_depth_mm: float | None = None  # rows of presses at least so deep
    scale: float = 1.0
    mean: bool = False

    def __call__(self, rows: Iterable[Row]) -> float | None:
        """None when the rows do not have it."""
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
    """One figure. `must` is required, `aim` is what we would like; either may be missing."""

    name: str
    unit: str = ""
    must: float | None = None
    aim: float | None = None
    value: Selection | None = None
    over: Selection | None = None  # what the value is divided by
    at_least: bool = False  # larger is better
    remark: str = ""  # what to know where it is missed
    elsewhere: str = ""  # why no row can have it

    def find(self, rows: Sequence[Row]) -> float | None:
        """The value in these rows; None when they do not have it."""
        value = None if self.value is None else self.value(rows)
        if value is None or self.over is None:
            return value
        over = self.over(rows)
        return None if over is None or over == 0 else value / over

    def evaluate(self, value: float | None) -> Verdict:
        """What a value means. The limit itself is within it."""
        if value is None:
            return "not measured"
        reached = [limit is not None and self._within(value, limit) for limit in (self.must, self.aim)]
        if self.must is not None and not reached[0]:
            return "missed"
        if self.aim is None or reached[1]:
            return "met" if self.aim is None else "aim met"
        return "aim missed" if self.must is None else "met"

    def _within(self, value: float, limit: float) -> bool:
        return value >= limit if self.at_least else value <= limit

    def cells(self, value: float | None) -> list[str]:
        """A line of the table, as text."""
        verdict = self.evaluate(value)
        shown = "" if value is None else f"{value:.3g} {self.unit}".strip()
        words = f"**{verdict}**" if verdict == "missed" else verdict
        why = {"missed": self.remark, "not measured": self.elsewhere}.get(verdict)
        return [self.name, shown, *map(self._limit, (self.must, self.aim)), words + (f": {why}" if why else "")]

    def _limit(self, limit: float | None) -> str:
        return "" if limit is None else f"{'≥' if self.at_least else '≤'} {limit:g}"


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
    """The table as text, a list of cells a target."""
    return [target.cells(target.find(rows)) for target in targets]
