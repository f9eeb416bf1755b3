"""Every public call of ur_rtde 1.6.5 against the mock, each case in a process of its own; the page that says so."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

import pytest

from robot.mock import MockUR
from tests.robot.mock.ur import arm_cases, control_cases, other_cases  # noqa: F401  # they enter CASES
from tests.robot.mock.ur.cases import CASES, CLASSES, Verdict
from tests.robot.mock.wire_client import wire_host

ROOT = Path(__file__).resolve().parents[4]
PAGE = ROOT / "docs" / "mock-calls.md"
BEGIN, END = "<!-- calls of ur_rtde: written by tests/robot/mock/ur/test_calls.py -->\n", "<!-- end of calls -->"
LIMIT = 120.0  # of one client process [s]
QUICK = {"servo", "speeds", "questions", "motion", "load", "dashboard_commands", "dynamics", "refused_connections"}

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("rtde_control") is None, reason="ur_rtde has no wheel for this Python"
)


def public_methods(of: str) -> set[str]:
    found = vars(getattr(import_module(CLASSES[of]), of)).items()
    return {name for name, what in found if not name.startswith("_") and callable(what) and not isinstance(what, type)}


def table() -> str:
    """What the page says: a row for each class and verdict with its own note."""
    lines = ["| Class | Calls | Verdict |", "|---|---|---|"]
    rows: dict[tuple[str, Verdict, str], list[str]] = {}
    for each in CASES.values():
        rows.setdefault((each.of, each.verdict, each.note), []).extend(each.methods)
    classes, verdicts = [*CLASSES], [*Verdict]
    ordered = sorted(rows.items(), key=lambda row: (classes.index(row[0][0]), verdicts.index(row[0][1])))
    for (of, verdict, note), methods in ordered:
        words = f"{verdict.value}: {note}" if note else verdict.value
        lines.append(f"| {of} | {', '.join(f'`{name}`' for name in methods)} | {words} |")
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize("of", CLASSES)
def test_each_public_call_has_a_case(of: str) -> None:
    named = [name for each in CASES.values() if each.of == of for name in each.methods]
    assert len(named) == len(set(named))
    assert public_methods(of) ^ set(named) == set()


def test_page_equals_table_of_cases() -> None:
    page = PAGE.read_text(encoding="utf-8")
    before, rest = page.split(BEGIN)
    _, after = rest.split(END)
    if "WRITE_PAGE" in os.environ:
        PAGE.write_text(f"{before}{BEGIN}{table()}{END}{after}", encoding="utf-8")
    assert rest == f"{table()}{END}{after}", "WRITE_PAGE=1 pytest this test writes the page again"


@pytest.fixture(scope="module")
def called() -> Iterator[MockUR]:
    with MockUR(wire_host(40)) as mock:
        yield mock


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[] if name in QUICK else pytest.mark.deep) for name in CASES]
)
def test_call(called: MockUR, name: str) -> None:
    command = [sys.executable, "-m", "tests.robot.mock.ur.cases", called.host, name]
    done = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT, cwd=ROOT, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert called.running
