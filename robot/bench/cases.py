"""All cases, by group."""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial

from robot.bench import materials, press, squeeze
from robot.bench.runner import Case
from robot.bench.schema import Group

CASES: tuple[Case, ...] = (*press.CASES, *squeeze.CASES, *materials.CASES)


def chosen(groups: Iterable[Group], *, baselines: bool) -> list[Case]:
    """The cases of `groups` in their order; long ones and other methods only with `baselines`."""
    wanted = set(groups)
    return [case for case in CASES if case.group in wanted and (baselines or not case.baseline)]


def description(group: Group, name: str, method: str) -> str:
    """What a case does, from the first line of its docstring; empty for a case that is no more."""
    for case in CASES:
        if (case.group, case.name, case.method) == (group, name, method):
            function = case.measure.func if isinstance(case.measure, partial) else case.measure
            return (function.__doc__ or "").strip().partition("\n")[0]
    return ""
