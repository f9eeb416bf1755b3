"""All cases, by group."""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from pathlib import Path

from robot.bench import deep, incline, materials, press, real, reliability, scenes, squeeze
from robot.bench.runner import Case
from robot.bench.schema import Group

CASES: tuple[Case, ...] = (
    *press.CASES,
    *squeeze.CASES,
    *deep.CASES,
    *incline.CASES,
    *materials.CASES,
    *scenes.CASES,
    *reliability.CASES,
)


def chosen(groups: Iterable[Group], *, baselines: bool, long: bool = False, data: Path | None = None) -> list[Case]:
    """The cases of `groups` in their order; other methods only with `baselines`, long ones only with `long`.

    `data`: folder of the real group's frames; without it that group has no cases. Raises BadData, ConfigError for one
    that cannot be used.
    """
    wanted = set(groups)
    every = CASES if data is None or "real" not in wanted else (*CASES, *real.cases(data))
    return [
        case for case in every if case.group in wanted and (baselines or not case.baseline) and (long or not case.long)
    ]


def description(group: Group, name: str, method: str) -> str:
    """What a case does, from the first line of its docstring; empty for a case that is no more."""
    if (group, name) == ("real", real.CASE):
        return _first_line(real.contact_radius)
    for case in CASES:
        if (case.group, case.name, case.method) == (group, name, method):
            return _first_line(case.measure.func if isinstance(case.measure, partial) else case.measure)
    return ""


def _first_line(function: object) -> str:
    return (function.__doc__ or "").strip().partition("\n")[0]
