"""The page of the promises: figures from repetitions, verdicts, and the tests that record them."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

from benchmarks.harness.schema import Failure, Report, Row
from benchmarks.pages import reliability
from benchmarks.pages.reliability import COUNT, PROMISES, Figure, marked_tests

ROOT = Path(__file__).resolve().parents[2]
pytest_plugins = ["pytester"]


@pytest.fixture(scope="module")
def report() -> Report:
    return Report.model_validate_json((ROOT / "benchmarks" / "reliability.json").read_bytes())


def figures(*values: float, unit: str = "ms", at_most: float | None = 150.0) -> Row:
    (row,) = reliability.rows(
        [Figure(3, "standstill", value, unit, at_most, "tests/test_x.py::test_a", 1.0, 0.1) for value in values], 90.0
    )
    return row


def test_what_is_measured_has_a_median_and_what_is_counted_a_sum() -> None:
    late = figures(3.0, 1.0, 2.0, 9.0, 4.0)
    assert (late.case, late.variant, late.error, late.repeats) == ("Force", "standstill", 3.0, 5)
    assert late.figures == {"worst_ms": 9.0, "spread_ms": 2.0, "promised_ms": 150.0}
    assert figures(0.0, 1.0, 1.0, unit=COUNT, at_most=0.0).error == 2.0


@pytest.mark.parametrize(
    ("row", "cells"),
    [
        (figures(20.0, 20.0, 30.0), ["20 ms", "30 ms", "150 ms", "met"]),
        (figures(20.0, 20.0, 151.0), ["20 ms", "151 ms", "150 ms", "met, worst beyond"]),
        (figures(151.0, 160.0, 151.0), ["151 ms", "160 ms", "150 ms", "**missed**"]),
        (figures(3.0, at_most=None), ["3 ms", "3 ms", "", "to compare with"]),
        (figures(0.0, 1.0, unit=COUNT, at_most=0.0), ["1", "", "0", "**missed**"]),
    ],
)
def test_verdicts(row: Row, cells: list[str]) -> None:
    (found,) = [line for line in reliability.lines([row]) if line[1] == "standstill"]
    assert found == ["3 Force", "standstill", *cells]


@pytest.mark.slow
def test_every_promise_has_tests_and_the_published_report_their_figures(report: Report) -> None:
    tests = marked_tests()
    assert sorted(tests) == list(range(1, len(PROMISES) + 1)) and len(PROMISES) == 16
    recorded = set()
    for file in {test.partition("::")[0] for found in tests.values() for test in found}:
        text = (ROOT / file).read_text(encoding="utf-8")
        recorded |= set(re.findall(r"""\bfigure\(\s*f?"(.+?)",""", text))
    names = {row.variant for row in report.results if reliability.EVENT not in row.variant}
    patterns = {re.sub(r"\\\{\w+\\\}", ".+", re.escape(name)) for name in recorded}  # {name} of an f-string
    unknown = {name for name in names if not any(re.fullmatch(pattern, name) for pattern in patterns)}
    missing = {pattern for pattern in patterns if not any(re.fullmatch(pattern, name) for name in names)}
    assert not unknown and not missing, "run: make reliability"
    assert {row.case for row in report.results} == {name for name, _ in PROMISES} - {"One contract"}


def test_a_promise_that_is_measured_alone_replaces_its_rows_and_says_so(report: Report) -> None:
    row, (test, *_) = figures(7.0, 8.0, 9.0), marked_tests()[3]
    lost = [Failure(group="robot", case=f"{case}[1]", method="tacsim", resolution="mock", cause="late")
            for case in (test, marked_tests()[1][0])]  # fmt: skip
    before = report.model_copy(update={"failures": lost})
    of_another = row.model_copy(update={"case": "Box"})
    alone = report.model_copy(update={"results": [row, of_another], "failures": []})
    after = reliability.replace_promise(before, alone, 3)
    assert [each.case for each in after.results if each.case != "Force"] == [
        each.case for each in report.results if each.case != "Force"
    ]
    (replaced,) = [each for each in after.results if each.case == "Force"]
    assert (replaced.error, replaced.variant) == (8.0, "standstill") and str(report.metadata.commit) in replaced.note
    assert after.failures == lost[1:] and after.metadata == report.metadata
    assert f"*Force*, {replaced.note}" in reliability.markdown(after)
    assert "*Force*," not in reliability.markdown(before)


def test_events_have_a_table_of_their_own(report: Report) -> None:
    def found(column: str, *values: float, unit: str = "ms") -> Row:
        at_most = 0.0 if unit == COUNT else None
        seen = [Figure(7, f"line cut · {column}", value, unit, at_most, "tests/x.py::x", 1.0, 0.1) for value in values]
        return reliability.rows(seen, 90.0)[0]

    told = [found("still after", 100.0, 104.0, 120.0), found("path", 3.0, 3.1, 8.0, unit="mm")]
    told += [
        found("moved after standstill", 0.0, 2e-3, 1e-3, unit="mm"),
        found("programs left running", 0, 1, unit=COUNT),
    ]
    page = reliability.markdown(report.model_copy(update={"results": told}))
    assert "| line cut | 104 / 120 ms | 3.1 / 8.0 mm |  | 0.001 / 0.002 mm | 1 |" in page
    assert "of 3 repetitions. The" in page and "| 7 Stops | line cut" not in page


@pytest.mark.parametrize(
    ("load", "words"), [(0.1, "The machine was idle otherwise"), (9.0, "**The machine was not idle**")]
)
def test_a_busy_machine_is_told(report: Report, load: float, words: str) -> None:
    loads: dict[str, Any] = {"load_before": [load, 0, 0], "load_after": [0.0, 0, 0], "cores": 2}
    machine = report.metadata.machine.model_copy(update=loads)
    busy = report.model_copy(update={"metadata": report.metadata.model_copy(update={"machine": machine})})
    page = reliability.markdown(busy)
    assert words in page and "None of this is a safety function" in page and "load average" in page


EXAMPLE = """
import itertools
import pytest
count = itertools.count()

@pytest.mark.promise(3)
def test_a(figure, measuring):
    assert measuring
    figure("late", next(count), "ms", at_most=5)
    figure("lost", 0, promise=4)

@pytest.mark.promise(3)
def test_b(figure):
    figure("never", 1, "ms", at_most=5)
    raise RuntimeError("a busy machine")

@pytest.mark.promise(3)
def test_without_a_figure():
    raise AssertionError("not run")
"""


def test_the_recorder_repeats_tests_and_keeps_what_passed(pytester: pytest.Pytester) -> None:
    pytester.makepyfile(EXAMPLE)
    path = pytester.path / "report.json"
    options = ("-p", "tests.promises", "-p", "no:cacheprovider", "-m", "promise", "--repeat", "3")
    pytester.runpytest_inprocess(*options, "--reliability", str(path)).assert_outcomes(passed=3, failed=3, deselected=1)
    made = Report.model_validate_json(path.read_bytes())
    late, lost = made.results
    assert (late.case, late.variant, late.error, late.repeats) == ("Force", "late", 1.0, 3)
    assert (lost.case, lost.error, lost.error_unit) == ("Stale", 0.0, COUNT)
    assert [failure.cause for failure in made.failures] == ["call: RuntimeError: a busy machine"] * 3
