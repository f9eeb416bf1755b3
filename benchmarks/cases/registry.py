"""All cases, by group."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from pathlib import Path

from benchmarks.cases import (
    cycles,
    cylinder,
    environments,
    incline,
    large_strain,
    materials,
    oracles,
    press,
    random_steps,
    scenes,
    slide,
    slow_limit,
    squeeze,
)
from benchmarks.cases.real import (
    ball_touch,
    balls,
    contact_radius,
    costs,
    films,
    invariance,
    known_depth,
    labels,
    punches,
)
from benchmarks.cases.real.labels import BadData
from benchmarks.harness.machine import backend
from benchmarks.harness.runner import Case, missing_case
from benchmarks.harness.schema import Group

CASES: tuple[Case, ...] = (
    *press.CASES,
    *slide.CASES,
    *squeeze.CASES,
    *cycles.CASES,
    *random_steps.CASES,
    *slow_limit.CASES,
    *large_strain.CASES,
    *incline.CASES,
    *materials.CASES,
    *scenes.CASES,
    *environments.CASES,
    *oracles.CASES,
    *cylinder.CASES,
)

CPU_ONLY = "it runs on the CPU only"

BY_DATA: dict[tuple[str, str], Callable[..., object]] = {  # cases that need the user's frames
    ("real", contact_radius.CASE): contact_radius.contact_radius,
    ("real", films.CASE): films.marker_film,
    ("real", balls.CASE): balls.ball_presses,
    ("real", known_depth.CASE): known_depth.known_depth,
    ("real", punches.CASE): punches.punch,
    ("real", invariance.CASE): invariance.invariance,
    ("real", costs.RENDER): costs.calibrated_render,
    ("real", costs.NORMALISE): costs.normaliser,
    ("real", ball_touch.CASE): ball_touch.touch_ball,
}


def select_cases(
    groups: Iterable[Group], *, baselines: bool, long: bool = False, data: Path | None = None
) -> list[Case]:
    """The cases of `groups` in order; other methods only with `baselines`, long ones only with `long`.

    On a device (TACSIM_DEVICE), other methods and cases that need the CPU are reported as not measured.

    data: folder with the frames of the real group; without it that group has no cases. Raises BadData, ConfigError for
    a folder that cannot be used.
    """
    wanted = set(groups)
    every = CASES if data is None or "real" not in wanted else (*CASES, *_real_cases(data))
    cases = [
        case for case in every if case.group in wanted and (baselines or not case.baseline) and (long or not case.long)
    ]
    if backend() == "cpu":
        return cases
    return [replace(case, missing=case.missing or CPU_ONLY) if case.needs_cpu else case for case in cases]


def _real_cases(data: Path) -> tuple[Case, ...]:
    """The cases of the frames below `data`, and those without frames; cases without their frames are marked as missing.

    Raises BadData if no frames are found, or if the folder's own labels name missing frames; ConfigError.
    """
    found = (*films.cases(data), *balls.cases(data)) if data.is_dir() else ()
    try:
        presses = contact_radius.cases(data)
    except BadData as error:
        if all(case.missing for case in found) or (data / labels.OWN).is_file():
            raise
        presses = (missing_case(contact_radius.CASE, str(error)),)
    if not any(case.name == films.CASE for case in found):
        found = (*found, missing_case(films.CASE, f"no film of a dotted gel below {data}"))
    of_light = (*known_depth.cases(data), *punches.cases(data), *invariance.cases(data))
    return (*presses, *found, *of_light, *costs.CASES, *ball_touch.CASES)


def description(group: Group, name: str, method: str) -> str:
    """Description of a case, from the first paragraph of its docstring; empty for a removed case."""
    if (group, name) in BY_DATA:
        return _first_paragraph(BY_DATA[group, name])
    for case in CASES:
        if (case.group, case.name, case.method) == (group, name, method):
            return _first_paragraph(case.measure.func if isinstance(case.measure, partial) else case.measure)
    return ""


def _first_paragraph(function: object) -> str:
    return " ".join((function.__doc__ or "").partition("\n\n")[0].split())
