"""pytest plugin: figures of what is promised of arms and cameras, recorded by the tests that check the promises.

A test marked `@pytest.mark.promise(n)` may take the fixture `figure` and say what it measured. In `make test` nobody
keeps that; `pytest -m promise --repeat 5 --reliability FILE` runs those tests so often, with the time-outs that are
promised, and writes the report that docs/reliability.md is made from (benchmarks/pages/reliability.py). A test marked
`often` runs four times as often.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any, Protocol

import pytest

OFTEN = 4
COUNT = "count"  # unit of what must not happen even once


class Record(Protocol):
    """What the fixture `figure` is: a call for each figure. `at_most` is what is promised (None: to compare with);
    `promise` is the number, if the test is marked with several. Without a unit something is counted that must not
    happen at all."""

    def __call__(
        self, name: str, value: float, unit: str = COUNT, *, at_most: float | None = 0.0, promise: int | None = None
    ) -> None: ...


def pytest_addoption(parser: pytest.Parser) -> None:
    group = parser.getgroup("reliability")
    group.addoption("--repeat", type=int, metavar="N", help="only tests that record figures, N times each")
    group.addoption("--reliability", type=Path, metavar="FILE", help="write the report of the figures here")


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line("markers", "promise(n): checks promise n of docs/reliability.md")
    config.addinivalue_line("markers", "often: is repeated four times as often where figures are measured")
    if config.getoption("reliability") is not None and not hasattr(
        config, "workerinput"
    ):  # the first process writes it
        config.pluginmanager.register(_Recorder(config.getoption("reliability"), config.getoption("repeat") or 1))


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    repeat = metafunc.config.getoption("repeat")
    if repeat is not None and "figure" in metafunc.fixturenames:
        metafunc.fixturenames.append("repetition")
        often = metafunc.definition.get_closest_marker("often") is not None
        metafunc.parametrize("repetition", range(OFTEN * repeat if often else repeat), indirect=True)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if config.getoption("repeat") is not None:
        left = [item for item in items if "figure" not in getattr(item, "fixturenames", ())]
        config.hook.pytest_deselected(items=left)
        items[:] = [item for item in items if item not in left]


@pytest.fixture
def repetition(request: pytest.FixtureRequest) -> int:
    """Which of the repetitions this is."""
    number: int = request.param
    return number


@pytest.fixture(scope="session")
def measuring(pytestconfig: pytest.Config) -> bool:
    """Whether figures are measured: then time-outs are those of the promises, else such that a busy machine is no
    fault."""
    return pytestconfig.getoption("repeat") is not None


@pytest.fixture
def figure(request: pytest.FixtureRequest) -> Record:
    """Records a figure of the promise that the test is marked with."""
    mark, cpu = request.node.get_closest_marker("promise"), time.process_time()

    def record(
        name: str, value: float, unit: str = COUNT, *, at_most: float | None = 0.0, promise: int | None = None
    ) -> None:
        found = {"promise": promise or mark.args[0], "name": name, "value": float(value), "unit": unit}
        found |= {"at_most": at_most, "cpu_seconds": time.process_time() - cpu}
        request.node.user_properties.append(("figure", found))

    return record


class _Recorder:
    """Collects the figures of a run, and writes the report when it ends."""

    def __init__(self, path: Path, repeat: int) -> None:
        from benchmarks.harness.machine import Run

        self._path, self._repeat, self._run = path, repeat, Run()
        self._figures: list[dict[str, Any]] = []
        self._failures: list[dict[str, str]] = []

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.failed:
            crash = getattr(report.longrepr, "reprcrash", None)
            words = str(report.longrepr if crash is None else crash.message).strip().splitlines()
            cause = f"{report.when}: {words[0] if words else 'no words'}"
            names = {"group": "robot", "case": report.nodeid, "method": "tacsim", "resolution": "mock"}
            self._failures.append({**names, "cause": cause})
        elif report.when == "call":
            test = {"test": report.nodeid.partition("[")[0], "seconds": report.duration}
            found = [value for name, value in report.user_properties if name == "figure"]
            self._figures += [{**test, **value} for value in found if isinstance(value, dict)]

    def pytest_sessionfinish(self) -> None:
        from benchmarks.harness.measure import peak_memory
        from benchmarks.harness.schema import Failure, Report
        from benchmarks.pages.reliability import Figure, rows

        made = Report(
            metadata=self._run.metadata(["robot"], self._repeat, long=self._repeat > 1),
            results=rows((Figure(**found) for found in self._figures), peak_memory()),
            failures=[Failure.model_validate(lost) for lost in self._failures],
        )
        self._path.parent.mkdir(parents=True, exist_ok=True)
        self._path.write_text(made.model_dump_json(indent=1) + "\n", encoding="utf-8")
