"""Problems of a configuration and their places. All are collected, then raised as one ConfigError."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from tacsim.models.text import printable_line


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
