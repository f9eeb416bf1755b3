"""The promises: figures from repetitions, the page from a report, and the tests that they name."""

from __future__ import annotations

import ast
import os
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from benchmarks.cases.registry import CASES, chosen
from benchmarks.harness.runner import measure
from benchmarks.harness.schema import GROUPS, Report, Row
from benchmarks.pages.targets import Target
from benchmarks.reliability import page as reliability_page
from benchmarks.reliability import rehearsal, reliability
from benchmarks.reliability.promises import PROMISES
from benchmarks.reliability.repeated import AGAIN, COUNT, Disturbed, Figure, repeated
from robot.cli import app

ROOT = Path(__file__).resolve().parents[2]
REPORT = ROOT / "benchmarks" / "reliability.json"
FIGURES = [figure for promise in PROMISES for figure in promise.figures]
ROBOT = [case for case in CASES if case.group == "robot"]


@pytest.fixture(scope="module")
def report() -> Report:
    return Report.model_validate_json(REPORT.read_bytes())


def row(**changes: Any) -> Row:
    plain = {
        "group": "robot", "case": "force", "variant": "standstill", "method": "tacsim", "resolution": "mock",
        "seconds": 1.0, "spread": None, "cpu_seconds": 0.1, "repeats": 5, "error": 20.0, "error_unit": "ms",
        "against": "a package", "peak_mb": 90.0, "figures": {"worst_ms": 30.0},
    }  # fmt: skip
    return Row.model_validate(plain | changes)


def test_what_is_measured_has_a_median_and_what_is_counted_a_sum() -> None:
    values = iter([3.0, 1.0, 2.0, 9.0, 4.0])

    def once() -> dict[str, float]:
        return {"late": (value := next(values)), "lost": float(value > 3)}

    late, lost = repeated(5, once, [Figure("late", "ms", "now"), Figure("lost", COUNT, "all")])
    assert (late.error, late.figures, lost.error) == (3.0, {"worst_ms": 9.0, "spread_ms": 2.0}, 2.0)
    assert len(late.timing.samples) == 5 and late.note == ""


def test_a_disturbed_repetition_is_done_again_and_told() -> None:
    turns = iter([True, False, True, False])

    def once() -> dict[str, float]:
        if next(turns):
            raise Disturbed("a busy machine")
        return {"late": 1.0}

    (found,) = repeated(2, once, [Figure("late", "ms", "now")])
    assert len(found.timing.samples) == 2
    assert found.note == "2 repetitions were disturbed and done again: a busy machine"
    turns = iter([True] * (AGAIN + 1))
    with pytest.raises(Disturbed, match="busy"):
        repeated(2, once, [Figure("late", "ms", "now")])


def test_every_promise_names_tests_that_exist() -> None:
    there: dict[str, set[str]] = {}
    for promise in PROMISES:
        assert promise.tests, promise.name
        for test in promise.tests:
            file, _, function = test.partition("::")
            if file not in there:
                tree = ast.parse((ROOT / "tests" / file).read_text(encoding="utf-8"))
                there[file] = {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}
            assert function in there[file], f"{promise.name}: {test}"
    assert len(PROMISES) == 15


def test_every_figure_is_measured_by_a_case(report: Report) -> None:
    known = {case.name for case in ROBOT}
    failed = {failure.case for failure in report.failures}
    assert {row.case for row in report.results} | failed == known
    shown: set[str] = set()
    for figure in FIGURES:
        mine = [row for row in report.results if figure.value([row]) is not None]
        assert len(mine) == 1 or (not mine and failed), figure.name
        shown |= {row.case for row in mine}
    assert shown | failed == known  # no case measures what no promise asks for


def test_the_published_page_is_that_of_the_published_report(report: Report) -> None:
    page = (ROOT / "docs" / "reliability.md").read_text(encoding="utf-8")
    made = reliability_page.markdown(report)
    assert page == made, "run: tacsim bench --from benchmarks/reliability.json --docs docs"
    assert "None of this is a safety function" in page and "load average" in page


def cells(name: str, *rows: Row) -> list[str]:
    (found,) = [cells for cells in reliability_page.lines(rows) if cells[1] == name]
    return found[2:]


