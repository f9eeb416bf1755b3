"""CONTRIBUTING.md, the templates, and the workflow file, which does what .ci/run does."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
CI_SCRIPT = (ROOT / ".ci/run").read_text(encoding="utf-8")
WORKFLOW_TEXT = (ROOT / ".github/workflows/ci.yml").read_text(encoding="utf-8")
WORKFLOW: dict[str, Any] = yaml.safe_load(WORKFLOW_TEXT)
JOBS: dict[str, Any] = WORKFLOW["jobs"]
STEPS: list[dict[str, Any]] = [step for job in JOBS.values() for step in job["steps"]]
TEMPLATES = sorted((ROOT / ".github/ISSUE_TEMPLATE").glob("*.yml"))
MAX_LINES = 50  # of a screen
MAKE = re.compile(r"\bmake ([a-z-]+)\b")


def make_targets() -> set[str]:
    """The targets that the Makefile offers."""
    declared = re.search(r"^\.PHONY: (.+)$", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    assert declared is not None
    return set(declared[1].split())


def commands(text: str) -> str:
    """A script without its comments and messages."""
    return "\n".join(line for line in text.splitlines() if not re.match(r"\s*(#|echo\b)", line))


def test_the_page_fits_one_screen_and_says_each_step() -> None:
    assert len(PAGE.splitlines()) <= MAX_LINES
    for step in ("Set up", "Check", "Test", "Add a driver", "Add a task", "Commit"):
        assert f"**{step}" in PAGE


def test_commands_and_paths_on_the_page_exist() -> None:
    assert set(MAKE.findall(PAGE.replace(", and make", ""))) <= make_targets()
    paths = re.findall(r"`(?:\.venv/bin/python )?((?:tests|docs|configs|examples|tacsim)/[\w/.]+)[^`]*`", PAGE)
    assert paths
    assert [path for path in paths if not (ROOT / path).exists()] == []


def test_workflow_makes_the_targets_of_the_ci_script() -> None:
    made = {target for step in STEPS for target in MAKE.findall(step.get("run", ""))}
    assert made == set(MAKE.findall(commands(CI_SCRIPT)))
    assert made <= make_targets()


def test_workflow_tests_each_supported_python() -> None:
    classifiers = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["classifiers"]
    supported = [each.rpartition(" ")[2] for each in classifiers if re.search(r":: 3\.\d+$", each)]
    assert JOBS["test"]["strategy"]["matrix"] == {"python": supported}
    assert "make test PYTHON=python${{ matrix.python }}" in [step.get("run") for step in JOBS["test"]["steps"]]


def test_workflow_may_only_read_and_pins_its_actions() -> None:
    assert WORKFLOW["permissions"] == {"contents": "read"}
    assert [name for name, job in JOBS.items() if "permissions" in job or "timeout-minutes" not in job] == []
    used = [step["uses"] for step in STEPS if "uses" in step]
    assert used
    assert [action for action in used if not re.fullmatch(r"actions/[a-z-]+@v\d+", action)] == []
    assert "secrets" not in WORKFLOW_TEXT


def test_workflow_names_no_host() -> None:
    """Where packages come from is the machine's affair."""
    assert re.findall(r"://|index-url|find-links|\b[\w-]+\.(?:org|com|io|net)\b", WORKFLOW_TEXT) == []


@pytest.mark.parametrize("path", [each for each in TEMPLATES if each.stem != "config"], ids=lambda path: path.stem)
def test_issue_template_is_a_form_with_required_answers(path: Path) -> None:
    form = yaml.safe_load(path.read_text(encoding="utf-8"))
    assert form["name"] and form["description"]
    identifiers = [each["id"] for each in form["body"]]
    assert len(identifiers) == len(set(identifiers))
    assert all(each["attributes"]["label"] for each in form["body"])
    assert any(each.get("validations", {}).get("required") for each in form["body"])
