"""Timing, memory, processes of their own, the cache, the report."""

from __future__ import annotations

import json
import multiprocessing
import os
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
from pydantic import ValidationError

from benchmarks.cases.press import layer_press
from benchmarks.cases.registry import CASES, description, select_cases
from benchmarks.harness import cache, measure
from benchmarks.harness.measure import Measurement, Timing, peak_memory, reset_peak_memory, timed
from benchmarks.harness.runner import NOT_MEASURED, Case, run_cases
from benchmarks.harness.schema import GROUPS, Group, Report, Row, json_schema


def test_the_first_run_is_not_timed(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter(range(100))
    monkeypatch.setattr(measure.time, "perf_counter", lambda: 0.01 * next(clock) ** 2)
    calls: list[int] = []
    timing, last = timed(lambda: calls.append(0) or len(calls), 4)
    assert last == 5 and len(timing.samples) == 4
    assert timing.samples == pytest.approx([0.01, 0.05, 0.09, 0.13])  # each between two looks at the clock


def test_repetitions_stop_at_the_budget_but_one_is_made(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter(range(100))
    monkeypatch.setattr(measure.time, "perf_counter", lambda: 0.6 * measure.BUDGET * next(clock))
    assert len(timed(lambda: 0, 10)[0].samples) == 3  # what a spread needs; two would fill the budget
    assert len(timed(lambda: 0, 2)[0].samples) == 2
    assert len(timed(lambda: 0, 1)[0].samples) == 1
    clock = iter(range(100))
    monkeypatch.setattr(measure.time, "perf_counter", lambda: 1.01 * measure.LONG_REPETITION * next(clock))
    assert len(timed(lambda: 0, 10)[0].samples) == 1


def test_median_and_spread() -> None:
    timing = Timing((5.0, 1.0, 2.0, 4.0, 3.0), 1.0)
    assert timing.median == 3.0 and timing.spread == 2.0
    assert Timing((1.0, 9.0), 1.0).spread is None


@pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="only Linux forgets a peak")
def test_peak_memory_sees_a_large_array_that_is_gone_until_it_is_forgotten() -> None:
    reset_peak_memory()
    before = peak_memory()
    block = bytearray(400_000_000)  # far more than other threads of the process allocate at the same time
    block[::4096] = b"x" * len(block[::4096])
    del block
    assert peak_memory() > before + 250
    reset_peak_memory()
    assert peak_memory() < before + 250


# Importable by name, as a spawned process needs it: json.loads(3) raises, os._exit(3) dies, time.sleep(30) hangs.
RAISES = Case("press", "raises", "tacsim", "none", json.loads)
DIES = Case("press", "dies", "tacsim", "none", os._exit)
HANGS = Case("press", "hangs", "tacsim", "none", time.sleep)
WORKS = Case("press", "sphere_press", "layer", "pixel 0.0625 mm", layer_press)


@pytest.mark.slow
def test_a_case_that_raises_or_dies_is_named_and_the_next_one_runs() -> None:
    report = run_cases([RAISES, DIES, WORKS], 3, baselines=False)
    assert [failure.case for failure in report.failures] == ["raises", "dies"]
    assert "TypeError" in report.failures[0].cause
    assert "exit code 3" in report.failures[1].cause
    (row,) = report.results
    assert 1 <= row.repeats <= 3 and row.seconds > 0 and row.cpu_seconds > 0
    assert 20 < row.peak_mb < 1000
    assert 2 < row.error < 20  # small strain without friction at a quarter of the thickness
    assert report.metadata.machine.cores >= 1 and report.metadata.versions["numpy"]
    assert Report.model_validate_json(report.model_dump_json()) == report


def test_a_report_says_how_long_each_group_took() -> None:
    more = replace(RAISES, group="materials"), replace(DIES, group="scenes", baseline=True), replace(RAISES, long=True)
    config = run_cases([RAISES, *more], 1, baselines=True, long=True).metadata
    assert list(config.group_seconds) == ["press", "materials"]  # other methods and long rows of ours do not count
    assert 0 < sum(config.group_seconds.values()) < config.seconds
    assert "group_seconds" not in json_schema()["$defs"]["Metadata"]["required"]  # older reports have none


@pytest.mark.deep
def test_short_cases_of_a_group_share_a_process_wherever_they_stand(tmp_path: Path) -> None:
    def told(name: str, group: Group = "press", **of: bool) -> Case:
        return Case(group, name, "tacsim", "", partial(tell_process, tmp_path / name), **of)

    cases = [told("a"), told("long", long=True), told("b"), told("peer", baseline=True), told("c", "scenes"), told("d")]
    report = run_cases(cases, 1, baselines=True, long=True)
    assert not report.failures and [row.case for row in report.results] == [case.name for case in cases]
    process = {case.name: (tmp_path / case.name).read_text(encoding="ascii") for case in cases}
    assert process["a"] == process["b"] == process["d"]
    assert len(set(process.values())) == 4


def tell_process(path: Path, repeat: int) -> list[Measurement]:
    path.write_text(str(os.getpid()), encoding="ascii")
    return [Measurement(Timing((1.0,), 1.0), 0.0, "%", "nothing")]


@pytest.mark.slow
def test_a_stop_ends_the_running_case_at_once_and_keeps_the_rows_of_those_before() -> None:
    begun: list[Case] = []
    stopped_at: list[float] = []

    def stop() -> bool:
        if HANGS in begun:
            stopped_at.append(time.perf_counter())
        return bool(stopped_at)

    report = run_cases([WORKS, HANGS, RAISES], 30, baselines=False, on_start=begun.append, stop=stop)
    assert time.perf_counter() - stopped_at[0] < 10
    assert {row.case for row in report.results} == {WORKS.name}
    assert [(failure.case, failure.cause) for failure in report.failures] == [
        (HANGS.name, NOT_MEASURED), (RAISES.name, NOT_MEASURED),
    ]  # fmt: skip
    assert begun == [WORKS, HANGS]
    assert not [child for child in multiprocessing.active_children() if child.name.startswith("SpawnProcess")]


ROW = {
    "group": "press", "case": "a", "method": "tacsim", "resolution": "h", "seconds": 1.0, "spread": None,
    "cpu_seconds": 1.0, "repeats": 1, "error": 0.5, "error_unit": "%", "against": "truth", "peak_mb": 100.0,
}  # fmt: skip


def test_no_row_without_time_error_and_memory() -> None:
    Row.model_validate(ROW)
    for name in ("seconds", "cpu_seconds", "error", "error_unit", "against", "peak_mb"):
        with pytest.raises(ValidationError, match=name):
            Row.model_validate({key: value for key, value in ROW.items() if key != name})


@pytest.mark.parametrize(
    ("name", "value"), [("error", float("nan")), ("seconds", -1.0), ("peak_mb", 0.0), ("group", "x"), ("more", 1)]
)
def test_rows_that_say_nothing_are_refused(name: str, value: object) -> None:
    with pytest.raises(ValidationError, match=name):
        Row.model_validate({**ROW, name: value})


def test_cases_are_distinct_described_and_importable() -> None:
    import pickle

    names = [(case.group, case.name, case.method, case.resolution) for case in CASES]
    assert len(set(names)) == len(names)
    for case in CASES:
        assert description(case.group, case.name, case.method).endswith((".", ":")), case.name
        pickle.dumps(case)  # as it goes to its process


def test_without_baselines_only_short_cases_of_ours() -> None:
    for group in GROUPS:
        if group in ("real", "robot"):  # no cases without frames; measured by tests
            continue
        short = select_cases([group], baselines=False)
        every = select_cases([group], baselines=True, long=True)
        assert short and set(short) <= set(every)
        assert {case.method for case in short} <= {"tacsim", "layer"} and not any(case.long for case in short)
    baselines, long = select_cases(GROUPS, baselines=True), select_cases(GROUPS, baselines=False, long=True)
    assert {case.method for case in baselines} > {"tacsim", "layer"} and not any(case.long for case in baselines)
    assert {case.method for case in long} == {"tacsim", "layer"} and any(case.long for case in long)


def test_the_cache_answers_only_the_same_question_of_the_same_physics(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cache, "folder", lambda: tmp_path)
    asked: list[str] = []

    def answer(value: float) -> list[float]:
        asked.append("")
        return [value]

    assert cache.cached("a", "question", lambda: answer(1.0)) == [1.0]
    assert cache.cached("a", "question", lambda: answer(2.0)) == [1.0]
    assert cache.cached("a", "other question", lambda: answer(3.0)) == [3.0]
    assert len(asked) == 2
    monkeypatch.setattr(cache, "fingerprint", lambda package: "changed physics")
    assert cache.cached("a", "question", lambda: answer(6.0)) == [6.0]
    monkeypatch.undo()
    monkeypatch.setattr(cache, "folder", lambda: tmp_path)
    for kept in tmp_path.iterdir():
        kept.write_text("[1.0", encoding="utf-8")
    assert cache.cached("a", "question", lambda: answer(4.0)) == [4.0]
    monkeypatch.setattr(cache, "folder", lambda: tmp_path / "file.json" / "no folder")
    (tmp_path / "file.json").write_text("", encoding="utf-8")
    assert cache.cached("a", "question", lambda: answer(5.0)) == [5.0]


def test_the_fingerprint_follows_the_sources(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "some_package").mkdir()
    source = tmp_path / "some_package" / "__init__.py"
    source.write_text("", encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    before = cache.fingerprint("some_package")
    assert cache.fingerprint("some_package") == before
    source.write_text("# changed", encoding="utf-8")
    assert cache.fingerprint("some_package") != before


def test_a_report_says_when_the_code_changed_under_it(monkeypatch: pytest.MonkeyPatch) -> None:
    versions = iter(("one", "two", "two", "two"))
    monkeypatch.setattr("benchmarks.harness.machine.fingerprint", lambda *packages: next(versions))
    assert run_cases([], 1, baselines=False).metadata.changed
    assert not run_cases([], 1, baselines=False).metadata.changed