def test_met_missed_and_a_worst_beyond() -> None:
    name = "standstill, from 50 mm/s"
    assert cells(name, row()) == ["20 ms", "30 ms", "150 ms", "met"]
    assert cells(name, row(figures={"worst_ms": 151.0})) == ["20 ms", "151 ms", "150 ms", "met, worst beyond"]
    assert cells(name, row(error=151.0, figures={"worst_ms": 160.0})) == ["151 ms", "160 ms", "150 ms", "**missed**"]
    assert cells(name) == ["", "", "150 ms", "not measured"]
    counted = row(variant="approach commands", error=1.0, error_unit="count", figures={})
    (figure,) = [each for each in FIGURES if each.value([counted]) is not None]
    assert isinstance(figure, Target) and figure.judge([counted]) == (1.0, "missed")


def test_a_busy_machine_and_a_disturbance_are_told(report: Report) -> None:
    machine = report.metadata.machine
    for load, words in (([0.1, 0, 0], "The machine was idle otherwise"), ([9.0, 0, 0], "**The machine was not idle**")):
        there = machine.model_copy(update={"load_before": load, "load_after": [0.0, 0, 0], "cores": 2})
        config = report.metadata.model_copy(update={"machine": there})
        noted = report.model_copy(update={"metadata": config, "results": [row(note="again")]})
        page = reliability_page.markdown(noted)
        assert words in page and "- `force`: again." in page


def test_the_command_writes_only_the_page_of_its_rows(tmp_path: Path, report: Report) -> None:
    whole = report.model_copy(update={"failures": []})
    (tmp_path / "given.json").write_text(whole.model_dump_json(), encoding="utf-8")
    words = [
        "bench",
        "--from",
        tmp_path / "given.json",
        "--docs",
        tmp_path / "docs",
        "--json",
        tmp_path / "out" / "a.json",
    ]
    result = CliRunner().invoke(app, [str(word) for word in words], env={"COLUMNS": "200", "TERM": "dumb"})
    assert result.exit_code == 0, result.output
    assert [path.name for path in (tmp_path / "docs").iterdir()] == ["reliability.md"]
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["a.json"]


def test_robot_cases_are_asked_for_by_name() -> None:
    assert "robot" in GROUPS
    assert {case.group for case in chosen(["robot"], baselines=False)} == {"robot"}
    assert len({case.name for case in ROBOT}) == len(ROBOT)


def test_the_guard_lets_nothing_out_and_counts_what_it_does(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reliability, "GUARDED", 20_000)
    (case,) = [case for case in ROBOT if case.name == "box_guard"]
    (found,) = measure(case, 5)
    assert (found.error, found.error_unit, found.repeats) == (0.0, "count", 1)
    monkeypatch.setattr(
        reliability, "fractions_inside", lambda starts, *_: np.ones(len(starts))
    )  # a guard that is none
    (broken,) = measure(case, 5)
    assert broken.error > 5_000


def test_hostile_targets_are_hostile() -> None:
    rows = rehearsal.hostile(np.random.default_rng(0), 10_000, bad=0.4)
    broken = ~np.isfinite(rows).all(axis=1)
    assert 0.15 < broken.mean() < 0.35
    outside = rehearsal.config("127.0.0.2").limits.region.excess(np.nan_to_num(rows[:, :3])) > 0
    assert outside.mean() > 0.5
    calm = rehearsal.hostile(np.random.default_rng(0), 1_000, bad=0.0, run=100)[:, :3]
    assert len(np.unique(calm, axis=0)) == 10 and all((a == b).all() for a, b in pairwise(calm[:100]))


def test_it_runs_against_a_mock_and_ends_clean() -> None:
    """One cheap case whole: mock, driver, watcher. Its figures are for the bench, here only that they are there."""
    pytest.importorskip("rtde_control", reason="ur_rtde has no wheel for this Python")
    (case,) = [case for case in ROBOT if case.name == "shutdown"]
    found = {row.variant: row for row in measure(case, 1)}
    assert set(found) == {"close", "left"}
    assert found["left"].error == 0
    assert rehearsal.workers(os.getpid()) == [] and rehearsal.segments(os.getpid()) == 0
